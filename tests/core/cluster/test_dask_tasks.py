# SPDX-License-Identifier: GPL-3.0-or-later
"""Children by Dask on this computer: side by side, killed, given up, ended with the cluster."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.cluster import dask_tasks
from gaussian_wrapping_addon.core.cluster.dask_tasks import DaskTasks, Ended, request_of
from gaussian_wrapping_addon.core.errors import UsageError, WorkerError
from gaussian_wrapping_addon.core.processes.process_identity import process_alive

pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")
pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="processes are killed by a signal"),
]


@pytest.fixture(scope="module")
def tasks() -> Iterator[DaskTasks]:
    made = DaskTasks("local", 2)
    yield made
    made.close(0.0)


def submit(tasks: DaskTasks, name: str, code: str, folder: Path) -> None:
    request = request_of(folder, "m", {}, [sys.executable, "-c", code])
    tasks.submit(name, f"{name}-{time.time_ns()}", request)


def all_ended(tasks: DaskTasks, count: int) -> dict[str, Ended]:
    found: dict[str, Ended] = {}
    end_s = time.monotonic() + 120.0
    while len(found) < count:
        assert time.monotonic() < end_s
        found |= {end.name: end for end in tasks.ended(1.0)}
    return found


def test_children_run_side_by_side_and_end_as_they_end(tasks: DaskTasks, tmp_path: Path) -> None:
    assert tasks.slots == 2
    meet = (
        "import pathlib,sys,time,json; here = pathlib.Path(json.loads(sys.argv[2])['out']);"
        "(here / sys.argv[1]).touch(); end = time.time() + 60\n"
        "while len(list(here.iterdir())) < 2 and time.time() < end: time.sleep(0.05)\n"
        "raise SystemExit(len(list(here.iterdir())) != 2)"
    )
    for name in ("a", "b"):
        request = request_of(tmp_path, name, {}, [sys.executable, "-c", meet])
        tasks.submit(name, f"{name}-{time.time_ns()}", request)
    assert {end.code for end in all_ended(tasks, 2).values()} == {0}
    submit(tasks, "bad", "raise SystemExit(4)", tmp_path)
    submit(tasks, "killed", "import os; os.kill(os.getpid(), 9)", tmp_path)
    ends = all_ended(tasks, 2)
    assert (ends["bad"].code, ends["killed"].code) == (4, -9)
    assert "signal 9" in ends["killed"].error


def test_what_kills_three_dask_workers_is_given_up(tasks: DaskTasks, tmp_path: Path) -> None:
    count = (
        "import json,os,pathlib,sys,uuid;"
        "pathlib.Path(json.loads(sys.argv[2])['out'], uuid.uuid4().hex).touch();"
        "os.kill(os.getppid(), 9)"
    )
    submit(tasks, "murderer", count, tmp_path)
    end = all_ended(tasks, 1)["murderer"]
    assert "It took 3 Dask workers with it" in end.error
    assert end.code == 1
    assert len(list(tmp_path.iterdir())) == 3
    submit(tasks, "next", "pass", tmp_path)
    assert all_ended(tasks, 1)["next"].code == 0


def test_children_end_with_the_cluster(tmp_path: Path) -> None:
    own = DaskTasks("local", 1)
    nap = (
        "import ctypes,json,os,pathlib,sys,time; ctypes.CDLL(None).prctl(1, 9);"
        "pathlib.Path(json.loads(sys.argv[2])['out'], 'pid').write_text(str(os.getpid()));"
        "time.sleep(300)"
    )
    submit(own, "nap", nap, tmp_path)
    end_s = time.monotonic() + 60.0
    while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
        assert time.monotonic() < end_s
        time.sleep(0.05)
    own.close(0.0)
    pid = int((tmp_path / "pid").read_text())
    while process_alive(pid, 0):
        assert time.monotonic() < end_s
        time.sleep(0.05)


def test_nothing_answers_or_nothing_may_be_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_tasks, "CONNECT_S", 2.0)
    with pytest.raises(WorkerError, match="No Dask scheduler answers at tcp://127"):
        DaskTasks("tcp://127.0.0.1:1", 1)
    with pytest.raises(UsageError, match="is not encrypted"):
        DaskTasks("tcp://192.0.2.1:8786", 1)
    monkeypatch.delenv("GW_CERTIFICATES", raising=False)
    with pytest.raises(UsageError, match="needs certificates"):
        DaskTasks("tls://127.0.0.1:8786", 1)
