# SPDX-License-Identifier: GPL-3.0-or-later
"""Set-up without network from tiny wheels: whole, cancelled, repaired, removed, refused."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core import worker_environment
from gaussian_wrapping_addon.core.errors import EXIT_RESOURCES, UsageError
from gaussian_wrapping_addon.core.helper_process import child_command
from gaussian_wrapping_addon.core.jobs import client as job_client
from gaussian_wrapping_addon.core.jobs.doctor import find_and_diagnose
from gaussian_wrapping_addon.core.jobs.job_folder import JobStatus, process_alive
from gaussian_wrapping_addon.core.setup import install, pythons
from gaussian_wrapping_addon.core.setup.client import SetupClient
from gaussian_wrapping_addon.core.setup.commands import SetupRequest
from gaussian_wrapping_addon.core.setup.examine import GOOD, examine_worker
from tests.core.setup.wheels import write_wheel

DEADLINE_S = 100.0


def finish(request: SetupRequest) -> JobStatus:
    return SetupClient.start(request).wait(DEADLINE_S)


def site_packages(request: SetupRequest) -> Path:
    (found,) = request.environment.venv.glob("[Ll]ib/**/site-packages")
    return found


def own_packages() -> dict[str, float]:
    """Every distribution of the Python that runs the tests, with the time of its folder."""
    return {
        str(d.locate_file("")) + d.metadata["Name"]: os.stat(d._path).st_mtime  # type: ignore[attr-defined]
        for d in importlib.metadata.distributions()
    }


def imported(request: SetupRequest, module: str) -> str:
    """Ask the environment for a module's version, in the way a worker is started."""
    command = child_command("jobs.doctor", python=request.environment.worker())
    entry = command.index("-u")
    code = (
        "import sys; f = sys._xoptions.get('gwrap_packages'); f and sys.path.insert(0, f);"
        f"import {module}; print({module}.VERSION)"
    )
    done = subprocess.run(
        [*command[:entry], "-c", code], capture_output=True, text=True, check=False
    )
    return done.stdout.strip()


