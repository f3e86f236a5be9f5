# SPDX-License-Identifier: GPL-3.0-or-later
"""Points near the surface: grids in boxes, samples of depth maps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .. import limits
from ..compiled import inline, kernel
from ..gaussians.model import OrientedGaussians
from ..progress import Progress
from ..render.projection import RawArrays
from ..render.types import Renderer, RenderOptions
from ..render.view_renderer import ViewRenderer
from ..scene.camera import Camera

# -- Multi-level hash grid of boxes: lists, for a point, the boxes that may contain it ------------


COORDINATE_MASK = (1 << 21) - 1
"""Cells 2^21 apart on an axis share a list: harmless, as callers test each box anyway."""
MAX_LEVELS = 48
EMPTY_KEY = -1


@inline
def cell_key(ix: int, iy: int, iz: int) -> int:
    """Pack three cell coordinates, each modulo 2^21, into 63 bits."""
    packed = ((ix & COORDINATE_MASK) << 42) | ((iy & COORDINATE_MASK) << 21)
    return packed | (iz & COORDINATE_MASK)


@inline
def hash_key(key: int) -> int:
    """Mix the bits of a key; the result is >= 0."""
    mixed = key ^ (key >> 31)
    mixed = (mixed * 0x1E3779B97F4A7C15) & 0x7FFFFFFFFFFFFFFF
    return mixed ^ (mixed >> 29)


@kernel(fast=False)
def _count_cells(low, high, cell_size, counts):  # type: ignore[no-untyped-def]
    for i in range(low.shape[0]):
        n = 1
        for k in range(3):
            a = int(np.floor(low[i, k] / cell_size[i]))
            b = int(np.floor(high[i, k] / cell_size[i]))
            n *= b - a + 1
        counts[i] = n


@kernel(fast=False)
def _write_cells(low, high, cell_size, begins, keys, owners):  # type: ignore[no-untyped-def]
    for i in range(low.shape[0]):
        h = cell_size[i]
        at = begins[i]
        for ix in range(int(np.floor(low[i, 0] / h)), int(np.floor(high[i, 0] / h)) + 1):
            for iy in range(int(np.floor(low[i, 1] / h)), int(np.floor(high[i, 1] / h)) + 1):
                for iz in range(int(np.floor(low[i, 2] / h)), int(np.floor(high[i, 2] / h)) + 1):
                    keys[at] = cell_key(ix, iy, iz)
                    owners[at] = i
                    at += 1


@kernel(fast=False)
def _fill_table(keys, values, slot_keys, slot_values, mask):  # type: ignore[no-untyped-def]
    for i in range(keys.shape[0]):
        slot = hash_key(keys[i]) & mask
        while slot_keys[slot] != EMPTY_KEY:
            slot = (slot + 1) & mask
        slot_keys[slot] = keys[i]
        slot_values[slot] = values[i]


@dataclass(frozen=True)
class BoxGrid:
    """Lists of boxes per cell, for each level; see :func:`build_box_grid`.

    Kernels find the list of a point at level ``k`` by probing the hash table slots
    ``[table_begin[k], table_begin[k] + table_mask[k]]`` for :func:`cell_key`; for its value ``c``
    the list is ``owners[cell_begin[c] : cell_begin[c + 1]]``.
    """

    origin: np.ndarray  # (3,) float64 subtracted from points before cells are found
    level_size: np.ndarray  # (levels,) float64 cell edge
    table_begin: np.ndarray  # (levels,) int64
    table_mask: np.ndarray  # (levels,) int64
    slot_keys: np.ndarray  # (slots,) int64, -1 where empty
    slot_cells: np.ndarray  # (slots,) int32
    cell_begin: np.ndarray  # (cells + 1,) int64
    owners: np.ndarray  # (entries,) int32


def build_box_grid(low: np.ndarray, high: np.ndarray) -> BoxGrid:
    """Build a grid that lists boxes, from (n, 3) low to high corners, in cells of their own size.

    Each box is listed in the cells that it touches (at most 27) of the level whose cell edge is
    between half and all of its longest side; so a query reads one cell per level, and neither huge
    nor tiny boxes lengthen the lists of others. Cells twice as large make vector field queries 40 %
    slower, cells half as large need four times the memory without any gain.
    """
    count = len(low)
    origin = low.mean(0) if count else np.zeros(3)
    low, high = low - origin, high - origin
    longest = (high - low).max(1) if count else np.zeros(0)
    top = float(longest.max()) if count else 1.0
    # Level k has cells of top / 2^k; boxes much smaller than the last level's cells are put there.
    with np.errstate(divide="ignore"):
        depth = np.floor(np.log2(top / longest)) if top > 0.0 else np.zeros(count)
    level = np.clip(depth + 1, 0, MAX_LEVELS - 1).astype(np.int64)  # (n,)
    used = np.unique(level)
    level_size = np.ldexp(max(top, 1e-300), -used)  # (levels,)

    table_begin, table_mask = [], []
    slot_key_parts, slot_cell_parts = [np.zeros(0, np.int64)], [np.zeros(0, np.int32)]
    begin_parts, owner_parts = [np.zeros(1, np.int64)], [np.zeros(0, np.int32)]
    slots = cells = entries = 0
    for size, number in zip(level_size.tolist(), used.tolist(), strict=True):
        rows = np.flatnonzero(level == number)
        sizes = np.full(len(rows), size)
        counts = np.empty(len(rows), np.int64)
        _count_cells(low[rows], high[rows], sizes, counts)
        begins = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        keys = np.empty(begins[-1], np.int64)
        owners = np.empty(begins[-1], np.int32)
        _write_cells(low[rows], high[rows], sizes, begins, keys, owners)
        order = np.argsort(keys, kind="stable")
        unique_keys, first = np.unique(keys[order], return_index=True)
        capacity = 1 << max(1, int(2 * len(unique_keys) - 1).bit_length())
        slot_keys = np.full(capacity, EMPTY_KEY, np.int64)
        slot_cells = np.zeros(capacity, np.int32)
        numbers = np.arange(cells, cells + len(unique_keys), dtype=np.int32)
        _fill_table(unique_keys, numbers, slot_keys, slot_cells, capacity - 1)
        table_begin.append(slots)
        table_mask.append(capacity - 1)
        slot_key_parts.append(slot_keys)
        slot_cell_parts.append(slot_cells)
        ends = np.concatenate([first[1:], [len(keys)]]) + entries
        begin_parts.append(ends.astype(np.int64))
        owner_parts.append(rows[owners[order]].astype(np.int32))
        slots, cells, entries = slots + capacity, cells + len(unique_keys), entries + len(keys)
    return BoxGrid(
        origin, level_size, np.asarray(table_begin, np.int64), np.asarray(table_mask, np.int64),
        *(np.concatenate(p) for p in (slot_key_parts, slot_cell_parts, begin_parts, owner_parts)),
    )  # fmt: skip


# -- Surface samples from the cameras' depth maps, and point pairs across the surface from them
#
# Pivots of the Gaussians alone (docs/method.md, section 6.1) miss parts about as thin as a pixel:
# their Gaussians are small, half transparent and many, so that no centre or outer pivot need lie
# inside the solid that they form together. The isosurface of each camera finds it.


MAX_DEPTH_SAMPLES = 120_000
"""Largest number of samples, about evenly over the surface (bounds the triangulation)."""

MAX_SIDE_PX = 960
"""Largest long side of the rendered depth maps."""

DEPTHS_PX = (0.5, 1.0, 2.0)
"""Steps behind the surface, in pixels at its depth, that are tested for being inside."""

STEP_OUT_PX = 0.5
"""Step towards the camera: transmittance exceeds 0.5 there, so the point is empty."""

_POOL = 8 * MAX_DEPTH_SAMPLES
"""Number of pending samples from which they are thinned."""


@dataclass(frozen=True)
class DepthSamples:
    """Points on the cameras' isosurfaces."""

    points: np.ndarray  # (n, 3) float64 scene frame
    directions: np.ndarray  # (n, 3) float64 unit, away from the camera
    footprints: np.ndarray  # (n,) float64 size of a pixel at the point, scene units

    def __len__(self) -> int:
        return len(self.points)

    def kept(self, index: np.ndarray) -> DepthSamples:
        """Return the samples of an index or mask."""
        return DepthSamples(self.points[index], self.directions[index], self.footprints[index])


