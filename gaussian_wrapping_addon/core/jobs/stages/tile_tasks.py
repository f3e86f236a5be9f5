# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of a tiled mesh: points of a tile, all points, faces of a tile."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from ...meshing.tiles.kinds import GATHER, POINTS, TILE_KINDS
from ...meshing.tiles.plan import Field, TilePlan
from ...meshing.tiles.store import (
    faces_path,
    gathered_path,
    load_gathered,
    load_plan,
    load_points,
    points_path,
    save_gathered,
    save_points,
    save_surface,
)
from ...meshing.tiles.tile_faces import tile_faces
from ...meshing.tiles.tile_points import GatheredPoints, gather, tile_points
from ...meshing.tiles.tile_surface import tile_surface
from ...progress import Progress


def tile_file(folder: Path, kind: str, tile: int) -> Path:
    """Return the file that a part of a tiled mesh makes."""
    if kind == GATHER:
        return gathered_path(folder)
    return (points_path if kind == POINTS else faces_path)(folder, tile)


class TileMaker:
    """Makes the parts of one planned region; each can be made again, with the same result.

    Parameters
    ----------
    folder : Path
        Of the tiles, with their plan.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @cached_property
    def plan(self) -> TilePlan:
        """The plan of the region."""
        return load_plan(self._folder)[0]

    @cached_property
    def _all_points(self) -> GatheredPoints:
        return load_gathered(gathered_path(self._folder))

    def make_all(self, field: Field, progress: Progress) -> None:
        """Make all parts that are missing, one after another."""
        count = len(self.plan.tiling)
        todo = [(kind, tile) for kind in TILE_KINDS for tile in range(count)]
        todo = [(kind, tile) for kind, tile in todo if kind != GATHER or tile == 0]
        for number, (kind, tile) in enumerate(todo):
            if not tile_file(self._folder, kind, tile).is_file():
                span = progress.span(number / len(todo), (number + 1) / len(todo))
                self.make(kind, tile, field, span)

    def make(self, kind: str, tile: int, field: Field, progress: Progress) -> Path:
        """Make a part and return its file."""
        path = tile_file(self._folder, kind, tile)
        if kind == POINTS:
            save_points(path, tile_points(field, self.plan, tile, progress))
        elif kind == GATHER:
            progress.update(0.0, "bringing the tiles' points together")
            count = len(self.plan.tiling)
            parts = [load_points(points_path(self._folder, number)) for number in range(count)]
            save_gathered(path, gather(self.plan, parts))
        else:
            faces = tile_faces(field, self.plan, self._all_points, tile, progress.span(0.0, 0.9))
            save_surface(path, tile_surface(self.plan, self._all_points, faces))
        return path
