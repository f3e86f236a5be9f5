# SPDX-License-Identifier: GPL-3.0-or-later
"""Set-up without network from tiny wheels: complete, cancelled, replaced, removed, invalid."""

from __future__ import annotations

import importlib.metadata
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.command_line import setup_command
from gaussian_wrapping_addon.core.errors import (
    EXIT_CANCELLED,
    EXIT_RESOURCES,
    EXIT_USAGE,
    UsageError,
)
from gaussian_wrapping_addon.core.jobs import client as job_client
from gaussian_wrapping_addon.core.jobs import install
from gaussian_wrapping_addon.core.jobs.commands.doctor import find_and_diagnose
from gaussian_wrapping_addon.core.jobs.install import SetupRequest, SetupTask
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.worker.environment import WorkerEnvironment, interpreter_of
from gaussian_wrapping_addon.core.worker.helper_process import child_command
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from tests.core.setup.wheels import write_wheel

DEADLINE_S = 100.0


def finish(request: SetupRequest) -> JobStatus:
    task = SetupTask(request)
    task.start()
    task.join(DEADLINE_S)
    return task.status


def own_packages() -> dict[str, float]:
    """Every distribution of the Python that runs the tests, with the time of its folder."""
    return {
        str(d.locate_file("")) + d.metadata["Name"]: os.stat(d._path).st_mtime  # type: ignore[attr-defined]
        for d in importlib.metadata.distributions()
    }


def imported(request: SetupRequest, module: str) -> str:
    """Ask the environment for a module's version, in the way a worker is started."""
    command = child_command("jobs.commands.doctor", python=request.environment.worker())
    code = (
        "import sys; f = sys._xoptions.get('gwrap_packages'); f and sys.path.insert(0, f);"
        f"import {module}; print({module}.VERSION)"
    )
    words = [*command[: command.index("-u")], "-c", code]
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip()


def until(happened: Callable[[], object]) -> None:
    end_s = time.monotonic() + 30
    while not happened():
        assert time.monotonic() < end_s
        time.sleep(0.02)


