# SPDX-License-Identifier: GPL-3.0-or-later
"""Work beside Blender's main thread, and child processes of estimates."""

from __future__ import annotations

import contextlib
import json
import logging
import queue
import subprocess
import threading
import weakref
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import bpy
from bpy.app.handlers import persistent

from ..core.errors import Cancelled, WorkerError
from ..core.worker.environment import not_started
from ..core.worker.spawn import kill_group, spawn

# -- Background work in Blender: threads run tasks, one timer delivers their results --------------
#
# A :class:`Lane` is a thread that runs one :class:`Task` after the other. Tasks touch nothing of
# Blender. Their results and errors are delivered on the main thread by :func:`poll`, the only
# timer of background work, which also calls the functions registered with :func:`watch`. The
# timer never waits and starts no thread: threads are started when work is submitted, or ahead of
# time by :meth:`Lane.start`.


_logger = logging.getLogger(__name__)

POLL_S = 0.3
"""Interval of the timer."""

Result = TypeVar("Result")


class Task(Generic[Result]):
    """One call of a :class:`Lane` and its outcome.

    Parameters
    ----------
    call : callable
        Runs in the lane's thread.
    then : callable, optional
        Receives the result on the main thread. Without it, the caller polls :meth:`finished` and
        reads :meth:`result`.
    failed : callable, optional
        Receives the exception if ``call`` raised one; by default it is logged.
    end : callable, optional
        Called by :meth:`cancel` to end what the call waits for; must not block.
    """

    def __init__(
        self,
        call: Callable[[], Result],
        then: Callable[[Result], None] | None = None,
        failed: Callable[[Exception], None] | None = None,
        end: Callable[[], None] | None = None,
    ) -> None:
        self._call = call
        self._then = then
        self._failed = failed
        self._end = end
        self._results: list[Result] = []
        self._failure: Exception | None = None
        self._ended = threading.Event()
        self._settled = then is None

    def run(self) -> None:
        """Make the call, in the lane's thread."""
        try:
            if self._then is not None and self._settled:
                raise Cancelled()
            self._results.append(self._call())
        except Exception as failure:  # delivered, or raised by result()
            self._failure = failure
        finally:
            self._ended.set()

    def finished(self, wait_s: float = 0.0) -> bool:
        """Return whether the call has ended, waiting up to ``wait_s`` seconds."""
        return self._ended.wait(wait_s)

    def result(self) -> Result:
        """Wait for the call; return its result or raise its exception."""
        self._ended.wait()
        if self._failure is not None:
            raise self._failure
        return self._results[0]

    @property
    def pending(self) -> bool:
        """Whether a result is still to be delivered."""
        return not self._settled

    def cancel(self) -> None:
        """Discard the result; end what the call waits for."""
        if self.pending:
            self._settled = True
            if self._end is not None:
                self._end()

    def deliver(self) -> None:
        """Pass the result or error of a finished call on, once; called by the timer."""
        if self._then is None or self._settled:
            return
        self._settled = True
        failure = self._failure
        try:
            if failure is None:
                self._then(self._results[0])
            elif self._failed is not None:
                self._failed(failure)
            else:
                _logger.error("a background task failed", exc_info=failure)
        except Exception:  # a timer that raises would be dropped silently
            _logger.exception("delivering the result of a background task")


