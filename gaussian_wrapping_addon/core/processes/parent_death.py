# SPDX-License-Identifier: GPL-3.0-or-later
"""Let the system end this process with its parent, where the system can (Linux).

Elsewhere, and as well, a child looks after its caller (:mod:`.process_identity`): that needs the
interpreter, which long native calls may hold.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys

_SET_PARENT_DEATH_SIGNAL = 1
"""``PR_SET_PDEATHSIG`` of prctl(2). The signal comes when the thread that started this process
ends: it must wait for it."""


def end_with_parent() -> None:
    """Have this process killed when the thread that started it ends."""
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    parent = os.getppid()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:  # it died before the call
        os._exit(128 + signal.SIGKILL)
