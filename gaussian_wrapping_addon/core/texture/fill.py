# SPDX-License-Identifier: GPL-3.0-or-later
"""Fill unseen texels and the space between charts.

Unseen texels get a harmonic interpolation of the seen colours over the surface, on small cells in
space, so that it does not depend on the charts; near seen texels of the same chart it blends into
their colours. The space between charts repeats the chart's border, then fades to averages, so that
mip maps stay clean.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, identity
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from ..compiled import kernel
from .photo_samples import SurfaceArrays, SurfacePoints

CELLS_PER_SIDE = 96
BLEND_TEXELS = 16
NEAREST_WEIGHT = 1e-4
"""Weight of the nearest seen cell against one neighbour: determines pieces without seen cells."""
UNKNOWN_GREY = 128
CELL_BITS = 10
BACKGROUND_ROWS = 256
"""Image rows held as floats at once; even, so that row pairs stay together."""


def surface_positions(points: SurfacePoints, surface: SurfaceArrays) -> np.ndarray:
    """Return (n, 3) float64 positions of surface points."""
    bary = points.bary.astype(np.float64)
    weights = np.concatenate([bary, 1.0 - bary.sum(axis=1, keepdims=True)], axis=1)
    corners = surface.vertices[surface.faces[points.face]]  # (n, 3, 3)
    return np.einsum("nc,ncx->nx", weights, corners)


class HarmonicFill:
    """Harmonic interpolation of point colours over the surface.

    Parameters
    ----------
    known, colors : (n, 3) float64, (n, 3) uint8
        Positions and their colours; without any, the result is mid grey.
    queries : callable
        Each call yields again all positions to colour, in blocks of (m, 3) float64: there may be
        tens of millions of them.
    """

    def __init__(
        self, known: np.ndarray, colors: np.ndarray, queries: Callable[[], Iterable[np.ndarray]]
    ) -> None:
        self._keys = np.empty(0, np.int64)
        if len(known) == 0:
            return
        low, high = known.min(axis=0), known.max(axis=0)
        for block in queries():
            low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
        self._low = low
        self._cell = max(float((high - low).max()), 1e-12) / CELLS_PER_SIDE
        key_known = self._cells(known)
        keys = np.unique(key_known)
        for block in queries():
            keys = np.union1d(keys, self._cells(block))
        index = np.searchsorted(keys, key_known)
        count = np.bincount(index, minlength=len(keys))
        has = count > 0
        values = np.empty((len(keys), 3))
        for channel in range(3):
            total = np.bincount(index, colors[:, channel], len(keys))
            values[:, channel] = total / np.maximum(count, 1)
        centres = np.stack([keys >> (2 * CELL_BITS), (keys >> CELL_BITS), keys], axis=1)
        centres = centres & ((1 << CELL_BITS) - 1)  # (cells, 3)
        values[~has] = _harmonic(keys, centres, has, values[has])
        self._keys, self._values = keys, values

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Return (m, 3) float32 colours of positions that ``queries`` yielded."""
        if len(self._keys) == 0:
            return np.full((len(positions), 3), UNKNOWN_GREY, np.float32)
        return _interpolate(self._keys, self._values, (positions - self._low) / self._cell)

    def _cells(self, positions: np.ndarray) -> np.ndarray:
        return _key(((positions - self._low) / self._cell).astype(np.int64))


def _key(coordinates: np.ndarray) -> np.ndarray:
    x, y, z = coordinates[..., 0], coordinates[..., 1], coordinates[..., 2]
    return (x << (2 * CELL_BITS)) | (y << CELL_BITS) | z


