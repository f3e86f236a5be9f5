# SPDX-License-Identifier: GPL-3.0-or-later
"""A worker's Python that is none, too old, or lacks packages: messages and exit codes."""

from __future__ import annotations

import json
import os
import stat
import sys
from pathlib import Path

import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import EXIT_OTHER, EXIT_USAGE, WorkerError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.commands import run_in_worker as calls
from gaussian_wrapping_addon.core.jobs.commands.doctor import diagnose_worker
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.settings import JobSettings
from gaussian_wrapping_addon.core.worker import worker_main
from gaussian_wrapping_addon.core.worker.spawn import process_start_ticks

posix = pytest.mark.skipif(os.name == "nt", reason="the interpreters are scripts")
WITHOUT = """#!{python}
import runpy, sys
for name in {missing!r}:
    sys.modules[name] = None
entry = next(i for i, text in enumerate(sys.argv) if text.endswith("worker_main.py"))
sys.argv = sys.argv[entry:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def script(path: Path, text: str) -> str:
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def without(folder: Path, *missing: str) -> str:
    """Return a Python that lacks packages."""
    return script(folder / "python", WITHOUT.format(python=sys.executable, missing=missing))


def wrap(folder: Path, python: str) -> JobStatus:
    (folder / "photos").mkdir()
    for number in range(3):
        Image.new("RGB", (64, 48)).save(folder / "photos" / f"{number}.png")
    job = make_job("wrap", folder / "photos", JobSettings())
    return JobClient.start(folder / "out", job, python=python).wait(60)


def estimate(folder: Path, python: str) -> int:
    job = make_job("wrap", folder, JobSettings())
    return calls.run_in_worker(
        job.to_json(), python=python, module="jobs.commands.estimate_command", what="estimate"
    )


@posix
@pytest.mark.parametrize(
    ("missing", "of_command"),
    [("numpy", "numpy"), ("PIL", "numba")],  # at the import of the worker, and later
)
def test_a_job_names_the_package_that_is_missing(
    tmp_path: Path, missing: str, of_command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    status = wrap(tmp_path, without(tmp_path, missing))
    assert (status.state, status.exit_code) == ("FAILED", EXIT_OTHER)
    assert "The worker's Python, " in status.error
    assert "lacks a package" in status.error
    assert missing in status.error
    assert "Set Up Worker" in status.hint
    assert "bug" not in status.hint
    told: list[str] = []
    monkeypatch.setattr(calls._logger, "error", lambda text, *values: told.append(text % values))
    assert estimate(tmp_path, without(tmp_path, of_command)) == EXIT_OTHER
    (said,) = told
    assert "lacks a package" in said
    assert of_command in said


@posix
def test_a_missing_module_of_our_own_is_no_missing_package(tmp_path: Path) -> None:
    status = wrap(tmp_path, without(tmp_path, "gaussian_wrapping_addon.core.jobs.runner"))
    assert status.error.startswith("Unexpected ModuleNotFoundError")
    assert "bug report" in status.hint


@posix
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("#!/bin/sh\necho hello\n", "hello"),
        ("#!/bin/sh\necho 'Unknown option: -I' >&2\nexit 2\n", "Unknown option: -I"),
    ],
)
def test_what_is_no_python_is_named_with_the_next_step(
    tmp_path: Path, text: str, said: str
) -> None:
    python = script(tmp_path / "python", text)
    status = wrap(tmp_path, python)
    assert status.state == "FAILED"
    assert said in status.error
    assert "batch.py doctor" in status.hint
    with pytest.raises(WorkerError, match=r"batch\.py doctor"):
        estimate(tmp_path, python)


@posix
@pytest.mark.parametrize(
    ("text", "said"), [("#!/nowhere\n", "No such file"), ("no program", "Exec format error")]
)
def test_what_the_system_does_not_start_is_named_with_the_next_step(
    tmp_path: Path, text: str, said: str
) -> None:
    python = script(tmp_path / "python", text)
    for call in (wrap, estimate, lambda _, python: diagnose_worker(python)):
        with pytest.raises(WorkerError, match=f"{python}, does not run: {said}.*Set Up Worker"):
            call(tmp_path, python)


def test_an_older_python_is_told_its_version(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(worker_main, "_OLDEST", (99, 0))
    assert worker_main._main("jobs.worker", []) == EXIT_OTHER
    told = json.loads(capsys.readouterr().out)
    assert sys.version.split()[0] in told["error"]
    assert "Version 99.0 or later is needed" in told["hint"]


@posix
def test_doctor_tells_what_the_python_says_of_itself(tmp_path: Path) -> None:
    told = json.dumps({"error": "The worker's Python is version 3.8.", "hint": "Another one."})
    python = script(tmp_path / "python", f"#!/bin/sh\necho '{told.replace(chr(39), '')}'\nexit 1\n")
    with pytest.raises(WorkerError, match=r"is version 3\.8\. Another one\."):
        diagnose_worker(python)


def test_the_loser_of_a_concurrent_start_ends_with_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = JobFolder(tmp_path / "out")
    folder.create()
    mine = {"pid": os.getpid(), "started": process_start_ticks(os.getpid())}
    write_json(folder.lock_path, mine)
    # Both looked before either worker had locked the folder.
    monkeypatch.setattr(JobFolder, "locked", lambda _: False)
    status = wrap(tmp_path, sys.executable)
    assert (status.state, status.exit_code) == ("FAILED", EXIT_USAGE)
    assert status.error == f"Process {os.getpid()} is working in {folder.root}."