class Lane:
    """A thread that runs one task after the other.

    Starting a thread blocks until it runs, which takes long while a worker keeps all processors
    busy: :meth:`start` does it ahead of time.

    ``of_file``: tasks concern the open file and are cancelled before another one is loaded.
    """

    def __init__(self, *, of_file: bool = False) -> None:
        self.of_file = of_file
        self._calls: queue.SimpleQueue[Task[Any] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._tasks: list[Task[Any]] = []
        _lanes.add(self)

    def start(self) -> None:
        """Start the thread unless it is running."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, args=(self._calls,), daemon=True)
            self._thread.start()

    def submit(
        self,
        call: Callable[[], Result],
        then: Callable[[Result], None] | None = None,
        *,
        failed: Callable[[Exception], None] | None = None,
        end: Callable[[], None] | None = None,
    ) -> Task[Result]:
        """Run a call in the thread; see :class:`Task`."""
        self.start()
        task = Task(call, then, failed, end)
        self._calls.put(task)
        if task.pending:
            self._tasks.append(task)
            start_timer()
        return task

    @property
    def busy(self) -> bool:
        """Whether a result is still to be delivered."""
        return any(task.pending for task in self._tasks)

    def deliver(self) -> None:
        """Deliver finished tasks in order; called by the timer."""
        for task in self._tasks.copy():
            if task.finished():
                task.deliver()
        self._tasks = [task for task in self._tasks if task.pending]

    def cancel(self) -> None:
        """Cancel all pending deliveries; tasks without a receiver still run.

        A busy thread ends after its current task; the next task gets a new thread.
        """
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        if not all(task.finished() for task in tasks):
            self._release()

    def stop(self) -> None:
        """Cancel, and let the thread end after its queued tasks, without waiting for it."""
        self.cancel()
        self._release()

    def _release(self) -> None:
        if self._thread is not None:
            self._calls.put(None)
            self._calls, self._thread = queue.SimpleQueue(), None

    @staticmethod
    def _work(calls: queue.SimpleQueue[Task[Any] | None]) -> None:
        while (task := calls.get()) is not None:
            task.run()


_lanes: weakref.WeakSet[Lane] = weakref.WeakSet()
_watched: list[Callable[[], bool]] = []


def watch(function: Callable[[], bool]) -> None:
    """Call a function at every tick, on the main thread, as long as it returns true."""
    if function not in _watched:
        _watched.append(function)
    start_timer()


def start_timer() -> None:
    """Register :func:`poll` as a timer."""
    if not bpy.app.timers.is_registered(poll):
        bpy.app.timers.register(poll, first_interval=POLL_S, persistent=True)


def poll() -> float | None:
    """Timer: deliver finished tasks, call watched functions; return seconds to the next tick."""
    for function in _watched.copy():
        _watched.remove(function)
        if _continues(function) and function not in _watched:
            _watched.append(function)
    for lane in list(_lanes):
        lane.deliver()
    return POLL_S if _watched or any(lane.busy for lane in _lanes) else None


def _continues(function: Callable[[], bool]) -> bool:
    try:
        return function()
    except Exception:  # a timer that raises would be dropped silently
        _logger.exception("background timer")
        return False


@persistent
def before_load(*_arguments: object) -> None:
    """``load_pre``: cancel the tasks that concern the open file."""
    for lane in list(_lanes):
        if lane.of_file:
            lane.cancel()


def stop() -> None:
    """Remove the timer and cancel everything; threads end after their current task."""
    if bpy.app.timers.is_registered(poll):
        bpy.app.timers.unregister(poll)
    _watched.clear()
    lanes = list(_lanes)
    for lane in lanes:  # first: the end of a task may need another lane
        lane.cancel()
    for lane in lanes:
        lane.stop()


# -- Estimates by the worker's Python: run a child process and parse its output, or end it --------


_endings = Lane()


def get_ready() -> None:
    """Start the thread that ends children, ahead of a timer that uses it."""
    _endings.start()


class Child:
    """A child process that can be cancelled before it has answered."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self._guard = threading.Lock()
        self._wanted = True

    def run(
        self, command: list[str], deadline_s: float, late: WorkerError | None = None
    ) -> tuple[list[dict[str, Any]], str]:
        """Run a child to its end, in a thread; touches nothing of Blender.

        ``late``: raised where it takes too long, in place of the error of an estimate.
        Returns ``messages``: JSON objects from standard output, one a line; ``last_words``: the
        last line of standard error.
        Raises WorkerError: the child does not start, or takes too long.
        """
        try:
            process = spawn(command)
        except OSError as error:
            raise not_started(command[0], error) from None
        with self._guard:
            self.process = process
            wanted = self._wanted
        if not wanted:
            kill_group(process)
        try:
            output, words = process.communicate(timeout=deadline_s)
        except subprocess.TimeoutExpired:
            kill_group(process)
            too_long = WorkerError("The estimate took too long.", "Start the job without it.")
            raise late or too_long from None
        found = []
        for line in output.decode(errors="replace").splitlines():
            with contextlib.suppress(ValueError):
                found.append(json.loads(line))
        last = words.decode(errors="replace").strip().splitlines()
        return [v for v in found if isinstance(v, dict)], last[-1] if last else ""

    def end(self) -> None:
        """Cancel: end the process in the background, or as soon as it has started."""
        with self._guard:
            self._wanted = False
            process = self.process
        if process is not None and process.poll() is None:
            _endings.submit(lambda: kill_group(process))
