# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of a job: which there are, their file, progress and states."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import ParseError, UsageError
from gaussian_wrapping_addon.core.jobs.parts import runner, states
from gaussian_wrapping_addon.core.jobs.parts.graph import (
    PARTS_NAME,
    Part,
    PartsGraph,
    PlannedTiles,
    code_version,
    fixed_tiles,
    new_state,
    plan_hash,
    plan_parts,
    read_parts,
    write_parts,
    write_state,
)
from gaussian_wrapping_addon.core.jobs.parts.runner import JobProgress
from gaussian_wrapping_addon.core.jobs.parts.states import SILENT_S, FailedPart, PartReader
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job
from gaussian_wrapping_addon.core.progress import ProgressEvent
from gaussian_wrapping_addon.core.settings import JobSettings, MeshingSettings
from tests.core.jobs.finished_sphere import write_cube
from tests.core.jobs.parts.job_parts import graph
from tests.core.jobs.parts.job_parts import write_state as write_state_of

GRAPH = PartsGraph(
    "0123456789ab", "ba9876543210", "../photos",
    (
        Part("cameras", "cameras", (), ("stages/cameras-*/scene.json",), 0.12),
        Part("train", "train", ("cameras",), ("stages/train-*/gaussians.npz",), 0.6),
        Part("plan-a_1", "plan", ("train",), (), 0.1, "a_1"),
        Part("points-a_1-0000", "points", ("plan-a_1",), (), 0.1, "a_1", 0, 7 << 30, 12.5),
    ),
)  # fmt: skip


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_parts(tmp_path, GRAPH)
    assert read_parts(tmp_path) == GRAPH
    assert [part.name for part in GRAPH.of_region("a_1")] == ["plan-a_1", "points-a_1-0000"]
    assert GRAPH.part("train").needs == ("cameras",)
    with pytest.raises(UsageError, match="no part faces-9"):
        GRAPH.part("faces-9")


def _set(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(values: dict[str, Any]) -> None:
        *where, last = [int(w) if w.isdigit() else w for w in path.split(".")]
        target: Any = values
        for key in where:
            target = target[key]
        target[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_set("version", 2), "version: it is not 1"),
        (_set("parts", []), "not a list of 1 to"),
        (_set("code", 7), "code: not a short text"),
        (_set("parts.0.name", "../cameras"), r"parts\[0\]"),
        (_set("parts.0.kind", "mine"), r"parts\[0\]"),
        (_set("parts.0.outputs", ["/etc/passwd"]), r"parts\[0\]"),
        (_set("parts.0.outputs", ["a/../../b"]), r"parts\[0\]"),
        (_set("parts.0.outputs", ["C:x"]), r"parts\[0\]"),
        (_set("parts.0.needs", "train"), r"parts\[0\]"),
        (_set("parts.0.needs", ["train"]), "cameras, train wait for each other"),
        (_set("parts.1.needs", ["camera"]), r"parts\[1\]\.needs: 'camera' is no part"),
        (_set("parts.1.name", "cameras"), "two have the same name, but for case"),
        (_set("parts.1.share", -0.1), r"parts\[1\]"),
        (_set("parts.1.block", 1e9), r"parts\[1\]\.block"),
        (_set("parts.3.region", "a/b"), r"parts\[3\]"),
        (_set("parts.3.seconds", "long"), r"parts\[3\]"),
        (lambda values: values["parts"][2].pop("share"), r"parts\[2\]"),
        (lambda values: values["parts"][2].update(run="rm"), r"parts\[2\]"),
        (lambda values: values["parts"].append(5), r"parts\[4\]"),
    ],
)
def test_what_does_not_fit_is_refused(
    change: Callable[[dict[str, Any]], None], said: str, tmp_path: Path
) -> None:
    write_parts(tmp_path, GRAPH)
    values = json.loads((tmp_path / PARTS_NAME).read_text())
    change(values)
    (tmp_path / PARTS_NAME).write_text(json.dumps(values))
    with pytest.raises(ParseError, match=said) as caught:
        read_parts(tmp_path)
    assert "parts.json" in caught.value.message
    assert caught.value.hint


def test_a_list_that_is_missing_cut_or_too_long_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match=r"has no parts\.json"):
        read_parts(tmp_path)
    write_parts(tmp_path, GRAPH)
    text = (tmp_path / PARTS_NAME).read_text()
    (tmp_path / PARTS_NAME).write_text(text[:100])
    with pytest.raises(ParseError):
        read_parts(tmp_path)
    monkeypatch.setattr(limits, "MAX_PARTS", 3)
    (tmp_path / PARTS_NAME).write_text(text)
    with pytest.raises(ParseError, match="not a list of 1 to 3 parts"):
        read_parts(tmp_path)


