# SPDX-License-Identifier: GPL-3.0-or-later
"""The study of interrupted jobs: what is drawn, what counts as a fault, and its page."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks import kills as processes
from benchmarks.kills import (
    BLOCK_BYTES,
    CALLER,
    DISK,
    KILL,
    LEFT_OUT,
    LONGEST_END_S,
    MEMORY,
    STAGES,
    WAYS,
    Outcome,
    Reference,
    Trial,
    _limit,
    _without_places,
    draw,
    page,
    read_outcomes,
    room,
    write_document,
    write_outcomes,
)
from benchmarks.provenance import ROOT
from tools.version_comparison.contents import Contents, differences, read_contents

GOOD = Outcome(
    Trial(KILL, 3, "mesh", 0.5), "mesh", 4, "error: The worker was stopped.", 0.1, 0, False, 0, 900,
    (), "0123456789", "2026-11-25",
)  # fmt: skip


def test_trials_follow_from_the_seed_and_more_of_them_begin_with_the_same() -> None:
    few, many = draw(10, 0), draw(100, 0)
    assert {t.identity: t for t in few}.items() <= {t.identity: t for t in many}.items()
    assert len({t.identity for t in many}) == len(many) == 100 + 20 + 20 + 20 + 50
    assert draw(10, 1) != few
    kills = [t for t in many if t.way == KILL]
    counts = [sum(t.stage == stage for t in kills) for stage in STAGES]
    assert max(counts) - min(counts) <= 1
    shares = [t.share for t in kills]
    assert min(shares) < 0.1
    assert max(shares) > 0.9
    assert [t.way for t in draw(1, 0)] == list(WAYS)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"code": 1}, "code 1"),
        ({"traceback": True}, "traceback"),
        ({"left": 2}, "2 processes"),
        ({"end_s": LONGEST_END_S + 0.1}, "after 12.1 s"),
        ({"resumed": 3}, "resumed with code 3"),
        ({"differences": ("result/a.npz : means: 1 of 9 values",)}, "another result: result/a"),
    ],
)
def test_each_fault_is_told(change: dict[str, object], words: str) -> None:
    assert GOOD.faults == []
    (fault,) = dataclasses.replace(GOOD, **change).faults  # type: ignore[arg-type]
    assert words in fault
    assert f"- kill-003 (at mesh): {fault}" in page([dataclasses.replace(GOOD, **change)], 1)  # type: ignore[arg-type]


def test_a_killed_caller_has_no_exit_code() -> None:
    caller = dataclasses.replace(GOOD, trial=Trial(CALLER, 0, "", 0.5))
    assert caller.faults
    assert dataclasses.replace(caller, code=None).faults == []


def test_outcomes_are_kept_and_the_page_is_written_from_them(tmp_path: Path) -> None:
    path = tmp_path / "records" / "outcomes.json"
    assert read_outcomes(path) == {}
    ended = dataclasses.replace(GOOD, trial=Trial(KILL, 4, "export", 0.9), hit="", code=0)
    known = {o.trial.identity: o for o in (GOOD, ended)}
    write_outcomes(known, path)
    assert read_outcomes(path) == known
    text = write_document(tmp_path, known, 2).read_text()
    (row,) = [line for line in text.splitlines() if "SIGKILL" in line and line.startswith("|")]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[1:] == ["2", "1", "mesh 1", "2 (4)", "2", "2", "0.1", "2", "2"]
    assert "Nothing." in text


def test_limits_lie_between_what_packages_and_what_the_job_take() -> None:
    reference = Reference(Contents({}, 0), {}, 1_000_000, 200, 1_000)
    for share in (0.0, 0.5, 1.0):
        assert 20_000 <= _limit(Trial(DISK, 0, "", share), reference) <= 1_000_000
        assert 100 < _limit(Trial(MEMORY, 0, "", share), reference) <= 1_000
    assert _limit(Trial(KILL, 0, "mesh", 0.5), reference) == 0


def test_messages_name_no_folder_of_the_machine(tmp_path: Path) -> None:
    said = f"error: {ROOT}/.venv/bin/python could not write {tmp_path}/stages/a."
    told = _without_places(said, tmp_path)
    assert told == "error: REPOSITORY/.venv/bin/python could not write DIR/stages/a."
    assert not [o for o in read_outcomes().values() if str(ROOT) in o.message]


def test_a_reused_stage_alone_is_no_difference(tmp_path: Path) -> None:
    for name, text in (
        ("a", '{"stages": [{"name": "train", "reused": false}]}'),
        ("b", '{"stages": [{"name": "train", "reused": true}]}'),
        ("c", '{"stages": [{"name": "mesh", "reused": true}]}'),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.json").write_text(text)
    a, b, c = (read_contents(tmp_path / name, LEFT_OUT) for name in "abc")
    assert differences(a, b) == []
    assert len(differences(a, c)) == 1
    assert differences(read_contents(tmp_path / "a"), read_contents(tmp_path / "b"))


def test_room_is_counted_in_pages(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a").write_bytes(bytes(1))
    (tmp_path / "b").write_bytes(bytes(BLOCK_BYTES + 1))
    assert room(tmp_path) == 3 * BLOCK_BYTES


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc, which Linux has")
def test_processes_of_a_folder_are_found_until_they_end(tmp_path: Path) -> None:
    code = "import sys; sys.stdin.read()"
    words = [sys.executable, "-c", code, processes.WORKER_MODULE, str(tmp_path)]
    process = subprocess.Popen(words, stdin=subprocess.PIPE)
    try:
        # A process that begins has no command line for a moment.
        end_s = time.monotonic() + 5.0
        while not processes.processes_of(tmp_path) and time.monotonic() < end_s:
            time.sleep(0.01)
        assert processes.wait_until_gone(tmp_path, 0.1)[1] == [process.pid]
        assert processes.worker_of(tmp_path) == process.pid
        assert processes.peak_address_space(process.pid) > 1_000_000
    finally:
        process.communicate()
    assert processes.wait_until_gone(tmp_path, 5.0)[1] == []
    assert processes.worker_of(tmp_path) == 0
    assert processes.peak_address_space(process.pid) == 0
