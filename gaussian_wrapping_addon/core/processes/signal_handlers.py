# SPDX-License-Identifier: GPL-3.0-or-later
"""Keep the handlers of signals where a native library replaces them.

glog, in pycolmap, catches SIGTERM when it is imported: the process then dies with a native trace
instead of the typed end that its own handler would bring.
"""

from __future__ import annotations

import contextlib
import ctypes
import signal
from collections.abc import Iterator

_UNKNOWN = ctypes.c_void_p(-1).value
"""What C returns for a signal without handlers: SIG_ERR."""


@contextlib.contextmanager
def kept_signal_handlers() -> Iterator[None]:
    """Put the handlers of all signals back when the block ends; in any thread.

    ``signal.signal`` works in the main thread only, and Python does not notice what native code
    sets: the handlers are those of the system, as Python's C interface gives them.
    """
    get, put = ctypes.pythonapi.PyOS_getsig, ctypes.pythonapi.PyOS_setsig
    get.argtypes, get.restype = [ctypes.c_int], ctypes.c_void_p
    put.argtypes, put.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_void_p
    numbers = [int(number) for number in signal.valid_signals()]
    before = {number: get(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler != _UNKNOWN and get(number) != handler:
                put(number, handler)