Contains = Callable[[np.ndarray], np.ndarray]
"""Maps (n, 3) points to (n,) bool."""


def sample_depth_maps(
    gaussians: OrientedGaussians,
    cameras: Sequence[Camera],
    contains: Contains,
    progress: Progress,
    *,
    most: int = MAX_DEPTH_SAMPLES,
    near_z: float = limits.NEAR_Z,
    threads: int = 0,
    renderer: Renderer | None = None,
) -> DepthSamples:
    """Sample the cameras' depth maps inside a volume, thinned evenly; all in the scene frame.

    ``contains`` tells which points lie in the volume. At most ``most`` samples: one is kept per
    cell and octant of viewing directions, with cells as small as this number allows, but not
    smaller than a pixel. The renderer is by default that of the processor, which ``threads`` is
    for.
    """
    renderer, raw = renderer or ViewRenderer(), RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=True, sh_degree=0, near_z=near_z, threads=threads)
    found, waiting = [], 0
    for index, camera in enumerate(cameras):
        progress.update(index / len(cameras), "sampling depth maps")
        shrink = max(1.0, max(camera.width, camera.height) / MAX_SIDE_PX)
        camera = camera.resized(round(camera.width / shrink), round(camera.height / shrink))
        depth = renderer.render(raw, camera, options).depth  # (h, w)
        rays = camera.rays()[depth > 0]  # (k, 3) camera frame, z = 1
        z = depth[depth > 0].astype(np.float64)
        points = (rays * z[:, None]) @ camera.rotation + camera.center
        inside = contains(points)
        toward = rays[inside] @ camera.rotation
        toward /= np.linalg.norm(toward, axis=1)[:, None]
        found.append(DepthSamples(points[inside], toward, z[inside] / max(camera.fx, camera.fy)))
        waiting += len(found[-1])
        if waiting > _POOL:
            found = [thin_evenly(_concatenated(found), most)]
            waiting = len(found[0])
    return thin_evenly(_concatenated(found), most)


