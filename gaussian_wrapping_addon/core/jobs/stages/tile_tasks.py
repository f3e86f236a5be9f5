# SPDX-License-Identifier: GPL-3.0-or-later
"""Tasks of a tiled mesh, which any number of processes can share."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

from ...meshing.tiles.plan import Field, TilePlan
from ...meshing.tiles.store import (
    faces_path,
    gathered_path,
    load_gathered,
    load_points,
    points_path,
    save_faces,
    save_gathered,
    save_points,
)
from ...meshing.tiles.tile_faces import tile_faces
from ...meshing.tiles.tile_points import gather, tile_points
from ...progress import Progress
from ..store.claims import Task


def tile_tasks(folder: Path, plan: TilePlan, field: Field) -> list[Task]:
    """Return the tasks of a tile list: points of each tile, all points, faces of each tile."""
    count = len(plan.tiling)
    all_points = cache(lambda: load_gathered(gathered_path(folder)))

    def make_points(tile: int, progress: Progress) -> None:
        save_points(points_path(folder, tile), tile_points(field, plan, tile, progress))

    def gather_points(progress: Progress) -> None:
        progress.update(0.0, "bringing the tiles' points together")
        parts = [load_points(points_path(folder, tile)) for tile in range(count)]
        save_gathered(gathered_path(folder), gather(plan, parts))

    def make_faces(tile: int, progress: Progress) -> None:
        part = tile_faces(field, plan, all_points(), tile, progress)
        save_faces(faces_path(folder, tile), part)

    def all_sampled() -> bool:
        return all(points_path(folder, tile).is_file() for tile in range(count))

    gathered = gathered_path(folder).is_file
    tasks = [
        Task(
            f"points-{tile:04d}",
            points_path(folder, tile).is_file,
            lambda: True,
            partial(make_points, tile),
        )
        for tile in range(count)
    ]
    tasks.append(Task("points", gathered, all_sampled, gather_points))
    tasks += [
        Task(
            f"faces-{tile:04d}",
            faces_path(folder, tile).is_file,
            gathered,
            partial(make_faces, tile),
        )
        for tile in range(count)
    ]
    return tasks
