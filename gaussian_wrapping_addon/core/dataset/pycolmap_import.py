# SPDX-License-Identifier: GPL-3.0-or-later
"""The one place where pycolmap is imported."""

from __future__ import annotations

import sys
from typing import Any

from ..processes.signal_handlers import kept_signal_handlers


def import_pycolmap() -> Any:
    """Return the module pycolmap; the worker's handling of SIGTERM stays as it is.

    Raises
    ------
    ImportError
        It is not installed.
    """
    known = sys.modules.get("pycolmap")
    if known is not None:
        return known
    with kept_signal_handlers():
        import pycolmap

    return pycolmap