def _concatenated(parts: list[DepthSamples]) -> DepthSamples:
    if not parts:
        return DepthSamples(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    return DepthSamples(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.directions for part in parts]),
        np.concatenate([part.footprints for part in parts]),
    )


def thin_evenly(depth_samples: DepthSamples, most: int) -> DepthSamples:
    """Keep the sharpest sample of each cell and octant of directions; at most ``most`` samples."""
    if len(depth_samples) == 0:
        return depth_samples
    low, high = depth_samples.points.min(0), depth_samples.points.max(0)
    side = float(np.median(depth_samples.footprints))
    side = max(side, float((high - low).max()) / 2**20)  # cell indices fit into 20 bits
    octant = (depth_samples.directions > 0) @ np.array([1, 2, 4])  # (n,)
    order = np.argsort(depth_samples.footprints, kind="stable")
    while True:
        cell = np.floor((depth_samples.points - low) / side).astype(np.int64)  # (n, 3)
        key = ((cell[:, 0] << 20 | cell[:, 1]) << 20 | cell[:, 2]) << 3 | octant
        _, first = np.unique(key[order], return_index=True)
        if len(first) <= most:
            return depth_samples.kept(np.sort(order[first]))
        # On a surface the number falls with the square of the side.
        side *= max(1.1, float(np.sqrt(len(first) / most)))


def bracket_pairs(
    depth_samples: DepthSamples, is_empty: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of points (k, 3) outside and inside the solid, across its surface.

    Samples without an occupied point behind them are dropped: what is opaque for one camera may be
    transparent for another. ``is_empty`` maps (n, 3) points to (n,) bool, over all cameras.
    """
    step = depth_samples.directions * depth_samples.footprints[:, None]  # (n, 3) one pixel
    inner = depth_samples.points.copy()
    waiting = np.arange(len(depth_samples))
    for depth in DEPTHS_PX:
        trial = depth_samples.points[waiting] + depth * step[waiting]
        solid = ~is_empty(trial)
        inner[waiting[solid]] = trial[solid]
        waiting = waiting[~solid]
    paired = np.ones(len(depth_samples), np.bool_)
    paired[waiting] = False
    outer = depth_samples.points - STEP_OUT_PX * step
    return outer[paired], inner[paired]
