# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth, normal and confidence of all photos by multi-view PatchMatch.

See docs/method.md, section 11.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .. import tolerances
from ..dataset.camera import Camera
from ..dataset.photo_source import PhotoSource
from ..kernels.parallel import default_threads, run_chunks
from ..progress import Progress
from .matching_level import NO_PRIOR, MatchingLevel, grey_levels
from .planar_prior import plane_normals, points_in_view, triangle_planes
from .source_views import in_image, source_views

_logger = logging.getLogger(__name__)

COARSE_SWEEPS, COARSE_GEOMETRIC_SWEEPS, FINE_SWEEPS = 3, 2, 2
"""Sweeps at the coarse level before and after photos are compared, and at the fine level."""

GEOMETRIC_COST = 0.15
"""Of a pixel of forward-backward error."""

RANDOM_SHARE = 0.25
"""Share of the pixels that start with a random plane although triangles cover them."""

NEAREST_FACTOR, FARTHEST_FACTOR = 1.5, 0.02
"""Range of the inverse depths over that of the sparse points."""

FEW_POINTS = 20
"""A photo with fewer of them takes the range from all points."""

MOST_PIXELS = 12_000_000
"""Of all photos together at that size; more photos are matched at a smaller one."""

PRIOR_CELL_PX = 4
RELIABLE_COST, RELIABLE_SOURCES = 0.3, 2
"""The best pixel of each cell that is reliable by these is a corner of the prior's triangles."""

LEAST_SOURCES = 2
LEAST_CORRELATION = 0.5
CERTAIN_SOURCES = 4
"""Sources and correlation that confidence needs, and sources from which it no longer rises."""

SINGLE_COST = 0.7
"""A lower mean cost confirms a depth with one source: in a second one, nothing need match."""

SINGLE_PARALLAX_PX = 100.0
"""Focal length times the sine of the angle between the rays of a depth with one source: a pixel,
which is what the two may be apart, is then one per cent of the depth."""

TEXTURE_VARIANCE = 20.0
"""Noise in the variance of a window that correlation is corrected for, squared grey levels."""


@dataclass(frozen=True)
class DepthMap:
    """What stereo found in one photo."""

    camera: Camera
    """Of this size, scene frame."""
    depth: np.ndarray
    """(h, w) float32 z-depth of the best plane, scene units, confirmed or not."""
    normal: np.ndarray
    """(h, w, 3) float32 unit normals towards the camera, scene frame."""
    confidence: np.ndarray
    """(h, w) float32 in [0, 1], 0 where sources do not confirm the depth or a mask excludes the
    pixel; an order, no probability."""
    agreeing: np.ndarray
    """(h, w) uint8 number of sources whose depth agrees."""
    cost: np.ndarray
    """(h, w) float32 mean cost in the two best sources; about 1 where nothing matches."""
    color: np.ndarray
    """(h, w, 3) uint8."""
    mask: np.ndarray | None
    """(h, w) bool, true where the photo counts."""
    free: np.ndarray | None = None
    """(h, w) float32 z-depth of parts without texture but for their borders, 0 elsewhere: the
    photo shows nothing before it. ``None`` until such parts were looked for."""


def estimate_depth_maps(
    photos: PhotoSource,
    views: Sequence[int],
    points: np.ndarray,
    progress: Progress,
    *,
    side_px: int,
    seed: int = 0,
    threads: int = 0,
) -> list[DepthMap]:
    """Estimate the depth maps of photos; the result does not depend on ``threads``.

    Parameters
    ----------
    photos : PhotoSource
    views : sequence of int
        Views to match with each other.
    points : (n, 3) float64
        Sparse points, scene frame: they tell the range of depths and which photos to compare.
    progress : Progress
        Updated after each photo and level; checked for cancellation.
    side_px : int
        Longest side at which photos are matched (:func:`least_divisor`).

    Returns
    -------
    list of DepthMap
        In the order of ``views``; empty where there are too few points or views to compare, or a
        photo is too small to be halved.
    """
    threads = threads or default_threads()
    views = list(views)
    full = [photos.camera(view, 1) for view in views]
    if len(views) <= LEAST_SOURCES or len(points) < FEW_POINTS:
        return []
    fine = matching_divisor(full, side_px)
    if min(min(camera.width, camera.height) for camera in full) < 2 * fine:
        return []
    sources = source_views(full, points)
    ranges = np.array([_depth_range(camera, points) for camera in full])
    matcher = _Matcher(photos, views, points, sources, ranges, seed, threads, progress)
    coarse = matcher.coarse(2 * fine)
    level, means = matcher.fine(coarse, fine)
    found = []
    for number, view in enumerate(views):
        color, mask = photos.photo(view, fine), photos.mask(view, fine)
        found.append(_depth_map(level, number, means[number], color, mask))
    share = float(np.mean([np.mean(depth_map.confidence > 0) for depth_map in found]))
    _logger.info("stereo: %.0f %% of the pixels of %d photos", 100 * share, len(views))
    return found


