# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial Gaussians far away, where the photos show what stereo cannot place.

Sky and the far distance have no parallax. Without Gaussians there, training explains them by fog
before the things. See docs/method.md, section 11.9.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ... import tolerances
from ...stereo.depth_maps import DepthMap
from ...stereo.fusion import DensePoints
from ...stereo.open_cells import CELL_PX, by_cell, cells_of, open_cells

REACH_FACTOR = 4.0
"""Radius of the shell over the distance of the farthest points but one in a hundred."""

LEAST_REACH = tolerances.FAR_RADIUS
"""Smallest radius: the cameras lie within a tenth of it."""


def far_shell(
    depth_maps: Sequence[DepthMap], points: np.ndarray, wanted: int
) -> tuple[DensePoints, float]:
    """Return points on a sphere where photos show something and nothing is known of its depth.

    Parameters
    ----------
    depth_maps : sequence of DepthMap
    points : (n, 3) float64
        Points known so far, scene frame; they cover the cells that they project into.
    wanted : int
        Largest number of points; cells are merged until it is kept.

    Returns
    -------
    shell : DensePoints
        Sizes are the distances of neighbours.
    radius : float
        Of the sphere around the origin of the scene frame.
    """
    reach = float(np.percentile(np.linalg.norm(points, axis=1), 99)) if len(points) else 0.0
    radius = max(LEAST_REACH, REACH_FACTOR * reach)
    directions, colors, angles = [], [], []
    for depth_map in depth_maps:
        row, column, color = _open_cells(depth_map, points)
        camera = depth_map.camera
        at = (np.stack([column, row], 1) + 0.5) * CELL_PX  # (m, 2) pixels
        rays = camera.rays_at(at) @ camera.rotation
        directions.append(onto_sphere(camera.center, rays, radius))
        colors.append(color)
        angles.append(np.full(len(at), CELL_PX / camera.fx))
    found, color = np.concatenate(directions), np.concatenate(colors)
    if len(found) == 0 or wanted < 1:
        return _shell(np.zeros((0, 3)), np.zeros((0, 3)), 0.0, radius), radius
    step = float(np.median(np.concatenate(angles)))
    while True:
        key = np.floor(found / step + 0.5).astype(np.int64)
        cells, cell, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        if len(cells) <= wanted:
            break
        step *= 1.25
    cell = cell.reshape(-1)
    direction = np.stack([np.bincount(cell, found[:, k]) for k in range(3)], 1)
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    mean = np.stack([np.bincount(cell, color[:, k]) / count for k in range(3)], 1)
    return _shell(direction, mean, step, radius), radius


def _shell(direction: np.ndarray, color: np.ndarray, step: float, radius: float) -> DensePoints:
    count = len(direction)
    return DensePoints(
        radius * direction,
        -direction,
        np.clip(color + 0.5, 0, 255).astype(np.uint8),
        np.full(count, radius * step),
        np.zeros(count, np.float32),
    )


def _open_cells(
    depth_map: DepthMap, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and mean colours (m, 3) of the cells that nothing explains."""
    found = open_cells(depth_map)
    _, row, column = cells_of(points, depth_map)
    found[row, column] = False
    row, column = np.nonzero(found)
    return row, column, by_cell(depth_map.color.astype(np.float64))[row, column]


def onto_sphere(center: np.ndarray, rays: np.ndarray, radius: float) -> np.ndarray:
    """Return where rays (m, 3) from inside a sphere around the origin meet it, as unit vectors."""
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    along = unit @ center
    distance = -along + np.sqrt(along**2 + radius**2 - center @ center)
    return (center + unit * distance[:, None]) / radius
