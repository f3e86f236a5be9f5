# SPDX-License-Identifier: GPL-3.0-or-later
"""A street that is as long as it has photos: cameras, boxes, and sparse points of their faces."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.dataset.camera import Camera

from ..camera_solving.places import Place, camera_at
from ..camera_solving.ray_caster import Boxes, render
from ..scenes.colmap_project import write_colmap
from ..scenes.sparse_points import SparsePoints

STEP_M = 1.0
"""Between photos of one way along the street; half of the photos are of the way back."""
PLOT_M, HOUSE_M = 10.0, 7.0
"""Length of a plot along the street, and the largest side of its house."""
HALF_WIDTH_M, AROUND_M, SKY_M = 4.5, 8.0, 18.0
"""From the street's middle to the plots; from these to the end of the world; its height."""
POINTS_PER_PHOTO = 60
"""Sparse points that are tried; those that two photos see are kept."""
_SWING_DEGREES, _SWING_M = 42.0, 17.0


def length_m(photos: int) -> float:
    """Return how long the street of so many photos is."""
    return STEP_M * photos / 2


def street(photos: int) -> Place:
    """Return houses along both sides of a street, walked along one way and back.

    Its length is in proportion to the photos: the place grows, it is not photographed more.
    """
    chance = np.random.default_rng(1)
    length, far = length_m(photos), HALF_WIDTH_M + PLOT_M + AROUND_M
    lower, upper = [[-AROUND_M, -far, 0.0]], [[length + AROUND_M, far, SKY_M]]
    for plot in range(max(1, round(length / PLOT_M))):
        for side in (-1.0, 1.0):
            half = chance.uniform(0.6, 1.0, 2) * HOUSE_M / 2
            middle = np.array([(plot + 0.5) * PLOT_M, side * (HALF_WIDTH_M + HOUSE_M / 2)])
            middle += chance.uniform(-0.6, 0.6, 2)
            lower.append([*(middle - half), 0.0])
            upper.append([*(middle + half), chance.uniform(2.5, 7.0)])
            for _ in range(3):  # things along the walls, which stand out
                at = middle + chance.uniform(-1.25, 1.25, 2) * half
                size = chance.uniform(0.2, 0.6, 2)
                lower.append([*(at - size), 0.0])
                upper.append([*(at + size), chance.uniform(0.5, 2.2)])
    looks = np.arange(6 * len(lower)).reshape(-1, 6)
    cameras = []
    ways = (photos - photos // 2, photos // 2)
    for number in range(photos):
        back = number >= ways[0]
        at = (number - back * ways[0] + 0.5) / ways[back]
        x, turn = length * (1.0 - at if back else at), np.pi * back
        turn += np.radians(_SWING_DEGREES) * np.sin(2 * np.pi * x / _SWING_M + back)
        center = np.array([x, 0.8 if back else -0.8, 1.7 + 0.5 * np.sin(number / 9.0)])
        center[:2] += chance.uniform(-0.15, 0.15, 2)
        camera = camera_at(number, center, np.array([np.cos(turn), np.sin(turn), 0.05]))
        cameras.append(dataclasses.replace(camera, name=f"{Path(camera.name).stem}.png"))
    return Place(Boxes(np.array(lower), np.array(upper), looks), tuple(cameras))


def make_scene(folder: Path, photos: int, width: int, threads: int) -> Path:
    """Write a COLMAP project of the street in a new folder, unless it is there; return it."""
    target = folder / f"street-{photos}-{width}"
    if target.is_dir():
        return target
    making = target.with_name(f"{target.name}.making")
    (making / "images").mkdir(parents=True, exist_ok=True)
    place = street(photos)
    cameras = [c.resized(width, round(width * c.height / c.width)) for c in place.cameras]
    images = []
    for camera in cameras:
        images.append(render(place.boxes, camera, threads=threads))
        Image.fromarray(images[-1]).save(making / "images" / camera.name)
    sparse = seen_points(place.boxes, cameras, images, POINTS_PER_PHOTO * photos)
    write_colmap(making / "sparse" / "0", cameras, sparse)
    making.rename(target)
    return target


def face_points(boxes: Boxes, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return (count, 3) random points of the boxes' faces, evenly by area, and their normals.

    Normals of the first box, which is seen from inside, point inward.
    """
    random = np.random.default_rng(seed)
    size = boxes.upper - boxes.lower
    areas = np.stack([size[:, (a + 1) % 3] * size[:, (a + 2) % 3] for a in range(3)], 1)
    shares = np.repeat(areas, 2, 1).reshape(-1) / (2.0 * areas.sum())
    face = random.choice(len(shares), count, p=shares)
    box, side = face // 6, face % 6
    inside = random.random((count, 3))
    inside[np.arange(count), side // 2] = side % 2
    normals = np.zeros((count, 3))
    normals[np.arange(count), side // 2] = np.where(side % 2 == 1, 1.0, -1.0)
    normals[box == 0] *= -1.0
    return boxes.lower[box] + inside * size[box], normals


def shown_in(
    boxes: Boxes, camera: Camera, points: np.ndarray, far_m: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Return which (n, 3) points a photo shows, rows in increasing order, and at which pixels.

    Points deeper than ``far_m`` are left out.
    """
    pixels, depth = camera.project(points)
    shown = (depth > 0.1) & (depth <= far_m) & (pixels >= 1).all(1)
    shown &= (pixels < (camera.width - 1, camera.height - 1)).all(1)
    rows = np.flatnonzero(shown)
    rows = rows[_in_sight(boxes, camera.center, points[rows])]
    return rows, pixels[rows]


def seen_points(
    boxes: Boxes, cameras: Sequence[Camera], images: Sequence[np.ndarray], count: int
) -> SparsePoints:
    """Return random points of the boxes' faces that at least two photos see, with exact tracks."""
    points, _ = face_points(boxes, count)
    found: list[tuple[int, int, np.ndarray]] = []
    colors = np.zeros((count, 3), np.uint8)
    for index, camera in enumerate(cameras):
        rows, pixels = shown_in(boxes, camera, points)
        at = pixels.astype(np.int64)
        colors[rows] = images[index][at[:, 1], at[:, 0]]
        found += [(row, index, pixel) for row, pixel in zip(rows.tolist(), pixels, strict=True)]
    seen = np.bincount([row for row, _, _ in found], minlength=count)
    number = np.cumsum(seen >= 2) - 1
    kept = sorted((number[row], view, pixel) for row, view, pixel in found if seen[row] >= 2)
    return SparsePoints(
        points[seen >= 2], colors[seen >= 2], np.zeros(int((seen >= 2).sum())),
        np.array([row for row, _, _ in kept], np.int64),
        np.array([view for _, view, _ in kept], np.int64),
        np.array([pixel for _, _, pixel in kept]).reshape(-1, 2),
    )  # fmt: skip


def _in_sight(boxes: Boxes, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Tell which points nothing stands before; the first box is seen from inside and hides none."""
    way = points - eye
    clear = np.ones(len(points), np.bool_)
    if not len(points):
        return clear
    # What lies between is in the box around the eye and all points.
    first_corner, last_corner = np.minimum(way.min(0), 0.0), np.maximum(way.max(0), 0.0)
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    lower, upper = boxes.lower[1:] - eye, boxes.upper[1:] - eye
    between = ((lower <= last_corner) & (upper >= first_corner)).all(1)
    for low, high in zip(lower[between], upper[between], strict=True):
        a, b = low / way, high / way
        first, last = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        clear &= ~((first < last) & (last > 0.0) & (first < 1.0 - 1e-6))
    return clear
