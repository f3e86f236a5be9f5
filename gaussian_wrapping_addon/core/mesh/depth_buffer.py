# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth buffer of a mesh: rasterise depth and face indices as seen from a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..compiled import kernel
from ..limits import SCENE_RADIUS
from ..parallel import even_bounds, run_chunks
from ..scene.camera import Camera

NEAR_DEPTH = 1e-3 * SCENE_RADIUS
"""Near plane in scene units, so that a camera inside a mesh sees past it; callers in other frames
pass their own."""


@dataclass(frozen=True)
class DepthBuffer:
    """First hits of the rays through the pixel centres."""

    depth: np.ndarray  # (h, w) float32 z-depth, infinite where nothing is hit
    face: np.ndarray  # (h, w) int32, -1 where nothing is hit


def depth_buffer(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, *,
    threads: int = 1, near: float = NEAR_DEPTH,
) -> DepthBuffer:  # fmt: skip
    """Rasterise a mesh; front and back faces both occlude.

    ``vertices`` (v, 3) float64 and ``near``, the z-depth > 0 of the near plane, are in the camera's
    world frame; ``faces`` are (f, 3) int32. The result does not depend on the number of threads:
    ties go to the lower face.
    """
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    face = np.full((camera.height, camera.width), -1, np.int32)
    triangles, ids = _in_front(camera.to_camera(vertices), faces, near)
    inverse = 1.0 / triangles[..., 2]
    screen = np.empty_like(triangles)  # (t, 3, 3): x, y, 1 / z; linear in each other
    screen[..., 0] = camera.fx * triangles[..., 0] * inverse + camera.cx
    screen[..., 1] = camera.fy * triangles[..., 1] * inverse + camera.cy
    screen[..., 2] = inverse
    low, high = screen[..., :2].min(axis=1), screen[..., :2].max(axis=1)
    shown = (high > 0.0).all(axis=1) & (low < [camera.width, camera.height]).all(axis=1)
    screen, ids = np.ascontiguousarray(screen[shown]), ids[shown]

    def band(begin: int, end: int) -> None:
        _raster_rows(screen, ids, begin, end, depth, face)

    run_chunks(band, even_bounds(camera.height, threads), threads)
    return DepthBuffer(depth, face)


def _in_front(local: np.ndarray, faces: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Clip triangles to the near plane; return them (t, 3, 3) and their faces."""
    ids = np.arange(len(faces), dtype=np.int32)
    front = local[:, 2] > near
    inside = front[faces].sum(axis=1)
    pieces, owners = [local[faces[inside == 3]]], [ids[inside == 3]]
    for face in np.flatnonzero((inside == 1) | (inside == 2)).tolist():
        corners = local[faces[face]]
        polygon: list[np.ndarray] = []
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if a[2] > near:
                polygon.append(a)
            if (a[2] > near) != (b[2] > near):
                polygon.append(a + (b - a) * ((near - a[2]) / (b[2] - a[2])))
        for k in range(1, len(polygon) - 1):
            pieces.append(np.stack([polygon[0], polygon[k], polygon[k + 1]])[None])
            owners.append(ids[face : face + 1])
    triangles, owner = np.concatenate(pieces), np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return triangles[order], owner[order]


@kernel(fast=False)
def _raster_rows(screen: Any, ids: Any, begin: int, end: int, depth: Any, face: Any) -> None:
    width = depth.shape[1]
    for t in range(len(screen)):
        x0, y0, w0 = screen[t, 0, 0], screen[t, 0, 1], screen[t, 0, 2]
        x1, y1, w1 = screen[t, 1, 0], screen[t, 1, 1], screen[t, 1, 2]
        x2, y2, w2 = screen[t, 2, 0], screen[t, 2, 1], screen[t, 2, 2]
        # Clamped before the cast: clipped triangles can project very far away.
        top = int(min(max(np.ceil(min(y0, y1, y2) - 0.5), begin), end))
        bottom = int(max(min(np.floor(max(y0, y1, y2) - 0.5) + 1.0, end), begin))
        if top >= bottom:
            continue
        left = int(min(max(np.ceil(min(x0, x1, x2) - 0.5), 0.0), width))
        right = int(max(min(np.floor(max(x0, x1, x2) - 0.5) + 1.0, width), 0.0))
        if left >= right:
            continue
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if abs(area) < 1e-18:
            continue
        # Weights are linear in the pixel: a step of one in x adds a constant.
        step0 = (y1 - y2) / area
        step1 = (y2 - y0) / area
        for y in range(top, bottom):
            px, py = left + 0.5, y + 0.5
            a = ((x1 - px) * (y2 - py) - (x2 - px) * (y1 - py)) / area
            b = ((x2 - px) * (y0 - py) - (x0 - px) * (y2 - py)) / area
            for x in range(left, right):
                i = x - left
                l0, l1 = a + i * step0, b + i * step1
                l2 = 1.0 - l0 - l1
                # The margin closes cracks between neighbours that rounding would leave.
                if l0 < -1e-9 or l1 < -1e-9 or l2 < -1e-9:
                    continue
                z = np.float32(1.0 / (l0 * w0 + l1 * w1 + l2 * w2))
                if z < depth[y, x]:
                    depth[y, x] = z
                    face[y, x] = ids[t]
