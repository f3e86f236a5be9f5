# SPDX-License-Identifier: GPL-3.0-or-later
"""Convex regions of interest, and boxes that partition space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from ..scene.camera import Similarity
from .box import CUBE_CORNERS, check_volume, flat_region_error

# -- Partition space into boxes that hold about the same weight each ------------------------------


Split = tuple[int, int, float]
"""Index of the tile that is split, axis, coordinate: points at or beyond it form a new tile."""


@dataclass(frozen=True)
class Tiling:
    """Half-open axis-aligned boxes that partition space.

    Every point has exactly one owner, also on a border.
    """

    splits: tuple[Split, ...]

    def __len__(self) -> int:
        return len(self.splits) + 1

    def owner(self, points: np.ndarray) -> np.ndarray:
        """Return the tile index of each of (n, 3) points, (n,) int64."""
        result = np.zeros(len(points), np.int64)
        for new, (tile, axis, coordinate) in enumerate(self.splits, 1):
            result[(result == tile) & (points[:, axis] >= coordinate)] = new
        return result

    def box(self, tile: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest corner of a tile, infinite where space is not split."""
        low = np.full((len(self), 3), -np.inf)
        high = np.full((len(self), 3), np.inf)
        for new, (cut, axis, coordinate) in enumerate(self.splits, 1):
            low[new], high[new] = low[cut], high[cut]
            high[cut, axis] = low[new, axis] = coordinate
        return low[tile], high[tile]

    def within(self, tile: int, points: np.ndarray, reach: float | np.ndarray) -> np.ndarray:
        """Return which of (n, 3) points lie at most ``reach`` outside a tile's box, (n,) bool.

        ``reach`` is a length, or one for each axis.
        """
        low, high = self.box(tile)
        return np.asarray(((points >= low - reach) & (points <= high + reach)).all(1))

    def to_json(self) -> list[list[float]]:
        """Return JSON values."""
        return [[tile, axis, coordinate] for tile, axis, coordinate in self.splits]

    @classmethod
    def from_json(cls, values: Sequence[Sequence[float]]) -> Tiling:
        """Build from JSON values."""
        return cls(tuple((int(tile), int(axis), float(at)) for tile, axis, at in values))


def split_evenly(
    centers: np.ndarray, weights: np.ndarray, bounds: tuple[np.ndarray, np.ndarray],
    enough: Callable[[int, float], bool],
) -> Tiling:  # fmt: skip
    """Split the heaviest tile in two until there are enough.

    A tile is split at the median of its weight, along the longest side of the bounding box of its
    contents; where nothing has weight, it is halved within the bounds of the whole. ``enough`` maps
    the number of tiles and the greatest weight to whether to stop.
    """
    owner = np.zeros(len(centers), np.int64)
    tile_weights, splits = [float(weights.sum())], []
    boxes = [(np.array(bounds[0], np.float64), np.array(bounds[1], np.float64))]
    while not enough(len(tile_weights), max(tile_weights)):
        tile, new = int(np.argmax(tile_weights)), len(tile_weights)
        rows = np.flatnonzero((owner == tile) & (weights > 0))
        low, high = boxes[tile]
        if len(rows) >= 2:
            held = centers[rows]
            axis = int(np.argmax(held.max(0) - held.min(0)))
            order = np.argsort(held[:, axis], kind="stable")
            half = int(np.searchsorted(np.cumsum(weights[rows[order]]), tile_weights[tile] / 2))
            half = min(half, len(rows) - 2)
            coordinate = float(held[order[half : half + 2], axis].mean())
        else:
            axis = int(np.argmax(high - low))
            coordinate = float((low[axis] + high[axis]) / 2)
        moved = (owner == tile) & (centers[:, axis] >= coordinate)
        owner[moved] = new
        middle_high, middle_low = high.copy(), low.copy()
        middle_high[axis] = middle_low[axis] = coordinate
        boxes[tile] = (low, middle_high)
        boxes.append((middle_low, high))
        tile_weights.append(float(weights[moved].sum()))
        tile_weights[tile] = float(weights[owner == tile].sum())
        splits.append((tile, axis, coordinate))
    return Tiling(tuple(splits))


# -- Region of interest: a convex body given by its vertices --------------------------------------


COPLANAR_COSINE = 1.0 - 1e-9
"""Hull triangles whose normals have at least this cosine belong to one face."""


