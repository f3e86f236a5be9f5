# SPDX-License-Identifier: GPL-3.0-or-later
"""Background work: threads do it, the one timer delivers it on Blender's main thread."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator

import bpy
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.ops import background
from gaussian_wrapping_addon.ops.background import Lane
from tests.blender.job_play import play_background

WAIT_S = 20.0


@pytest.fixture
def lane() -> Iterator[Lane]:
    yield Lane()
    background.stop()


@pytest.fixture
def gate() -> Iterator[threading.Event]:
    """What keeps a task at work until it is set."""
    event = threading.Event()
    yield event
    event.set()


def test_results_and_errors_are_delivered_in_order_on_the_main_thread(
    lane: Lane, caplog: pytest.LogCaptureFixture
) -> None:
    told: list[object] = []

    def tell(what: object) -> None:
        told.append((threading.current_thread() is threading.main_thread(), what))

    lane.submit(threading.get_ident, lambda ident: tell(ident != threading.get_ident()))
    lane.submit(lambda: 1 // 0, tell, failed=lambda error: tell(type(error)))
    lane.submit(lambda: 3, tell)
    with caplog.at_level(logging.ERROR):
        lane.submit(lambda: 1 // 0, tell)
        lane.submit(lambda: 4, lambda _: 1 // 0)
        lane.submit(lambda: 5, tell)
        assert lane.busy
        assert bpy.app.timers.is_registered(background.poll)
        play_background()
    assert told == [(True, True), (True, ZeroDivisionError), (True, 3), (True, 5)]
    assert caplog.text.count("ZeroDivisionError") == 2, "of a call and of a receiver"
    assert not lane.busy


def test_a_tick_waits_for_nothing(lane: Lane, gate: threading.Event) -> None:
    told: list[bool] = []
    lane.submit(lambda: gate.wait(WAIT_S), told.append)
    begun_s = time.perf_counter()
    for _ in range(10):
        assert background.poll() == background.POLL_S
    assert time.perf_counter() - begun_s < 1.0
    assert told == []
    gate.set()
    play_background()
    assert told == [True]


def test_who_asks_for_it_gets_the_result_itself(lane: Lane, gate: threading.Event) -> None:
    task = lane.submit(lambda: gate.wait(WAIT_S))
    failing = lane.submit(lambda: 1 // 0)
    assert not task.finished()
    assert background.poll() is None, "nothing is to be delivered"
    gate.set()
    assert task.result() is True
    with pytest.raises(ZeroDivisionError):
        failing.result()


def test_cancelled_tasks_are_not_run_and_not_delivered(lane: Lane, gate: threading.Event) -> None:
    told: list[object] = []
    begun = threading.Event()

    def work() -> str:
        begun.set()
        gate.wait(WAIT_S)
        return "late"

    running = lane.submit(work, told.append, end=lambda: told.append("ended"))
    waiting = lane.submit(lambda: told.append("run"), told.append, end=gate.set)
    assert begun.wait(WAIT_S)
    lane.cancel()
    assert told == ["ended"]
    assert not lane.busy
    lane.submit(lambda: "next", told.append)
    play_background()
    assert told == ["ended", "next"], "the next one did not wait for the one that was given up"
    assert running.result() == "late"
    with pytest.raises(Cancelled):
        waiting.result()
    running.cancel()
    background.poll()
    assert told == ["ended", "next"], "once"


def test_another_file_cancels_what_is_about_this_one(addon: object, gate: threading.Event) -> None:
    told: list[object] = []
    lanes = Lane(of_file=True), Lane()
    for name, lane in zip(("file", "machine"), lanes, strict=True):
        lane.submit(lambda: gate.wait(WAIT_S), lambda _, n=name: told.append(n))
    bpy.ops.wm.read_homefile(use_empty=True)
    assert [lane.busy for lane in lanes] == [False, True]
    gate.set()
    play_background()
    assert told == ["machine"]


def test_nothing_is_left_when_the_addon_is_disabled(addon: object, gate: threading.Event) -> None:
    addon.unregister()  # type: ignore[attr-defined]
    before = set(threading.enumerate())
    addon.register()  # type: ignore[attr-defined]
    told: list[object] = []
    done: list[str] = []
    lane, other = Lane(), Lane()
    # What ends a task may need another lane, and is done all the same.
    lane.submit(lambda: gate.wait(WAIT_S), told.append, end=lambda: other.submit(end) and None)

    def end() -> None:
        gate.set()
        done.append("ended")

    addon.unregister()  # type: ignore[attr-defined]
    assert not bpy.app.timers.is_registered(background.poll)
    play_background(lambda: set(threading.enumerate()) <= before)
    assert background.poll() is None
    assert (told, done) == ([], ["ended"])


def test_what_is_watched_is_called_until_it_is_done(caplog: pytest.LogCaptureFixture) -> None:
    calls: list[str] = []

    def twice() -> bool:
        calls.append("twice")
        if len(calls) == 1:
            background.watch(once)
        return calls.count("twice") < 2

    def once() -> bool:
        calls.append("once")
        raise ValueError("broken")

    background.watch(twice)
    background.watch(twice)
    with caplog.at_level(logging.ERROR):
        assert background.poll() == background.POLL_S
        assert background.poll() is None
    assert sorted(calls) == ["once", "twice", "twice"]
    assert "ValueError: broken" in caplog.text
    background.stop()


def test_deliveries_start_no_thread(
    addon: object, lane: Lane, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lane that was started ahead takes work from a timer as it is."""
    told: list[int] = []
    second = Lane()
    second.start()
    lane.submit(lambda: 1, lambda value: second.submit(lambda: value + 1, told.append) and None)

    def refuse(_thread: threading.Thread) -> None:
        raise AssertionError("the timer starts a thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    play_background()
    assert told == [2]
