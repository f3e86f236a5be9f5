# SPDX-License-Identifier: GPL-3.0-or-later
"""Bin the Gaussians seen by a camera into tiles, packed for vacancy queries."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ... import tolerances
from ...dataset.camera import Camera
from ...errors import ResourceError
from ...gaussians.model import GaussianArrays
from ...render.projection.projection import pack_camera, project_arrays
from .vacancy_kernels import BOUND_COLUMNS, ROW_COLUMNS, list_tiles

VIRTUAL_SIDE_PX = 65536
"""Long side of the virtual screen of queries. Nothing is rasterised, so its resolution only decides
which Gaussians are lost between pixel centres: at this size, none that matters."""
TILES_ALONG_SIDE = 64
TILE_PX = VIRTUAL_SIDE_PX // TILES_ALONG_SIDE
DEPTH_TAIL = 1e-5
"""A Gaussian is ignored in front of the depth where its value first exceeds this."""
STRIP_MARGIN_PX = 0.05
"""Several float32 roundings of a coordinate on the virtual screen."""
MAX_TILE_INTERSECTIONS = 2**31 - 1


@dataclass(frozen=True)
class VirtualScreen:
    """A camera resized so that its longer side has :data:`VIRTUAL_SIDE_PX` pixels."""

    camera: Camera
    packed: np.ndarray
    """(22,) float64, as in ``render.projection.pack_camera``."""
    tiles_x: int
    tiles_y: int

    @classmethod
    def of(cls, camera: Camera, near_z: float) -> VirtualScreen:
        """Return the virtual screen of a camera of any resolution."""
        scale = VIRTUAL_SIDE_PX / max(camera.width, camera.height)
        width, height = round(camera.width * scale), round(camera.height * scale)
        virtual = camera.resized(max(1, width), max(1, height))
        tiles_x, tiles_y = -(-virtual.width // TILE_PX), -(-virtual.height // TILE_PX)
        return cls(virtual, pack_camera(virtual, near_z), tiles_x, tiles_y)

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return self.tiles_x * self.tiles_y


@dataclass(frozen=True)
class CameraBins:
    """Binned Gaussians of one camera, for :func:`.vacancy_kernels.transmittance_of_cells`."""

    rows: np.ndarray
    """(m, 16) float32, nearest first."""
    bounds: np.ndarray
    """(m, 8) float32, pixels of the virtual screen."""
    tile_start: np.ndarray
    """(tiles + 1,) int64."""
    tile_ids: np.ndarray
    """(intersections,) int32."""
    longest_list: int
    ids: np.ndarray
    """(m,) int32: the Gaussian of each row."""

    @property
    def size_bytes(self) -> int:
        """Size in memory."""
        arrays = (self.rows, self.bounds, self.tile_start, self.tile_ids, self.ids)
        return sum(a.nbytes for a in arrays)


def region_window(
    camera: Camera, bounds: np.ndarray, near_z: float
) -> tuple[float, float, float, float, float] | None:
    """Bound the image area and depth in which a box can be visible.

    Parameters
    ----------
    bounds : (2, 3) float64
        Lowest and highest corner, scene frame.

    Returns
    -------
    tuple or None
        x0, y0, x1, y1 in pixels and the largest z-depth; ``None`` if the camera cannot see it.
    """
    corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), -1).reshape(-1, 3)  # (8, 3)
    pixels, depth = camera.project(corners)
    # Slightly less than near_z: a point on the box's far corner may round to the other side.
    if depth.max() <= near_z * (1.0 - 1e-9):
        return None
    x0, y0, x1, y1 = 0.0, 0.0, float(camera.width), float(camera.height)
    if depth.min() > 1e-6 * depth.max():
        # Only then does the projected box lie in the hull of its projected corners.
        x0, y0 = max(x0, pixels[:, 0].min() - 1.0), max(y0, pixels[:, 1].min() - 1.0)
        x1, y1 = min(x1, pixels[:, 0].max() + 1.0), min(y1, pixels[:, 1].max() + 1.0)
        if x0 > x1 or y0 > y1:
            return None
    return x0, y0, x1, y1, float(depth.max())


def footprint_bounds(boxes: np.ndarray, skews: np.ndarray) -> np.ndarray:
    """Bound elliptic footprints by their box and by the narrowest strip that contains them.

    Parameters
    ----------
    boxes : (n, 4) float32
        x0 y0 x1 y1, pixels.
    skews : (n,) float32
        x offset from the centre to the ellipse's point of largest y; inf where unbounded.

    Returns
    -------
    (n, 8) float32
        See ``vacancy_kernels.BOUND_COLUMNS``. A strip of infinite width is no constraint.
    """
    wide = boxes.astype(np.float64)
    middle = 0.5 * (wide[:, :2] + wide[:, 2:])  # (n, 2)
    half = 0.5 * (wide[:, 2:] - wide[:, :2])  # (n, 2)
    bounded = np.isfinite(skews)
    # The ellipse's matrix C: its width along a unit normal is sqrt(normal^T C normal).
    xx, yy = half[:, 0] ** 2, half[:, 1] ** 2
    xy = np.where(bounded, skews, 0.0) * half[:, 1]
    turn = 0.5 * np.arctan2(2.0 * xy, xx - yy) + 0.5 * math.pi  # angle of the minor axis
    normal = np.stack([np.cos(turn), np.sin(turn)], 1)  # (n, 2)
    width_sq = normal[:, 0] ** 2 * xx + 2.0 * normal.prod(1) * xy + normal[:, 1] ** 2 * yy
    # xy is derived from float32 values, which limits the accuracy of a thin ellipse's width.
    width = np.sqrt(np.maximum(width_sq, 0.0) + 1e-6 * (xx + yy)) + STRIP_MARGIN_PX
    out = np.empty((len(boxes), BOUND_COLUMNS), np.float32)
    out[:, :4] = boxes
    out[:, 4:6] = normal
    out[:, 6] = (normal * middle).sum(1)
    out[:, 7] = np.where(bounded, width, np.inf)
    return out


def bin_camera(
    arrays: GaussianArrays,
    virtual: VirtualScreen,
    near_z: float,
    bounds: np.ndarray | None,
    threads: int,
) -> CameraBins | None:
    """Project, pack and bin the Gaussians for a camera; ``None`` if it cannot see the region.

    Raises
    ------
    ResourceError
        The tile lists are too long.
    """
    camera = virtual.camera
    window = None if bounds is None else region_window(camera, bounds, near_z)
    if bounds is not None and window is None:
        return None
    screen = project_arrays(arrays, camera, near_z, threads=threads)
    kept = screen.visible.copy()
    log_opacity = arrays.log_opacities
    reach = np.maximum(2.0 * (log_opacity - math.log(tolerances.ALPHA_MIN)), 0.0)  # (n,)
    depth_reach = np.sqrt(2.0 * np.maximum(log_opacity - math.log(DEPTH_TAIL), 0.0))
    begin_z = screen.params[:, 10] - depth_reach * screen.params[:, 22]  # (n,)
    boxes = screen.boxes
    if window is not None:
        x0, y0, x1, y1, deepest = window
        kept &= (boxes[:, 0] <= x1) & (boxes[:, 2] >= x0)
        kept &= (boxes[:, 1] <= y1) & (boxes[:, 3] >= y0) & (begin_z <= deepest)
    ids = np.flatnonzero(kept)
    ids = ids[np.argsort(screen.depths[ids], kind="stable")]
    rows = np.zeros((len(ids), ROW_COLUMNS), np.float32)
    rows[:, :11] = screen.params[ids, :11]
    rows[:, 11] = screen.params[ids, 12]
    rows[:, 12] = screen.params[ids, 11]
    rows[:, 13] = reach[ids]
    rows[:, 14] = begin_z[ids]
    footprints = footprint_bounds(boxes[ids], screen.skews[ids])
    if window is not None:
        # Lists of tiles outside the window are never read.
        footprints[:, :2] = np.maximum(footprints[:, :2], np.array([x0, y0], np.float32))
        footprints[:, 2:4] = np.minimum(footprints[:, 2:4], np.array([x1, y1], np.float32))
    tiles_x, tiles_y = virtual.tiles_x, virtual.tiles_y
    start = np.zeros(virtual.tiles + 1, np.int64)
    tile_ids = np.empty(0, np.int32)
    tile_px = np.float32(TILE_PX)
    list_tiles(footprints, tile_px, tiles_x, tiles_y, start[1:], tile_ids, False)
    longest = int(start.max())
    np.cumsum(start, out=start)
    if start[-1] > MAX_TILE_INTERSECTIONS:
        raise ResourceError(
            f"Camera {camera.name} would have {start[-1]} tile intersections of Gaussians.",
            "Train with fewer Gaussians.",
        )
    tile_ids = np.empty(start[-1], np.int32)
    list_tiles(footprints, tile_px, tiles_x, tiles_y, start[:-1].copy(), tile_ids, True)
    return CameraBins(rows, footprints, start, tile_ids, longest, ids.astype(np.int32))
