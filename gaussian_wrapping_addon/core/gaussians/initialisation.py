# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial Gaussians: from sparse points, and along camera rays if these are few.

The start from an existing splat is in ``core/training/initialisation/``.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.spatial import cKDTree

from .. import tolerances
from ..dataset.camera import Camera
from ..dataset.scene import Scene, usable_points
from ..errors import DatasetError
from .model import OrientedGaussians

_logger = logging.getLogger(__name__)

PhotoLoader = Callable[[int], tuple[Camera, np.ndarray, np.ndarray | None]]
"""Returns camera, (h, w, 3) uint8 photo and (h, w) bool mask or ``None``, at a small size."""

INITIAL_OPACITY = 0.1
SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""

MIN_START_POINTS = 5000
"""With fewer sparse points, more are added until there are this many."""

MIN_SPACING_SQ = 1e-7
"""Squared distances between neighbours are clamped to this (docs/method.md, section 1.3)."""

MAX_SPACING_SHARE = 0.1
"""Largest size of an initial Gaussian relative to its distance to the nearest camera."""

_DEPTH_NEIGHBOURS = 4
_DEPTH_JITTER = 0.05
"""Relative standard deviation of added points around the depth of the nearest sparse points."""

_DEPTH_TRIALS = 8


def initial_gaussians(
    scene: Scene,
    view_indices: list[int],
    load_photo: PhotoLoader,
    *,
    max_gaussians: int,
    sh_degree: int,
    seed: int,
) -> OrientedGaussians:
    """Return the Gaussians that training starts from (docs/method.md, section 1.3).

    One per sparse point within ``tolerances.POINT_REACH``: round, as large as the mean distance to
    its three nearest neighbours, opacity 0.1, orientation zero. Where there are fewer than
    :data:`MIN_START_POINTS`, random pixels are lifted to the depth of the nearest sparse points;
    where there are none, to a random depth, keeping the positions that most cameras see.

    Parameters
    ----------
    scene : Scene
    view_indices : list of int
        Views to use (without held-out ones).
    load_photo : callable
        Returns camera, photo and mask of a view; only called if points are few.
    max_gaussians : int
        Upper bound; a random subset of the points is used if there are more.
    sh_degree : int
        Degree of the harmonics to allocate.
    seed : int

    Returns
    -------
    OrientedGaussians
        float32, with ``filter_3d`` zero.

    Raises
    ------
    DatasetError
        If there is no view, or points are few and the masks exclude all pixels.
    """
    if not view_indices:
        raise DatasetError("There is no view to train on.", "Add photos.")
    random = np.random.default_rng([seed, 1])
    points = np.asarray(scene.points, np.float64).reshape(-1, 3)
    usable = usable_points(points)
    if not usable.all():
        _logger.warning(
            "%d of %d sparse points are not finite or too far away: no Gaussian starts there",
            int((~usable).sum()), len(usable),
        )  # fmt: skip
    points = points[usable]
    colors = np.asarray(scene.point_colors).reshape(-1, 3)[usable] / 255.0
    cameras = [scene.views[i].camera for i in view_indices]
    if len(points) > max_gaussians:
        chosen = np.sort(random.choice(len(points), max_gaussians, replace=False))
        points, colors = points[chosen], colors[chosen]
    wanted = min(MIN_START_POINTS, max_gaussians) - len(points)
    if wanted > 0:
        more_points, more_colors = _points_along_rays(
            points, wanted, view_indices, load_photo, random
        )
        points = np.concatenate([points, more_points])
        colors = np.concatenate([colors, more_colors])
    return gaussians_at(points, colors, point_spacing(points, cameras), sh_degree)


