# SPDX-License-Identifier: GPL-3.0-or-later
"""Automatic region: a robust bounding box of what the cameras look at."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..dataset.camera import Camera
from ..dataset.scene import Scene
from ..errors import MeshingError
from ..gaussians.model import GaussianArrays
from .convex_region import Region

_logger = logging.getLogger(__name__)

MIN_POINTS = 24
"""Least number of weighted points from which an extent is estimated."""

WEIGHT_THAT_COUNTS = 1e-3

WELL_SEEN_SHARE = 0.6
"""Points in fewer than this share of the most-seen point's views have little weight."""

VOXEL_SHARE = 0.06
"""Side, in frame sizes, of the voxels that balance the density of keypoints."""

TAIL_SHARE = 0.01
"""Share of the weight trimmed at each end of each axis."""

PADDING_SHARE = 0.08
"""Margin around the points: keypoints lie on the surface, but seldom at its extremes."""

HEADROOM = 0.15
HEAD_TAIL_DIVISOR = 5.0
"""At the top of the box: extra share of the height, and divisor of the trimmed tail."""

ROTATED_GAIN = 0.9
"""A rotated box is preferred only below this share of the axis-aligned box's footprint."""

APART_SHARE = 0.4
"""Photos look at no one thing if the middles of half of them pass their common point by more than
this share of the cameras' spread: 0.02 to 0.22 around things, 0.6 and more inside rooms, along
streets, and in parallel rows."""

SURROUNDINGS_REACH = 3.0
"""Reach of what such photos show, in median distances of points from the nearest camera."""

SURROUNDINGS_MIN_VIEWS = 3
"""Photos that must show a point of theirs; all, where there are fewer."""

WHOLE_TAIL_SHARE = 0.005
WHOLE_MIN_ALPHA = 0.1
WHOLE_MIN_VIEWS = 2
WHOLE_REACH = 6.0
"""Reach of the whole scene, in median distances from the cameras to the centre."""


def automatic_region(scene: Scene) -> Region:
    """Return a Z-up box, possibly rotated about Z, around what the cameras look at.

    Sparse points are weighted by the share of views whose frame contains them and by their
    closeness to the point where the middles of the photos converge, in units of the frame size
    there; the box spans robust quantiles of the weight. Outlying cameras and points have no weight.
    Photos that look at no one thing, as inside a room or in a row, get a box around all near points
    that several of them show.

    Parameters
    ----------
    scene : Scene
        In the scene frame; its points may be few or none.

    Returns
    -------
    Region
        In the scene frame, named ``"auto"``.

    Raises
    ------
    MeshingError
        The scene has no usable camera.
    """
    cameras = _usable_cameras(scene.cameras)
    focus, distance = _focus(cameras, scene.points)
    frame_size = distance * _half_frame(cameras)  # half of the frame's short side at the focus
    points = scene.points[np.isfinite(scene.points).all(1)] if len(scene.points) else scene.points
    if not _look_at_one_thing(cameras, focus):
        near = _surroundings(points, cameras)
        if len(near) >= MIN_POINTS:
            weight = _thinned(near, VOXEL_SHARE * frame_size)
            if (weight > WEIGHT_THAT_COUNTS).sum() >= MIN_POINTS:
                return _box_around("auto", near, weight, TAIL_SHARE, PADDING_SHARE)
    if len(points) >= MIN_POINTS:
        seen = _views_of(points, cameras) / len(cameras)  # (n,) share of views
        support = _ramp(seen / max(seen.max(), 1e-12)) * _thinned(points, VOXEL_SHARE * frame_size)
        for _ in range(3):
            offset = np.linalg.norm(points - focus, axis=1) / frame_size  # (n,)
            weight = np.exp(-2.0 * offset**2) * support
            if (weight > WEIGHT_THAT_COUNTS).sum() < MIN_POINTS:
                break
            focus = _weighted_quantiles(points, weight, np.array([0.5]))[0]
        if (weight > WEIGHT_THAT_COUNTS).sum() >= MIN_POINTS:
            return _box_around("auto", points, weight, TAIL_SHARE, PADDING_SHARE)
    _logger.warning("Too few sparse points for an automatic region: using only the cameras")
    half = np.full(3, 0.6 * frame_size)
    return Region.box("auto", focus - half, focus + half)


