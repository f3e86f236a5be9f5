# SPDX-License-Identifier: GPL-3.0-or-later
"""``farm``: job folders handed to a stub of a Manager, looked at, cancelled and tried again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, EXIT_DONE, EXIT_OTHER, EXIT_USAGE
from gaussian_wrapping_addon.core.jobs.parts.graph import read_parts
from gaussian_wrapping_addon.core.names import SHARED_VARIABLE
from tests.core.farm.flamenco.stub_manager import JOB, StubManager, serving
from tests.core.farm.job_parts import GRAPHS, job_folder, write_state


@pytest.fixture
def stub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StubManager:
    monkeypatch.setenv(SHARED_VARIABLE, str(tmp_path))
    return StubManager()


@pytest.fixture
def url(stub: StubManager) -> Iterator[str]:
    with serving(stub) as address:
        yield str(address)


def castle(tmp_path: Path, name: str = "castle") -> str:
    return str(job_folder(tmp_path / name, GRAPHS["tiles"]).root)


def test_several_jobs_are_submitted(
    stub: StubManager, url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = castle(tmp_path), castle(tmp_path, "door")
    command = ["farm", "submit", first, second, f"{first}/.", "--flamenco", url, "--priority", "80"]
    assert batch.main([*command, "--tag", "big"]) == EXIT_DONE
    assert [(b["name"], b["priority"]) for b in stub.submitted] == [("castle", 80), ("door", 80)]
    assert capsys.readouterr().out.splitlines() == [
        f"{folder}: job {JOB} of Flamenco 3.8.2, 23 parts" for folder in (first, second)
    ]


def test_status_has_parts_tasks_and_lines(
    stub: StubManager, url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = castle(tmp_path)
    batch.main(["farm", "submit", folder, "--flamenco", url])
    stub.status = "active"
    stub.fail("train", "iteration 10\nerror: Too little memory.\n")
    write_state(Path(folder), "cameras", "DONE")
    write_state(Path(folder), "train", "FAILED")
    capsys.readouterr()
    assert batch.main(["farm", "status", folder]) == EXIT_DONE
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split() for line in lines]
    assert rows[:3] == [
        ["part", "done", "running", "failed", "left"],
        ["cameras", "1", "0", "0", "0"],
        ["train", "0", "0", "1", "0"],
    ]
    assert ["all", "1", "0", "1", "21"] in rows
    assert lines[-5:] == [
        f"job {JOB} at {url}: active",
        "tasks: 22 queued, 1 failed",
        "train: failed on blade-3",
        "    iteration 10",
        "    error: Too little memory.",
    ]


def test_cancel_and_retry(
    stub: StubManager, url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = castle(tmp_path)
    batch.main(["farm", "submit", folder, "--flamenco", url])
    assert batch.main(["farm", "cancel", folder]) == EXIT_DONE
    assert (Path(folder) / "cancel").exists()
    assert batch.main(["farm", "retry", folder]) == EXIT_DONE
    assert not (Path(folder) / "cancel").exists()
    assert [c["status"] for c in stub.changes] == ["cancel-requested", "requeueing"]
    assert (
        capsys.readouterr().out.splitlines()[-1] == f"queued again; look with: farm status {folder}"
    )


def test_missing_variables_are_warned_of(
    stub: StubManager, url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    del stub.variables["gw_batch"]
    assert batch.main(["farm", "submit", castle(tmp_path), "--flamenco", url]) == EXIT_DONE
    assert "warning: The Manager has no variable gw_batch" in capsys.readouterr().out


def test_nothing_is_submitted_where_one_folder_is_damaged(
    stub: StubManager, url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = castle(tmp_path), castle(tmp_path, "bad")
    (Path(bad) / "parts.json").write_text("{}")
    assert batch.main(["farm", "submit", good, bad, "--flamenco", url]) == EXIT_BAD_DATA
    assert "parts.json, version" in capsys.readouterr().out
    assert stub.submitted == stub.asked == []
    assert not (Path(good) / "flamenco.json").exists()


def test_a_job_without_parts_is_divided(stub: StubManager, url: str, tmp_path: Path) -> None:
    folder = job_folder(tmp_path / "castle").root
    assert batch.main(["farm", "submit", str(folder), "--flamenco", url]) == EXIT_DONE
    (body,) = stub.submitted
    sent = json.loads(body["settings"]["parts"])["parts"]
    assert [part["name"] for part in sent] == [part.name for part in read_parts(folder).parts]
    assert [part["kind"] for part in sent].count("faces") == 8


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["submit", "DIR", "--flamenco", "localhost:8080"], EXIT_USAGE, "such as http://"),
        (["submit", "DIR", "--flamenco", "http://127.0.0.1:9"], EXIT_OTHER, "Nothing answers at"),
        (["submit", "DIR"], EXIT_USAGE, "--flamenco"),
        (["submit", "--flamenco", "http://x"], EXIT_USAGE, "DIR"),
        (["submit", "DIR", "--flamenco", "http://x", "--priority", "101"], EXIT_USAGE, "0 to 100"),
        (["submit", "DIR", "--flamenco", "http://x", "--priority", "x"], EXIT_USAGE, "priority"),
        (["submit", "PHOTOS", "--flamenco", "http://x"], EXIT_USAGE, "holds no job"),
        (["status", "DIR"], EXIT_USAGE, "was not submitted"),
        (["retry", "DIR"], EXIT_USAGE, "was not submitted"),
        (["cancel", "DIR"], EXIT_USAGE, "was not submitted"),
        (["job-type", "PHOTOS/none"], EXIT_USAGE, "is no folder"),
        ([], EXIT_USAGE, "farm_command"),
    ],
)
def test_refusals(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    folder, photos = castle(tmp_path), str(tmp_path / "photos")
    given = [a.replace("DIR", folder).replace("PHOTOS", photos) for a in arguments]
    assert batch.main(["farm", *given]) == code
    assert words in capsys.readouterr().out


def test_the_job_type_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert batch.main(["farm", "job-type", str(tmp_path)]) == EXIT_DONE
    assert (tmp_path / "gaussian-wrapping.js").is_file()
    assert "restart the Manager" in capsys.readouterr().out