def point_spacing(points: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """(n,) RMS distance to the three nearest neighbours, capped by the distance to the cameras."""
    neighbours = min(3, len(points) - 1)
    if neighbours > 0:
        distance, _ = cKDTree(points).query(points, k=neighbours + 1)
        mean_sq = np.maximum((distance[:, 1:] ** 2).mean(axis=1), MIN_SPACING_SQ)
    else:
        mean_sq = np.full(len(points), math.inf)
    centers = np.stack([camera.center for camera in cameras])
    to_camera, _ = cKDTree(centers).query(points)
    cap = np.maximum(MAX_SPACING_SHARE * to_camera, math.sqrt(MIN_SPACING_SQ))
    return np.minimum(np.sqrt(mean_sq), cap)


def gaussians_at(
    points: np.ndarray,
    colors: np.ndarray,
    sizes: np.ndarray,
    sh_degree: int,
    *,
    normals: np.ndarray | None = None,
    flatness: np.ndarray | float = 1.0,
    opacities: np.ndarray | float = INITIAL_OPACITY,
) -> OrientedGaussians:
    """Return Gaussians at points, round or flat across normals, without orientation.

    Parameters
    ----------
    points : (n, 3) float64
    colors : (n, 3)
        In [0, 1].
    sizes : (n,)
        Standard deviations along the surface.
    sh_degree : int
    normals : (n, 3), optional
        Unit; the third axis of a Gaussian points along it.
    flatness : (n,) or float
        Standard deviation along the third axis, as a share of the size.
    opacities : (n,) or float
    """
    count = len(points)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colors - 0.5) / SH_C0
    quats = np.zeros((count, 4), np.float32)
    quats[:, 0] = 1.0
    if normals is not None:
        quats = _turning_z_to(normals)
    log_scales = np.repeat(np.log(sizes)[:, None], 3, axis=1)  # (n, 3)
    log_scales[:, 2] += np.log(flatness)
    opacities = np.broadcast_to(opacities, count)
    arrays = {
        "means": points,
        "log_scales": log_scales,
        "quats": quats,
        "opacity_logits": np.log(opacities / (1.0 - opacities)),
        "sh": sh,
        "orientation": np.zeros((count, 4)),
        "filter_3d": np.zeros(count),
    }
    return OrientedGaussians(
        **{name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
    )


def _turning_z_to(normals: np.ndarray) -> np.ndarray:
    """Return (n, 4) unit quaternions w x y z that turn the z axis to unit vectors."""
    quats = np.zeros((len(normals), 4))
    quats[:, 0] = 1.0 + normals[:, 2]
    quats[:, 1], quats[:, 2] = -normals[:, 1], normals[:, 0]
    opposite = quats[:, 0] < 1e-6
    quats[opposite] = (0.0, 1.0, 0.0, 0.0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _points_along_rays(
    points: np.ndarray,
    wanted: int,
    view_indices: list[int],
    load_photo: PhotoLoader,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``wanted`` additional points with colours in [0, 1], from pixels of the photos."""
    views, cameras = [], []
    for index in view_indices:  # twice, as hundreds of photos do not fit into memory
        camera, _, mask = load_photo(index)
        if mask is None or mask.any():
            views.append(index)
            cameras.append(camera)
    if not views:
        raise DatasetError("The masks exclude all pixels of all photos.", "Check the masks.")
    share = np.full(len(views), wanted // len(views))
    share[: wanted - int(share.sum())] += 1
    found_points, found_colors = [], []
    for index, count in zip(views, share.tolist(), strict=True):
        if count == 0:
            continue
        camera, photo, mask = load_photo(index)
        allowed = np.arange(photo.shape[0] * photo.shape[1])
        if mask is not None:
            allowed = np.nonzero(mask.reshape(-1))[0]
        row, column = np.divmod(random.choice(allowed, count), photo.shape[1])  # (count,)
        pixels = np.stack([column, row], axis=1) + random.uniform(size=(count, 2))
        depth = _depth_near_points(points, camera, pixels, random)
        if depth is None:
            depth = _most_seen_depth(camera, pixels, cameras, random)
        local = camera.rays_at(pixels) * depth[:, None]
        found_points.append(local @ camera.rotation + camera.center)
        found_colors.append(photo[row, column] / 255.0)
    return np.concatenate(found_points), np.concatenate(found_colors)


def _depth_near_points(
    points: np.ndarray, camera: Camera, pixels: np.ndarray, random: np.random.Generator
) -> np.ndarray | None:
    """(m,) depth of one of the sparse points nearest in the image; ``None`` without points."""
    if len(points) == 0:
        return None
    where, depth = camera.project(points)
    inside = (depth > tolerances.NEAR_Z) & (where >= 0).all(axis=1)
    inside &= (where[:, 0] < camera.width) & (where[:, 1] < camera.height)
    if inside.sum() < _DEPTH_NEIGHBOURS:
        return None
    _, nearest = cKDTree(where[inside]).query(pixels, k=_DEPTH_NEIGHBOURS)
    pick = random.integers(0, _DEPTH_NEIGHBOURS, len(pixels))
    chosen = depth[inside][nearest[np.arange(len(pixels)), pick]]
    return np.maximum(
        chosen * (1.0 + _DEPTH_JITTER * random.normal(size=len(pixels))), tolerances.NEAR_Z
    )


def _most_seen_depth(
    camera: Camera, pixels: np.ndarray, cameras: list[Camera], random: np.random.Generator
) -> np.ndarray:
    """(m,) out of several random depths, that of the position most cameras see."""
    near, far = 0.1 * tolerances.SCENE_RADIUS, 4.0 * tolerances.SCENE_RADIUS
    best = np.zeros(len(pixels))
    most = np.full(len(pixels), -1)
    rays = camera.rays_at(pixels)
    for _ in range(_DEPTH_TRIALS):
        # Uniform in inverse depth, which matches the depth resolution of the photos.
        depth = 1.0 / random.uniform(1.0 / far, 1.0 / near, len(pixels))
        positions = (rays * depth[:, None]) @ camera.rotation + camera.center
        seen = np.zeros(len(pixels), int)
        for other in cameras:
            where, z = other.project(positions)
            seen += (
                (z > tolerances.NEAR_Z)
                & (where >= 0).all(axis=1)
                & (where[:, 0] < other.width)
                & (where[:, 1] < other.height)
            )
        better = seen > most
        best[better], most[better] = depth[better], seen[better]
    return best
