# SPDX-License-Identifier: GPL-3.0-or-later
"""What is found about a worker: each thing that is wrong with one, and its next step."""

from __future__ import annotations

import asyncio
import json
import platform
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.farm.dask import Answer
from gaussian_wrapping_addon.core.jobs.commands import farm_findings
from gaussian_wrapping_addon.core.jobs.commands.farm_findings import (
    MAX_CHARACTERS,
    MeetingFolder,
    WorkerFinding,
    finding_of,
)

HERE = {"code": "aaa", "python": platform.python_version(), "torch": "2.13.0", "numpy": "1.26.4"}
GOOD: dict[str, Any] = {
    **HERE, "torch": "2.13.0+cu126", "cores": 16, "memory_bytes": 64 << 30,
    "gpu": "NVIDIA L4", "free_bytes": 200 << 30, "bad": [], "reply": "said there",
}  # fmt: skip
PLACE = "tls://10.0.0.7:41234"


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(farm_findings, "SEEN_S", 0.3)


def found(folder: Path, *, clock_s: float = 0.2, **changes: Any) -> WorkerFinding:
    """Judge a worker that has answered, and written its file."""
    with MeetingFolder(folder) as meeting:
        (meeting.root / "worker-0.txt").write_text("said there")
        answer = {**GOOD, "token": meeting.token, **changes}
        result = {"host": "blade", "code": 0, "answer": answer}
        told = Answer(PLACE, "", HERE["python"], clock_s, [result])
        return asyncio.run(finding_of(told, meeting, HERE))


def judged(folder: Path, answer: Answer) -> WorkerFinding:
    with MeetingFolder(folder) as meeting:
        return asyncio.run(finding_of(answer, meeting, HERE))


def test_a_good_one(tmp_path: Path) -> None:
    finding = found(tmp_path)
    assert finding.line() == (
        f"blade (10.0.0.7:41234): ok; version aaa, Python {HERE['python']}, torch 2.13.0+cu126, "
        "numpy 1.26.4, 16 cores, 64.0 GiB memory, NVIDIA L4, 200.0 GiB free in the shared folder, "
        "clock +0.2 s"
    )
    assert finding.to_json() == {
        "name": "blade (10.0.0.7:41234)", "good": True, "problems": [], "cores": 16,
        "memory_gib": 64.0, "gpu": "NVIDIA L4",
    }  # fmt: skip
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"code": "bbb"}, "It has version bbb of the program, this computer aaa. Install the same"),
        ({"torch": "2.12.1+cpu"}, "It has torch 2.12.1+cpu, this computer 2.13.0. Set up its"),
        ({"clock_s": 70.0}, "Its clock is 70 s ahead of that of this computer. Let both"),
        ({"clock_s": -61.0}, "Its clock is 61 s behind that of this computer. Let both"),
        ({"token": "other"}, "Its shared folder is not the one of this computer. Mount"),
        ({"reply": "never written"}, "What it writes into the shared folder is not seen here. Use"),
        ({"folder_error": "Read-only file system: /x"}, "It cannot use the shared folder: Read-on"),
        ({"bad": [["Disk: 1.0 GiB free", "Free at least 2 GiB."]]}, "Disk: 1.0 GiB free Free at"),
    ],
)
def test_what_is_wrong_is_told(changes: dict[str, Any], says: str, tmp_path: Path) -> None:
    finding = found(tmp_path, **changes)
    assert not finding.good
    (problem,) = finding.problems
    assert problem.startswith(says)
    assert finding.line().startswith(f"blade (10.0.0.7:41234): {says}")


def test_who_does_not_answer_or_cannot(tmp_path: Path) -> None:
    (long,) = judged(tmp_path, Answer(PLACE, "x" * 9999)).problems
    assert len(long) == MAX_CHARACTERS
    (late,) = judged(tmp_path, Answer(PLACE, "It does not answer within 9 s.")).problems
    assert late.startswith("It does not answer within 9 s. Look at that computer")
    (other,) = judged(tmp_path, Answer(PLACE, python="3.99.1")).problems
    assert other.startswith(f"It has Python 3.99.1, this computer {HERE['python']}. Set up")
    failed = {"host": "blade", "code": 2, "error": "GW_ENTRY is not set on blade.", "answer": None}
    finding = judged(tmp_path, Answer(PLACE, "", HERE["python"], 0.0, [failed, failed]))
    (lost,) = finding.problems
    assert lost.startswith("GW_ENTRY is not set on blade. Start it with batch.py farm worker, of")


def test_a_folder_that_is_not_seen_is_named_without_ours_in_it(tmp_path: Path) -> None:
    with MeetingFolder(tmp_path) as meeting:
        error = f"blade does not see /mnt/farm/{meeting.root.name}."
        results = [
            {"host": "blade", "code": 2, "error": error, "answer": None},
            {"host": "blade", "code": 0, "answer": GOOD},
        ]
        told = Answer(PLACE, "", HERE["python"], 0.0, results)
        finding = asyncio.run(finding_of(told, meeting, HERE))
    (problem,) = finding.problems
    assert problem.startswith("blade does not see /mnt/farm. Mount the shared folder there")
    assert "free in the shared folder" not in finding.line()


@pytest.mark.parametrize("answer", [{}, {"bad": "x", "cores": "many"}, {"bad": [1, [2]]}, "text"])
def test_an_answer_of_another_version_is_no_crash(answer: Any, tmp_path: Path) -> None:
    result = {"host": "\x1b[31mblade\n", "code": 0, "answer": answer}
    finding = judged(tmp_path, Answer(PLACE, "", HERE["python"], 0.0, [result]))
    assert not finding.good
    assert finding.name == "[31mblade (10.0.0.7:41234)"


def test_the_worker_reads_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(farm_findings, "diagnose", lambda _folder: [])
    monkeypatch.setattr(farm_findings, "end_with_parent", lambda: None)
    with MeetingFolder(tmp_path) as meeting:
        seen, unseen = meeting.requests(3, 600.0)
        for request, folder in ((seen, meeting.root), (unseen, tmp_path)):
            arguments = {**request["arguments"], "out": str(folder)}
            assert farm_findings.main([json.dumps(arguments)]) == 0
        first, second = map(json.loads, capsys.readouterr().out.splitlines())
        assert first["answer"]["token"] == meeting.token
        assert (meeting.root / "worker-3.txt").read_text() == first["answer"]["reply"]
        assert asyncio.run(meeting.sees(first["answer"]["reply"]))
        assert "token" not in second["answer"]
    arguments = {**seen["arguments"], "out": str(tmp_path)}
    farm_findings.main([json.dumps(arguments)])
    told = json.loads(capsys.readouterr().out)["answer"]["folder_error"]
    assert told.startswith("No such file or directory")
    assert list(tmp_path.iterdir()) == []