def job_of(root: Path, tiles: str = "auto", regions: int = 1) -> JobFile:
    """Return a job for regions of a folder of photos."""
    (root / "photos").mkdir(exist_ok=True)
    paths = tuple(str(write_cube(root / f"r{number}.json")) for number in range(regions))
    settings = JobSettings(regions=paths, meshing=MeshingSettings(tiles=tiles))
    return make_job("wrap", root / "photos", settings)


def check(graph: PartsGraph) -> None:
    """Assert that parts stand after what they need, and that shares add up."""
    done: set[str] = set()
    for part in graph.parts:
        assert set(part.needs) <= done
        done.add(part.name)
    assert len(done) == len(graph.parts)
    assert sum(part.share for part in graph.parts) == pytest.approx(1.0)


def test_a_job_begins_with_its_stages_and_tiles_that_are_set(tmp_path: Path) -> None:
    job = job_of(tmp_path, regions=2)
    graph = plan_parts(tmp_path / "out", job, {})
    check(graph)
    assert [part.name for part in graph.parts] == [
        "cameras", "train", "plan-r0", "mesh-r0", "texture-r0", "plan-r1", "mesh-r1", "texture-r1",
        "export",
    ]  # fmt: skip
    assert graph.part("plan-r1").needs == ("train",)
    assert graph.part("export").needs == ("texture-r0", "texture-r1")
    assert (graph.source, graph.code) == ("../photos", code_version())
    assert fixed_tiles(job) == fixed_tiles(job_of(tmp_path, "off")) == {}
    assert fixed_tiles(job_of(tmp_path, "4")) == {"r0": PlannedTiles(4)}
    # The plan depends on what is to be done alone.
    elsewhere = dataclasses.replace(job.settings, threads=3, computers="local", processes=5)
    other = dataclasses.replace(job.settings, seed=1)
    hashes = [plan_hash(dataclasses.replace(job, settings=s)) for s in (elsewhere, other)]
    assert hashes[0] == graph.plan != hashes[1]


def test_tiles_are_parts_once_they_are_known(tmp_path: Path) -> None:
    job = job_of(tmp_path, regions=2)
    before = plan_parts(tmp_path / "out", job, {})
    graph = plan_parts(tmp_path / "out", job, {"r1": PlannedTiles(3, 5 << 30, 100.0)})
    check(graph)
    assert graph.plan == before.plan == plan_hash(job)
    assert {part.name for part in before.parts} <= {part.name for part in graph.parts}
    assert graph.part("points-r1-0002").needs == ("plan-r1",)
    assert graph.part("gather-r1").needs == tuple(f"points-r1-{n:04d}" for n in range(3))
    assert graph.part("faces-r1-0000").needs == ("gather-r1",)
    assert graph.part("mesh-r1").needs == tuple(f"faces-r1-{n:04d}" for n in range(3))
    tile = graph.part("faces-r1-0001")
    assert (tile.tile, tile.memory_bytes) == (1, 5 << 30)
    assert tile.seconds is not None
    assert 5.0 < tile.seconds < 20.0
    write_parts(tmp_path, graph)
    assert read_parts(tmp_path) == graph


def test_a_training_in_blocks_is_parts_from_the_start(tmp_path: Path) -> None:
    job = job_of(tmp_path)
    training = dataclasses.replace(job.settings.training, blocks=3)
    divided = dataclasses.replace(
        job, settings=dataclasses.replace(job.settings, training=training)
    )
    graph = plan_parts(tmp_path / "out", divided, {})
    check(graph)
    blocks = ("block-0000", "block-0001", "block-0002")
    assert [part.name for part in graph.parts][:6] == ["cameras", "coarse", *blocks, "train"]
    assert graph.part("coarse").needs == ("cameras",)
    assert all(graph.part(name).needs == ("coarse",) for name in blocks)
    assert graph.part("train").needs == blocks
    assert [graph.part(name).block for name in (*blocks, "train")] == [0, 1, 2, -1]
    assert graph.part("block-0001").is_one_of_many
    assert not graph.part("coarse").is_one_of_many
    whole = plan_parts(tmp_path / "out", job, {})
    assert graph.plan != whole.plan
    kinds = ("coarse", "block", "train")
    share = sum(part.share for part in graph.parts if part.kind in kinds)
    assert share == pytest.approx(whole.part("train").share)
    write_parts(tmp_path, graph)
    assert read_parts(tmp_path) == graph


PARTS = {f"block-{k:04d}": Part(f"block-{k:04d}", "block", (), (), 0.2, block=k) for k in range(3)}


