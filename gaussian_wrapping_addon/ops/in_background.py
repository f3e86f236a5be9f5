# SPDX-License-Identifier: GPL-3.0-or-later
"""Work that waits for disks, done in a thread, so that Blender goes on meanwhile."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

Answer = TypeVar("Answer")


class InBackground(Generic[Answer]):
    """One call of a :class:`Lane`, and what comes of it."""

    def __init__(self, call: Callable[[], Answer]) -> None:
        self._call = call
        self._answers: list[Answer] = []
        self._failure: Exception | None = None
        self._ended = threading.Event()

    def run(self) -> None:
        """Do it; the lane's thread does."""
        try:
            self._answers.append(self._call())
        except Exception as failure:  # raised where somebody waits for it
            self._failure = failure
        self._ended.set()

    def finished(self, wait_s: float = 0.0) -> bool:
        """Tell whether :meth:`answer` has one, or gets one within a time."""
        return self._ended.wait(wait_s)

    def answer(self) -> Answer:
        """Return what the call returned, or raise what it raised; waits for it."""
        self._ended.wait()
        if self._failure is not None:
            raise self._failure
        return self._answers[0]


class Lane:
    """A thread that does one call after the other.

    It is started once, ahead of time: to start a thread is to wait for it, which takes long where
    a worker keeps all processors busy.
    """

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[InBackground[Any] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread where it does not run yet."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, args=(self._calls,), daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Let the thread end after what it has to do; nobody waits for it."""
        if self._thread is not None:
            self._calls.put(None)
            self._calls, self._thread = queue.SimpleQueue(), None

    def run(self, call: Callable[[], Answer]) -> InBackground[Answer]:
        """Have something done; it touches nothing of Blender."""
        self.start()
        work = InBackground(call)
        self._calls.put(work)
        return work

    @staticmethod
    def _work(calls: queue.SimpleQueue[InBackground[Any] | None]) -> None:
        while (work := calls.get()) is not None:
            work.run()