def _find(keys: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Return the index of each key, or -1."""
    index = np.searchsorted(keys, queries).clip(0, len(keys) - 1)
    return np.where(keys[index] == queries, index, -1)


def _harmonic(
    keys: np.ndarray, centres: np.ndarray, known: np.ndarray, values: np.ndarray
) -> np.ndarray:
    unknown = np.flatnonzero(~known)
    if len(unknown) == 0:
        return np.empty((0, 3))
    number = np.full(len(keys), -1)
    number[unknown] = np.arange(len(unknown))
    number_known = np.full(len(keys), -1)
    number_known[known] = np.arange(int(known.sum()))
    nearest = cKDTree(centres[known]).query(centres[unknown])[1]
    right = NEAREST_WEIGHT * values[nearest]
    degree = np.full(len(unknown), NEAREST_WEIGHT)
    rows, columns = [], []
    limit = (1 << CELL_BITS) - 1
    for offset in np.ndindex(3, 3, 3):
        step = np.array(offset) - 1
        if not step.any():
            continue
        target = centres[unknown] + step
        there = _find(keys, _key(target))
        there[((target < 0) | (target > limit)).any(axis=1)] = -1
        has = there >= 0
        degree += has
        row = np.flatnonzero(has)
        to_known = number_known[there[row]]
        fixed = to_known >= 0
        np.add.at(right, row[fixed], values[to_known[fixed]])
        rows.append(row[~fixed])
        columns.append(number[there[row[~fixed]]])
    row, column = np.concatenate(rows), np.concatenate(columns)
    size = (len(unknown), len(unknown))
    adjacency = coo_matrix((np.ones(len(row)), (row, column)), shape=size)
    matrix = identity(len(unknown)).multiply(degree[:, None]) - adjacency
    return splu(matrix.tocsc()).solve(right)


def _interpolate(keys: np.ndarray, values: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Interpolate trilinearly among existing cells; the cell of a point always exists."""
    base = np.floor(positions - 0.5).astype(np.int64)
    share = positions - 0.5 - base
    total = np.zeros((len(positions), 3))
    weight_sum = np.full(len(positions), 1e-12)
    for offset in np.ndindex(2, 2, 2):
        target = base + offset
        weight = np.prod(np.where(np.array(offset) == 1, share, 1.0 - share), axis=1)
        there = _find(keys, _key(target.clip(0)))
        weight = np.where((there >= 0) & (target >= 0).all(axis=1), weight, 0.0)
        total += weight[:, None] * values[there]
        weight_sum += weight
    return (total / weight_sum[:, None]).astype(np.float32)


def dilate(
    image: np.ndarray, ring: np.ndarray, chart: np.ndarray, rings: int, inside: bool
) -> None:
    """Dilate filled texels ring by ring; each texel is the mean of its neighbours in earlier rings.

    Parameters
    ----------
    image, ring : (h, w, 3) uint8, (h, w) int16
        Modified in place. ``ring`` is 0 if filled, -1 if not, then the ring that filled the texel.
    chart : (h, w) int32
        Chart of each texel, -1 between charts.
    rings : int
        Number of rings, texels.
    inside : bool
        Dilate only within each chart; otherwise only between charts.
    """
    frontier = np.empty(_border_texels(ring, chart, inside, np.empty(0, np.int64)), np.int64)
    _border_texels(ring, chart, inside, frontier)
    for number in range(1, rings + 1):
        if len(frontier) == 0:
            return
        frontier = _dilate_ring(frontier, number, image, ring, chart, inside)


def fill_gutters(image: np.ndarray, owned: np.ndarray, gutter_px: int) -> np.ndarray:
    """Dilate the texels of charts into the space between, in place; return which are filled."""
    ring = np.where(owned, np.int16(0), np.int16(-1))
    chart = np.where(owned, np.int32(0), np.int32(-1))
    dilate(image, ring, chart, gutter_px, inside=False)
    return np.asarray(ring >= 0)


@kernel(fast=False)
def _border_texels(ring: Any, chart: Any, inside: bool, out: Any) -> int:
    """Count the filled texels next to unfilled ones; write as many as fit into ``out``."""
    height, width = ring.shape
    count = 0
    for y in range(height):
        for x in range(width):
            if ring[y, x] != 0:
                continue
            is_open = False
            for v in range(max(y - 1, 0), min(y + 2, height)):
                for u in range(max(x - 1, 0), min(x + 2, width)):
                    queries = chart[v, u] == chart[y, x] if inside else chart[v, u] < 0
                    is_open = is_open or (ring[v, u] < 0 and queries)
            if is_open:
                if count < len(out):
                    out[count] = y * width + x
                count += 1
    return count


@kernel(fast=False)
def _dilate_ring(
    frontier: Any, number: int, image: Any, ring: Any, chart: Any, inside: bool
) -> np.ndarray:
    height, width = ring.shape
    found = np.empty(8 * len(frontier), np.int64)
    count = 0
    for texel in frontier:
        y, x = texel // width, texel % width
        for v in range(max(y - 1, 0), min(y + 2, height)):
            for u in range(max(x - 1, 0), min(x + 2, width)):
                queries = chart[v, u] == chart[y, x] if inside else chart[v, u] < 0
                if ring[v, u] < 0 and queries:
                    ring[v, u] = number
                    found[count] = v * width + u
                    count += 1
    for k in range(count):
        y, x = found[k] // width, found[k] % width
        red, green, blue, total = 0, 0, 0, 0
        for v in range(max(y - 1, 0), min(y + 2, height)):
            for u in range(max(x - 1, 0), min(x + 2, width)):
                if ring[v, u] < 0 or ring[v, u] >= number:
                    continue
                if inside and chart[v, u] != chart[y, x]:
                    continue
                red += image[v, u, 0]
                green += image[v, u, 1]
                blue += image[v, u, 2]
                total += 1
        image[y, x, 0] = (red + total // 2) // total
        image[y, x, 1] = (green + total // 2) // total
        image[y, x, 2] = (blue + total // 2) // total
    return found[:count]


def fill_background(image: np.ndarray, filled: np.ndarray) -> None:
    """Fill the rest of the image by averages of increasingly large blocks (pull-push), in place."""
    if filled.all():
        return
    if not filled.any():
        image[:] = UNKNOWN_GREY
        return
    height, width = filled.shape
    if max(height, width) == 1:
        return
    # The finest level is the image itself: as floats it would be the largest array.
    colors = [np.empty((-(-height // 2), -(-width // 2), 3), np.float32)]
    weights = [np.empty(colors[0].shape[:2], np.float32)]
    bands = [(row, min(row + BACKGROUND_ROWS, height)) for row in range(0, height, BACKGROUND_ROWS)]
    for begin, end in bands:
        known = filled[begin:end].astype(np.float32)
        rows = slice(begin // 2, -(-end // 2))
        colors[0][rows], weights[0][rows] = _coarser(image[begin:end] * known[..., None], known)
    while max(weights[-1].shape) > 1:
        color, weight = _coarser(colors[-1], weights[-1])
        colors.append(color)
        weights.append(weight)
    current = colors.pop()
    weights.pop()
    while colors:
        color, weight = colors.pop(), weights.pop()
        wide = _finer(current, *weight.shape)
        np.copyto(color, wide, where=weight[..., None] == 0)
        current = color
    for begin, end in bands:
        wide = _finer(current[begin // 2 : -(-end // 2)], end - begin, width)
        empty = ~filled[begin:end]
        image[begin:end][empty] = np.rint(wide[empty]).astype(np.uint8)


def _coarser(color: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Average blocks of 2 x 2 with weights of 0 and 1; return such weights too."""
    total = _halved(weight[..., None])
    known = (total > 0).astype(np.float32)
    return _halved(color) / np.maximum(total, 1e-6) * known, known[..., 0]


def _finer(values: np.ndarray, height: int, width: int) -> np.ndarray:
    return values.repeat(2, axis=0)[:height].repeat(2, axis=1)[:, :width]


def _halved(values: np.ndarray) -> np.ndarray:
    height, width = values.shape[:2]
    if height % 2 or width % 2:
        values = np.pad(values, ((0, height % 2), (0, width % 2), (0, 0)))
    return values[0::2, 0::2] + values[1::2, 0::2] + values[0::2, 1::2] + values[1::2, 1::2]
