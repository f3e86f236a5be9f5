# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes through the parts of photos that have no texture: segments and candidates."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import ndimage

from ..resampling import grey_of
from ..scene.camera import Camera
from .depth_maps import DepthMap, points_in_view

# -- Noise of photos in their plain parts (docs/method.md, section 11.12) -------------------------


DARKEST, BRIGHTEST = 1.0, 254.0  # grey levels between which noise shows
SIDES_PX = (1, 2)
"""Of the squares whose means are looked at. Resizing and JPEG take noise of single pixels away and
leave that of squares, which texture is made of, too; squares of 4 px show faint texture itself."""

BLOCK, LEAST_USED, LEAST_BLOCKS = 16, 0.5, 4
"""Squares along the side of a block (so that a block of squares of 2 px has 32), share of them that
must be usable, and blocks needed."""

QUIET_BLOCKS, QUIET_SHARE = 0.25, 0.945
"""Quantile of the blocks that counts, and share of white noise that it shows. Faint texture shows
in most blocks; within one the mean of the power counts, as JPEG flattens most blocks of its own and
leaves few differences, large ones."""

_SECOND_DIFFERENCES = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32) / 6.0
"""Leave the standard deviation of white noise as it is."""


def noise_levels(color: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Return (c,) the standard deviations of white noise as strong as that of a photo, grey levels.

    From second differences in both directions, which leave out shading and straight steps
    [Immerkaer 1996], of pixels and of means of squares; the largest counts. Too few plain pixels
    tell no noise: 0.

    Of the channels (h, w, c) float32 of the photo as taken, at ``plain`` pixels (h, w) bool, those
    without texture; what is black or saturated is left out, as it shows none.
    """
    usable = plain & ((color > DARKEST) & (color < BRIGHTEST)).all(-1)
    found = np.zeros(color.shape[-1])
    for side in SIDES_PX:
        inner = ndimage.binary_erosion(_means(usable, side) == 1.0, np.ones((3, 3)))
        used = _means(inner, BLOCK)
        chosen = used >= LEAST_USED
        if chosen.sum() < LEAST_BLOCKS:
            continue
        for number, channel in enumerate(np.moveaxis(color, -1, 0)):
            differences = ndimage.convolve(_means(channel, side), _SECOND_DIFFERENCES)
            power = _means(np.where(inner, differences, 0.0) ** 2, BLOCK)[chosen] / used[chosen]
            level = side / QUIET_SHARE * np.sqrt(np.quantile(power, QUIET_BLOCKS))
            found[number] = max(found[number], level)
    return found


def _means(image: np.ndarray, side: int) -> np.ndarray:
    """Return the means over squares of an image (h, w), as many as fit."""
    height, width = image.shape[0] // side, image.shape[1] // side
    squares = image[: height * side, : width * side].reshape(height, side, width, side)
    return squares.mean((1, 3), dtype=np.float32)


def smoothed_noise(noise: Any, sigma_px: Any) -> Any:
    """Return the standard deviations of white noise after Gaussian filters of these widths."""
    return noise / (2.0 * np.sqrt(np.pi) * sigma_px)


def smoothed_step_noise(noise: float, sigma_px: float) -> float:
    """Return that of the difference of two neighbours after a Gaussian filter."""
    shared = np.exp(-1.0 / (4.0 * sigma_px**2))
    return float(smoothed_noise(noise, sigma_px) * np.sqrt(2.0 * (1.0 - shared)))


# -- Parts of photos without texture, and the depths known in and around them ---------------------


STEP_LEVELS = 2.5
"""Largest difference of grey levels of neighbours, smoothed by the first of the widths below,
within a plain segment; as much less as the width is larger, as a step of colours is."""

SMOOTHING_PX = (0.7, 1.0, 1.4, 2.0, 2.8)
CLEAR_OF_NOISE = 4.5
"""The first width is taken at which that difference is so many standard deviations of noise."""

LEAST_SHARE = 0.0008  # of the pixels of a photo that a segment needs
LARGE_SHARE = 0.004
"""Of the pixels of a photo from which a segment proposes planes; smaller ones may take over those
of their neighbours."""

BORDER_PX = 5  # width of the band around a segment whose confirmed depths count
MOST_BORDER = 600  # Known depths of a segment, at most; a regular choice of more.
SPARSE_WEIGHT = 3.0  # Of a sparse point inside a segment; confirmed pixels of the border weigh 1.
INSIDE_WEIGHT = 0.3
"""Of a confirmed pixel inside: windows without texture also agree where they should not."""


@dataclass(frozen=True)
class Segment:
    """Connected pixels without texture."""

    view: int  # number of the depth map
    rows: np.ndarray  # (p,) int64
    columns: np.ndarray  # (p,) int64
    places: np.ndarray  # (b, 2) float64 pixels of known depths in and around it, centres whole
    inverse_depths: np.ndarray  # (b,) of those
    weights: np.ndarray  # (b,)
    large: bool
    unknown: float  # share of its pixels whose depth no source confirms
    noise: float
    """Standard deviation of white noise as strong as that of its photo's grey levels, as taken."""

    @cached_property
    def pixels(self) -> np.ndarray:
        """(p, 2) float64 column and row, centres whole."""
        return np.stack([self.columns, self.rows], 1).astype(np.float64)

    @cached_property
    def extent(self) -> np.ndarray:
        """(2, 2) covariance of its pixels."""
        return np.cov(self.pixels.T)


def segments_of(depth_maps: Sequence[DepthMap], points: np.ndarray) -> list[Segment]:
    """Return the plain segments of all photos, of sparse points (n, 3) in the scene frame."""
    found: list[Segment] = []
    for view, depth_map in enumerate(depth_maps):
        found += _segments(depth_map, view, points)
    return found


def numbered(segments: Sequence[Segment], shape: tuple[int, ...]) -> np.ndarray:
    """Return (n, h, w) int32 numbers of the segments of each photo from 1, 0 elsewhere.

    The shape is the number of photos, height and width of the largest.
    """
    numbers = np.zeros(shape, np.int32)
    count = np.zeros(len(numbers), np.int32)
    for segment in segments:
        count[segment.view] += 1
        numbers[segment.view, segment.rows, segment.columns] = count[segment.view]
    return numbers


def plain_pixels(depth_map: DepthMap) -> tuple[np.ndarray, float]:
    """Return the plain pixels of a photo, (h, w) bool, and the noise of its grey levels.

    Plain pixels have no step of grey levels to a neighbour, and no mask excludes them; the noise is
    the standard deviation of white noise as strong.
    """
    color = depth_map.color.astype(np.float32)
    shown = True if depth_map.mask is None else depth_map.mask
    channels = np.concatenate([color, grey_of(color)[..., None]], -1)
    *of_colors, of_grey = noise_levels(channels, _without_steps(color, SMOOTHING_PX[-1]) & shown)
    for width in SMOOTHING_PX:
        step_noise = smoothed_step_noise(float(np.mean(of_colors)), width)
        if _step_levels(width) >= CLEAR_OF_NOISE * step_noise:
            break
    return _without_steps(color, width) & shown, float(of_grey)


def _step_levels(smoothing_px: float) -> float:
    return STEP_LEVELS * SMOOTHING_PX[0] / smoothing_px


def _without_steps(color: np.ndarray, smoothing_px: float) -> np.ndarray:
    """Return (h, w) bool: pixels without a step to a neighbour in smoothed colours (h, w, 3)."""
    smooth = ndimage.gaussian_filter(color, (smoothing_px, smoothing_px, 0))
    most = _step_levels(smoothing_px)
    plain = np.ones(smooth.shape[:2], bool)
    flat = np.abs(np.diff(smooth, axis=0)).max(-1) <= most
    plain[:-1] &= flat
    plain[1:] &= flat
    flat = np.abs(np.diff(smooth, axis=1)).max(-1) <= most
    plain[:, :-1] &= flat
    plain[:, 1:] &= flat
    return plain


def _segments(depth_map: DepthMap, view: int, points: np.ndarray) -> list[Segment]:
    plain, noise = plain_pixels(depth_map)
    numbers, count = ndimage.label(plain)
    sizes = np.bincount(numbers.reshape(-1), minlength=count + 1)
    confirmed = depth_map.confidence > 0
    inverse = 1.0 / depth_map.depth.astype(np.float64)
    camera = depth_map.camera
    sparse_px, sparse_inverse = points_in_view(camera, points)
    last = np.array([camera.width - 1, camera.height - 1])
    sparse_at = np.clip(np.rint(sparse_px), 0, last).astype(int)
    boxes = ndimage.find_objects(numbers)
    found = []
    for number in np.flatnonzero(sizes[1:] >= max(LEAST_SHARE * plain.size, 3)) + 1:
        row, column = boxes[number - 1]
        box = (_wider(row, plain.shape[0]), _wider(column, plain.shape[1]))
        corner = np.array([box[1].start, box[0].start])
        inside = numbers[box] == number
        near = ndimage.binary_dilation(inside, iterations=BORDER_PX)
        border_row, border_column = np.nonzero(near & ~inside & confirmed[box])
        inner_row, inner_column = np.nonzero(inside & confirmed[box])
        rows = np.concatenate([border_row, inner_row]) + corner[1]
        columns = np.concatenate([border_column, inner_column]) + corner[0]
        weight = np.repeat([1.0, INSIDE_WEIGHT], [len(border_row), len(inner_row)])
        chosen = np.linspace(0, len(rows) - 1, min(len(rows), MOST_BORDER)).astype(int)
        rows, columns, weight = rows[chosen], columns[chosen], weight[chosen]
        own = numbers[sparse_at[:, 1], sparse_at[:, 0]] == number
        row, column = np.nonzero(inside)
        places = np.concatenate([np.stack([columns, rows], 1), sparse_px[own]])
        known = np.concatenate([inverse[rows, columns], sparse_inverse[own]])
        weights = np.concatenate([weight, np.full(int(own.sum()), SPARSE_WEIGHT)])
        large = bool(sizes[number] >= LARGE_SHARE * plain.size)
        unknown = 1.0 - len(inner_row) / len(row)
        row, column = row + corner[1], column + corner[0]
        found.append(Segment(view, row, column, places, known, weights, large, unknown, noise))
    return found


def _wider(part: slice, size: int) -> slice:
    return slice(max(0, part.start - BORDER_PX), min(size, part.stop + BORDER_PX))


# -- Planes in space, their inverse depths in photos, and their fit to points ---------------------


LIKE_COSINE, LIKE_SHARE = 0.996, 0.012
"""Planes are one if their normals are so close and each passes the other's centre so closely,
relative to the distance of the camera (three times that for the weaker one's plane)."""

LEAST_INVERSE_DEPTH = 1e-9
"""Pixels where that of a plane is smaller do not show it: it is too far away, or lies behind."""

ANNEALING = (0.02, 0.014, 0.01, 0.007, 0.005, 0.0035, 0.0025, 0.0025)
"""Scales of the residuals, relative to the depth, of the steps of a robust fit."""


@dataclass(frozen=True)
class Plane:
    """All points X with ``normal @ X == offset``, and the points that speak for it."""

    normal: np.ndarray  # (3,) unit
    offset: float
    center: np.ndarray  # (3,) of the points
    points: np.ndarray  # (n, 3)
    weights: np.ndarray  # (n,) over squared depth, so that residuals count relative to it
    support: float  # sum of the weights of the known depths of segments
    views: frozenset[int]  # depth maps whose segments speak for it
    distance: float  # of the points from a camera that sees them

    def moved(self, normal: np.ndarray, offset: float) -> Plane:
        """Return the same evidence for another place."""
        return replace(self, normal=normal, offset=offset)


def image_plane(plane: Plane, camera: Camera) -> np.ndarray:
    """Return (3,) q: the plane's inverse depth is q @ (column, row, 1) at centres whole."""
    normal = camera.rotation @ plane.normal
    offset = plane.offset + normal @ camera.cam_from_world[:, 3]
    q = normal / (offset if abs(offset) > 1e-12 else 1e-12)
    a, b = q[0] / camera.fx, q[1] / camera.fy
    return np.array([a, b, q[2] - a * (camera.cx - 0.5) - b * (camera.cy - 0.5)])


def with_ones(pixels: np.ndarray) -> np.ndarray:
    """Return (n, 3) column, row, 1 of (n, 2) pixels."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1)


def lifted_pixels(camera: Camera, pixels: np.ndarray, inverse_depths: np.ndarray) -> np.ndarray:
    """Return the (n, 3) points, scene frame, of (n, 2) pixels with centres whole."""
    local = camera.rays_at(pixels + 0.5) / inverse_depths[:, None]
    return (local - camera.cam_from_world[:, 3]) @ camera.rotation


def fit_plane(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the normal, the offset and the centre of the plane of least squares."""
    center = np.average(points, axis=0, weights=weights)
    scaled = (points - center) * np.sqrt(weights)[:, None]
    normal = np.linalg.svd(scaled, full_matrices=False)[2][-1]
    return normal, float(normal @ center), center


def refined(plane: Plane) -> Plane:
    """Return the plane fitted to its points, those near it more and more alone."""
    normal, offset, center = plane.normal, plane.offset, plane.center
    for scale in ANNEALING:
        residual = np.abs(plane.points @ normal - offset) * np.sqrt(plane.weights)
        weights = plane.weights / (1.0 + (residual / scale) ** 2) ** 2
        normal, offset, center = fit_plane(plane.points, weights)
    return replace(plane, normal=normal, offset=offset, center=center)


def pooled(planes: Sequence[Plane], *, fit: bool = True) -> list[Plane]:
    """Return the planes with those that are the same as one; the best supported first.

    With ``fit`` each is fitted to the points of all that were put together.
    """
    ordered = sorted(planes, key=lambda p: -p.support)
    normals, centers = np.zeros((len(ordered), 3)), np.zeros((len(ordered), 3))
    offsets = np.zeros(len(ordered))
    groups: list[list[Plane]] = []
    for plane in ordered:
        count = len(groups)
        cosines = np.abs(normals[:count] @ plane.normal)
        passing = np.abs(normals[:count] @ plane.center - offsets[:count])
        passed = np.abs(centers[:count] @ plane.normal - plane.offset)
        near = LIKE_SHARE * plane.distance
        same = (cosines >= LIKE_COSINE) & (passing < near) & (passed < 3.0 * near)
        if same.any():
            groups[int(np.argmax(same))].append(plane)
        else:
            normals[count], centers[count] = plane.normal, plane.center
            offsets[count] = plane.offset
            groups.append([plane])
    joined = [_joined(group) for group in groups]
    return [refined(plane) for plane in joined] if fit else joined


def _joined(group: Sequence[Plane]) -> Plane:
    first = group[0]
    if len(group) == 1:
        return first
    return replace(
        first, points=np.concatenate([plane.points for plane in group]),
        weights=np.concatenate([plane.weights for plane in group]),
        support=sum(plane.support for plane in group),
        views=frozenset().union(*(plane.views for plane in group)),
    )  # fmt: skip


# -- Planes that the known depths of one plain segment propose ------------------------------------


PLANE_SHARE = 0.01
"""Largest relative difference in inverse depth of an inlier of a proposal; known depths speak for
a plane in question up to :data:`SPEAKING_SHARE`."""
SPEAKING_SHARE = 0.015

TRIALS = 600
LEAST_TRIANGLE = 50.0
"""Twice the least area of the triangle of three pixels that propose a plane."""

MOST_PLANES = 4
LEAST_WEIGHT, LEAST_SUPPORT = 25.0, 0.12
"""Weight of the inliers of a proposal, and its share of the segment's."""

FULL_SPREAD, LEAST_SPREAD = 0.5, 0.25
"""Standard deviation of the inliers across their line over that of the segment's pixels, from which
a proposal counts fully, and which it needs: depths along a single edge, as where a wall meets the
floor, fit every plane through that edge."""

SAME_INLIERS = 0.7  # share of inliers in common with a better proposal from which one is left out


def proposed_planes(
    segment: Segment, camera: Camera, random: np.random.Generator
) -> Iterator[Plane]:
    """Yield up to :data:`MOST_PLANES` planes found by random consensus in inverse depth."""
    inverse, weights = segment.inverse_depths, segment.weights
    if weights.sum() < LEAST_WEIGHT or len(inverse) < 3:
        return
    at = with_ones(segment.places)
    picked = random.choice(len(at), (TRIALS, 3), p=weights / weights.sum())
    picked = picked[np.abs(np.linalg.det(at[picked])) > LEAST_TRIANGLE]
    if len(picked) == 0:
        return
    q = np.linalg.solve(at[picked], inverse[picked][..., None])[..., 0]  # (t, 3)
    inliers = (np.abs(q @ at.T / inverse - 1.0) < PLANE_SHARE).astype(np.float32)  # (t, b)
    total = inliers @ weights
    score = total * np.minimum(spreads(inliers, segment) / FULL_SPREAD, 1.0)
    for _ in range(MOST_PLANES):
        best = int(np.argmax(score))
        if score[best] < max(LEAST_WEIGHT, LEAST_SUPPORT * weights.sum()):
            return
        common = inliers @ (weights * inliers[best]) / np.maximum(total, 1e-9)
        score = np.where(common > SAME_INLIERS, 0.0, score)
        score[best] = 0.0
        chosen = _settled(inliers[best] > 0, at, segment)
        if chosen.sum() < 8 or spreads(chosen[None], segment)[0] < LEAST_SPREAD:
            continue
        points = lifted_pixels(camera, segment.places[chosen], inverse[chosen])
        relative = weights[chosen] * inverse[chosen] ** 2
        normal, offset, center = fit_plane(points, relative)
        distance = float(np.linalg.norm(center - camera.center))
        yield Plane(
            normal, offset, center, points, relative, float(weights[chosen].sum()),
            frozenset([segment.view]), distance,
        )  # fmt: skip


def _settled(chosen: np.ndarray, at: np.ndarray, segment: Segment) -> np.ndarray:
    """Return the inliers of the plane of least squares through inliers, (b,) bool."""
    inverse = segment.inverse_depths
    for _ in range(2):
        if chosen.sum() < 3:
            break
        root = np.sqrt(segment.weights[chosen]) / inverse[chosen]
        q = np.linalg.lstsq(at[chosen] * root[:, None], inverse[chosen] * root, rcond=None)[0]
        chosen = np.abs(at @ q / inverse - 1.0) < PLANE_SHARE
    return chosen


def spreads(
    inliers: np.ndarray, segment: Segment, extent: np.ndarray | None = None
) -> np.ndarray:  # fmt: skip
    """Return (t,) how widely sets of known depths spread across their line.

    That is the standard deviation along the shorter axis of each set, over that of the pixels along
    it. ``inliers`` (t, b) are 1 or true where a known depth of the segment belongs to a set;
    ``extent`` (2, 2) is the covariance of the pixels, by default those of the segment.
    """
    extent = segment.extent if extent is None else extent
    x, y = (segment.places - segment.places.mean(0)).T
    moments = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1) * segment.weights[:, None]
    total, mean_x, mean_y, xx, xy, yy = (inliers @ moments).T
    total = np.maximum(total, 1e-12)
    mean_x, mean_y = mean_x / total, mean_y / total
    xx, xy, yy = xx / total - mean_x**2, xy / total - mean_x * mean_y, yy / total - mean_y**2
    least = np.maximum((xx + yy) / 2 - np.hypot((xx - yy) / 2, xy), 0.0)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
    axis = np.stack([np.cos(angle), np.sin(angle)], 1)
    own = np.einsum("ti,ij,tj->t", axis, extent, axis)
    return np.sqrt(least / np.maximum(own, 1e-9))