def whole_region(scene: Scene, arrays: GaussianArrays) -> Region:
    """Return a robust bounding box of all that at least two photos see.

    Parameters
    ----------
    scene : Scene
    arrays : GaussianArrays
        Trained Gaussians, scene frame; faint ones are ignored.

    Raises
    ------
    MeshingError
        No Gaussian is seen by enough photos.
    """
    cameras = _usable_cameras(scene.cameras)
    focus, distance = _focus(cameras, scene.points)
    solid = arrays.log_opacities > np.log(WHOLE_MIN_ALPHA)
    points = arrays.means[solid & np.isfinite(arrays.means).all(1)]
    near = np.linalg.norm(points - focus, axis=1) < WHOLE_REACH * distance
    points = points[near]
    seen = _views_of(points, cameras)
    points = points[seen >= min(WHOLE_MIN_VIEWS, len(cameras))]
    if len(points) < 4:
        raise MeshingError(
            "No Gaussian is seen by two photos.", "Train longer, or draw a region by hand."
        )
    return _box_around("all", points, np.ones(len(points)), WHOLE_TAIL_SHARE, PADDING_SHARE)


def _usable_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """Drop cameras that are not finite or lie far from the others."""
    good = [c for c in cameras if np.isfinite(c.cam_from_world).all()]
    if not good:
        raise MeshingError("The scene has no usable camera.", "Check the camera poses.")
    centers = np.array([c.center for c in good])  # (c, 3)
    away = np.linalg.norm(centers - np.median(centers, 0), axis=1)
    limit = 10.0 * np.median(away)
    return [c for c, a in zip(good, away, strict=True) if a <= limit] or good


def _half_frame(cameras: Sequence[Camera]) -> float:
    """Return the median tangent of half the narrower field of view."""
    return float(np.median([min(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]))


def _focus(cameras: Sequence[Camera], points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the point closest to the rays of the images' middles, and its median camera distance.

    A weak prior at the depth of the sparse points along each ray gives a sensible point even for
    near-parallel rays (one camera, a forward-facing row).
    """
    centers = np.array([c.center for c in cameras])  # (c, 3)
    gazes = np.array([c.gaze for c in cameras])  # (c, 3)
    depth = _median_depth(cameras, points)
    prior = centers + gazes * depth[:, None]  # (c, 3)
    forwards = gazes / np.linalg.norm(gazes, axis=1, keepdims=True)
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # (c, 3, 3)
    focus = np.median(prior, 0)
    for _ in range(20):
        miss = np.linalg.norm(np.einsum("cij,cj->ci", across, focus - centers), axis=1)  # (c,)
        weight = 1.0 / np.maximum(miss, 1e-3 * np.median(depth))
        prior_weight = 0.01 * weight
        matrix = np.einsum("c,cij->ij", weight, across) + np.eye(3) * prior_weight.sum()
        right = np.einsum("c,cij,cj->i", weight, across, centers) + prior_weight @ prior
        focus = np.linalg.solve(matrix, right)
    in_front = ((focus - centers) * forwards).sum(1) > 0
    if in_front.mean() < 0.5:  # outward-facing cameras: use the points in front of them
        focus = np.median(prior, 0)
    return focus, float(np.median(np.linalg.norm(focus - centers, axis=1)))


def _look_at_one_thing(cameras: Sequence[Camera], focus: np.ndarray) -> bool:
    """Tell whether the middles of the photos meet at a point."""
    centers = np.array([c.center for c in cameras])  # (c, 3)
    gazes = np.array([c.gaze for c in cameras])  # (c, 3)
    gazes /= np.linalg.norm(gazes, axis=1, keepdims=True)
    to_focus = focus - centers
    missed = to_focus - (to_focus * gazes).sum(1, keepdims=True) * gazes
    spread = np.median(np.linalg.norm(centers - centers.mean(0), axis=1))
    return bool(np.median(np.linalg.norm(missed, axis=1)) <= APART_SHARE * spread)


def _surroundings(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the (n, 3) points that several photos show and that are not far beyond the others."""
    if len(points) == 0:
        return points
    centers = np.array([c.center for c in cameras])  # (c, 3)
    seen = points[_views_of(points, cameras) >= min(SURROUNDINGS_MIN_VIEWS, len(cameras))]
    if len(seen) == 0:
        return seen
    distance = cKDTree(centers).query(seen)[0]  # (n,)
    return seen[distance <= SURROUNDINGS_REACH * np.median(distance)]


def _median_depth(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """Return the median depth of the points in each frame, (c,); their median where too few."""
    centers = np.array([c.center for c in cameras])
    spread = float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1)))
    result = np.full(len(cameras), np.nan)
    for index, camera in enumerate(cameras):
        if len(points):
            inside, depth = _in_frame(points, camera)
            if inside.sum() >= MIN_POINTS:
                result[index] = np.median(depth[inside])
    known = result[np.isfinite(result)]
    fallback = float(np.median(known)) if len(known) else max(spread, 1e-6)
    return np.where(np.isfinite(result), result, fallback)


