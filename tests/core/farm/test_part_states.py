# SPDX-License-Identifier: GPL-3.0-or-later
"""States of parts: counted by kind, read again only where they changed, whatever files hold."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.jobs.parts import states
from gaussian_wrapping_addon.core.jobs.parts.states import SILENT_S, FailedPart, PartReader
from tests.core.farm.job_parts import graph, write_state

NOW_S = 1010.0


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "parts.json").write_text(json.dumps(graph({"a": 2, "b": 0})))
    return tmp_path


def reader_of(root: Path) -> PartReader:
    return PartReader(root, lambda: NOW_S)


def test_nothing_has_begun(root: Path) -> None:
    board = reader_of(root).read()
    assert board.problem == ""
    assert board.failed == ()
    assert dict(board.counts) == {
        "cameras": (0, 0, 0, 1), "train": (0, 0, 0, 1), "plan": (0, 0, 0, 2),
        "points": (0, 0, 0, 2), "gather": (0, 0, 0, 1), "faces": (0, 0, 0, 2),
        "mesh": (0, 0, 0, 2), "texture": (0, 0, 0, 2), "export": (0, 0, 0, 1),
    }  # fmt: skip
    assert board.totals == (0, 0, 0, 14)
    assert not board.finished


def test_states_are_counted(root: Path) -> None:
    reader = reader_of(root)
    write_state(root, "cameras", "DONE")
    write_state(root, "train", "DONE")
    write_state(root, "points-a-0000", "RUNNING")
    write_state(root, "points-a-0001", "FAILED", error="Too little memory.", hint="Close others.")
    board = reader.read()
    counts = dict(board.counts)
    assert counts["cameras"] == counts["train"] == (1, 0, 0, 0)
    assert counts["points"] == (0, 1, 1, 0)
    assert board.failed == (
        FailedPart("points-a-0001", "host", "Too little memory. Close others."),
    )
    assert board.totals == (2, 1, 1, 10)
    for part in graph({"a": 2, "b": 0})["parts"]:
        write_state(root, part["name"], "DONE", seconds=22.0)
    board = reader.read()
    assert board.finished
    assert board.failed == ()


def test_a_silent_part_is_left_to_another_computer(root: Path) -> None:
    write_state(root, "train", "RUNNING", heartbeat_s=NOW_S - SILENT_S + 1.0)
    assert dict(reader_of(root).read().counts)["train"] == (0, 1, 0, 0)
    write_state(root, "train", "RUNNING", heartbeat_s=NOW_S - SILENT_S - 1.0)
    assert dict(reader_of(root).read().counts)["train"] == (0, 0, 0, 1)


DAMAGED = (
    b"", b"[]", b"{", b'{"state": "ASLEEP"}', b'{"state": 7}', b"\xff\xfe", b"[" * 100_000,
    b" " * (limits.MAX_PART_STATE_BYTES + 1), b'{"state": NaN}',
)  # fmt: skip


@pytest.mark.parametrize("data", DAMAGED, ids=range(len(DAMAGED)))
def test_damaged_states_count_as_left(root: Path, data: bytes) -> None:
    write_state(root, "cameras", "DONE")
    (root / "parts" / "train.json").write_bytes(data)
    counts = dict(reader_of(root).read().counts)
    assert counts["cameras"] == (1, 0, 0, 0)
    assert counts["train"] == (0, 0, 0, 1)


def test_odd_entries_do_no_harm(root: Path) -> None:
    (root / "parts").mkdir()
    write_state(root, "train", "FAILED", error="x" * 5000)
    write_state(root, "plan-a", "RUNNING", heartbeat_s=10**400)
    write_state(root, "mesh-a", "FAILED", place=3)
    (root / "parts" / "foreign.json").write_text(json.dumps({"state": "FAILED"}))
    (root / "parts" / "cameras.json").symlink_to(root / "parts.json")
    os.mkfifo(root / "parts" / "export.json")
    board = reader_of(root).read()
    assert board.failed == (FailedPart("train", "host", "x" * states.MAX_TEXT_CHARACTERS),)
    assert board.totals == (0, 0, 1, 13)


def test_a_linked_folder_of_states_is_not_read(root: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    write_state(other, "train", "DONE")
    (root / "parts").symlink_to(other / "parts")
    assert reader_of(root).read().totals == (0, 0, 0, 14)


def test_only_changed_files_are_read_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = []
    inner = states.read_state
    monkeypatch.setattr(states, "read_state", lambda r, n: read.append(n) or inner(r, n))
    reader = reader_of(root)
    write_state(root, "cameras", "DONE")
    write_state(root, "train", "RUNNING")
    reader.read()
    assert sorted(read) == ["cameras", "train"]
    write_state(root, "train", "DONE", seconds=123.456)
    assert reader.read().totals == (2, 0, 0, 12)
    assert read[2:] == ["train"]
    (root / "parts" / "train.json").write_bytes(b"{")  # while it is replaced, as it was
    assert reader.read().totals == (2, 0, 0, 12)


def test_a_new_plan_is_noticed_and_a_damaged_one_said(root: Path) -> None:
    reader = reader_of(root)
    assert reader.read().totals == (0, 0, 0, 14)
    (root / "parts.json").write_text(json.dumps(graph({"a": 4})))
    assert reader.read().totals == (0, 0, 0, 15)
    (root / "parts.json").write_text("{}")
    assert "parts.json, version" in reader.read().problem
    (root / "parts.json").unlink()
    assert "no parts.json" in reader.read().problem
    (root / "parts.json").write_text(json.dumps(graph({"a": 0})))
    assert reader.read().totals == (0, 0, 0, 6)
