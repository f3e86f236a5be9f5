# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands of the worker in this process: a case then takes no seconds to start a Python.

The child's module gets the same request and its lines are read back in the same way. What is left
out is the process itself, which ``tests/core/jobs/test_wrong_python.py`` and others test.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
import traceback
from collections.abc import Iterator
from unittest import mock

from gaussian_wrapping_addon.core.errors import EXIT_OTHER
from gaussian_wrapping_addon.core.jobs.commands import run_in_worker
from gaussian_wrapping_addon.core.worker.spawn import Caller

_CORE = "gaussian_wrapping_addon.core"


class _Ended:
    """Stands for a child that has ended, with what it wrote."""

    def __init__(self, command: list[str], **_: object) -> None:
        module, request = command[-2:]
        output = io.StringIO()
        try:
            with contextlib.redirect_stdout(output):
                self._code = importlib.import_module(f"{_CORE}.{module}").main([request])
        except Exception:
            traceback.print_exc(file=sys.stderr)
            self._code = EXIT_OTHER
        self.stdout = [line.encode() for line in output.getvalue().splitlines(keepends=True)]

    def wait(self) -> int:
        return self._code

    def poll(self) -> int:
        return self._code


def _watch_nobody(_caller: Caller) -> None:
    """Stand for the thread that ends a child with its caller."""


@contextlib.contextmanager
def workers_in_this_process() -> Iterator[None]:
    """Run what ``run_in_worker`` starts in this process while the block runs."""
    with (
        mock.patch.object(run_in_worker, "spawn", _Ended),
        mock.patch.object(run_in_worker, "exit_with_caller", _watch_nobody),
    ):
        yield