@pytest.mark.slow
def test_a_whole_life(request_: SetupRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set up offline, find, replace, remove; the own Python stays as it is."""
    before = own_packages()
    task = SetupTask(request_)
    seen = []
    task.start()
    while task.is_alive():
        seen.append((task.status.stage, task.status.fraction))
        time.sleep(0.02)
    assert task.status.state == "DONE", task.status
    fractions = [f for _, f in seen]
    assert fractions == sorted(fractions)
    assert {"environment", "install"} <= {stage for stage, _ in seen}
    environment = request_.environment
    assert environment.is_ready()
    versions = json.loads(environment.ready_path.read_text())
    assert {k: v for k, v in versions.items() if k.startswith("gw")} == {
        "gwalpha": "1.2", "gwbeta": "0.9", "gwgamma": "1.0",
    }  # fmt: skip
    assert imported(request_, "gwalpha") == "1.2"
    assert imported(request_, "gwgamma") == "1.0", "what a package needs came too"
    names = {"env", "log.txt", "ready.json", "gaussian-wrapping-worker.json"}
    assert {p.name for p in environment.root.iterdir()} == names
    assert own_packages() == before

    # It is found, after a preference and the variable, and before the own Python.
    monkeypatch.delenv(job_client.PYTHON_VARIABLE, raising=False)
    worker = environment.worker()
    assert job_client.worker_python() == worker
    assert job_client.worker_python(sys.executable) == sys.executable
    monkeypatch.setenv(job_client.PYTHON_VARIABLE, sys.executable)
    assert job_client.worker_python() == sys.executable
    monkeypatch.delenv(job_client.PYTHON_VARIABLE)

    # A package of which a needed one has another version does not get through pip check.
    write_wheel(Path(request_.find_links), "gwalpha", "1.2", "gwgamma>=2")
    status = finish(request_)
    assert status.state == "FAILED"
    assert "gwgamma" in status.error
    assert job_client.worker_python() == worker, "the one that was there stays in use"
    write_wheel(Path(request_.find_links), "gwgamma", "2.0")
    assert finish(request_).state == "DONE"
    assert environment.folder.name == "env-2"
    assert (environment.root / "env").exists(), "a job that runs may still load packages from it"
    assert imported(request_, "gwgamma") == "2.0"
    assert job_client.worker_python() == environment.worker() != worker

    install.remove(environment)
    assert not environment.root.exists()
    assert job_client.worker_python() == sys.executable
    assert own_packages() == before


def test_a_cancelled_set_up_keeps_the_one_that_is_there(quick: SetupRequest) -> None:
    assert finish(quick).state == "DONE"
    before = sorted(Path(quick.root).rglob("*"))
    task = SetupTask(quick)
    task.cancel()
    task.start()
    task.join(20)
    assert (task.status.state, task.status.exit_code) == ("CANCELLED", EXIT_CANCELLED)
    assert sorted(Path(quick.root).rglob("*")) == before
    assert imported(quick, "gwalpha") == "1.2"


def test_ctrl_c_cancels_the_command(request_: SetupRequest) -> None:
    batch = Path(install.__file__).parents[2] / "batch.py"
    options = ["--find-links", request_.find_links, "--requirements", request_.requirements]
    command = [sys.executable, str(batch), "set-up-worker", "--to", request_.root, *options]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True,
        # Started in the background of a shell, the tests themselves ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    until(request_.environment.folder.exists)
    process.send_signal(signal.SIGINT)
    words, _ = process.communicate(timeout=20)
    assert process.returncode == EXIT_CANCELLED, words
    assert "-m venv --clear" in words.splitlines()[0]
    assert "The set-up was cancelled." in words
    assert not Path(request_.root).exists()


@pytest.mark.parametrize("end", ["cancelled", "asker killed"])
def test_no_command_outlives_the_one_who_asked(tmp_path: Path, end: str) -> None:
    """Nor does what the command has started itself."""
    pid_file = tmp_path / "pid"
    sleeper = f"import os, time; open({str(pid_file)!r}, 'w').write(str(os.getpid()))"
    sleeper += "; time.sleep(60)"
    starter = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {sleeper!r}])"
    asker_code = (
        f"import sys; sys.path.insert(0, {str(Path(install.__file__).parents[3])!r})\n"
        "import io, pathlib, threading\n"
        "from gaussian_wrapping_addon.core.jobs import install as commands, install\n"
        f"root = pathlib.Path({str(tmp_path)!r}); (root / 'tmp').mkdir()\n"
        "task = install.SetupTask(commands.SetupRequest(str(root), '', ''))\n"
        "threading.Thread(target=lambda: sys.stdin.read() or task.cancel(), daemon=True).start()\n"
        f"command = (sys.executable, '-c', {starter!r})\n"
        "task._run_command(command, sys.executable, io.StringIO(), 1)\n"
    )
    asker = subprocess.Popen(
        [sys.executable, "-c", asker_code], stdin=subprocess.PIPE, stderr=subprocess.PIPE
    )
    until(lambda: pid_file.exists() and pid_file.read_text())
    pid = int(pid_file.read_text())
    assert process_alive(pid, 0)
    if end == "cancelled":
        _, words = asker.communicate(timeout=20)
        assert b"The set-up was cancelled." in words
    else:
        asker.kill()
        asker.communicate()
    until(lambda: not process_alive(pid, 0))


def test_a_half_made_one_is_not_believed(
    quick: SetupRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a set-up leaves it that was killed."""
    assert finish(quick).state == "DONE"
    quick.environment.ready_path.unlink()
    monkeypatch.delenv(job_client.PYTHON_VARIABLE, raising=False)
    monkeypatch.setattr(job_client, "_has_torch", lambda: False)
    with pytest.raises(UsageError, match=r"No worker is set up.*Set Up Worker"):
        job_client.worker_python()
    assert [d.subject for d in find_and_diagnose()] == ["Worker"]
    assert finish(quick).state == "DONE"
    assert job_client.worker_python() == quick.root


@pytest.mark.parametrize("kind", ["venv", "packages"])
def test_one_that_0_1_0_made_is_used_and_replaced(quick: SetupRequest, kind: str) -> None:
    """Its marker names no folder: that was given by the kind."""
    environment = quick.environment
    old = environment.root / ("env" if kind == "venv" else "packages")
    python = old / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.touch()
    marker = {
        "made_by": "gaussian_wrapping_addon", "kind": kind, "python": sys.executable,
        "version": "3.11.7", "torch": "cpu",
    }  # fmt: skip
    environment.marker_path.write_text(json.dumps(marker))
    assert not environment.is_ready()
    environment.ready_path.write_text('{"torch": "2.13.0"}')
    assert environment.is_ready()
    expected = (str(python), "") if kind == "venv" else (sys.executable, str(old))
    assert interpreter_of(environment.worker()) == expected
    assert finish(quick).state == "DONE"
    assert environment.is_ready()
    assert imported(quick, "gwbeta") == "0.9"
    assert old.exists(), "a job that runs may still load packages from it"
    assert finish(quick).state == "DONE"
    assert environment.is_ready()
    assert not (environment.root / "packages").exists(), "the next set-up deletes it"


def test_a_marker_from_elsewhere_names_no_other_folder(tmp_path: Path) -> None:
    environment = WorkerEnvironment(tmp_path)
    marker = {"made_by": "gaussian_wrapping_addon", "kind": "venv", "folder": "../x"}
    environment.marker_path.write_text(json.dumps(marker))
    assert environment.folder == tmp_path / "env"


def test_a_missing_wheel_and_folder_of_wheels_are_named(quick: SetupRequest) -> None:
    status = finish(replace(quick, find_links=quick.find_links + "x"))
    assert "does not exist" in status.error
    assert not Path(quick.root).exists()
    next(Path(quick.find_links).glob("gwbeta*")).unlink()
    status = finish(quick)
    assert status.state == "FAILED"
    assert "No wheel of gwbeta" in status.error
    assert "wheel folder" in status.hint
    assert status.exit_code == EXIT_RESOURCES
    assert "gwbeta" in (Path(quick.root) / "log.txt").read_text()
    assert not quick.environment.folder.exists()


def test_without_a_venv_only_the_child_sees_packages(quick: SetupRequest) -> None:
    """Where no venv can be made (Blender's own Python on Windows)."""
    assert finish(quick).state == "DONE"
    environment = quick.environment
    assert environment.marker()["kind"] == "packages"
    assert environment.is_ready()
    assert environment.worker() == quick.root
    assert child_command("jobs.commands.doctor", python=quick.root)[:2] == [quick.python, "-I"]
    assert imported(quick, "gwalpha") == "1.2"
    plain = subprocess.run(
        [quick.python, "-I", "-c", "import gwalpha"], capture_output=True, check=False
    )
    assert plain.returncode != 0


def test_the_pip_that_ensurepip_carries_will_do(
    request_: SetupRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = install.probe(sys.executable)
    bundled = ("-c", install._BUNDLED_PIP)
    bare = replace(real, has_venv=False, pip=bundled)
    monkeypatch.setattr(install, "probe", lambda _path: bare)
    assert finish(request_).state == "DONE"
    assert imported(request_, "gwbeta") == "0.9"


def test_settings_of_pip_cannot_lead_elsewhere(
    quick: SetupRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_PREFIX", str(tmp_path / "elsewhere"))
    monkeypatch.setenv("PIP_DRY_RUN", "1")
    # pip is isolated where it has a wheel folder: it would not look at the variables.
    links = quick.find_links
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", Path(links).as_uri())
    request = replace(quick, find_links="", torch="index")
    assert finish(request).state == "DONE"
    assert imported(request, "gwalpha") == "1.2"
    assert not (tmp_path / "elsewhere").exists()


def test_only_what_we_made_is_removed(request_: SetupRequest) -> None:
    folder, environment = Path(request_.root), request_.environment
    (folder / "env").mkdir(parents=True)
    thesis = folder / "env" / "thesis.txt"
    thesis.write_text("mine")
    with pytest.raises(UsageError, match="not made by this add-on"):
        install.remove(environment)
    status = finish(request_)
    assert "holds other files" in status.error
    assert status.exit_code == EXIT_USAGE
    assert [p.name for p in folder.iterdir()] == ["env"], "nothing of ours is left there"
    assert thesis.read_text() == "mine"
    # What lies beside ours stays, and so does what a link in its place leads to.
    elsewhere = (folder / "env").rename(folder.parent / "elsewhere")
    environment.marker_path.write_text('{"made_by": "gaussian_wrapping_addon"}')
    (folder / "notes.txt").write_text("mine")
    (folder / "env").symlink_to(elsewhere, target_is_directory=True)
    install.remove(environment)
    assert [p.name for p in folder.iterdir()] == ["notes.txt"]
    assert (elsewhere / "thesis.txt").is_file()


def test_two_set_ups_at_once(quick: SetupRequest) -> None:
    """The other one runs in another process."""
    assert finish(quick).state == "DONE"
    folder = str(JobFolder(Path(quick.root)).lock_path)
    code = (
        "import json, sys, time, os\n"
        "ticks = int(open('/proc/self/stat').read().rsplit(')', 1)[1].split()[19])\n"
        f"json.dump({{'pid': os.getpid(), 'started': ticks}}, open({folder!r}, 'w'))\n"
        "print(flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        try:
            assert "is working in" in finish(quick).error
            with pytest.raises(UsageError, match="is running"):
                install.remove(quick.environment)
        finally:
            other.kill()
    assert quick.environment.is_ready()


@pytest.mark.parametrize(("driver", "torch"), [(True, "cpu"), (True, "cuda"), (False, "cpu")])
def test_the_build_for_cuda_is_offered_where_there_is_a_driver(
    driver: bool, torch: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(setup_command, "cuda_present", lambda: driver)
    words = ["set-up-worker", "--dry-run", "--python", sys.executable, "--torch", torch]
    assert batch.main([*words, "--to", str(tmp_path / "env")]) == 0
    told = capfd.readouterr()
    offer = "An NVIDIA driver was found. With --torch cuda: Training and vacancy on the GPU"
    assert (offer in told.out + told.err) == (driver and torch == "cpu")
    assert not (tmp_path / "env").exists()
