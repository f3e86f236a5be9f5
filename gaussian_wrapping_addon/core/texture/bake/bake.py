# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours of surface points from photos: occlusion test, best views, robust blending."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ...dataset.photo_source import PhotoSource
from ...imaging.trilinear import pyramid
from ...kernels.compiled import kernel, part
from ...kernels.parallel import even_bounds, run_chunks
from ...progress import Progress
from .fill import surface_positions
from .low_frequency_correction import solve_low_frequency_correction
from .photo_gains import solve_gains
from .photo_samples import LAST_RESORT_BELOW, PhotoView, SurfaceArrays, SurfacePoints, sample_photo
from .visibility import photo_visibility

KEPT_VIEWS = 15
"""Odd, so that the median of the views is one of them. With five, the median changed wherever one
view replaced another: flakes along the rim of a pot whose photos differ in exposure."""
SHARPNESS_AGREEING, SHARPNESS_DISAGREEING = 6.0, 1.0
"""Exponents of the weights, how far the best views dominate: where views agree, or are one or two,
and where they do not. A high one keeps gradients, noise and highlights of single photos where they
disagree, a low one blurs where they agree (benchmarks/texturing.py)."""
DISAGREEMENT = 10.0
"""Median distance of the views from their median, of 255 levels, half way between the two."""
OUTLIER_FLOOR = 20.0
"""Views within this many of 255 levels of the median are never outliers."""
OUTLIER_FACTOR = 2.5
OUTLIER_FADE = 0.5
"""Views fade from this share of the limit on, and are gone at it: a hard limit leaves flakes with
sharp borders where neighbouring texels reject different views."""
CLEAR_PX = 2
"""Closer to a silhouette, a pixel's colour is mixed with that of another surface."""
MEDIAN_POWER = 0.25
"""Exponent of the weights in the median: even enough that one view cannot outvote the others."""
POINTS_PER_BLOCK = 6_000_000
"""Points processed at once with their views (105 bytes each)."""
CORRECTION_POINTS = 24_000
"""About fifty per grid cell of a photo's low-frequency correction, with a fifth of them in view."""
MAX_CORRECTION_SAMPLES = 8_000_000
"""Bound on points x photos of the colour correction."""
COARSE_LONG_SIDE_PX = 480


@dataclass(frozen=True)
class BakedColors:
    """Blended colours of surface points."""

    colors: np.ndarray
    """(n, 3) uint8; 0 if no photo sees the point."""
    views: np.ndarray
    """(n,) uint8 number of views blended, 0 if unseen."""
    clear: np.ndarray
    """(n,) bool: some view sees the point away from silhouettes, where two surfaces mix."""
    reliable: np.ndarray
    """(n,) bool: some view sees the point neither at a grazing angle nor partly occluded."""
    photos_used: int
    """Number of photos with at least one depth sample of the mesh."""
    gain_spread: float
    """Standard deviation of the log gains between photos."""
    gains_applied: bool
    low_frequency_spread: float
    """Standard deviation of the log low-frequency corrections within photos."""
    low_frequency_applied: bool
    rejected: int
    """Number of kept views rejected as outliers."""


@dataclass(frozen=True)
class PhotoPreparation:
    """Photos that show the mesh, and their colour correction."""

    used_photos: list[_UsedPhoto]
    """Photos that show the mesh, and the level at which each is read."""
    correction: _ColorCorrection


@dataclass(frozen=True)
class _UsedPhoto:
    index: int
    divisor: int


@dataclass(frozen=True)
class _ColorCorrection:
    factors: np.ndarray
    """(photos, gh, gw, 3) float64 colour factors of each photo, on a grid over the photo."""
    gain_spread: float
    gains_applied: bool
    low_frequency_spread: float
    low_frequency_applied: bool


