# SPDX-License-Identifier: GPL-3.0-or-later
"""Start points far away wherever a photo has no sparse points: plain walls, sky.

Without them, training explains a plain background by fog around the object, inside the region.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ..dataset.camera import Camera
from ..dataset.photo_source import PhotoSource
from ..dataset.scene import Scene
from ..training.initialisation.far_shell import LEAST_REACH, onto_sphere

CELL_PX = 8
"""Side of the cells that are looked at, pixels of the photos."""
MOST_POINTS = 8000
LEAST_POINTS = 5000
"""Start points, at least: with fewer, training invents some between the others, near the object."""


def with_background(scene: Scene, photos: PhotoSource, *, seed: int) -> Scene:
    """Return the scene with points on a sphere around everything.

    They are in the direction of pixels drawn by chance, where neither the cell nor its neighbours
    show a sparse point; where that gives too few, of all pixels.

    Parameters
    ----------
    photos : PhotoStore
        Small photos of the scene's views.
    """
    random = np.random.default_rng([seed, 7])
    tried = -(-(MOST_POINTS + LEAST_POINTS) // len(scene.views))  # a photo
    found, colors, is_open = [], [], []
    for index in range(len(scene.views)):
        camera, photo, mask = photos.camera(index), photos.photo(index), photos.mask(index)
        row, column = random.integers(0, [[camera.height], [camera.width]], (2, tried))
        if mask is not None:
            row, column = row[mask[row, column]], column[mask[row, column]]
        rays = camera.rays_at(np.stack([column, row], 1) + 0.5) @ camera.rotation
        found.append(onto_sphere(camera.center, rays, LEAST_REACH) * LEAST_REACH)
        colors.append(photo[row, column])
        is_open.append(~_near_points(camera, scene.points)[row // CELL_PX, column // CELL_PX])
    points, color, opened = (np.concatenate(parts) for parts in (found, colors, is_open))
    order = random.permutation(len(opened))
    order = order[np.argsort(~opened[order], kind="stable")]  # open ones first
    wanted = max(min(MOST_POINTS, int(opened.sum())), LEAST_POINTS - len(scene.points))
    chosen = np.sort(order[:wanted])
    return dataclasses.replace(
        scene,
        points=np.concatenate([scene.points, points[chosen]]),
        point_colors=np.concatenate([scene.point_colors, color[chosen]]),
    )


def _near_points(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return (rows, columns) bool: the cells of a photo with a point, and those around them."""
    _, row, column, _ = camera.shown(points)
    shown = np.zeros((-(-camera.height // CELL_PX) + 2, -(-camera.width // CELL_PX) + 2), bool)
    shown[row // CELL_PX + 1, column // CELL_PX + 1] = True
    wide = shown[:-2] | shown[1:-1] | shown[2:]
    return np.asarray(wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:])
