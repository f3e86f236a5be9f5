# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of photos without texture, and the depths known in and around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from ...imaging.luma import grey_of
from ..depth_maps import DepthMap
from ..planar_prior import points_in_view
from .noise import noise_levels, smoothed_step_noise

STEP_LEVELS = 2.5
"""Largest difference of grey levels of neighbours, smoothed by the first of the widths below,
within a plain segment; as much less as the width is larger, as a step of colours is."""

SMOOTHING_PX = (0.7, 1.0, 1.4, 2.0, 2.8)
CLEAR_OF_NOISE = 4.5
"""The first width is taken at which that difference is so many standard deviations of noise."""

LEAST_SHARE = 0.0008
"""Of the pixels of a photo that a segment needs."""

LARGE_SHARE = 0.004
"""Of the pixels of a photo from which a segment proposes planes; smaller ones may take over those
of their neighbours."""

BORDER_PX = 5
"""Width of the band around a segment whose confirmed depths count."""

MOST_BORDER = 600
"""Known depths of a segment, at most; a regular choice of more."""

SPARSE_WEIGHT = 3.0
"""Of a sparse point inside a segment; confirmed pixels of the border weigh 1."""

INSIDE_WEIGHT = 0.3
"""Of a confirmed pixel inside: windows without texture also agree where they should not."""


@dataclass(frozen=True)
class Segment:
    """Connected pixels without texture."""

    view: int
    """Number of the depth map."""
    rows: np.ndarray  # (p,) int64
    columns: np.ndarray  # (p,) int64
    places: np.ndarray  # (b, 2) float64 pixels of known depths in and around it, centres whole
    inverse_depths: np.ndarray  # (b,) of those
    weights: np.ndarray  # (b,)
    large: bool
    unknown: float
    """Share of its pixels whose depth no source confirms."""
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
    """Return the plain segments of all photos.

    Parameters
    ----------
    depth_maps : sequence of DepthMap
    points : (n, 3) float64
        Sparse points, scene frame.
    """
    return [
        segment
        for view, depth_map in enumerate(depth_maps)
        for segment in _segments(depth_map, view, points)
    ]


def numbered(segments: Sequence[Segment], shape: tuple[int, ...]) -> np.ndarray:
    """Return (n, h, w) int32 numbers of the segments of each photo from 1, 0 elsewhere.

    Parameters
    ----------
    segments : sequence of Segment
    shape : (3,) int
        Number of photos, height and width of the largest.
    """
    numbers = np.zeros(shape, np.int32)
    count = np.zeros(len(numbers), np.int32)
    for segment in segments:
        count[segment.view] += 1
        numbers[segment.view, segment.rows, segment.columns] = count[segment.view]
    return numbers


def plain_pixels(depth_map: DepthMap) -> tuple[np.ndarray, float]:
    """Return the plain pixels of a photo and the noise of its grey levels.

    Returns
    -------
    plain : (h, w) bool
        No step of grey levels to a neighbour, and no mask excludes the pixel.
    noise : float
        Standard deviation of white noise as strong.
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
        found.append(
            Segment(
                view,
                row + corner[1],
                column + corner[0],
                np.concatenate([np.stack([columns, rows], 1), sparse_px[own]]),
                np.concatenate([inverse[rows, columns], sparse_inverse[own]]),
                np.concatenate([weight, np.full(int(own.sum()), SPARSE_WEIGHT)]),
                bool(sizes[number] >= LARGE_SHARE * plain.size),
                1.0 - len(inner_row) / len(row),
                noise,
            )
        )
    return found


def _wider(part: slice, size: int) -> slice:
    return slice(max(0, part.start - BORDER_PX), min(size, part.stop + BORDER_PX))