def test_parts_here_and_elsewhere_move_the_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "STATES_EVERY_S", -1.0)
    sent: list[ProgressEvent] = []
    progress = JobProgress(sent.append, lambda: False)
    progress.begin(0.8)
    progress.report(0.5, {}, 2)
    progress.part(PARTS["block-0000"]).update(0.5, "iteration 7", iteration=7.0)
    assert sent[-1].fraction == pytest.approx(0.5 + 0.5 * 0.2 / 0.8)
    assert sent[-1].figures == {"iteration": 7.0}
    report = progress.side_by_side(tmp_path)
    report(0.25, PARTS, 1)
    assert sent[-1].message == ("block-0000: waits for a computer and 2 more; parts done: 1")
    state = dataclasses.replace(
        new_state("plan", 1), fraction=0.5, message="iteration 9", figures={"psnr": 24.5}
    )
    write_state(tmp_path, "block-0001", state)
    write_state(tmp_path, "block-0002", dataclasses.replace(state, state="DONE", fraction=1.0))
    report(0.25, PARTS, 1)
    assert sent[-1].stage == "train"
    assert sent[-1].message == "block-0001: iteration 9 and 2 more; parts done: 1"
    assert sent[-1].figures == {"psnr": 24.5}
    assert sent[-1].fraction == pytest.approx(0.25 + 0.5 * 0.2 / 0.8)
    count = len(sent)
    report(0.5, {}, 2)
    assert len(sent) == count, "nothing runs"


NOW_S = 1010.0


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "parts.json").write_text(json.dumps(graph({"a": 2, "b": 0})))
    return tmp_path


def reader_of(root: Path) -> PartReader:
    return PartReader(root, lambda: NOW_S)


def test_states_are_counted(root: Path) -> None:
    reader = reader_of(root)
    board = reader.read()
    assert (board.problem, board.failed, board.totals) == ("", (), (0, 0, 0, 14))
    assert (dict(board.counts)["mesh"], board.finished) == ((0, 0, 0, 2), False)
    write_state_of(root, "cameras", "DONE")
    write_state_of(root, "train", "DONE")
    write_state_of(root, "points-a-0000", "RUNNING")
    write_state_of(
        root, "points-a-0001", "FAILED", error="Too little memory.", hint="Close others."
    )
    board = reader.read()
    counts = dict(board.counts)
    assert counts["cameras"] == counts["train"] == (1, 0, 0, 0)
    assert counts["points"] == (0, 1, 1, 0)
    assert board.failed == (
        FailedPart("points-a-0001", "host", "Too little memory. Close others."),
    )
    assert board.totals == (2, 1, 1, 10)
    for part in graph({"a": 2, "b": 0})["parts"]:
        write_state_of(root, part["name"], "DONE", seconds=22.0)
    board = reader.read()
    assert (board.finished, board.failed) == (True, ())


def test_a_silent_part_is_left_to_another_computer(root: Path) -> None:
    write_state_of(root, "train", "RUNNING", heartbeat_s=NOW_S - SILENT_S + 1.0)
    assert dict(reader_of(root).read().counts)["train"] == (0, 1, 0, 0)
    write_state_of(root, "train", "RUNNING", heartbeat_s=NOW_S - SILENT_S - 1.0)
    assert dict(reader_of(root).read().counts)["train"] == (0, 0, 0, 1)


DAMAGED = (
    b"", b"[]", b'{"state": "ASLEEP"}', b'{"state": 7}', b"\xff\xfe", b"[" * 100_000,
    b" " * (limits.MAX_PART_STATE_BYTES + 1), b'{"state": NaN}',
)  # fmt: skip


@pytest.mark.parametrize("data", DAMAGED, ids=range(len(DAMAGED)))
def test_damaged_states_count_as_left(root: Path, data: bytes) -> None:
    write_state_of(root, "cameras", "DONE")
    (root / "parts" / "train.json").write_bytes(data)
    counts = dict(reader_of(root).read().counts)
    assert counts["cameras"] == (1, 0, 0, 0)
    assert counts["train"] == (0, 0, 0, 1)


def test_odd_entries_do_no_harm(root: Path) -> None:
    (root / "parts").mkdir()
    write_state_of(root, "train", "FAILED", error="x" * 5000)
    write_state_of(root, "plan-a", "RUNNING", heartbeat_s=10**400)
    write_state_of(root, "mesh-a", "FAILED", place=3)
    (root / "parts" / "foreign.json").write_text(json.dumps({"state": "FAILED"}))
    (root / "parts" / "cameras.json").symlink_to(root / "parts.json")
    os.mkfifo(root / "parts" / "export.json")
    board = reader_of(root).read()
    assert board.failed == (FailedPart("train", "host", "x" * states.MAX_TEXT_CHARACTERS),)
    assert board.totals == (0, 0, 1, 13)
    (root / "parts").rename(root / "elsewhere")
    (root / "parts").symlink_to(root / "elsewhere")
    assert reader_of(root).read().totals == (0, 0, 0, 14), "a linked folder is not read"


def test_only_changed_files_are_read_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = []
    inner = states.read_state
    monkeypatch.setattr(states, "read_state", lambda r, n: read.append(n) or inner(r, n))
    reader = reader_of(root)
    write_state_of(root, "cameras", "DONE")
    write_state_of(root, "train", "RUNNING")
    reader.read()
    assert sorted(read) == ["cameras", "train"]
    write_state_of(root, "train", "DONE", seconds=123.456)
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
