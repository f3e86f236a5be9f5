# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth maps of all photos: matched, checked against each other, fused to points."""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from .. import limits
from ..array_file import read_arrays
from ..errors import ParseError
from ..files import write_bytes
from ..parallel import default_threads, run_chunks
from ..progress import Progress
from ..scene.camera import Camera
from ..scene.scene import PhotoSource
from .matching import (
    NO_PRIOR,
    MatchingLevel,
    coarser_planes,
    finer_planes,
    grey_levels,
    in_image,
    source_angles_deg,
    source_views,
)
from .semi_global import matched_planes, volume_bytes

# -- Planes of triangles between points whose depth is known (docs/method.md, section 11.6) -------


LEAST_COSINE = 0.15  # between ray and normal: steeper triangles mostly bridge the edge of a thing
HIDDEN_SHARE = 1.25
"""A point this much farther away than the nearest one of its cell counts as hidden."""

BEHIND_SHARE = 1.05  # a point this much farther away than the pixel's own depth is hidden
_CELLS = 24  # cells along the long side of an image
_LEAST_AREA = 1e-9


def points_in_view(
    camera: Camera, points: np.ndarray, inverse_depths: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (m, 2) and inverse depths (m,), float64, of the points that a photo may show.

    Hidden is what lies behind other points of its cell, or behind known ``inverse_depths`` (h, w)
    of the photo. Points (n, 3) are in the frame that the camera stands in; pixels have their
    centres at whole numbers.
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

    Of pixels (n, 2) with centres at whole numbers and inverse depths (n,): (w, a, b) of each pixel
    (:mod:`~.matching`), 0 outside all triangles and in steep ones.
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


# -- Depth, normal and confidence of all photos by multi-view PatchMatch --------------------------
#
# See docs/method.md, section 11.


_logger = logging.getLogger(__name__)

COARSE_SWEEPS, COARSE_GEOMETRIC_SWEEPS, FINE_SWEEPS = 3, 2, 2
GUIDED_COARSE_SWEEPS, GUIDED_FINE_SWEEPS = 1, 1
"""Sweeps at the coarse level before and after photos are compared, and at the fine level; fewer
where semi-global matching has found the planes."""

LEAST_GUIDED_DEG, GUIDED_ANGLE_DEG = 0.5, 10.0
"""Semi-global matching guides photos whose widest source sees their points within these angles.
From wider apart, squares of two photos look less alike than windows that follow the surface."""

GEOMETRIC_COST = 0.15  # of a pixel of forward-backward error
RANDOM_SHARE = 0.25
"""Share of the pixels that start with a random plane although triangles cover them."""

GUIDE_STEPS = 8
"""Semi-global matching of a photo takes about as long as so many coarse sweeps."""

MOST_VOLUME_BYTES, ALL_VOLUMES_BYTES = 400_000_000, 1_000_000_000
"""Memory of the costs of one photo, and of all that are matched at a time."""

NEAREST_FACTOR, FARTHEST_FACTOR = 1.5, 0.02
"""Range of the inverse depths over that of the sparse points."""

FEW_POINTS = 20  # a photo with fewer of them takes the range from all points
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

    camera: Camera  # of this size, scene frame
    depth: np.ndarray  # (h, w) float32 z-depth of the best plane, scene units, confirmed or not
    normal: np.ndarray  # (h, w, 3) float32 unit normals towards the camera, scene frame
    confidence: np.ndarray
    """(h, w) float32 in [0, 1], 0 where sources do not confirm the depth or a mask excludes the
    pixel; an order, no probability."""
    agreeing: np.ndarray  # (h, w) uint8 number of sources whose depth agrees
    cost: np.ndarray
    """(h, w) float32 mean cost in the two best sources; about 1 where nothing matches."""
    color: np.ndarray  # (h, w, 3) uint8
    mask: np.ndarray | None  # (h, w) bool, true where the photo counts
    free: np.ndarray | None = None
    """(h, w) float32 z-depth of parts without texture but for their borders, 0 elsewhere: the
    photo shows nothing before it. ``None`` until such parts were looked for."""


def estimate_depth_maps(
    photos: PhotoSource, views: Sequence[int], points: np.ndarray, progress: Progress, *,
    side_px: int, seed: int = 0, threads: int = 0,
) -> list[DepthMap]:  # fmt: skip
    """Estimate the depth maps of photos; the result does not depend on ``threads``.

    Parameters
    ----------
    views : sequence of int
        Views to match with each other; the result is in their order, and empty where there are too
        few points or views to compare, or a photo is too small to be halved.
    points : (n, 3) float64
        Sparse points, scene frame: they tell the range of depths and which photos to compare.
    progress : Progress
        Updated after each photo and level; checked for cancellation.
    side_px : int
        Longest side at which photos are matched (:func:`least_divisor`).
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
    guides = matcher.guides(fine)
    coarse = matcher.coarse(2 * fine, guides)
    level, means = matcher.fine(coarse, fine, guides)
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
        full = [photos.camera(view, 1) for view in views]
        self.guiding: list[np.ndarray] = []  # of each photo, the sources that tell its depth
        self.guided: list[bool] = []
        for view, near in enumerate(sources):
            angles = source_angles_deg(full, view, near, points)
            self.guiding.append(near[angles > LEAST_GUIDED_DEG])  # others look alike at all depths
            self.guided.append(bool((angles <= GUIDED_ANGLE_DEG).all()))
        while True:  # a guide is confirmed by those of the sources
            lonely = [
                view
                for view, near in enumerate(self.guiding)
                if self.guided[view] and sum(self.guided[k] for k in near) < LEAST_SOURCES
            ]
            if not lonely:
                break
            for view in lonely:
                self.guided[view] = False
        # A fine sweep visits four times the pixels of a coarse one.
        plain = COARSE_SWEEPS + COARSE_GEOMETRIC_SWEEPS + 4 * FINE_SWEEPS
        guided = GUIDE_STEPS + GUIDED_COARSE_SWEEPS + COARSE_GEOMETRIC_SWEEPS
        guided += 4 * GUIDED_FINE_SWEEPS
        self.steps = sum(guided if by_guide else plain for by_guide in self.guided)
        self.done, self.lock = 0, threading.Lock()

    def guides(self, divisor: int) -> list[np.ndarray]:
        """Return the planes (h, w, 3) that semi-global matching finds and two sources confirm.

        0 elsewhere, and in photos that it does not guide. Photos whose costs would take too much
        memory are matched at half the size.
        """
        full = [self.photos.camera(view, divisor) for view in self.views]
        shapes = [(camera.height, camera.width) for camera in full]
        if not any(self.guided):
            return [np.zeros((*shape, 3), np.float32) for shape in shapes]
        most_bytes = max(volume_bytes(height * width) for height, width in shapes)
        halved = most_bytes > MOST_VOLUME_BYTES
        if halved:
            most_bytes //= 4
        level = self._level(2 * divisor if halved else divisor)

        def match(view: int) -> None:
            if self.guided[view]:
                chosen = self.guiding[view]
                level.planes_of(view)[:] = matched_planes(
                    level.cameras[view], level.greys[view],
                    [level.cameras[k] for k in chosen], [level.greys[k] for k in chosen],
                    self.ranges[view],
                )  # fmt: skip

        at_once = max(1, ALL_VOLUMES_BYTES // most_bytes)
        self._each(match, [GUIDE_STEPS * guided for guided in self.guided], at_once)
        level.confirm_all()
        guides = []
        for view, shape in enumerate(shapes):
            known = (_BITS[level.confirmed[view]] >= LEAST_SOURCES)[..., None]
            guide = np.where(known, level.planes_of(view), np.float32(0))
            if halved:
                guide = finer_planes(guide, shape)
                low, high = level.depth_ranges[view]
                guide[(guide[..., 0] < low) | (guide[..., 0] > high)] = 0.0
            guides.append(guide)
        return guides

    def coarse(self, divisor: int, guides: list[np.ndarray]) -> MatchingLevel:
        """Match at half the guides' size, from them, sparse points and random planes."""
        level = self._level(divisor)
        guides = [
            coarser_planes(guide, grey.shape)
            for guide, grey in zip(guides, level.greys, strict=True)
        ]
        sweeps = [GUIDED_COARSE_SWEEPS if guided else COARSE_SWEEPS for guided in self.guided]

        def photometric(view: int) -> None:
            self._start(level, view, guides[view])
            for turn in range(sweeps[view]):
                level.sweep(view, turn, self.seed, fresh=True, prior=self._guide(guides, view))

        self._each(photometric, sweeps)
        level.confirm_all()
        level.compare_brightness()
        for turn in range(COARSE_GEOMETRIC_SWEEPS):
            self._geometric_sweep(level, guides, turn, COARSE_GEOMETRIC_SWEEPS, 1)
        level.confirm_all()
        return level

    def fine(
        self, coarse: MatchingLevel, divisor: int, guides: list[np.ndarray]
    ) -> tuple[MatchingLevel, list[np.ndarray]]:
        """Refine at twice the size; return the level and the mean inverse depths."""
        level = self._level(divisor)

        def start(view: int) -> None:
            level.start_from(coarse, view)
            known = guides[view][..., 0] > 0
            level.planes_of(view)[known] = guides[view][known]

        self._each(start, [0] * len(self.views))
        for turn in range(FINE_SWEEPS):
            self._geometric_sweep(level, guides, turn, GUIDED_FINE_SWEEPS, 4)
        return level, level.confirm_all()

    def _guide(self, guides: list[np.ndarray], view: int) -> np.ndarray:
        return guides[view] if self.guided[view] else NO_PRIOR

    def _level(self, divisor: int) -> MatchingLevel:
        cameras = [self.photos.camera(view, divisor) for view in self.views]
        greys = [grey_levels(self.photos.photo(view, divisor)) for view in self.views]
        return MatchingLevel(cameras, greys, self.sources, self.ranges)

    def _geometric_sweep(
        self, level: MatchingLevel, guides: list[np.ndarray], turn: int, guided_turns: int,
        weight: int,
    ) -> None:  # fmt: skip
        """Sweep over all photos, comparing with the depths that all had before.

        Guided photos have so many turns, the others all.
        """
        depths = level.inverse_depths()
        swept = [turn < guided_turns or not guided for guided in self.guided]

        def run(view: int) -> None:
            if not swept[view]:
                return
            prior = self._guide(guides, view)
            if turn == 0:
                between = self._prior(level, view, reliable=weight == 1)
                prior = np.where(prior[..., :1] > 0, prior, between) if len(prior) else between
            level.sweep(
                view, COARSE_SWEEPS + turn, self.seed, geometric=GEOMETRIC_COST,
                inverse_depths=depths, prior=prior,
            )  # fmt: skip

        self._each(run, [weight * counts for counts in swept])

    def _each(
        self, work: Callable[[int], object], weights: Sequence[int], at_once: int = 1 << 16
    ) -> None:
        """Do work for all photos, so many at a time, and report progress."""

        def run(begin: int, end: int) -> None:
            for view in range(begin, end):
                self.progress.check()
                work(view)
                if weights[view]:
                    self._report(weights[view])

        run_chunks(run, np.arange(len(self.views) + 1), min(self.threads, at_once))

    def _report(self, weight: int) -> None:
        with self.lock:  # or a thread could report less than another one before it
            self.done += weight
            share = self.done / self.steps
            self.progress.update(share, f"matching photos for a dense start · {share:.0%}")

    def _start(self, level: MatchingLevel, view: int, guide: np.ndarray) -> None:
        """Guides, else planes between sparse points; random ones elsewhere and for a share."""
        camera, random = level.cameras[view], np.random.default_rng([self.seed, view])
        pixels, inverse = points_in_view(camera, self.points)
        planes = np.where(
            guide[..., :1] > 0, guide, triangle_planes(pixels, inverse, camera)
        )  # (h, w, 3)
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
    good = (_BITS[level.confirmed[view]] >= RELIABLE_SOURCES) & (cost < RELIABLE_COST)
    row, column = np.nonzero(good)
    cell = (row // PRIOR_CELL_PX) * (width // PRIOR_CELL_PX + 1) + column // PRIOR_CELL_PX
    order = np.lexsort((cost[row, column], cell))
    first = order[np.unique(cell[order], return_index=True)[1]]
    return row[first], column[first]


def _depth_map(
    level: MatchingLevel, view: int, means: np.ndarray, color: np.ndarray, mask: np.ndarray | None
) -> DepthMap:
    count = _BITS[level.confirmed[view]]
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
    depth = (1.0 / np.maximum(means, 1.0 / limits.FINITE_Z_MAX)).astype(np.float32)
    confidence = np.where(good, confidence, 0.0).astype(np.float32)
    return DepthMap(
        camera, depth, normal.astype(np.float32), confidence, count, level.costs[view], color, mask
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


_BITS = np.array([bin(value).count("1") for value in range(256)], np.uint8)
"""Number of bits that are set, of each byte."""


def _depth_range(camera: Camera, points: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest inverse depth to try."""
    inside, depth = in_image(camera, points)
    if inside.sum() < FEW_POINTS:
        distance = np.linalg.norm(points - camera.center, axis=1)
        near, far = np.percentile(distance, (1, 99))
    else:
        near, far = np.percentile(depth[inside], (1, 99))
    near, far = max(near, limits.NEAR_Z), max(far, limits.NEAR_Z)
    return FARTHEST_FACTOR / far, NEAREST_FACTOR / near


def matching_divisor(cameras: Sequence[Camera], most_px: int) -> int:
    """Return the divisor of the size at which photos are matched; ``cameras`` are of divisor 1."""
    side_px = max(max(camera.width, camera.height) for camera in cameras)
    pixels = sum(camera.width * camera.height for camera in cameras)
    return least_divisor(side_px, pixels, most_px)


def least_divisor(side_px: float, pixels: float, most_px: int) -> int:
    """Return the least power of 2 that brings photos below both limits.

    Divided by it, the long side of the largest photo is at most ``most_px``, and all photos
    together have at most :data:`MOST_PIXELS`.
    """
    divisor = 1
    while side_px / divisor > most_px or pixels / divisor**2 > MOST_PIXELS:
        divisor *= 2
    return divisor


# -- Parts of photos where stereo finds nothing: sky, far distance, what other photos do not show


CELL_PX = 8  # side of the cells of a photo, at the size it was matched at
OPEN_SHARE = 0.75  # share of a cell's pixels that must be unexplained for the cell to be open
BEHIND_COST = 0.7  # matching cost from which a pixel is unexplained: nothing matches


def open_cells(depth_map: DepthMap) -> np.ndarray:
    """Return the cells of a photo where nothing matches, (h // CELL_PX, w // CELL_PX) bool."""
    unknown = (depth_map.agreeing == 0) & (depth_map.cost >= BEHIND_COST)
    if depth_map.mask is not None:
        unknown &= depth_map.mask
    return by_cell(unknown.astype(np.float64)) >= OPEN_SHARE


def cells_of(points: np.ndarray, depth_map: DepthMap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which of the points (n, 3), scene frame, whole cells of a photo show.

    Returns their indices, and rows and columns of their cells, (m,) int64 each.
    """
    indices, row, column, _ = depth_map.camera.shown(points)
    row, column = row // CELL_PX, column // CELL_PX
    rows, columns = (side // CELL_PX for side in depth_map.depth.shape)
    whole = (row < rows) & (column < columns)
    return indices[whole], row[whole], column[whole]


def shown_open(points: np.ndarray, depth_map: DepthMap) -> np.ndarray:
    """Return the indices of the points (n, 3) that a photo shows in open cells."""
    indices, row, column = cells_of(points, depth_map)
    return indices[open_cells(depth_map)[row, column]]


def by_cell(image: np.ndarray) -> np.ndarray:
    """Return the means of an image over its cells, (rows, columns) or (rows, columns, 3)."""
    rows, columns = (side // CELL_PX for side in image.shape[:2])
    whole = image[: rows * CELL_PX, : columns * CELL_PX]
    cells = whole.reshape(rows, CELL_PX, columns, CELL_PX, *image.shape[2:])
    return np.asarray(cells.mean((1, 3)))


# -- Points with normals, colours and sizes from depth maps (docs/method.md, section 11.7) --------


LIKE_NORMAL = 0.7  # least cosine between the normals of pixels of one surface
OUTLIER_SIGMAS = 1.5
"""Pixels farther from the mean along the normal are left out of the second mean."""

_CELL_RANGE = (0.5, 64.0)
"""Size of a cell over the footprint of a pixel, between which the wanted number is looked for."""

_BISECTIONS = 9


@dataclass(frozen=True)
class DensePoints:
    """Points on surfaces, scene frame."""

    positions: np.ndarray  # (n, 3) float64
    normals: np.ndarray  # (n, 3) float64 unit, towards the cameras
    colors: np.ndarray  # (n, 3) uint8
    sizes: np.ndarray  # (n,) float64, side of the cell that a point stands for
    confidences: np.ndarray  # (n,) float32 in [0, 1]

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, chosen: np.ndarray) -> DensePoints:
        """Return the points of an index or mask array."""
        return DensePoints(
            self.positions[chosen], self.normals[chosen], self.colors[chosen],
            self.sizes[chosen], self.confidences[chosen],
        )  # fmt: skip


def fuse(
    depth_maps: Sequence[DepthMap], wanted: int,
    apart: Callable[[np.ndarray], np.ndarray] | None = None,
) -> DensePoints:  # fmt: skip
    """Fuse depth maps into about ``wanted`` points.

    One point for each cell of an octree whose level follows the footprint of a pixel, so that
    points are even in the resolution of the photos, not in space. The most confident pixel of a
    cell leads; its place along its normal is the trimmed mean of the cell's pixels of like normal.
    Their number is the wanted one within some per cent; fewer where there are fewer pixels.

    ``apart`` returns for points (n, 3), scene frame, how many times as far from each other they
    are to be; by default they are even.
    """
    pixels = lifted(depth_maps, [m.confidence for m in depth_maps])
    if apart is not None:
        pixels = replace(pixels, sizes=apart(pixels.positions) * pixels.sizes)
    return merged(pixels, wanted)


def merged(pixels: DensePoints, wanted: int) -> DensePoints:
    """Merge points of a pixel each into about ``wanted`` ones (:func:`fuse`)."""
    if len(pixels) == 0:
        return pixels
    size = _cell_size(pixels, wanted)
    cell = np.unique(_cells(pixels, size), return_inverse=True)[1]
    order = np.lexsort((-pixels.confidences, cell))
    first = order[np.unique(cell[order], return_index=True)[1]]  # (m,) most confident of each cell
    lead = first[cell]  # (n,)
    leading = pixels.normals[lead]
    offset = ((pixels.positions - pixels.positions[lead]) * leading).sum(1)
    weight = pixels.confidences * ((pixels.normals * leading).sum(1) > LIKE_NORMAL)
    for _ in range(2):
        total = np.bincount(cell, weight)
        mean = np.bincount(cell, weight * offset) / total
        deviation = offset - mean[cell]
        spread = np.sqrt(np.bincount(cell, weight * deviation**2) / total)
        kept = np.abs(deviation) <= OUTLIER_SIGMAS * spread[cell] + 1e-12
        trimmed = np.where(kept, weight, 0.0)
        # A cell of two pixels can lose both to rounding.
        weight = np.where(np.bincount(cell, trimmed)[cell] > 0, trimmed, weight)
    found = pixels.select(first)
    positions = found.positions + mean[:, None] * found.normals
    return replace(found, positions=positions, sizes=found.sizes * size)


def lifted(depth_maps: Sequence[DepthMap], weights: Sequence[np.ndarray]) -> DensePoints:
    """Return the pixels of positive weight as points; their size is the footprint of a pixel.

    The weights, (h, w) float32 of each depth map, become confidences.
    """
    parts = []
    for depth_map, weight in zip(depth_maps, weights, strict=True):
        camera, good = depth_map.camera, weight > 0
        depth = depth_map.depth[good].astype(np.float64)
        points = camera.rays()[good] * depth[:, None] - camera.cam_from_world[:, 3]
        parts.append(
            (
                points @ camera.rotation, depth_map.normal[good].astype(np.float64),
                depth_map.color[good], depth / camera.fx, weight[good],
            )
        )  # fmt: skip
    if not parts:
        none = np.zeros((0, 3))
        return DensePoints(none, none, none.astype(np.uint8), np.zeros(0), np.zeros(0, np.float32))
    return DensePoints(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _cell_size(pixels: DensePoints, wanted: int) -> float:
    """Return the size of a cell, in footprints, that gives about ``wanted`` cells."""
    low, high = _CELL_RANGE
    for _ in range(_BISECTIONS):
        middle = (low * high) ** 0.5
        if len(np.unique(_cells(pixels, middle))) > wanted:
            low = middle
        else:
            high = middle
    return high


def _cells(pixels: DensePoints, size: float) -> np.ndarray:
    """Return (n,) int64 keys of the octree cells; equal for equal cells of equal level."""
    # Levels of the footprints alone, so that the number of cells follows ``size`` without steps.
    level = np.round(np.log2(pixels.sizes)).astype(np.int64)
    lowest = pixels.positions.min(0)
    side = size * 2.0 ** level[:, None]
    place = np.floor((pixels.positions - lowest) / side).astype(np.int64)
    # A hash: two cells of one key would merge, which the normals' test makes harmless.
    return ((place[:, 0] * 1000003 + place[:, 1]) * 1000003 + place[:, 2]) * 257 + level


# -- Points where stereo confirms nothing, so that training starts without holes ------------------
#
# See docs/method.md, section 11.8.


MOST_COST = 0.7
"""A depth that no source confirms is a guess if it costs less; else nothing is known."""

UNCONFIRMED_WEIGHT = 0.2  # Weight of a depth that no source confirms; each source adds as much.
CLEARANCE = 0.5  # sizes of a point from confirmed ones within which it is left out
SEEN_THROUGH_SHARE = 0.03
"""A confirmed depth this much larger than a point's sees through the point."""

SEEN_THROUGH_VIEWS = 2  # views that must see through a point for it to be left out
OPEN_VIEWS = 2  # views that must show a point where nothing matches for it to be left out


def fill_gaps(depth_maps: Sequence[DepthMap], confirmed: DensePoints, wanted: int) -> DensePoints:
    """Return points from unconfirmed depths, away from confirmed points and from free space.

    At most about ``wanted``.
    """
    guesses = merged(lifted(depth_maps, [_guessed(found) for found in depth_maps]), wanted)
    if len(guesses) == 0 or len(confirmed) == 0:
        return guesses
    distance, nearest = cKDTree(confirmed.positions).query(guesses.positions)
    reach = CLEARANCE * np.maximum(guesses.sizes, confirmed.sizes[nearest])
    guesses = guesses.select(distance > reach)
    for against, views in ((seen_through, SEEN_THROUGH_VIEWS), (shown_open, OPEN_VIEWS)):
        guesses = guesses.select(count_views(guesses.positions, depth_maps, against) < views)
    return guesses


def count_views(
    points: np.ndarray,
    depth_maps: Sequence[DepthMap],
    against: Callable[[np.ndarray, DepthMap], np.ndarray],
) -> np.ndarray:
    """Count the views that speak against each point (n, 3), scene frame, (n,) int64.

    ``against`` returns the indices of the points that a view speaks against, each once.
    """
    count = np.zeros(len(points), np.int64)
    for depth_map in depth_maps:
        count[against(points, depth_map)] += 1
    return count


def seen_through(points: np.ndarray, depth_map: DepthMap) -> np.ndarray:
    """Return the indices of the points (n, 3) with a view's confirmed depth clearly behind them."""
    shown, row, column, depth = depth_map.camera.shown(points)
    behind = depth_map.depth[row, column] > (1.0 + SEEN_THROUGH_SHARE) * depth
    return np.asarray(shown[behind & (depth_map.confidence[row, column] > 0)])


def _guessed(depth_map: DepthMap) -> np.ndarray:
    """Return (h, w) weights of the depths that are unconfirmed and yet better than nothing."""
    guess = (depth_map.confidence == 0) & ((depth_map.agreeing > 0) | (depth_map.cost < MOST_COST))
    if depth_map.mask is not None:
        guess &= depth_map.mask
    weight = UNCONFIRMED_WEIGHT * (1.0 + depth_map.agreeing)
    return np.where(guess, weight, 0.0).astype(np.float32)


# -- What stereo knows of the photos' depths, kept for the training that started on them ----------


FILE_NAME = "depth_priors.npz"

PLANE_STEP_PX = 5
PLANE_SHARE = 0.004
"""Largest second difference of inverse depths so far apart, as a share, on a plane. On the room of
benchmarks/scenes a third of the pixels pass, whose depths err by 0.02 % of the diagonal in the
median and 0.06 % at 90 % (all confirmed ones: 0.03 and 0.27 %). On curved things hardly any pass,
and there training finds the surface better than windows do."""


@dataclass(frozen=True)
class DepthPrior:
    """What is known of the depths of one photo."""

    camera: Camera  # of this size, scene frame
    depth: np.ndarray
    """(h, w) float32 z-depth, scene units; 0 where nothing is confirmed or planar."""
    confidence: np.ndarray  # (h, w) float32 in [0, 1]; 0 where nothing is confirmed.
    known: np.ndarray
    """(h, w) float32 confirmed z-depth, of planes or not; 0 where nothing is confirmed."""
    free: np.ndarray
    """(h, w) float32 z-depth before which the photo shows nothing; 0 where that is not known."""


_LAYERS = ("depth", "confidence", "known", "free")
_MOST_HEADER_BYTES = 1024
"""Of an array in the file; the key is no longer either."""


def priors_of(views: Sequence[int], depth_maps: Sequence[DepthMap]) -> dict[int, DepthPrior]:
    """Return the priors of views, by view."""
    priors = {}
    for view, found in zip(views, depth_maps, strict=True):
        plane = planar_pixels(found)
        priors[view] = DepthPrior(
            found.camera,
            np.where(plane, found.depth, np.float32(0)),
            np.where(plane, found.confidence, np.float32(0)),
            np.where(found.confidence > 0, found.depth, np.float32(0)),
            np.zeros_like(found.depth) if found.free is None else found.free,
        )
    return priors


def planar_pixels(depth_map: DepthMap) -> np.ndarray:
    """Tell where the depth of a pixel is that of a plane through its neighbours, (h, w) bool.

    On a plane, inverse depth is linear in the pixel. The neighbours lie :data:`PLANE_STEP_PX` away
    in all eight directions, and are confirmed.
    """
    confirmed, step = depth_map.confidence > 0, PLANE_STEP_PX
    inverse = 1.0 / depth_map.depth.astype(np.float64)
    planar = confirmed.copy()
    for x, y in ((step, 0), (0, step), (step, step), (step, -step)):
        one, other = (np.roll(inverse, shift, (0, 1)) for shift in ((y, x), (-y, -x)))
        planar &= np.abs(one + other - 2.0 * inverse) <= PLANE_SHARE * inverse
        for shift in ((y, x), (-y, -x)):
            planar &= np.roll(confirmed, shift, (0, 1))
    planar[:step] = planar[-step:] = False
    planar[:, :step] = planar[:, -step:] = False
    return planar


def save_priors(folder: Path, priors: Mapping[int, DepthPrior], key: str) -> None:
    """Write ``depth_priors.npz`` into a folder; ``key`` names what they were made from."""
    arrays = {"key": np.array(key)}
    for view, prior in priors.items():
        arrays |= {f"{layer}.{view}": getattr(prior, layer) for layer in _LAYERS}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(folder / FILE_NAME, buffer.getvalue())


def load_priors(
    folder: Path, cameras: Mapping[int, Camera], key: str, views: Collection[int] | None = None
) -> dict[int, DepthPrior] | None:
    """Read what :func:`save_priors` wrote for the same key, of some views or all.

    The cameras are those of all views that were matched, at the size they were matched at. Returns
    ``None`` where the file is missing, damaged or of another key: the priors follow from the photos
    and can be made again.
    """
    wanted = cameras.keys() if views is None else views
    names = ["key", *(f"{layer}.{view}" for view in wanted for layer in _LAYERS)]
    pixels = sum(camera.width * camera.height for camera in cameras.values())
    entries = 1 + len(_LAYERS) * len(cameras)
    most_bytes = 4 * len(_LAYERS) * pixels + _MOST_HEADER_BYTES * entries
    try:
        arrays = read_arrays(folder / FILE_NAME, names, most_bytes=most_bytes)
        if str(arrays["key"]) != key:
            return None
        return {
            view: _prior(cameras[view], [arrays[f"{layer}.{view}"] for layer in _LAYERS])
            for view in wanted
        }
    except (ParseError, ValueError):
        return None


def _prior(camera: Camera, layers: Sequence[np.ndarray]) -> DepthPrior:
    for layer in layers:
        if not (layer.dtype == np.float32 and layer.ndim == 2 and np.isfinite(layer).all()):
            raise ValueError("not (h, w) float32 depths and confidences")
        if layer.shape != (camera.height, camera.width):
            raise ValueError(f"depths are {layer.shape}, the photo is matched at another size")
    return DepthPrior(camera, *layers)
