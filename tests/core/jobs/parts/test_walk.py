# SPDX-License-Identifier: GPL-3.0-or-later
"""Walking the parts of a job with an engine that ends them as it is told."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.jobs.parts import runner as walk_module
from gaussian_wrapping_addon.core.jobs.parts.graph import (
    Part,
    PartState,
    PlannedTiles,
    fixed_tiles,
    new_state,
    read_parts,
    read_state,
    state_path,
    write_state,
)
from gaussian_wrapping_addon.core.jobs.parts.runner import Outcome, PartError, Walk
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from tests.core.jobs.parts.test_graph import job_of


class Told:
    """An engine whose parts end at once with the codes they are told, by default 0."""

    def __init__(self, root: Path, slots: int = 1, trusts: bool = False) -> None:
        self.root = root
        self.slots = slots
        self.trusts_states = trusts
        self.codes: dict[str, list[int]] = {}
        self.again: set[str] = set()
        self.made: dict[str, str] = {}
        self.started: list[str] = []
        self.at_once = 0
        self._running: list[tuple[Part, str]] = []

    def start(self, part: Part, plan: str, attempt: int) -> None:
        assert set(part.needs) <= {
            path.stem
            for path in (self.root / "parts").glob("*.json")
            if (state := read_state(self.root, path.stem)) and state.state == "DONE"
        }
        assert self.trusts_states is False or read_state(self.root, part.name) is None
        self.started.append(part.name)
        self._running.append((part, plan))
        self.at_once = max(self.at_once, len(self._running))

    def wait(self, seconds: float) -> list[Outcome]:
        part, plan = self._running.pop(0)
        if part.name in self.again:
            self.again.discard(part.name)
            return [Outcome(part, 0, begun_again=True)]
        code = self.codes.get(part.name, [0]).pop(0) if self.codes.get(part.name) else 0
        made = self.made.get(part.name, part.name)
        (self.root / "stages" / made).mkdir(parents=True, exist_ok=True)
        done = dataclasses.replace(new_state(plan, 1), state="DONE", outputs=(f"stages/{made}",))
        if code == 0:
            write_state(self.root, part.name, done)
        return [Outcome(part, code, error=f"code {code}.", place="somewhere")]

    def close(self, *, cancelled: bool) -> None: ...


PLANNED: dict[str, PlannedTiles] = {}
"""Tiles of the regions of the last job."""


@pytest.fixture(autouse=True)
def _planned(monkeypatch: pytest.MonkeyPatch) -> None:
    def planned_tiles(folder: JobFolder, state: PartState | None) -> PlannedTiles | None:
        return PLANNED.get(state.outputs[0].removeprefix("stages/plan-")) if state else None

    monkeypatch.setattr(walk_module, "planned_tiles", planned_tiles)


def walk(root: Path, engine: Told, **job: object) -> Walk:
    (root / "out").mkdir(exist_ok=True)
    made = job_of(root, **job)  # type: ignore[arg-type]
    PLANNED.clear()
    PLANNED.update(fixed_tiles(made))
    return Walk(JobFolder(root / "out"), made, engine, engine, lambda *_: None, lambda: False)


def engine_in(root: Path, **given: object) -> Told:
    return Told(root / "out", **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("slots", [1, 3])
def test_all_parts_are_run_in_order_and_side_by_side_where_they_can(
    slots: int, tmp_path: Path
) -> None:
    engine = engine_in(tmp_path, slots=slots)
    walk(tmp_path, engine, tiles="5").run()
    names = [part.name for part in read_parts(tmp_path / "out").parts]
    assert engine.at_once == slots
    assert engine.started == names if slots == 1 else sorted(engine.started) == sorted(names)


@pytest.mark.parametrize("code", [2, 3, -9])
def test_a_part_that_may_work_elsewhere_is_begun_again(code: int, tmp_path: Path) -> None:
    engine = engine_in(tmp_path)
    engine.codes = {"train": [code, code], "texture-r0": [code]}
    walk(tmp_path, engine).run()
    assert engine.started.count("train") == 3
    assert engine.started.count("texture-r0") == 2


@pytest.mark.parametrize(("codes", "times"), [([2] * 9, 3), ([-11] * 9, 3), ([1], 1)])
def test_a_part_that_never_works_is_named_and_the_rest_is_done(
    codes: list[int], times: int, tmp_path: Path
) -> None:
    engine = engine_in(tmp_path, slots=2)
    engine.codes = {"faces-r0-0001": list(codes)}
    with pytest.raises(PartError, match=r"Part faces-r0-0001 failed on somewhere: code") as caught:
        walk(tmp_path, engine, tiles="3", regions=2).run()
    assert "resume makes what is missing" in caught.value.hint
    assert engine.started.count("faces-r0-0001") == times
    left = {part.name for part in read_parts(tmp_path / "out").parts} - set(engine.started)
    assert left == {"mesh-r0", "texture-r0", "export"}


def test_a_region_that_is_begun_again_is_made_anew_from_its_plan(tmp_path: Path) -> None:
    engine = engine_in(tmp_path)
    engine.again = {"faces-r0-0000"}
    walk(tmp_path, engine, tiles="2", regions=2).run()
    of_region = [name for name in engine.started if "-r0" in name]
    tiles = ["points-r0-0000", "points-r0-0001", "gather-r0", "faces-r0-0000"]
    assert of_region == [
        "plan-r0", *tiles, "plan-r0", *tiles, "faces-r0-0001", "mesh-r0", "texture-r0",
    ]  # fmt: skip
    assert engine.started.count("train") == engine.started.count("plan-r1") == 1


def test_an_interrupted_walk_goes_on_where_it_was(tmp_path: Path) -> None:
    first = engine_in(tmp_path, trusts=True)
    first.codes = {"gather-r0": [1]}
    with pytest.raises(PartError):
        walk(tmp_path, first, tiles="2").run()
    second = engine_in(tmp_path, trusts=True)
    walk(tmp_path, second, tiles="2").run()
    assert second.started == [
        "cameras", "gather-r0", "faces-r0-0000", "faces-r0-0001", "mesh-r0", "texture-r0", "export",
    ]  # fmt: skip


def test_what_is_gone_or_has_other_photos_is_made_again(tmp_path: Path) -> None:
    first = engine_in(tmp_path, trusts=True)
    walk(tmp_path, first, tiles="2").run()
    (tmp_path / "out" / "stages" / "faces-r0-0001").rmdir()
    gone = engine_in(tmp_path, trusts=True)
    walk(tmp_path, gone, tiles="2").run()
    assert gone.started == ["cameras", "faces-r0-0001"]
    other = engine_in(tmp_path, trusts=True)
    other.made = {"cameras": "other-cameras"}
    walk(tmp_path, other, tiles="2").run()
    assert len(other.started) == len(read_parts(tmp_path / "out").parts)
    own = engine_in(tmp_path)  # asks every part: each knows whether it is finished
    walk(tmp_path, own, tiles="2").run()
    assert len(own.started) == len(other.started)


def test_a_damaged_state_counts_as_none(tmp_path: Path) -> None:
    walk(tmp_path, engine_in(tmp_path, trusts=True)).run()
    for name, text in (("train", "{"), ("plan-r0", '{"state": "DONE"}'), ("texture-r0", "[]")):
        state_path(tmp_path / "out", name).write_text(text)
    again = engine_in(tmp_path, trusts=True)
    walk(tmp_path, again).run()
    assert again.started == ["cameras", "train", "plan-r0", "texture-r0"]


def test_a_cancelled_walk_stops(tmp_path: Path) -> None:
    engine = engine_in(tmp_path)
    begun = walk(tmp_path, engine)
    begun.is_cancelled = lambda: "train" in engine.started
    with pytest.raises(Cancelled):
        begun.run()
    assert engine.started == ["cameras", "train"]