def bake(
    points: SurfacePoints,
    surface: SurfaceArrays,
    photos: PhotoSource,
    preparation: PhotoPreparation,
    progress: Progress,
    *,
    threads: int,
) -> BakedColors:
    """Blend the best views of each point by a robust mean.

    Parameters
    ----------
    points : SurfacePoints
        Points in texture order.
    photos : PhotoSource
        Read one at a time, at the level that matches the texel size.
    preparation : PhotoPreparation
        Result of :func:`prepare_photos` for these photos.

    Notes
    -----
    The weight of a view is (cosine x useful pixels per texel)^2, reduced near silhouettes and the
    image border. The best ``KEPT_VIEWS`` are kept; with three or more, those far from their median
    are rejected (docs/method.md, section 8.2).
    """
    used_photos, correction = preparation.used_photos, preparation.correction
    colors = np.zeros((len(points), 3), np.uint8)
    views = np.zeros(len(points), np.uint8)
    rejected = np.zeros(len(points), np.uint8)
    clearance = np.zeros(len(points), np.uint8)
    reliable = np.zeros(len(points), np.bool_)
    blocks = max(1, math.ceil(len(points) / POINTS_PER_BLOCK))
    bounds = np.linspace(0, len(points), blocks + 1).astype(int).tolist()
    steps = max(1, blocks * len(used_photos))
    for block, (begin, end) in enumerate(pairwise(bounds)):
        block_points = points.part(slice(begin, end))
        weights = np.zeros((end - begin, KEPT_VIEWS), np.float32)
        kept = np.zeros((end - begin, KEPT_VIEWS, 3), np.uint8)
        for step, used_photo in enumerate(used_photos):
            fraction = 0.95 * (block * len(used_photos) + step) / steps
            progress.update(fraction, f"texture: photo {step + 1} of {len(used_photos)}")
            view = _view(photos, used_photo.index, used_photo.divisor, surface, threads)
            sample_photo(
                block_points,
                surface,
                view,
                correction.factors[used_photo.index],
                weights,
                kept,
                clearance[begin:end],
                threads,
            )
        progress.update(0.95 * (block + 1) / blocks, "blending views")
        reliable[begin:end] = weights.max(axis=1) > LAST_RESORT_BELOW
        _blend_block(
            weights, kept, colors[begin:end], views[begin:end], rejected[begin:end], threads
        )
    return BakedColors(
        colors,
        views,
        clearance >= CLEAR_PX,
        reliable,
        len(used_photos),
        correction.gain_spread,
        correction.gains_applied,
        correction.low_frequency_spread,
        correction.low_frequency_applied,
        int(rejected.sum(dtype=np.int64)),
    )


def _view(
    photos: PhotoSource, index: int, divisor: int, surface: SurfaceArrays, threads: int
) -> PhotoView:
    camera = photos.camera(index, divisor)
    mask = photos.mask(index, divisor)
    return PhotoView(
        camera,
        photos.camera(index, 1).fx,
        pyramid(photos.photo(index, divisor)),
        np.ones((1, 1), np.bool_) if mask is None else mask,
        photo_visibility(surface.vertices, surface.faces, camera, threads),
    )