@dataclass(frozen=True)
class Region:
    """A convex body, in the caller's frame: world in files, scene inside the program.

    Raises
    ------
    MeshingError
        Fewer than four vertices, too many, not finite, or no volume.
    """

    name: str
    vertices: np.ndarray  # (v, 3) float64; their convex hull is the body

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, np.float64)
        check_volume(vertices, self.name)
        vertices.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)
        try:
            if self._hull.volume > 0.0:
                return
        except QhullError:
            pass
        raise flat_region_error(self.name)

    @classmethod
    def box(
        cls, name: str, low: np.ndarray, high: np.ndarray, rotation: np.ndarray | None = None
    ) -> Region:
        """Return the box from corner ``low`` to ``high`` of its own frame, (3,) each.

        The rotation maps that into the caller's: ``x = rotation @ local``.
        """
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        corners = (low + high) / 2 + CUBE_CORNERS * (high - low) / 2  # (8, 3)
        return cls(name, corners if rotation is None else corners @ np.asarray(rotation).T)

    @cached_property
    def _hull(self) -> ConvexHull:
        # Centred and scaled: a 1 m body at UTM coordinates would lose seven digits.
        return ConvexHull((self.vertices - self.center) / self.diagonal)

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest coordinates, (3,) each."""
        return self.vertices.min(0), self.vertices.max(0)

    @cached_property
    def center(self) -> np.ndarray:
        """(3,) middle of the bounds."""
        low, high = self.bounds
        return (low + high) / 2

    @cached_property
    def diagonal(self) -> float:
        """Length of the diagonal of the bounds."""
        low, high = self.bounds
        return float(np.linalg.norm(high - low))

    @cached_property
    def volume(self) -> float:
        """Volume of the convex hull."""
        return float(self._hull.volume) * self.diagonal**3

    @cached_property
    def area(self) -> float:
        """Area of the convex hull."""
        return float(self._hull.area) * self.diagonal**2

    @cached_property
    def simplices(self) -> np.ndarray:
        """(t, 3) int32 triangles of the hull, counter-clockwise seen from outside."""
        triangles = np.array(self._hull.simplices, np.int32)
        a, b, c = (self._hull.points[triangles[:, k]] for k in range(3))
        inward = (np.cross(b - a, c - a) * self._hull.equations[:, :3]).sum(1) < 0
        triangles[inward] = triangles[inward][:, ::-1]
        return triangles

    @cached_property
    def _faces_of_simplices(self) -> np.ndarray:
        """(t,) index of the planar face that each hull triangle belongs to."""
        equations = self._hull.equations
        labels = np.full(len(equations), -1, np.int64)
        for index in range(len(equations)):
            if labels[index] < 0:
                same = equations[:, :3] @ equations[index, :3] > COPLANAR_COSINE
                same &= np.abs(equations[:, 3] - equations[index, 3]) < 1e-9
                labels[same & (labels < 0)] = index
        return np.unique(labels, return_inverse=True)[1]

    @cached_property
    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Outward unit normals (k, 3) and offsets (k,) relative to :attr:`center`.

        A point is inside where ``normals @ (point - center) <= offsets``; one row per planar face.
        """
        _, first = np.unique(self._faces_of_simplices, return_index=True)
        equations = self._hull.equations[first]  # (k, 4)
        return equations[:, :3].copy(), -equations[:, 3] * self.diagonal

    def faces(self) -> list[np.ndarray]:
        """Return the triangles' corners for each row of :attr:`half_spaces`, (t, 3, 3) each."""
        count = len(self.half_spaces[1])
        corners = self.vertices[self.simplices]  # (t, 3, 3)
        return [corners[self._faces_of_simplices == index] for index in range(count)]

    def edges(self) -> np.ndarray:
        """Return the sharp edges of the body as (e, 2, 3) end points."""
        triangles = self.simplices
        pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)  # (3t, 2)
        owner = np.repeat(self._faces_of_simplices, 3)
        order = np.lexsort((pairs[:, 1], pairs[:, 0]))
        first, second = order[0::2], order[1::2]  # every hull edge has exactly two triangles
        sharp = owner[first] != owner[second]
        return self.vertices[pairs[first[sharp]]]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the largest signed half-space distance of (n, 3) points, (n,); < 0 inside."""
        normals, offsets = self.half_spaces
        local = np.asarray(points, np.float64) - self.center
        result = np.full(len(local), -np.inf)
        for normal, offset in zip(normals, offsets, strict=True):
            np.maximum(result, local @ normal - offset, out=result)
        return result

    def contains(self, points: np.ndarray, tolerance: float = 0.0) -> np.ndarray:
        """Return which of (n, 3) points lie inside, or outside by at most ``tolerance``, (n,)."""
        return self.distance(points) <= tolerance

    def transformed(self, target_from_source: Similarity) -> Region:
        """Return the same body in another frame."""
        return replace(self, vertices=target_from_source.points(self.vertices))