@pytest.mark.slow
def test_a_whole_life(request_: SetupRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set up offline, find, break, repair, remove; the own Python stays as it is."""
    before = own_packages()
    client = SetupClient.start(request_)
    seen = []
    while (status := client.poll()).active:
        seen.append((status.stage, status.fraction))
        time.sleep(0.02)
    assert status.state == "DONE", status
    fractions = [f for _, f in seen]
    assert fractions == sorted(fractions)
    assert {"environment", "install"} <= {stage for stage, _ in seen}
    environment = request_.environment
    assert environment.is_ready()
    assert json.loads(environment.ready_path.read_text()) == {"gwalpha": "1.2", "gwbeta": "0.9"}
    assert imported(request_, "gwalpha") == "1.2"
    assert imported(request_, "gwgamma") == "1.0", "what a package needs came too"
    assert not (environment.root / "tmp").exists()
    assert own_packages() == before

    # It is found, after a preference and the variable, and before the own Python.
    monkeypatch.delenv(job_client.PYTHON_VARIABLE, raising=False)
    assert job_client.worker_python() == str(environment.venv_python)
    assert job_client.worker_python(sys.executable) == sys.executable
    monkeypatch.setenv(job_client.PYTHON_VARIABLE, sys.executable)
    assert job_client.worker_python() == sys.executable
    monkeypatch.delenv(job_client.PYTHON_VARIABLE)

    # A file of one package and the whole of another go: the set-up mends both.
    packages = site_packages(request_)
    (packages / "gwalpha" / "data.txt").unlink()
    shutil.rmtree(packages / "gwbeta")
    shutil.rmtree(next(packages.glob("gwbeta-*.dist-info")))
    states = examine_worker(environment.worker(), Path(request_.requirements))
    assert [s.state for s in states] == ["broken", "missing"]
    repair = install.repair_request(replace(request_, python="", torch="cuda"))
    assert (repair.torch, repair.repair) == ("cpu", True)
    assert os.path.realpath(repair.python) == os.path.realpath(
        json.loads(environment.marker_path.read_text())["python"]
    )
    assert finish(repair).state == "DONE"
    assert (packages / "gwalpha" / "data.txt").is_file()
    states = examine_worker(environment.worker(), Path(request_.requirements))
    assert {s.state for s in states} == {GOOD}

    install.remove(environment)
    assert not environment.root.exists()
    assert job_client.worker_python() == sys.executable
    assert own_packages() == before


def test_a_cancelled_set_up_is_not_believed_and_goes_on(
    quick: SetupRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = SetupClient.start(quick)
    while not quick.environment.marker_path.exists():
        assert client.poll().active
        time.sleep(0.02)
    client.cancel()
    status = client.wait(20)
    assert status.state == "CANCELLED", status
    assert quick.environment.is_half()
    worker_environment.remember(Path(quick.root))
    monkeypatch.delenv(job_client.PYTHON_VARIABLE, raising=False)
    monkeypatch.setattr(job_client, "_has_torch", lambda: False)
    with pytest.raises(UsageError, match=r"only half set up.*Set Up Worker"):
        job_client.worker_python()
    assert [d.subject for d in find_and_diagnose()] == ["Environment", "Worker"]
    assert finish(quick).state == "DONE"
    assert job_client.worker_python() == quick.root


def test_a_set_up_ends_with_the_one_who_asked(request_: SetupRequest) -> None:
    """Quitting Blender in the middle leaves neither a process nor a believed environment."""
    code = (
        "import sys, json, time, pathlib\n"
        f"sys.path.insert(0, {str(Path(install.__file__).parents[3])!r})\n"
        "from gaussian_wrapping_addon.core.setup.client import SetupClient\n"
        "from gaussian_wrapping_addon.core.setup.commands import SetupRequest\n"
        "request = SetupRequest(**json.loads(sys.argv[1]))\n"
        "client = SetupClient.start(request)\n"
        "while not request.environment.marker_path.exists(): time.sleep(0.01)\n"
    )
    subprocess.run([sys.executable, "-c", code, json.dumps(request_.to_json())], check=True)
    end_s = time.monotonic() + 20
    path = Path(request_.root) / "status.json"
    while (status := json.loads(path.read_text()))["state"] == "RUNNING":
        assert time.monotonic() < end_s
        time.sleep(0.05)
    assert status["state"] == "CANCELLED"
    while process_alive(status["pid"], status["pid_started"]):
        assert time.monotonic() < end_s
        time.sleep(0.05)
    assert request_.environment.is_half()


def test_a_missing_wheel_is_named(quick: SetupRequest) -> None:
    next(Path(quick.find_links).glob("gwbeta*")).unlink()
    status = finish(quick)
    assert status.state == "FAILED"
    assert "No wheel of gwbeta" in status.error
    assert "wheel folder" in status.hint
    assert status.exit_code == EXIT_RESOURCES
    assert quick.environment.is_half()
    assert "gwbeta" in (Path(quick.root) / "log.txt").read_text()


def test_another_version_is_replaced(quick: SetupRequest) -> None:
    """Where no venv can be made (Blender's own Python on Windows), only the child sees packages."""
    assert finish(quick).state == "DONE"
    environment = quick.environment
    assert environment.marker()["kind"] == "packages"
    assert environment.is_ready()
    assert environment.worker() == quick.root
    assert not environment.venv.exists()
    assert child_command("jobs.doctor", python=quick.root)[:2] == [quick.python, "-I"]
    assert imported(quick, "gwalpha") == "1.2"
    plain = subprocess.run(
        [quick.python, "-I", "-c", "import gwalpha"], capture_output=True, check=False
    )
    assert plain.returncode != 0
    write_wheel(Path(quick.find_links), "gwalpha", "1.3")
    Path(quick.requirements).write_text("gwalpha==1.3\ngwbeta\n")
    (state, _) = examine_worker(environment.worker(), Path(quick.requirements))
    assert state.state == "wrong version"
    assert finish(quick).state == "DONE"
    assert imported(quick, "gwalpha") == "1.3"


def test_the_pip_that_ensurepip_carries_will_do(
    request_: SetupRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = pythons.probe(sys.executable)
    if not real.has_ensurepip:
        pytest.skip("this Python has no ensurepip")
    bare = replace(real, has_venv=False, has_pip=False)
    Path(request_.root).mkdir()
    monkeypatch.setattr(install, "probe", lambda _path: bare)
    install.set_up(request_, lambda *_words: None, lambda: False)
    assert imported(request_, "gwbeta") == "0.9"


def test_only_what_we_made_is_removed(request_: SetupRequest) -> None:
    folder = Path(request_.root)
    (folder / "env").mkdir(parents=True)
    (folder / "env" / "thesis.txt").write_text("mine")
    with pytest.raises(UsageError, match="not made by this add-on"):
        install.remove(request_.environment)
    with pytest.raises(UsageError, match="holds other files"):
        SetupClient.start(request_)
    assert [p.name for p in folder.iterdir()] == ["env"], "nothing of ours is left there"
    assert (folder / "env" / "thesis.txt").read_text() == "mine"


def test_what_lies_beside_it_stays(request_: SetupRequest) -> None:
    folder = Path(request_.root)
    folder.mkdir()
    request_.environment.marker_path.write_text('{"made_by": "gaussian_wrapping_addon"}')
    (folder / "notes.txt").write_text("mine")
    elsewhere = folder.parent / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "kept.txt").touch()
    request_.environment.venv.symlink_to(elsewhere, target_is_directory=True)
    install.remove(request_.environment)
    assert [p.name for p in folder.iterdir()] == ["notes.txt"]
    assert (elsewhere / "kept.txt").is_file()


def test_a_folder_of_wheels_that_is_not_there(request_: SetupRequest) -> None:
    with pytest.raises(UsageError, match="does not exist"):
        SetupClient.start(replace(request_, find_links=request_.find_links + "x"))
    assert not Path(request_.root).exists()


def test_two_set_ups_at_once(request_: SetupRequest) -> None:
    first = SetupClient.start(request_)
    while not (Path(request_.root) / "lock.json").exists():
        time.sleep(0.02)
    with pytest.raises(UsageError, match="is running"):
        SetupClient.start(request_)
    with pytest.raises(UsageError, match=r"is running|not made by"):
        install.remove(request_.environment)
    first.cancel()
    assert first.wait(20).state == "CANCELLED"