def _in_frame(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    pixels, depth = camera.project(points)
    inside = (depth > 0) & (pixels >= 0).all(1)
    return inside & (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height), depth


def _views_of(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Count the cameras whose frame contains each point, (n,)."""
    count = np.zeros(len(points))
    for camera in cameras:
        count += _in_frame(points, camera)[0]
    return count


def _thinned(points: np.ndarray, side: float) -> np.ndarray:
    """Return weights that balance voxels of different density, (n,); 0 for points alone in one.

    A smooth object on a textured carpet has few keypoints; without this the carpet would dominate.
    """
    cells = np.floor((points - points.min(0)) / side).astype(np.int64)  # (n, 3)
    _, index, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    own = count[index.reshape(-1)].astype(np.float64)
    return np.where(own > 1, own**-0.75, 0.0)


def _ramp(share: np.ndarray) -> np.ndarray:
    """Return a linear ramp: 0 below half of :data:`WELL_SEEN_SHARE`, 1 above it."""
    return np.clip(2.0 * share / WELL_SEEN_SHARE - 1.0, 0.0, 1.0)


def _weighted_quantiles(values: np.ndarray, weight: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return weighted quantiles of each column of (n, k) values, (len(shares), k).

    Values are not interpolated: the gap to an outlier of little weight would count.
    """
    result = np.empty((len(shares), values.shape[1]))
    for column in range(values.shape[1]):
        order = np.argsort(values[:, column], kind="stable")
        total = np.cumsum(weight[order])
        position = np.searchsorted(total, shares * total[-1])
        result[:, column] = values[order[np.minimum(position, len(order) - 1)], column]
    return result


def _box_around(
    name: str, points: np.ndarray, weight: np.ndarray, tail: float, padding: float
) -> Region:
    """Return the smallest robust Z-up box over yaw angles."""
    shares = np.array([tail, 1.0 - tail])
    best: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None
    for angle in np.deg2rad(np.arange(0.0, 90.0, 3.0)):
        cosine, sine = np.cos(angle), np.sin(angle)
        rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        low, high = _weighted_quantiles(points @ rotation, weight, shares)
        footprint = float((high[0] - low[0]) * (high[1] - low[1]))
        cost = footprint if angle == 0.0 else footprint / ROTATED_GAIN
        if best is None or cost < best[0]:
            best = (cost, rotation, low, high)
    assert best is not None
    _, rotation, low, high = best
    size = high - low
    pad = padding * size + 0.25 * padding * size.max()  # flat scenes need a margin as well
    # Empty space above costs nothing, and tips (a stem, a finial) have few keypoints.
    head = _weighted_quantiles(points[:, 2:], weight, np.array([1.0 - tail / HEAD_TAIL_DIVISOR]))
    high[2] = max(high[2], float(head[0, 0])) + HEADROOM * size[2]
    return Region.box(name, low - pad, high + pad, rotation)
