# SPDX-License-Identifier: GPL-3.0-or-later
"""Plan the parts of a job: those of its stages, and those of tiles once they are known."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ...meshing.tiles.kinds import FACES, GATHER, POINTS
from ...names import region_names
from ...settings import key_values
from ..store.job_file import JobFile, read_job
from ..store.job_folder import JobFolder
from ..store.stage_folder import STAGE_VERSIONS, stage_key
from .code_version import code_version
from .graph import PARTS_NAME, Part, PartsGraph, read_parts, write_parts

# Shares of a job's time: measured on the demo scene, 2 cores.
STAGE_SHARES = {"cameras": 0.12, "train": 0.60, "mesh": 0.14, "texture": 0.12, "export": 0.02}
MASKS_SHARE = 0.1
"""Of the time of a training that masks are made for."""
BAKE_BEGINS = 0.02
"""Share of a bake's time before the bake itself."""
_IN_BLOCKS = {"coarse": 0.12, "block": 0.68, "train": 0.2}
"""Shares of a training in blocks: the coarse one, all blocks, joining."""
_TILED = {"plan": 0.2, POINTS: 0.3, GATHER: 0.03, FACES: 0.37, "mesh": 0.1}
"""Shares of the mesh stage of a region in tiles."""


@dataclass(frozen=True)
class PlannedTiles:
    """What is known of a region in tiles."""

    count: int
    memory_bytes: int | None = None
    """Of a process that makes one of its parts."""
    seconds: float | None = None
    """Of the whole mesh."""


def plan_hash(job: JobFile) -> str:
    """Return the hash of what a job is to do, wherever it runs."""
    return stage_key(
        "parts", STAGE_VERSIONS, {**job.to_json(), "settings": key_values(job.settings)}
    )


def plan_parts(folder: Path, job: JobFile, tiles: Mapping[str, PlannedTiles]) -> PartsGraph:
    """Return the parts of a job, in an order in which they can be run one after another.

    Parameters
    ----------
    folder : Path
        The job folder.
    tiles : mapping
        By region, those that are known to be meshed in tiles.
    """
    parts = _begin(job)
    last = parts[-1].name
    if job.command == "bake":
        parts.append(Part("bake", "bake", (last,), ("baked/*",), 1.0 - BAKE_BEGINS))
    else:
        names = region_names(job.settings.regions, job.region_bodies)
        share = 1.0 / len(names)
        for name in names:
            parts += _of_region(name, last, share, tiles.get(name))
        textures = tuple(f"texture-{name}" for name in names)
        parts.append(
            Part("export", "export", textures, ("result/report.json",), STAGE_SHARES["export"])
        )
    return PartsGraph(code_version(), plan_hash(job), _relative(job.source, folder), tuple(parts))


def fixed_tiles(job: JobFile) -> dict[str, PlannedTiles]:
    """Return the regions whose number of tiles is a setting: known before anything is run."""
    names = region_names(job.settings.regions, job.region_bodies)
    known = {}
    for request, name in zip(job.settings.regions, names, strict=True):
        meshing = job.meshing_of(request)
        if meshing.method == "pam" and meshing.tiles not in ("auto", "off"):
            known[name] = PlannedTiles(int(meshing.tiles))
    return known


def plan_if_missing(folder: JobFolder) -> PartsGraph:
    """Return the parts of a job folder; plan them if that was never done, or for another job.

    Raises
    ------
    UsageError, ParseError
        There is no job, or a file is damaged.
    """
    job = read_job(folder.job_path)
    if (folder.root / PARTS_NAME).exists():
        graph = read_parts(folder.root)
        if graph.plan == plan_hash(job):
            return graph
    graph = plan_parts(folder.root, job, fixed_tiles(job))
    write_parts(folder.root, graph)
    return graph


def _begin(job: JobFile) -> list[Part]:
    """Return the parts up to the training."""
    train = STAGE_SHARES["train"]
    cameras = STAGE_SHARES["cameras"]
    if job.command == "bake":  # both are finished
        cameras = train = BAKE_BEGINS / 2
    parts = [Part("cameras", "cameras", (), ("stages/cameras-*/scene.json",), cameras)]
    if job.settings.masks_are_made:
        made = train * MASKS_SHARE
        train -= made
        parts.append(Part("masks", "masks", ("cameras",), ("stages/masked-*/scene.json",), made))
    needs: tuple[str, ...] = (parts[-1].name,)
    blocks = job.settings.training.blocks
    if blocks > 1 and job.command != "bake":
        of = {kind: train * share for kind, share in _IN_BLOCKS.items()}
        stage = "stages/blocks-*"
        parts.append(Part("coarse", "coarse", needs, (f"{stage}/blocks.json",), of["coarse"]))
        trained = [
            Part(
                f"block-{number:04d}", "block", ("coarse",),
                (f"{stage}/block-{number:04d}/gaussians.npz",), of["block"] / blocks, block=number,
            )
            for number in range(blocks)
        ]  # fmt: skip
        parts += trained
        needs, train = tuple(part.name for part in trained), of["train"]
    return [*parts, Part("train", "train", needs, ("stages/train-*/gaussians.npz",), train)]


def _of_region(name: str, after: str, share: float, tiles: PlannedTiles | None) -> list[Part]:
    """Return the parts of a region. ``plan`` also makes the whole mesh if tiles are not needed."""
    whole = share * STAGE_SHARES["mesh"]
    stage = f"stages/mesh-{name}-*"
    mesh = (f"{stage}/mesh.npz",)

    def part(kind: str, needs: tuple[str, ...], outputs: tuple[str, ...], of: float) -> Part:
        return Part(f"{kind}-{name}", kind, needs, outputs, of, name)

    plan, joined = f"plan-{name}", f"mesh-{name}"
    if tiles is None:
        parts = [
            part("plan", (after,), mesh, 0.9 * whole),
            part("mesh", (plan,), mesh, 0.1 * whole),
        ]
    else:
        count = tiles.count

        def tile(kind: str, number: int, needs: tuple[str, ...]) -> Part:
            of = _TILED[kind]
            seconds = None if tiles.seconds is None else tiles.seconds * of / count
            return Part(
                f"{kind}-{name}-{number:04d}", kind, needs,
                (f"{stage}/tiles/{kind}-{number:04d}.npz",), whole * of / count, name, number,
                tiles.memory_bytes, seconds,
            )  # fmt: skip

        points = [tile(POINTS, number, (plan,)) for number in range(count)]
        gather = part(
            GATHER, tuple(p.name for p in points), (f"{stage}/tiles/points.npz",),
            whole * _TILED[GATHER],
        )  # fmt: skip
        faces = [tile(FACES, number, (gather.name,)) for number in range(count)]
        parts = [
            part("plan", (after,), (f"{stage}/tiles/tiles.json",), whole * _TILED["plan"]),
            *points,
            gather,
            *faces,
            part("mesh", tuple(p.name for p in faces), mesh, whole * _TILED["mesh"]),
        ]
    textured = (f"stages/texture-{name}-*/files/mesh.npz",)
    return [*parts, part("texture", (joined,), textured, share * STAGE_SHARES["texture"])]


def _relative(source: str, folder: Path) -> str:
    try:
        return Path(os.path.relpath(source, folder)).as_posix()
    except ValueError:  # another drive of Windows
        return ""
