# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes of triangles between points whose depth is known (docs/method.md, section 11.6)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay, QhullError

from ..dataset.camera import Camera
from .source_views import in_image

LEAST_COSINE = 0.15
"""Between ray and normal: steeper triangles mostly bridge the edge of a thing."""

HIDDEN_SHARE = 1.25
"""A point this much farther away than the nearest one of its cell counts as hidden."""

BEHIND_SHARE = 1.05
"""A point this much farther away than the pixel's own depth is hidden."""

_CELLS = 24
"""Cells along the long side of an image."""

_LEAST_AREA = 1e-9


def points_in_view(
    camera: Camera, points: np.ndarray, inverse_depths: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (m, 2) and inverse depths (m,) of the points that a photo may show.

    Hidden is what lies behind other points of its cell, or behind known depths.

    Parameters
    ----------
    points : (n, 3)
        In the frame of the camera.
    inverse_depths : (h, w) array, optional
        Of the photo, in its size.

    Returns
    -------
    pixels : (m, 2) float64
        Centres of pixels at whole numbers.
    inverse_depths : (m,) float64
    """
    inside, depth = in_image(camera, points)
    pixels = camera.project(points[inside])[0] - 0.5
    depth = depth[inside]
    if inverse_depths is None:
        side = max(camera.width, camera.height) / _CELLS
        cell = (pixels // side).astype(int) @ np.array([1, 4 * _CELLS])
        cells, number = np.unique(cell, return_inverse=True)
        nearest = np.full(len(cells), np.inf)
        np.minimum.at(nearest, number, depth)
        shown = depth <= HIDDEN_SHARE * nearest[number]
    else:
        last = np.array([camera.width - 1, camera.height - 1])
        column, row = np.clip(np.rint(pixels), 0, last).astype(int).T
        shown = depth * inverse_depths[row, column] <= BEHIND_SHARE
    return pixels[shown], 1.0 / depth[shown]


def triangle_planes(pixels: np.ndarray, inverse_depths: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the (h, w, 3) float32 planes of the Delaunay triangles of points in an image.

    Parameters
    ----------
    pixels : (n, 2)
        Centres of pixels at whole numbers.
    inverse_depths : (n,)

    Returns
    -------
    (h, w, 3) float32
        (w, a, b) of each pixel (:mod:`~.plane_kernels`); 0 outside all triangles and in steep ones.
    """
    shape = (camera.height, camera.width)
    nothing = np.zeros((*shape, 3), np.float32)
    if len(pixels) < 4:
        return nothing
    try:
        triangulation = Delaunay(pixels)
    except QhullError:  # all on a line
        return nothing
    corners = pixels[triangulation.simplices]  # (t, 3, 2)
    values = inverse_depths[triangulation.simplices]  # (t, 3)
    edges, rises = corners[:, 1:] - corners[:, :1], values[:, 1:] - values[:, :1]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    area = np.where(np.abs(area) < _LEAST_AREA, _LEAST_AREA, area)
    a = (rises[:, 0] * edges[:, 1, 1] - rises[:, 1] * edges[:, 0, 1]) / area
    b = (rises[:, 1] * edges[:, 0, 0] - rises[:, 0] * edges[:, 1, 0]) / area
    row, column = np.mgrid[: shape[0], : shape[1]]
    at = np.stack([column, row], -1).reshape(-1, 2).astype(float)
    face = triangulation.find_simplex(at).reshape(shape)
    w = values[face, 0] + a[face] * (column - corners[face, 0, 0])
    w += b[face] * (row - corners[face, 0, 1])
    planes = np.stack([w, a[face], b[face]], -1)  # (h, w, 3)
    rays = camera.rays()
    normals = plane_normals(planes, camera)
    facing = (normals * rays).sum(-1) / np.linalg.norm(rays, axis=-1)
    good = (face >= 0) & (w > 0) & (facing > LEAST_COSINE)
    return np.where(good[..., None], planes, 0.0).astype(np.float32)


def plane_normals(planes: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the (h, w, 3) unit normals, away from the camera and in its frame, of planes."""
    rays = camera.rays()
    w, a, b = np.moveaxis(planes.astype(np.float64), -1, 0)
    x, y = a * camera.fx, b * camera.fy
    normals = np.stack([x, y, w - x * rays[..., 0] - y * rays[..., 1]], -1)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
