# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of a job: which there are, in which order, and what share each has."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.jobs.parts.graph import (
    PartsGraph,
    PlannedTiles,
    code_version,
    fixed_tiles,
    plan_hash,
    plan_parts,
    read_parts,
    write_parts,
)
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job
from gaussian_wrapping_addon.core.settings import JobSettings, MeshingSettings
from tests.core.jobs.finished_sphere import write_cube


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


def test_a_job_begins_with_its_stages(tmp_path: Path) -> None:
    graph = plan_parts(tmp_path / "out", job_of(tmp_path, regions=2), {})
    check(graph)
    assert [part.name for part in graph.parts] == [
        "cameras", "train", "plan-r0", "mesh-r0", "texture-r0", "plan-r1", "mesh-r1", "texture-r1",
        "export",
    ]  # fmt: skip
    assert graph.part("plan-r1").needs == ("train",)
    assert graph.part("export").needs == ("texture-r0", "texture-r1")
    assert (graph.source, graph.code) == ("../photos", code_version())


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


def test_a_number_of_tiles_that_is_set_is_known_before_anything_is_run(tmp_path: Path) -> None:
    assert fixed_tiles(job_of(tmp_path, "4")) == {"r0": PlannedTiles(4)}
    assert fixed_tiles(job_of(tmp_path, "auto")) == fixed_tiles(job_of(tmp_path, "off")) == {}


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


def test_the_plan_depends_on_what_is_to_be_done_alone(tmp_path: Path) -> None:
    job = job_of(tmp_path)
    elsewhere = dataclasses.replace(
        job, settings=dataclasses.replace(job.settings, threads=3, computers="local", processes=5)
    )
    other = dataclasses.replace(job, settings=dataclasses.replace(job.settings, seed=1))
    assert plan_hash(elsewhere) == plan_hash(job) != plan_hash(other)
