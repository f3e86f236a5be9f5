# SPDX-License-Identifier: GPL-3.0-or-later
"""Tiles joined in the memory of the simplified mesh."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...errors import MeshingError
from ...mesh.components import compacted
from ...mesh.edge_collapse import COLUMNS
from ...mesh.simplification import flip_edges, left_of, merge_vertices, quadrics_of
from ...mesh.surface_mesh import summed
from ...progress import Progress
from ..primal_adaptive import KIND_SPLIT, kinds_after
from ..repair import remove_degenerate, split_nonmanifold
from .plan import TilePlan
from .tile import BorderFaces, TileSurface, cost_units, longest_edge, tiles_disagree

# -- A simplified mesh that grows by one tile after another ---------------------------------------
#
# Of a tile only the vertices come in that are left below a cost of mergers; the band along its
# border comes in dense. As soon as all tiles at the points of a band are there, its faces are
# repaired and its vertices merged up to the same cost. So dense faces exist of one tile, and
# along the border of what has been joined so far.

RINGS = 2  # rings of faces around a band's points that are merged along with it

LoadTile = Callable[[int], TileSurface]  # returns the surface of a tile

BLOCK = 1 << 20  # faces that are looked through at once


class Joined(NamedTuple):
    """All tiles, simplified alike; :class:`GrowingMesh` has the arrays' descriptions."""

    vertices: np.ndarray
    faces: np.ndarray  # (f, 3) int64
    kind: np.ndarray
    quadrics: np.ndarray
    stand_for: np.ndarray


