# SPDX-License-Identifier: GPL-3.0-or-later
"""The one place where pycolmap is imported."""

from __future__ import annotations

import sys
import threading
from typing import Any

from ..processes.signal_handlers import kept_signal_handlers

_importing = threading.Lock()


def import_pycolmap() -> Any:
    """Return the module pycolmap; the worker's handling of SIGTERM stays as it is.

    Its own log goes to stderr, not to files.

    Raises
    ------
    ImportError
        It is not installed.
    """
    # One thread at a time: another one would take the half imported module, or the handlers that it
    # has just set for those to keep.
    with _importing:
        if "pycolmap" in sys.modules:
            return sys.modules["pycolmap"]
        with kept_signal_handlers():
            import pycolmap

        # Its warnings would otherwise fill the folder for temporary files, one file a process.
        pycolmap.logging.logtostderr = True
        return pycolmap
