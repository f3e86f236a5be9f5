# SPDX-License-Identifier: GPL-3.0-or-later
"""Children by Dask on this computer: side by side, killed, given up, ended with the cluster."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import UsageError, WorkerError
from gaussian_wrapping_addon.core.farm import dask
from gaussian_wrapping_addon.core.farm.dask import DaskTasks, Ended, FarmLostError, request_of
from gaussian_wrapping_addon.core.worker.spawn import process_alive

pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")


pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="processes are killed by a signal")
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


@pytest.mark.proof
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
    assert 2 <= len(list(tmp_path.iterdir())) <= 3  # one may have died before it wrote
    submit(tasks, "next", "pass", tmp_path)
    assert all_ended(tasks, 1)["next"].code == 0


def test_a_worker_that_refuses_is_not_asked_again_while_there_is_another(tmp_path: Path) -> None:
    tasks = DaskTasks("local", 2)
    asked = (
        "import json,os,pathlib,sys,uuid; here = pathlib.Path(json.loads(sys.argv[2])['out']);"
        "(here / f'{os.getppid()}-{uuid.uuid4().hex}').touch();"
        "raise SystemExit({code})"
    )
    submit(tasks, "refused", asked.replace("{code}", "3"), tmp_path)
    assert all_ended(tasks, 1)["refused"].code == 3
    assert len(tasks._fit()) == 1
    (refusing,) = tmp_path.iterdir()
    refusing.unlink()
    for number in range(6):
        submit(tasks, f"next{number}", asked.replace("{code}", "0"), tmp_path)
        assert all_ended(tasks, 1)[f"next{number}"].code == 0
    workers = [path.name.partition("-")[0] for path in tmp_path.iterdir()]
    assert len(workers) == 6
    assert refusing.name.partition("-")[0] not in workers
    # If the other one ends, what waits for it goes where it can.
    once = (
        "import json,os,pathlib,sys; here = pathlib.Path(json.loads(sys.argv[2])['out'], 'once')\n"
        "if not here.exists(): here.touch(); os.kill(os.getppid(), 9)"
    )
    submit(tasks, "once", once, tmp_path)
    assert all_ended(tasks, 1)["once"].code == 0
    assert (tmp_path / "once").exists()
    tasks.close(0.0)


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


def test_a_cluster_whose_workers_have_all_ended_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask, "_LOOK_S", 0.1)
    monkeypatch.setattr(dask, "_NONE_S", 0.3)
    own = DaskTasks("local", 1)
    monkeypatch.setattr(own, "_workers", dict)  # as if their start had failed
    submit(own, "nap", "import time; time.sleep(60)", tmp_path)
    with pytest.raises(FarmLostError, match="have ended"):
        own.ended(30.0)
    own.close(0.0)


@pytest.mark.proof
def test_a_scheduler_that_is_gone_is_told_whatever_is_asked(tmp_path: Path) -> None:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{found.getsockname()[1]}"
    scheduler = "from distributed.cli.dask_scheduler import main; main()"
    words = [sys.executable, "-c", scheduler, "--host", address, "--no-dashboard"]
    with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
        end_s = time.monotonic() + 60.0
        while (own := connected(address)) is None:
            assert time.monotonic() < end_s
        process.kill()
    submit_until_lost(own, tmp_path)
    with pytest.raises(FarmLostError, match="is gone"):
        submit(own, "b", "pass", tmp_path)
    own.close(0.0)


def submit_until_lost(tasks: DaskTasks, folder: Path) -> None:
    """Do what a walk does: ask for room, submit, wait."""
    for number in range(240):
        assert tasks.slots == 1  # a worker may still come
        try:
            submit(tasks, f"a{number}", "pass", folder)
            tasks.ended(0.5)
        except FarmLostError:
            return
    raise AssertionError("nobody has noticed")


def connected(address: str) -> DaskTasks | None:
    try:
        return DaskTasks(address, 1)
    except WorkerError:
        return None


def test_nothing_answers_or_nothing_may_be_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask, "CONNECT_S", 2.0)
    with pytest.raises(WorkerError, match="No Dask scheduler answers at tcp://127"):
        DaskTasks("tcp://127.0.0.1:1", 1)
    with socket.create_server(("127.0.0.1", 0)) as hung:  # the system accepts, nobody answers
        address = f"tcp://127.0.0.1:{hung.getsockname()[1]}"
        with pytest.raises(WorkerError, match=f"No Dask scheduler answers at {address} .no answer"):
            DaskTasks(address, 1)
    with pytest.raises(UsageError, match="is not encrypted"):
        DaskTasks("tcp://192.0.2.1:8786", 1)
    monkeypatch.delenv("GW_CERTIFICATES", raising=False)
    with pytest.raises(UsageError, match="needs certificates"):
        DaskTasks("tls://127.0.0.1:8786", 1)