class GrowingMesh:
    """Rows of vertices and faces; rows that become free are used again.

    Parameters
    ----------
    region : Region
    units : Units
        Of costs.
    level : float
        Highest cost of a merger; negative: nothing is merged.
    longest : float
        Greatest length of a new edge.
    least_height : float
        Faces with a smaller height are removed.
    vertices : int
        How many rows to begin with.
    """

    def __init__(self, plan: TilePlan, *, level: float, least_height: float, vertices: int) -> None:
        self._region, self._units = plan.region, cost_units(plan.region)
        self._level, self._longest, self._least_height = level, longest_edge(plan), least_height
        self.points = np.empty((vertices, 3))
        self.quadrics = np.empty((vertices, COLUMNS))  # of each with all that merged into it
        self.stand_for = np.empty(vertices, np.int32)  # how many vertices of the dense surface
        self.kind = np.empty(vertices, np.uint8)
        self.faces = np.empty((2 * vertices, 3), np.int32)  # -1 in free rows
        self._vertex_end = self._face_end = 0
        self._free_vertices = self._free_faces = np.zeros(0, np.int64)
        self._open_numbers = self._open_rows = np.zeros(0, np.int64)
        self.split_vertices = self.split_edges = 0

    def add(self, surface: TileSurface) -> None:
        """Add what is left of a tile's surface."""
        count = len(surface.vertices)
        dense = surface.faces.astype(np.int64)
        stands = left_of(surface.into, surface.level, self._level)
        faces = stands[dense]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        shared = surface.number >= 0
        stays = (stands == np.arange(count)) & shared
        stays[faces] = True
        quadrics = summed(stands, quadrics_of(surface.vertices, dense, self._units), count)
        where = np.full(count, -1)
        known = self._rows_of(surface.number[shared])
        where[np.flatnonzero(shared)] = known
        fresh = np.flatnonzero(stays & (where < 0))
        where[fresh] = self._new_vertices(len(fresh))
        rows = where[fresh]
        self.points[rows], self.quadrics[rows] = surface.vertices[fresh], quadrics[fresh]
        self.kind[rows] = surface.kind[fresh]
        self.stand_for[rows] = np.bincount(stands, minlength=count)[fresh]
        # Of points that came with another tile only the faces are new.
        again = np.flatnonzero(shared)[known >= 0]
        self.quadrics[where[again]] += quadrics[again]
        self._add_faces(where[faces])
        opened = fresh[shared[fresh]]
        self._open(surface.number[opened].astype(np.int64), where[opened])

    def add_between(self, faces: np.ndarray) -> np.ndarray:
        """Add faces between tiles, (f, 3) points' numbers; return their corners, (f, 3, 3).

        Raises MeshingError: no tile has one of the corners.
        """
        corners = self._rows_of(faces.reshape(-1)).reshape(-1, 3)
        if (corners < 0).any():
            raise tiles_disagree()
        rows, local = np.unique(corners, return_inverse=True)
        self.quadrics[rows] += quadrics_of(self.points[rows], local.reshape(-1, 3), self._units)
        self._add_faces(corners)
        return np.asarray(self.points[corners])

    def close(self, numbers: np.ndarray) -> None:
        """Repair and simplify around points whose faces are all there.

        Raises MeshingError: the faces around them are not closed.
        """
        ready = self._close(numbers)
        rows, inner = self._around(ready)
        used, local = np.unique(self.faces[rows], return_inverse=True)
        self._free_vertices = np.append(self._free_vertices, np.setdiff1d(ready, used))
        if len(rows) == 0:
            return
        is_ready = np.isin(used, ready)
        held = ~inner[used] | np.isin(used, self._open_rows)
        repaired = split_nonmanifold(self.points[used], local.reshape(-1, 3), ~is_ready)
        origin = np.maximum(repaired.origin, 0)
        fixed = (repaired.origin >= 0) & held[origin]
        faces, _ = remove_degenerate(
            repaired.vertices, repaired.faces, self._least_height, self._region, fixed
        )
        kind = kinds_after(self.kind[used], repaired.origin)
        quadrics, stand_for = self.quadrics[used][origin], self.stand_for[used][origin]
        parted = (kind == KIND_SPLIT) & (is_ready[origin] | (repaired.origin < 0))
        if parted.any():
            # A copy has the planes of its own faces only.
            alone = quadrics_of(repaired.vertices, repaired.faces, self._units)
            quadrics[parted], stand_for[parted] = alone[parted], 1
        if self._level >= 0.0:
            merged = merge_vertices(
                repaired.vertices, faces, self._units, 0, self._longest, most=self._level,
                locked=fixed, quadrics=quadrics,
            )  # fmt: skip
            stands = left_of(merged.into, merged.level, self._level)
            stand_for = np.bincount(stands, stand_for, minlength=len(stands))
            faces, quadrics = merged.faces, merged.quadrics
        # Held vertices keep their rows, which faces elsewhere refer to.
        where = np.full(len(fixed), -1)
        where[fixed] = used[origin[fixed]]
        self._free_vertices = np.append(self._free_vertices, used[~held])
        self._free_faces = np.append(self._free_faces, rows)
        self.faces[rows] = -1
        stays = np.zeros(len(fixed), np.bool_)
        stays[faces] = True
        fresh = np.flatnonzero(stays & ~fixed)
        at = where[fresh] = self._new_vertices(len(fresh))
        self.points[at], self.quadrics[at] = repaired.vertices[fresh], quadrics[fresh]
        self.kind[at], self.stand_for[at] = kind[fresh], stand_for[fresh]
        self._add_faces(where[faces])
        self.split_vertices += repaired.split_vertices
        self.split_edges += repaired.split_edges

    def compacted(self) -> Joined:
        """Return what has been joined; the rows are given up."""
        faces, self.faces = self.faces[: self._face_end], self.faces[:0]
        faces = faces[faces[:, 0] >= 0]
        rows, index = np.unique(faces, return_inverse=True)
        return Joined(
            self.points[rows], index.reshape(-1, 3).astype(np.int64), self.kind[rows],
            self.quadrics[rows], self.stand_for[rows],
        )  # fmt: skip

    def _around(self, ready: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the faces around vertices, and (v,) bool: vertices that have no others."""
        inner = np.zeros(self._vertex_end, np.bool_)
        inner[ready] = True
        for _ in range(RINGS):
            inner[self.faces[self._at(inner)]] = True
        return self._at(inner), inner

    def _at(self, chosen: np.ndarray) -> np.ndarray:
        """Return the rows of the faces with a corner at chosen vertices, increasing."""
        found = [
            begin + np.flatnonzero(chosen[block].any(1) & (block[:, 0] >= 0))
            for begin in range(0, self._face_end, BLOCK)
            for block in [self.faces[begin : min(begin + BLOCK, self._face_end)]]
        ]
        return np.concatenate([*found, np.zeros(0, np.int64)])

    def _rows_of(self, numbers: np.ndarray) -> np.ndarray:
        """Return the vertices of open points, -1 for others, (n,) int64."""
        if len(self._open_numbers) == 0:
            return np.full(len(numbers), -1)
        at = np.minimum(np.searchsorted(self._open_numbers, numbers), len(self._open_numbers) - 1)
        return np.where(self._open_numbers[at] == numbers, self._open_rows[at], -1)

    def _open(self, numbers: np.ndarray, rows: np.ndarray) -> None:
        numbers = np.concatenate([self._open_numbers, numbers])
        order = np.argsort(numbers)
        self._open_numbers = numbers[order]
        self._open_rows = np.concatenate([self._open_rows, rows])[order]

    def _close(self, numbers: np.ndarray) -> np.ndarray:
        """Take points out of the open ones; return the vertices of those that are there."""
        gone = np.isin(self._open_numbers, numbers)
        rows = self._open_rows[gone]
        self._open_numbers, self._open_rows = self._open_numbers[~gone], self._open_rows[~gone]
        return rows

    def _new_vertices(self, count: int) -> np.ndarray:
        rows, self._free_vertices = self._free_vertices[:count], self._free_vertices[count:]
        begin = self._vertex_end
        self._vertex_end += count - len(rows)
        for name in ("points", "quadrics", "stand_for", "kind"):
            setattr(self, name, _with_room(getattr(self, name), self._vertex_end))
        return np.concatenate([rows, np.arange(begin, self._vertex_end)])

    def _add_faces(self, faces: np.ndarray) -> None:
        rows, self._free_faces = self._free_faces[: len(faces)], self._free_faces[len(faces) :]
        begin = self._face_end
        self._face_end += len(faces) - len(rows)
        self.faces = _with_room(self.faces, self._face_end)
        self.faces[np.concatenate([rows, np.arange(begin, self._face_end)])] = faces


def _with_room(array: np.ndarray, count: int) -> np.ndarray:
    """Return the array, longer by a quarter where it has fewer than ``count`` rows."""
    if len(array) >= count:
        return array
    result = np.empty((count + count // 4, *array.shape[1:]), array.dtype)
    result[: len(array)] = array
    return result


# -- Flip edges of the joined mesh, tile by tile, to follow the dense surface of each -------------

ROOM_RADII = 8.0
"""The dense surface is given this far, in the largest radii, around the edges that are flipped."""


def flip_by_tiles(
    plan: TilePlan, load: LoadTile, boxes: np.ndarray, between: np.ndarray, vertices: np.ndarray,
    faces: np.ndarray, progress: Progress,
) -> np.ndarray:  # fmt: skip
    """Flip edges of a simplified mesh as :func:`~.simplification.flip_edges`, in little memory.

    Each tile's turn includes the faces just outside, so that edges across borders are flipped as
    well. ``boxes`` (t, 2, 3) are the bounds of each tile's surface, ``between`` (b, 3, 3) the
    corners of the dense faces between tiles. Returns (f, 3) int64.
    """
    faces = faces.copy()
    owner = plan.tiling.owner(vertices[faces].mean(1))
    for tile in range(len(plan.tiling)):
        progress.update(tile / len(plan.tiling), "turning edges")
        at = np.zeros(len(vertices), np.bool_)
        at[faces[owner == tile]] = True
        movable = at[faces].sum(1) >= 2
        if not movable.any():
            continue
        at[faces[movable]] = True
        low = vertices[at].min(0) - ROOM_RADII * plan.radius
        high = vertices[at].max(0) + ROOM_RADII * plan.radius
        near = np.flatnonzero((boxes[:, 0] <= high).all(1) & (boxes[:, 1] >= low).all(1))
        surfaces = (load(number) for number in near.tolist())  # one at a time
        others = (_in_box(near_by.vertices[near_by.faces], low, high) for near_by in surfaces)
        dense = np.concatenate([_in_box(between, low, high), *others])
        rows = np.flatnonzero(at[faces].any(1))
        points, local, source = compacted(vertices, faces[rows])
        turned = flip_edges(
            points, local, dense.reshape(-1, 3), np.arange(3 * len(dense)).reshape(-1, 3),
            longest_edge(plan), movable[rows],
        )  # fmt: skip
        faces[rows] = source[turned]
    return faces


def _in_box(corners: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the triangles (f, 3, 3) whose bounds overlap a box."""
    return corners[((corners.max(1) >= low) & (corners.min(1) <= high)).all(1)]


# -- Join the surfaces of tiles, one after another, simplified to one highest cost ----------------

_logger = logging.getLogger(__name__)

_COST_SHIFT = 46
"""Bits of a float64 that are dropped where costs are counted: 6 of the fraction are left."""


@dataclass(frozen=True)
class TileOverview:
    """What is known of all tiles before they are joined."""

    counts: np.ndarray  # (k,) int64: vertices whose cost of a merger lies in each interval
    kept: int  # vertices that no tile merges, without shared ones
    shared: int  # points at borders, each counted once
    order: tuple[int, ...]
    """In which tiles are joined: neighbours soon after each other, so that few borders are open."""
    ready: tuple[np.ndarray, ...]
    """For each tile, in that order, the numbers of the points that no later tile has, increasing.
    """
    boxes: np.ndarray
    """(t, 2, 3) float64: bounds of each tile's surface; empty tiles have infinite ones."""
    least_height: float
    figures: Counter[str]  # sums over the tiles

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
    figures: Counter[str] = Counter()
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
        figures.update(surface.figures)
        numbers.append(np.union1d(surface.number[~own], surface.border).astype(np.int32))
        places.append(np.full(len(numbers[-1]), place, np.int32))
    number, place_of = np.concatenate(numbers), np.concatenate(places)
    rows = np.lexsort((place_of, number))
    number, place_of = number[rows], place_of[rows]
    last = np.append(number[1:] != number[:-1], True)[: len(number)]
    number, place_of = number[last], place_of[last]
    ready = tuple(number[place_of == place] for place in range(count))
    return TileOverview(counts, kept, len(number), tuple(order), ready, boxes, height, figures)


def joined(
    plan: TilePlan, load: LoadTile, known: TileOverview, level: float, progress: Progress
) -> tuple[GrowingMesh, np.ndarray]:
    """Join all tiles, with all vertices merged up to a cost.

    Returns a closed 2-manifold, and the corners of the dense faces between tiles, (b, 3, 3).
    Raises MeshingError: tiles do not agree on their border.
    """
    left = int(known.counts[_bin_after(level) :].sum()) + known.kept
    mesh = GrowingMesh(
        plan, level=level, least_height=known.least_height, vertices=left + known.shared // 2
    )
    border, between = BorderFaces(), []
    count = len(plan.tiling)
    for place, (tile, ready) in enumerate(zip(known.order, known.ready, strict=True)):
        progress.update(place / count, f"joining tile {place + 1} of {count}")
        surface = load(tile)
        mesh.add(surface)
        faces = [border.add(surface.border, surface.solid), border.close(ready)]
        between.append(mesh.add_between(np.concatenate(faces)))
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
