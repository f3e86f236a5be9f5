# SPDX-License-Identifier: GPL-3.0-or-later
"""Visibility of surface points in a photo, and their distance to silhouettes.

One depth buffer per photo serves millions of texels. The test compares the buffer with the plane
of the texel's face at every pixel of the bilinear look-up, so that slopes need no tolerance and an
occluder's colour never bleeds onto the surface behind it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...dataset.camera import Camera
from ...kernels.compiled import inline, kernel
from ...mesh.depth_buffer import depth_buffer

BIAS_PX = 1.5
"""Depth tolerance in pixel footprints: creases deviate from the plane by about one."""
BIAS_RELATIVE = 1e-5
"""Relative rounding of float32 depths, with margin."""
JUMP_PX = 12.0
"""Neighbouring depths that differ by more footprints are a silhouette (slope above 85 degrees)."""
MAX_CLEARANCE_PX = 16


@dataclass(frozen=True)
class PhotoVisibility:
    """Depth of the mesh in a photo and distances to silhouettes."""

    depth: np.ndarray
    """(h, w) float32 z-depth of the first hit, infinite without a hit."""
    clearance: np.ndarray
    """(h, w) uint8 distance to the nearest silhouette, pixels, up to :data:`MAX_CLEARANCE_PX`."""


def photo_visibility(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, threads: int
) -> PhotoVisibility:
    """Rasterise the mesh and compute the distance of each pixel to silhouettes."""
    depth = depth_buffer(vertices, faces, camera, threads=threads).depth
    return PhotoVisibility(depth, _clearance(depth, JUMP_PX / min(camera.fx, camera.fy)))


@kernel(fast=False)
def _clearance(depth: Any, jump: float) -> np.ndarray:
    """Return chamfer distances to silhouettes by two sweeps (3-4 weights, thirds of a pixel)."""
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
    """Count the pixels around a position (0 to 4) at which the plane ``n . p = plane`` is occluded.

    Parameters
    ----------
    depth : (h, w) float32
    x, y : float
        Projection of the point, pixels.
    intrinsics : (4,) float64
        fx, fy, cx, cy.
    nx, ny, nz, plane : float
        The face's plane in camera coordinates; the normal points towards the camera.
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
        # Beyond the horizon of a grazing plane, the depth of the point is a better estimate.
        expected = expected if 0.0 < expected < 2.0 * z else z
        if depth[v, u] < expected - tolerance:
            hidden += 1
    return hidden
