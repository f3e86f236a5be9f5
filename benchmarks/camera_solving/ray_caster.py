# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of textured boxes by one ray a sample: cheap enough for hundreds, cameras exact."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.kernels.compiled import kernel, part
from gaussian_wrapping_addon.core.kernels.parallel import even_bounds, run_chunks

SAMPLES = 2
"""Rays along each side of a pixel."""
CELLS_M = (1.6, 0.7, 0.3, 0.14)
"""Sizes of the squares of plain colour that the texture is a sum of, metres."""


@dataclass(frozen=True)
class Boxes:
    """Axis-parallel boxes; the first is seen from inside, the others from outside."""

    lower: np.ndarray
    """(n, 3) float64, metres."""
    upper: np.ndarray
    """(n, 3) float64, metres."""
    face_looks: np.ndarray
    """(n, 6) int64: number of the texture of the faces -x, +x, -y, +y, -z, +z. Faces of one number
    that have one size look the same."""


def render(boxes: Boxes, camera: Camera, *, threads: int = 1) -> np.ndarray:
    """Return a (h, w, 3) uint8 photo."""
    photo = np.empty((camera.height, camera.width, 3), np.uint8)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    cells = np.array(CELLS_M)
    rotation, center = np.ascontiguousarray(camera.rotation), camera.center

    shown = _in_view(boxes, camera)
    lower, upper, looks = boxes.lower[shown], boxes.upper[shown], boxes.face_looks[shown]

    def rows(begin: int, end: int) -> None:
        _cast(lower, upper, looks, rotation, center, lens, cells, begin, end, photo)

    run_chunks(rows, even_bounds(camera.height, threads), threads)
    return photo


def _in_view(boxes: Boxes, camera: Camera) -> np.ndarray:
    """Return the numbers of the first box and of those whose spheres meet the cone of view."""
    middle = (boxes.lower + boxes.upper) / 2
    radius = np.linalg.norm(boxes.upper - boxes.lower, axis=1) / 2
    seen = camera.to_camera(middle)
    half = math.atan(math.hypot(camera.cx / camera.fx, camera.cy / camera.fy))
    beside, ahead = np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]
    # Distance of the sphere's middle from the cone's surface, positive outside.
    outside = beside * math.cos(half) - ahead * math.sin(half)
    return np.flatnonzero((outside < radius) | (np.arange(len(middle)) == 0))


@part(fast=False)
def _hashed(a: int, b: int, c: int, d: int) -> float:
    """Return a number in [0, 1) that four integers decide."""
    value = np.uint64(a * 73856093 ^ b * 19349663 ^ c * 83492791 ^ d * 2654435761)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    value = value ^ (value >> np.uint64(31))
    return (value >> np.uint64(40)) / 16777216.0


@kernel(fast=False)
def _cast(lower, upper, looks, rotation, center, lens, cells, begin, end, photo):  # type: ignore[no-untyped-def]
    inverse = np.empty(3)
    ray = np.empty(3)
    for row in range(begin, end):
        for column in range(photo.shape[1]):
            red, green, blue = 0.0, 0.0, 0.0
            for sample in range(SAMPLES * SAMPLES):
                u = column + (sample % SAMPLES + 0.5) / SAMPLES
                v = row + (sample // SAMPLES + 0.5) / SAMPLES
                x, y = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
                for axis in range(3):
                    ray[axis] = rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis]
                    step = ray[axis] if abs(ray[axis]) > 1e-12 else 1e-12
                    inverse[axis] = 1.0 / step
                best, box, face = 1e30, 0, 0
                for b in range(lower.shape[0]):
                    near, far = -1e30, 1e30
                    near_face, far_face = 0, 0
                    for axis in range(3):
                        t0 = (lower[b, axis] - center[axis]) * inverse[axis]
                        t1 = (upper[b, axis] - center[axis]) * inverse[axis]
                        f0, f1 = 2 * axis, 2 * axis + 1
                        if t0 > t1:
                            t0, t1 = t1, t0
                            f0, f1 = f1, f0
                        if t0 > near:
                            near, near_face = t0, f0
                        if t1 < far:
                            far, far_face = t1, f1
                    if b == 0:
                        best, face = far, far_face
                    elif 1e-6 < near < far and near < best:
                        best, box, face = near, b, near_face
                axis = face // 2
                first, second = (axis + 1) % 3, (axis + 2) % 3
                if first == 2:  # along the wall, then up
                    first, second = second, first
                a = center[first] + best * ray[first] - lower[box, first]
                c = center[second] + best * ray[second] - lower[box, second]
                if (face == 1 or face == 2) and axis < 2:
                    # Seen from the room, all walls run in one direction.
                    a = upper[box, first] - lower[box, first] - a
                look = looks[box, face]
                pixel_m = best / lens[0]
                shades = 0.0
                colour0, colour1, colour2 = 0.0, 0.0, 0.0
                for level in range(cells.shape[0]):
                    size = cells[level]
                    # Squares fade out before they are smaller than a pixel, which would alias.
                    weight = min(max((size / pixel_m - 1.0) / 2.0, 0.0), 1.0)
                    weight *= (size / cells[0]) ** 0.3  # large squares stand out
                    if weight > 0.0:
                        i, j = math.floor(a / size), math.floor(c / size)
                        key = look * 64 + level
                        grey = _hashed(key, i, j, 7) - 0.5
                        colour0 += weight * (grey + 0.5 * (_hashed(key, i, j, 1) - 0.5))
                        colour1 += weight * (grey + 0.5 * (_hashed(key, i, j, 2) - 0.5))
                        colour2 += weight * (grey + 0.5 * (_hashed(key, i, j, 3) - 0.5))
                    shades += 1.0
                light = 0.42 + 0.05 * (face % 3)
                gain = 0.9 / math.sqrt(shades)
                red += light + gain * colour0
                green += light + gain * colour1
                blue += light + gain * colour2
            share = 255.0 / (SAMPLES * SAMPLES)
            photo[row, column, 0] = np.uint8(min(max(red * share, 0.0), 255.0))
            photo[row, column, 1] = np.uint8(min(max(green * share, 0.0), 255.0))
            photo[row, column, 2] = np.uint8(min(max(blue * share, 0.0), 255.0))