class _Matcher:
    """The levels of one matching."""

    def __init__(
        self, photos: PhotoSource, views: list[int], points: np.ndarray,
        sources: list[np.ndarray], ranges: np.ndarray, seed: int, threads: int, progress: Progress,
    ) -> None:  # fmt: skip
        self.photos, self.views, self.points = photos, views, points
        self.sources, self.ranges, self.seed = sources, ranges, seed
        self.threads, self.progress = threads, progress
        # A fine sweep visits four times the pixels of a coarse one.
        self.steps = len(views) * (COARSE_SWEEPS + COARSE_GEOMETRIC_SWEEPS + 4 * FINE_SWEEPS)
        self.done, self.lock = 0, threading.Lock()

    def coarse(self, divisor: int) -> MatchingLevel:
        """Match from sparse points and random planes."""
        level = self._level(divisor)

        def photometric(view: int) -> None:
            self._start(level, view)
            for turn in range(COARSE_SWEEPS):
                level.sweep(view, turn, self.seed, fresh=True)

        self._each(photometric, COARSE_SWEEPS)
        depths = level.inverse_depths()
        for view in range(len(level)):
            level.confirm(view, depths)
        level.compare_brightness()
        for turn in range(COARSE_GEOMETRIC_SWEEPS):
            self._geometric_sweep(level, COARSE_SWEEPS + turn, turn == 0, 1)
        depths = level.inverse_depths()
        for view in range(len(level)):
            level.confirm(view, depths)
        return level

    def fine(self, coarse: MatchingLevel, divisor: int) -> tuple[MatchingLevel, list[np.ndarray]]:
        """Refine at twice the size; return the level and the mean inverse depths."""
        level = self._level(divisor)
        self._each(lambda view: level.start_from(coarse, view), 0)
        for turn in range(FINE_SWEEPS):
            self._geometric_sweep(level, COARSE_SWEEPS + turn, turn == 0, 4)
        depths = level.inverse_depths()
        return level, [level.confirm(view, depths) for view in range(len(level))]

    def _level(self, divisor: int) -> MatchingLevel:
        cameras = [self.photos.camera(view, divisor) for view in self.views]
        greys = [grey_levels(self.photos.photo(view, divisor)) for view in self.views]
        return MatchingLevel(cameras, greys, self.sources, self.ranges)

    def _geometric_sweep(
        self, level: MatchingLevel, turn: int, with_prior: bool, weight: int
    ) -> None:
        """Sweep over all photos, comparing with the depths that all had before."""
        depths = level.inverse_depths()
        coarse = weight == 1

        def run(view: int) -> None:
            prior = self._prior(level, view, coarse) if with_prior else NO_PRIOR
            level.sweep(
                view, turn, self.seed, geometric=GEOMETRIC_COST, inverse_depths=depths, prior=prior
            )

        self._each(run, weight)

    def _each(self, work: Callable[[int], object], weight: int) -> None:
        """Do work for all photos on all threads, and report progress."""

        def run(begin: int, end: int) -> None:
            for view in range(begin, end):
                self.progress.check()
                work(view)
                if weight:
                    self._report(weight)

        run_chunks(run, np.arange(len(self.views) + 1), self.threads)

    def _report(self, weight: int) -> None:
        with self.lock:  # or a thread could report less than another one before it
            self.done += weight
            share = self.done / self.steps
            self.progress.update(share, f"matching photos for a dense start · {share:.0%}")

    def _start(self, level: MatchingLevel, view: int) -> None:
        """Planes between sparse points; random ones elsewhere and for a share of the pixels."""
        camera, random = level.cameras[view], np.random.default_rng([self.seed, view])
        pixels, inverse = points_in_view(camera, self.points)
        planes = triangle_planes(pixels, inverse, camera)
        low, high = level.depth_ranges[view]
        gap = (planes[..., 0] < low) | (planes[..., 0] > high)
        gap |= random.random(gap.shape) < RANDOM_SHARE
        planes[gap] = 0.0
        planes[gap, 0] = random.uniform(low, high, int(gap.sum()))
        level.planes_of(view)[:] = planes

    def _prior(self, level: MatchingLevel, view: int, reliable: bool) -> np.ndarray:
        """Planes between reliable pixels, where wanted, and sparse points away from these.

        At the fine level sparse points alone: small triangles between pixels of the coarse level
        hand on their errors, which made plain walls clearly worse.
        """
        camera, planes = level.cameras[view], level.planes_of(view)
        pixels, inverse = points_in_view(camera, self.points, planes[..., 0])
        if reliable:
            row, column = _reliable_pixels(level, view)
            side = 2 * PRIOR_CELL_PX
            taken = np.zeros((camera.height // side + 1, camera.width // side + 1), bool)
            taken[row // side, column // side] = True
            at = np.clip(pixels, 0, (camera.width - 1, camera.height - 1)).astype(int) // side
            free = ~taken[at[:, 1], at[:, 0]]
            pixels = np.concatenate([np.stack([column, row], 1), pixels[free]])
            inverse = np.concatenate([planes[row, column, 0], inverse[free]])
        return triangle_planes(pixels, inverse, camera)


def _reliable_pixels(level: MatchingLevel, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column of the best pixel of each cell that sources confirm."""
    cost, width = level.costs[view], level.greys[view].shape[1]
    good = (_count(level.confirmed[view]) >= RELIABLE_SOURCES) & (cost < RELIABLE_COST)
    row, column = np.nonzero(good)
    cell = (row // PRIOR_CELL_PX) * (width // PRIOR_CELL_PX + 1) + column // PRIOR_CELL_PX
    order = np.lexsort((cost[row, column], cell))
    first = order[np.unique(cell[order], return_index=True)[1]]
    return row[first], column[first]


def _depth_map(
    level: MatchingLevel, view: int, means: np.ndarray, color: np.ndarray, mask: np.ndarray | None
) -> DepthMap:
    count = _count(level.confirmed[view])
    floor = 1.0 + TEXTURE_VARIANCE / np.maximum(level.variances[view], 1e-3)
    correlation = np.clip((1.0 - level.costs[view]) * floor, 0.0, 1.0)
    good = (count >= LEAST_SOURCES) & (correlation > LEAST_CORRELATION)
    good |= _from_aside(level, view, means) & (level.costs[view] < SINGLE_COST)
    good &= means > 0
    if mask is not None:
        good &= mask
    confidence = np.minimum(count / CERTAIN_SOURCES, 1.0) * np.sqrt(correlation)
    camera = level.cameras[view]
    normal = -plane_normals(level.planes_of(view), camera) @ camera.rotation
    return DepthMap(
        camera,
        (1.0 / np.maximum(means, 1.0 / tolerances.FINITE_Z_MAX)).astype(np.float32),
        normal.astype(np.float32),
        np.where(good, confidence, 0.0).astype(np.float32),
        count,
        level.costs[view],
        color,
        mask,
    )


def _from_aside(level: MatchingLevel, view: int, means: np.ndarray) -> np.ndarray:
    """Return (h, w) bool: one source alone confirms the depth, and sees it from aside."""
    camera, found = level.cameras[view], np.zeros(means.shape, bool)
    rays = camera.rays()
    for number, source in enumerate(level.sources[view]):
        row, column = np.nonzero((level.confirmed[view] == 1 << number) & (means > 0))
        away = (rays[row, column] / means[row, column, None]) @ camera.rotation  # (m, 3)
        across = away + camera.center - level.cameras[source].center
        sine = np.linalg.norm(np.cross(away, across), axis=1)
        sine /= np.maximum(np.linalg.norm(away, axis=1) * np.linalg.norm(across, axis=1), 1e-30)
        found[row, column] = camera.fx * sine > SINGLE_PARALLAX_PX
    return found


def _count(bits: np.ndarray) -> np.ndarray:
    return np.bitwise_count(bits) if hasattr(np, "bitwise_count") else _BITS[bits]


_BITS = np.array([bin(value).count("1") for value in range(256)], np.uint8)


def _depth_range(camera: Camera, points: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest inverse depth to try."""
    inside, depth = in_image(camera, points)
    if inside.sum() < FEW_POINTS:
        distance = np.linalg.norm(points - camera.center, axis=1)
        near, far = np.percentile(distance, (1, 99))
    else:
        near, far = np.percentile(depth[inside], (1, 99))
    near, far = max(near, tolerances.NEAR_Z), max(far, tolerances.NEAR_Z)
    return FARTHEST_FACTOR / far, NEAREST_FACTOR / near


def matching_divisor(cameras: Sequence[Camera], most_px: int) -> int:
    """Return the divisor of the size at which photos are matched; ``cameras`` are of divisor 1."""
    side_px = max(max(camera.width, camera.height) for camera in cameras)
    pixels = sum(camera.width * camera.height for camera in cameras)
    return least_divisor(side_px, pixels, most_px)


def least_divisor(side_px: float, pixels: float, most_px: int) -> int:
    """Return the least power of 2 that brings photos below both limits.

    Parameters
    ----------
    side_px : float
        Long side of the largest photo.
    pixels : float
        Of all photos together: divided, at most :data:`MOST_PIXELS`.
    most_px : int
        Long side, divided, at most.
    """
    divisor = 1
    while side_px / divisor > most_px or pixels / divisor**2 > MOST_PIXELS:
        divisor *= 2
    return divisor
