# SPDX-License-Identifier: GPL-3.0-or-later
"""Is a surface point seen by a photo, and how far is it from what hides it there?

A depth buffer per photo answers for millions of texels at once. The test compares the buffer
with the plane of the texel's face at every pixel that a bilinear look-up would touch, so that
slopes need no tolerance and an occluder's colour never bleeds onto what lies behind it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...dataset.camera import Camera
from ...kernels.compiled import inline, kernel
from ...mesh.depth_buffer import depth_buffer

BIAS_PX = 1.5
"""Depth tolerance in pixel footprints: creases bend away from the plane by about one."""
BIAS_RELATIVE = 1e-5
"""Rounding of float32 depths, with room."""
JUMP_PX = 12.0
"""Neighbouring depths that differ by more footprints are a silhouette (slope above 85 degrees)."""
MAX_CLEARANCE_PX = 16


@dataclass(frozen=True)
class PhotoVisibility:
    """What a photo sees of the mesh."""

    depth: np.ndarray
    """(h, w) float32 z-depth of the first hit, infinite where nothing is hit."""
    clearance: np.ndarray
    """(h, w) uint8 distance to the nearest silhouette, pixels, capped."""


def photo_visibility(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, threads: int
) -> PhotoVisibility:
    """Rasterise the mesh and measure the distance of each pixel to silhouettes."""
    depth = depth_buffer(vertices, faces, camera, threads=threads).depth
    return PhotoVisibility(depth, _clearance(depth, JUMP_PX / min(camera.fx, camera.fy)))


@kernel(fast=False)
def _clearance(depth: Any, jump: float) -> np.ndarray:
    """Two sweeps of chamfer distances (3-4 weights, thirds of a pixel)."""
    height, width = depth.shape
    far = 3 * MAX_CLEARANCE_PX
    distance = np.full((height, width), far, np.int32)
    for y in range(height):
        for x in range(width):
            here = depth[y, x]
            for k in range(2):
                v, u = y + (k == 0), x + (k == 1)
                if v >= height or u >= width:
                    continue
                there = depth[v, u]
                if np.isinf(here) and np.isinf(there):
                    continue
                if abs(here - there) > jump * min(here, there):
                    distance[y, x] = 0
                    distance[v, u] = 0
    for y in range(height):
        for x in range(width):
            best = distance[y, x]
            if x > 0:
                best = min(best, distance[y, x - 1] + 3)
            if y > 0:
                best = min(best, distance[y - 1, x] + 3)
                if x > 0:
                    best = min(best, distance[y - 1, x - 1] + 4)
                if x + 1 < width:
                    best = min(best, distance[y - 1, x + 1] + 4)
            distance[y, x] = best
    out = np.empty((height, width), np.uint8)
    for y in range(height - 1, -1, -1):
        for x in range(width - 1, -1, -1):
            best = distance[y, x]
            if x + 1 < width:
                best = min(best, distance[y, x + 1] + 3)
            if y + 1 < height:
                best = min(best, distance[y + 1, x] + 3)
                if x + 1 < width:
                    best = min(best, distance[y + 1, x + 1] + 4)
                if x > 0:
                    best = min(best, distance[y + 1, x - 1] + 4)
            distance[y, x] = best
            out[y, x] = best // 3
    return out


@inline
def hidden_pixels(
    depth: Any,
    x: float,
    y: float,
    intrinsics: Any,
    nx: float,
    ny: float,
    nz: float,
    plane: float,
    z: float,
) -> int:
    """Count the pixels around a position (0 to 4) where something lies before ``n . p = plane``.

    Parameters
    ----------
    depth : (h, w) float32
    x, y : float
        Where the point projects, pixels.
    intrinsics : (4,) float64
        fx, fy, cx, cy.
    nx, ny, nz, plane : float
        The face's plane in camera coordinates; the normal looks towards the camera.
    z : float
        Depth of the point.
    """
    height, width = depth.shape
    tolerance = z * (BIAS_RELATIVE + BIAS_PX / min(intrinsics[0], intrinsics[1]))
    ix = int(np.floor(x - 0.5))
    iy = int(np.floor(y - 0.5))
    hidden = 0
    for k in range(4):
        u = min(max(ix + (k & 1), 0), width - 1)
        v = min(max(iy + (k >> 1), 0), height - 1)
        ray_x = (u + 0.5 - intrinsics[2]) / intrinsics[0]
        ray_y = (v + 0.5 - intrinsics[3]) / intrinsics[1]
        slope = nx * ray_x + ny * ray_y + nz
        expected = plane / slope if slope < 0.0 else z
        # Behind the horizon of a grazing plane the point itself is the better guess.
        expected = expected if 0.0 < expected < 2.0 * z else z
        if depth[v, u] < expected - tolerance:
            hidden += 1
    return hidden
