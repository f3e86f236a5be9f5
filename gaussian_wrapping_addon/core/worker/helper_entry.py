# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry point of a helper process: set the memory limit, run the module, report failures."""

from __future__ import annotations

import importlib
import os
import threading
import time
from pathlib import Path

from ..errors import WrapError
from .environment import package_error
from .helper_process import FAILURES, emit, limit_address_space, own_peak_bytes
from .spawn import Caller, end_with_parent

_PARENT_POLL_S = 1.0


def main(arguments: list[str]) -> int:
    """Run ``arguments = [module, folder, memory_bytes]``; return the exit code."""
    module, folder, memory_bytes = arguments[0], Path(arguments[1]), int(arguments[2])
    if memory_bytes:
        limit_address_space(memory_bytes)
    caller = Caller()
    end_with_parent()  # while a native call holds the GIL, no thread of ours can poll
    threading.Thread(target=_exit_with_caller, args=(caller,), daemon=True).start()
    try:
        package = __name__.rpartition(".worker.")[0]
        importlib.import_module(f"{package}.{module}").main(folder)
    except WrapError as error:
        return _tell(error)
    except ImportError as error:
        missing = package_error(error)
        if missing is None:
            raise
        return _tell(missing)
    finally:
        emit(peak_bytes=own_peak_bytes())
    return 0


def _tell(error: WrapError) -> int:
    names = (kind.__name__ for kind in type(error).__mro__)
    kind = next((name for name in names if name in FAILURES), "")
    emit(error=error.message, hint=error.hint, kind=kind)
    return error.exit_code


def _exit_with_caller(caller: Caller) -> None:
    """Exit when the worker has ended: a helper must not outlive it."""
    while not caller.ended():
        time.sleep(_PARENT_POLL_S)
    os._exit(1)