def correction_sample_count(count: int) -> int:
    """Return the number of points that :func:`prepare_photos` needs for a number of photos."""
    return max(1, min(CORRECTION_POINTS, MAX_CORRECTION_SAMPLES // max(count, 1)))


def prepare_photos(
    sample: SurfacePoints,
    surface: SurfaceArrays,
    photos: PhotoSource,
    count: int,
    progress: Progress,
    *,
    threads: int,
) -> PhotoPreparation:
    """Find the photos that show the mesh, their level, and their colour correction.

    Parameters
    ----------
    sample : SurfacePoints
        Evenly spread over the surface, :func:`correction_sample_count` of them.
    count : int
        Number of photos.
    """
    wanted = len(sample)
    colors = np.zeros((wanted, count, 3), np.uint8)
    valid = np.zeros((wanted, count), np.bool_)
    image_positions = np.zeros((wanted, count, 2), np.float32)
    positions = surface_positions(sample, surface)
    used_photos = []
    for index in range(count):
        progress.update(index / count, f"texture: analysing photo {index + 1} of {count}")
        full = photos.camera(index, 1)
        coarse = max(1, math.ceil(max(full.width, full.height) / COARSE_LONG_SIDE_PX))
        coarse = min(coarse, full.width, full.height)
        view = _view(photos, index, coarse, surface, threads)
        hit = view.visibility.depth[np.isfinite(view.visibility.depth)]
        if len(hit) == 0:
            continue
        # At this level, a texel near the camera still has one pixel.
        near = float(np.percentile(hit, 2.0))
        divisor = max(1, int(full.fx * surface.texel_size / near))
        used_photos.append(_UsedPhoto(index, min(divisor, full.width, full.height)))
        weights = np.zeros((wanted, 1), np.float32)
        one = np.zeros((wanted, 1, 3), np.uint8)
        unused = np.zeros(wanted, np.uint8)
        sample_photo(sample, surface, view, np.ones((1, 1, 3)), weights, one, unused, threads)
        valid[:, index] = weights[:, 0] > LAST_RESORT_BELOW
        colors[:, index] = one[:, 0]
        image_positions[:, index] = full.project(positions)[0] / [full.width, full.height]
    gains, gain_spread = solve_gains(colors, valid)
    low_frequency, low_frequency_spread = solve_low_frequency_correction(
        colors, valid, image_positions, gains
    )
    correction = _ColorCorrection(
        gains[:, None, None] * low_frequency,
        gain_spread,
        bool((gains != 1.0).any()),
        low_frequency_spread,
        bool((low_frequency != 1.0).any()),
    )
    return PhotoPreparation(used_photos, correction)


def _blend_block(
    weights: np.ndarray,
    kept: np.ndarray,
    colors: np.ndarray,
    views: np.ndarray,
    rejected: np.ndarray,
    threads: int,
) -> None:
    def chunk(begin: int, end: int) -> None:
        _blend(weights, kept, begin, end, colors, views, rejected)

    run_chunks(chunk, even_bounds(len(weights), threads, 16), threads)


@kernel(fast=False)
def _blend(
    weights: Any, kept: Any, begin: int, end: int, colors: Any, views: Any, rejected: Any
) -> None:
    slots = weights.shape[1]
    order = np.empty(slots, np.int64)
    share = np.empty(slots)
    distance = np.empty(slots)
    sorted_distance = np.empty(slots)
    median = np.empty(3)
    values, ranked, mass = np.empty(slots), np.empty(slots), np.empty(slots)
    vote = np.empty(slots)
    for i in range(begin, end):
        count = 0
        best = 0.0
        for k in range(slots):
            best = max(best, float(weights[i, k]))
        # Views of last resort count only if there are no others.
        least = LAST_RESORT_BELOW if best > LAST_RESORT_BELOW else 0.0
        for k in range(slots):
            if weights[i, k] > least:
                order[count] = k
                count += 1
        if count == 0:
            continue
        for j in range(count):
            share[j] = weights[i, order[j]] / best
        limit = np.inf
        sharpness = SHARPNESS_AGREEING
        if count >= 3:
            for channel in range(3):
                for j in range(count):
                    values[j] = kept[i, order[j], channel]
                    vote[j] = share[j] ** MEDIAN_POWER
                median[channel] = _weighted_median(values, vote, count, ranked, mass)
            for j in range(count):
                far = 0.0
                for channel in range(3):
                    far = max(far, abs(kept[i, order[j], channel] - median[channel]))
                distance[j] = far
                rank = j
                while rank > 0 and sorted_distance[rank - 1] > far:
                    sorted_distance[rank] = sorted_distance[rank - 1]
                    rank -= 1
                sorted_distance[rank] = far
            spread = sorted_distance[(count - 1) // 2]
            limit = max(OUTLIER_FLOOR, OUTLIER_FACTOR * spread)
            agreement = 1.0 / (1.0 + (spread / DISAGREEMENT) ** 4)
            sharpness = agreement * SHARPNESS_AGREEING + (1.0 - agreement) * SHARPNESS_DISAGREEING
        red, green, blue, total = 0.0, 0.0, 0.0, 0.0
        used = 0
        for j in range(count):
            weight = share[j] ** sharpness
            if count >= 3:
                kept_share = (1.0 - distance[j] / limit) / (1.0 - OUTLIER_FADE)
                if kept_share <= 0.0:
                    rejected[i] += 1
                    continue
                weight *= min(kept_share, 1.0)
            red += weight * kept[i, order[j], 0]
            green += weight * kept[i, order[j], 1]
            blue += weight * kept[i, order[j], 2]
            total += weight
            used += 1
        colors[i, 0] = int(red / total + 0.5)
        colors[i, 1] = int(green / total + 0.5)
        colors[i, 2] = int(blue / total + 0.5)
        views[i] = used


@part(fast=False)
def _weighted_median(values: Any, share: Any, count: int, ranked: Any, mass: Any) -> float:
    """Return the weighted median, by insertion sort into the scratch arrays."""
    total = 0.0
    for j in range(count):
        value, weight = values[j], share[j]
        total += weight
        rank = j
        while rank > 0 and ranked[rank - 1] > value:
            ranked[rank] = ranked[rank - 1]
            mass[rank] = mass[rank - 1]
            rank -= 1
        ranked[rank] = value
        mass[rank] = weight
    running = 0.0
    for j in range(count):
        running += mass[j]
        if running >= 0.5 * total:
            return ranked[j]
    return ranked[count - 1]
