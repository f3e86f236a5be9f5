# SPDX-License-Identifier: GPL-3.0-or-later
"""Partition space into boxes that hold about the same weight each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

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
        return cls(
            tuple((int(tile), int(axis), float(coordinate)) for tile, axis, coordinate in values)
        )


def split_evenly(
    centers: np.ndarray,
    weights: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    enough: Callable[[int, float], bool],
) -> Tiling:
    """Split the heaviest tile in two until there are enough.

    A tile is split at the median of its weight, along the longest side of the bounding box of its
    contents.

    Parameters
    ----------
    centers : (n, 3) float64
    weights : (n,) float64
    bounds : pair of (3,)
        Bounds of the whole; where nothing has weight, tiles are halved.
    enough : callable
        Maps the number of tiles and the greatest weight to whether to stop.
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
