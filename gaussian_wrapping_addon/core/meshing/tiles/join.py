# SPDX-License-Identifier: GPL-3.0-or-later
"""Join the surfaces of tiles, one after another, simplified to one highest cost."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...errors import MeshingError
from ...progress import Progress
from .border_faces import BorderFaces, tiles_disagree
from .growing_mesh import GrowingMesh
from .plan import TilePlan
from .tile_surface import TileSurface, cost_units, longest_edge

_logger = logging.getLogger(__name__)

LoadTile = Callable[[int], TileSurface]

_COST_SHIFT = 46
"""Bits of a float64 that are dropped where costs are counted: 6 of the fraction are left."""


@dataclass(frozen=True)
class TileOverview:
    """What is known of all tiles before they are joined."""

    counts: np.ndarray
    """(k,) int64: vertices whose cost of a merger lies in each interval."""
    kept: int
    """Vertices that no tile merges, without shared ones."""
    shared: int
    """Points at borders, each counted once."""
    order: tuple[int, ...]
    """In which tiles are joined: neighbours soon after each other, so that few borders are open."""
    ready: tuple[np.ndarray, ...]
    """For each tile, in that order, the numbers of the points that no later tile has, increasing.
    """
    boxes: np.ndarray
    """(t, 2, 3) float64: bounds of each tile's surface; empty tiles have infinite ones."""
    least_height: float
    figures: dict[str, int]
    """Sums over the tiles."""

    @property
    def vertices(self) -> int:
        """Number of dense vertices."""
        return int(self.counts.sum()) + self.kept + self.shared

    def level_for(self, wanted: float) -> float:
        """Return the cost up to which vertices are merged, so that about ``wanted`` are left.

        Points at borders are taken to merge like the others. -1 where nothing is to be merged.
        """
        merged = np.cumsum(self.counts)
        alone = float(merged[-1]) + self.kept
        most = alone * (1.0 - wanted / self.vertices) if self.vertices else 0.0
        last = int(np.searchsorted(merged, most, side="right")) - 1
        if most <= 0.0 or last < 0 or merged[-1] == 0:
            return -1.0
        last = min(last, int(np.flatnonzero(self.counts)[-1]))
        bits = np.array([((last + 1) << _COST_SHIFT) - 1], np.int64)
        return float(bits.view(np.float64)[0])


def overview(plan: TilePlan, load: LoadTile, progress: Progress) -> TileOverview:
    """Look through the surfaces of all tiles."""
    count = len(plan.tiling)
    order = [0]
    for new, (tile, _, _) in enumerate(plan.tiling.splits, 1):
        order.insert(order.index(tile) + 1, new)
    counts = np.zeros(1 << (63 - _COST_SHIFT), np.int64)
    boxes = np.full((count, 2, 3), np.inf)
    kept, height = 0, np.inf
    figures: dict[str, int] = {}
    numbers, places = [], []
    for place, tile in enumerate(order):
        progress.update(place / count, f"counting tile {place + 1} of {count}")
        surface = load(tile)
        own = surface.number < 0
        levels = surface.level[own]
        finite = np.isfinite(levels)
        counts += np.bincount(levels[finite].view(np.int64) >> _COST_SHIFT, minlength=len(counts))
        kept += int((~finite).sum())
        height = min(height, surface.least_height)
        if len(surface.vertices):
            boxes[tile] = surface.vertices.min(0), surface.vertices.max(0)
        for name, value in surface.figures.items():
            figures[name] = figures.get(name, 0) + int(value)
        numbers.append(np.union1d(surface.number[~own], surface.border).astype(np.int32))
        places.append(np.full(len(numbers[-1]), place, np.int32))
    number, place_of = np.concatenate(numbers), np.concatenate(places)
    rows = np.lexsort((place_of, number))
    number, place_of = number[rows], place_of[rows]
    last = np.ones(len(number), np.bool_)
    last[:-1] = number[1:] != number[:-1]
    number, place_of = number[last], place_of[last]
    ready = tuple(number[place_of == place] for place in range(count))
    return TileOverview(counts, kept, len(number), tuple(order), ready, boxes, height, figures)


def joined(
    plan: TilePlan, load: LoadTile, known: TileOverview, level: float, progress: Progress
) -> tuple[GrowingMesh, np.ndarray]:
    """Join all tiles, with all vertices merged up to a cost.

    Returns
    -------
    mesh : GrowingMesh
        A closed 2-manifold.
    between : (b, 3, 3) float64
        Corners of the dense faces between tiles.

    Raises
    ------
    MeshingError
        Tiles do not agree on their border.
    """
    left = int(known.counts[_bin_after(level) :].sum()) + known.kept
    mesh = GrowingMesh(
        plan.region, cost_units(plan.region), level=level, longest=longest_edge(plan),
        least_height=known.least_height, vertices=left + known.shared // 2,
    )  # fmt: skip
    border, between = BorderFaces(), []
    count = len(plan.tiling)
    for place, (tile, ready) in enumerate(zip(known.order, known.ready, strict=True)):
        progress.update(place / count, f"joining tile {place + 1} of {count}")
        surface = load(tile)
        mesh.add(surface)
        faces = border.add(surface.border, surface.solid)
        faces = np.concatenate([faces, border.close(ready)])
        between.append(mesh.add_between(faces))
        try:
            mesh.close(ready)
        except MeshingError as error:
            _logger.warning("Tile %d: %s", tile, error.message)
            raise tiles_disagree() from error
    return mesh, np.concatenate(between)


def _bin_after(level: float) -> int:
    """Return the first interval of costs above a level that :meth:`level_for` has returned."""
    if level < 0.0:
        return 0
    return int(np.array([level]).view(np.int64)[0] >> _COST_SHIFT) + 1
