# SPDX-License-Identifier: GPL-3.0-or-later
"""Work that waits for disks, done in a thread, so that Blender goes on meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Answer = TypeVar("Answer")


class InBackground(Generic[Answer]):
    """One call that runs in a thread of its own, from now on.

    Parameters
    ----------
    call : callable
        Takes nothing and touches nothing of Blender; what it returns is kept.
    """

    def __init__(self, call: Callable[[], Answer]) -> None:
        self._call = call
        self._answers: list[Answer] = []
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._answers.append(self._call())
        except Exception as failure:  # raised where somebody waits for it
            self._failure = failure

    def finished(self, wait_s: float = 0.0) -> bool:
        """Tell whether :meth:`answer` has one, or gets one within a time."""
        self._thread.join(wait_s)
        return not self._thread.is_alive()

    def answer(self) -> Answer:
        """Return what the call returned, or raise what it raised; waits for it."""
        self._thread.join()
        if not self._answers:
            raise self._failure or RuntimeError("the call has ended without a word")
        return self._answers[0]
