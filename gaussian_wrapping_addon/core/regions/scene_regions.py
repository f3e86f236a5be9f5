# SPDX-License-Identifier: GPL-3.0-or-later
"""The regions of a job, and the one of a scene that nobody drew one for."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..errors import MeshingError, ParseError
from ..gaussians.model import GaussianArrays
from ..scene.camera import Camera, Similarity
from ..scene.frames import CENTER_STEP, snapped
from ..scene.scene import Scene
from .files import parse_region_file, read_region_body, write_region_file
from .shapes import Region

# -- Find the vertices on the boundary planes of a region, so that later steps keep them there ----


ON_PLANE_SHARE = 1e-9
"""Tolerance for a vertex on a face's plane, in diagonals of the region: caps are made on the planes
up to rounding."""
MAX_PLANES = 3


@dataclass(frozen=True)
class CapPlanes:
    """Planes of a region's boundary, in the caller's coordinates, and the vertices on them."""

    normals: np.ndarray  # (k, 3) float64, outward
    offsets: np.ndarray  # (k,) float64: inside is ``normals @ x <= offsets``
    planes: np.ndarray  # (v, 3) int64: planes that each vertex lies on, -1 for none
    fixed: np.ndarray  # (v,) bool: vertices on more than three planes, which cannot move


def cap_planes(vertices: np.ndarray, region: Region | None) -> CapPlanes:
    """Find the vertices on the faces of a region; without a region there are none."""
    count = len(vertices)
    planes = np.full((count, MAX_PLANES), -1, np.int64)
    fixed = np.zeros(count, np.bool_)
    if region is None:
        return CapPlanes(np.zeros((0, 3)), np.zeros(0), planes, fixed)
    normals, offsets = region.half_spaces
    local = vertices - region.center  # (v, 3)
    found = np.zeros(count, np.int64)
    for number, (normal, offset) in enumerate(zip(normals, offsets, strict=True)):
        on_it = np.flatnonzero(np.abs(local @ normal - offset) <= ON_PLANE_SHARE * region.diagonal)
        room = found[on_it] < MAX_PLANES
        planes[on_it[room], found[on_it[room]]] = number
        fixed[on_it[~room]] = True
        found[on_it] += 1
    return CapPlanes(normals, offsets + normals @ region.center, planes, fixed)


# -- Regions in the scene frame, on its grid: the same bits for every similarity of the input -----


STEP_BITS = 20
"""The step is at most this many halvings of the body's diagonal (one millionth of it), and at most
that of camera centres."""
_TIE_STEP = 2.0**-12
"""Distances that differ by less, as a share of the largest, count as equal: corners of a box can be
equally far from its diagonal, up to rounding."""


def region_in_scene(world: Region, world_from_scene: Similarity) -> Region:
    """Return a region of the world frame in the scene frame, see :func:`on_scene_grid`."""
    return on_scene_grid(world.transformed(world_from_scene.inverse()))


def on_scene_grid(region: Region) -> Region:
    """Return a body of the scene frame whose corners are rounded (docs/method.md, section 1.7).

    Four corners are rounded to the grid of camera centres. The others keep their affine
    coordinates with respect to these four, rounded as well, so that the faces of boxes, prisms and
    frusta stay plane. A body whose number of plane faces would change is returned as it is.

    Corners move by at most a few steps: 1e-5 scene units or a few millionths of the diagonal.
    Rounding twice changes nothing, even by way of the world frame.
    """
    exponent = math.frexp(region.diagonal)[1] - 1
    step = min(CENTER_STEP, 2.0 ** (exponent - STEP_BITS))
    vertices = region.vertices
    anchors = vertices[_spread_corners(vertices)]  # (4, 3)
    axes = (anchors[1:] - anchors[0]).T  # (3, 3), one axis a column
    shares = np.linalg.solve(axes, (vertices - anchors[0]).T).T  # (v, 3)
    anchors = snapped(anchors, step)
    rounded = anchors[0] + snapped(shares, 2.0**-STEP_BITS) @ (anchors[1:] - anchors[0])
    try:
        result = replace(region, vertices=rounded)
    except MeshingError:  # thinner than the steps
        return region
    same = len(result.half_spaces[1]) == len(region.half_spaces[1])
    return result if same else region


def _spread_corners(vertices: np.ndarray) -> list[int]:
    """Return four corners that span space: the first, and each time the farthest from those."""
    found = [0]
    rest = vertices - vertices[0]  # (v, 3), what is orthogonal to the corners found
    for _ in range(3):
        lengths = np.linalg.norm(rest, axis=1)
        index = int(np.argmax(snapped(lengths / lengths.max(), _TIE_STEP)))
        axis = rest[index] / lengths[index]
        rest = rest - np.outer(rest @ axis, axis)
        found.append(index)
    return found


# -- Automatic region: a robust bounding box of what the cameras look at --------------------------


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
ASIDE_DEG = 10.0
SIDE_SHARE = 0.1
"""Photos from one side have no thing in their middle either: seen from where the middles meet, all
cameras but this share lie within this angle of their mean direction."""
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
    that several of them show. The region is in the scene frame, named ``"auto"``; points may be few
    or none.

    Raises
    ------
    MeshingError
        The scene has no usable camera.
    """
    cameras = _usable_cameras(scene.cameras)
    focus, distance = _focus(cameras, scene.points)
    # Half of the frame's short side at the focus: from the median of the narrower field of view.
    narrow = [min(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]
    frame_size = distance * float(np.median(narrow))
    points = scene.points[np.isfinite(scene.points).all(1)] if len(scene.points) else scene.points
    if not _look_at_one_thing(cameras, focus):
        near = _surroundings(points, cameras)
        if len(near) >= MIN_POINTS:
            weight = _thinned(near, VOXEL_SHARE * frame_size)
            if (weight > WEIGHT_THAT_COUNTS).sum() >= MIN_POINTS:
                return _box_around("auto", near, weight, TAIL_SHARE)
    if len(points) >= MIN_POINTS:
        seen = _views_of(points, cameras) / len(cameras)  # (n,) share of views
        share = seen / max(seen.max(), 1e-12)
        # From 0 at half of the share to 1.
        ramp = np.clip(2.0 * share / WELL_SEEN_SHARE - 1.0, 0.0, 1.0)
        support = ramp * _thinned(points, VOXEL_SHARE * frame_size)
        for _ in range(3):
            offset = np.linalg.norm(points - focus, axis=1) / frame_size  # (n,)
            weight = np.exp(-2.0 * offset**2) * support
            if (weight > WEIGHT_THAT_COUNTS).sum() < MIN_POINTS:
                break
            focus = _weighted_quantiles(points, weight, np.array([0.5]))[0]
        if (weight > WEIGHT_THAT_COUNTS).sum() >= MIN_POINTS:
            return _box_around("auto", points, weight, TAIL_SHARE)
    _logger.warning("Too few sparse points for an automatic region: using only the cameras")
    half = np.full(3, 0.6 * frame_size)
    return Region.box("auto", focus - half, focus + half)


def whole_region(scene: Scene, arrays: GaussianArrays) -> Region:
    """Return a robust bounding box of all trained Gaussians but faint ones that two photos see.

    Raises
    ------
    MeshingError
        No Gaussian is seen by enough photos.
    """
    cameras = _usable_cameras(scene.cameras)
    focus, distance = _focus(cameras, scene.points)
    solid = arrays.log_opacities > np.log(WHOLE_MIN_ALPHA)
    points = arrays.means[solid & np.isfinite(arrays.means).all(1)]
    points = points[np.linalg.norm(points - focus, axis=1) < WHOLE_REACH * distance]
    points = points[_views_of(points, cameras) >= min(WHOLE_MIN_VIEWS, len(cameras))]
    if len(points) < 4:
        hint = "Train longer, or draw a region by hand."
        raise MeshingError("No Gaussian is seen by two photos.", hint)
    return _box_around("all", points, np.ones(len(points)), WHOLE_TAIL_SHARE)


def _usable_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """Drop cameras that are not finite or lie far from the others."""
    good = [c for c in cameras if np.isfinite(c.cam_from_world).all()]
    if not good:
        raise MeshingError("The scene has no usable camera.", "Check the camera poses.")
    centers = np.array([c.center for c in good])  # (c, 3)
    away = np.linalg.norm(centers - np.median(centers, 0), axis=1)
    limit = 10.0 * np.median(away)
    return [c for c, a in zip(good, away, strict=True) if a <= limit] or good


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
    """Tell whether the middles of the photos meet at a point, and see it from several sides."""
    centers = np.array([c.center for c in cameras])  # (c, 3)
    gazes = np.array([c.gaze for c in cameras])  # (c, 3)
    gazes /= np.linalg.norm(gazes, axis=1, keepdims=True)
    to_focus = focus - centers
    missed = to_focus - (to_focus * gazes).sum(1, keepdims=True) * gazes
    spread = np.median(np.linalg.norm(centers - centers.mean(0), axis=1))
    if np.median(np.linalg.norm(missed, axis=1)) > APART_SHARE * spread:
        return False
    sides = to_focus / np.maximum(np.linalg.norm(to_focus, axis=1, keepdims=True), 1e-12)
    mean = sides.mean(0) / max(np.linalg.norm(sides.mean(0)), 1e-12)
    return bool(np.quantile(sides @ mean, SIDE_SHARE) <= np.cos(np.radians(ASIDE_DEG)))


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


def _box_around(name: str, points: np.ndarray, weight: np.ndarray, tail: float) -> Region:
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
    # Flat scenes need a margin as well.
    pad = PADDING_SHARE * size + 0.25 * PADDING_SHARE * size.max()
    # Empty space above costs nothing, and tips (a stem, a finial) have few keypoints.
    head = _weighted_quantiles(points[:, 2:], weight, np.array([1.0 - tail / HEAD_TAIL_DIVISOR]))
    high[2] = max(high[2], float(head[0, 0])) + HEADROOM * size[2]
    return Region.box(name, low - pad, high + pad, rotation)


# -- Read and write regions -----------------------------------------------------------------------


def read_region(path: Path) -> Region:
    """Read a region file; the region is in world coordinates.

    Raises
    ------
    DatasetError
        There is no file, or it cannot be read.
    ParseError
        Names the file, the entry and what to do.
    """
    return parse_region(read_region_body(path), path)


def parse_region(values: Any, path: Path) -> Region:
    """Build a region from JSON values; ``path`` is used in errors only.

    Raises
    ------
    ParseError
    """
    file = parse_region_file(values, path)
    try:
        region = Region(file.name, file.vertices)
    except MeshingError as error:
        raise ParseError(path, "vertices", error.message, error.hint) from None
    used, count = len(np.unique(region.simplices)), len(file.vertices)
    if used < count:
        _logger.warning(
            "%s: %d of %d corners lie inside the convex hull; the hull is used",
            path.name, count - used, count,
        )  # fmt: skip
    return region


def write_region(path: Path, region: Region) -> None:
    """Write a region file atomically; the region must be in world coordinates."""
    write_region_file(path, region.name, region.vertices, region.simplices)
