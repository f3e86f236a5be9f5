# SPDX-License-Identifier: GPL-3.0-or-later
"""PatchMatch: source views, propagation and refinement of planes, levels of the pyramid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import ndimage

from .. import limits
from ..compiled import kernel, part
from ..resampling import LUMA
from ..scene.camera import Camera
from .matching_cost import (
    AT_X,
    AT_Y,
    F32,
    HALF,
    NO_BRIGHTNESS,
    ONE,
    REACH_PX,
    SAMPLES,
    TWO,
    WINDOW,
    WORST_COST,
    ZERO,
    brightness_of,
    confirm,
    fill_window,
    lens_matrix,
    normal_of,
    random_share,
    slopes_of,
    view_cost,
)

# -- Which photos each photo is matched with (docs/method.md, section 11.5) -----------------------


MOST_SOURCES = 8
"""Sources of a photo; one bit each in a byte. With five, a fifth fewer background pixels are
confirmed."""

BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG = 12.0, 5.0, 12.0
"""Angle between two rays to a point at which matching is best, and how fast it gets worse."""

LEAST_GAIN = 1e-3  # least share of the points for which a source is of use
_MOST_POINTS = 1500  # points that decide, subsampled from those given


def source_views(cameras: Sequence[Camera], points: np.ndarray) -> list[np.ndarray]:
    """Choose the sources of each photo, greedily, best first.

    A point in both images counts by the angle between its two rays and by the likeness of its two
    scales, the less the more sources chosen before hold it.

    Of sparse points (n, 3) in the frame of the cameras. Returns for each camera (k,) int64 indices
    of at most :data:`MOST_SOURCES` others; none where no camera shares points with it.
    """
    count = len(cameras)
    points = points[:: max(1, -(-len(points) // _MOST_POINTS))]
    if len(points) == 0:
        return [np.zeros(0, np.int64) for _ in cameras]
    inside = np.zeros((count, len(points)), bool)
    scale = np.ones((count, len(points)))  # scene units per pixel
    for i, camera in enumerate(cameras):
        inside[i], depth = in_image(camera, points)
        scale[i] = np.maximum(depth, limits.NEAR_Z) / camera.fx
    centers = np.stack([camera.center for camera in cameras])  # (c, 3)
    rays = points[None] - centers[:, None]  # (c, n, 3)
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    return [_sources_of(i, inside, scale, rays) for i in range(count)]


def in_image(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tell which points (n, 3) project into the image, and return their z-depths (n,)."""
    pixels, depth = camera.project(points)
    size = np.array([camera.width, camera.height])
    return (depth > limits.NEAR_Z) & (pixels >= 0).all(1) & (pixels < size).all(1), depth


def _sources_of(view: int, inside: np.ndarray, scale: np.ndarray, rays: np.ndarray) -> np.ndarray:
    seen = np.flatnonzero(inside[view])
    both = inside[:, seen]  # (c, m)
    cosine = np.einsum("pi,cpi->cp", rays[view, seen], rays[:, seen])
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    width_deg = np.where(angle_deg < BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG)
    likeness = np.minimum(scale[view, seen] / scale[:, seen], scale[:, seen] / scale[view, seen])
    gain = both * likeness * np.exp(-0.5 * ((angle_deg - BEST_ANGLE_DEG) / width_deg) ** 2)
    gain[view] = 0.0
    covered = np.zeros(len(seen))
    chosen: list[int] = []
    for _ in range(min(MOST_SOURCES, len(inside) - 1)):
        score = (gain / (1.0 + covered)).sum(1)
        score[chosen] = 0.0
        best = int(score.argmax())
        if score[best] <= LEAST_GAIN * max(1, len(seen)):
            break
        chosen.append(best)
        covered += gain[best]
    return np.array(chosen, np.int64)


def source_angles_deg(
    cameras: Sequence[Camera], view: int, sources: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Return the angle of each source (s,): the median of those between rays to the same point.

    Of the points (n, 3) that both images hold; 0 where there are none.
    """
    camera, angles = cameras[view], np.zeros(len(sources))
    points = points[:: max(1, -(-len(points) // _MOST_POINTS))]
    points = points[in_image(camera, points)[0]]
    for number, source in enumerate(sources):
        both = points[in_image(cameras[source], points)[0]]
        if len(both):
            one, other = both - camera.center, both - cameras[source].center
            cosine = (one * other).sum(1)
            cosine /= np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
            angles[number] = np.degrees(np.arccos(np.median(np.clip(cosine, -1.0, 1.0))))
    return angles


# -- One sweep of PatchMatch over a photo: planes spread between pixels and are refined -----------
#
# See docs/method.md, section 11.3.


KEPT_SOURCES = 2
"""Sources in which a pixel is judged: its best ones. The others may not see its surface."""

REFINEMENTS = 2  # random changes tried per pixel and sweep, the second half as large as the first
LEAST_COSINE = F32(0.12)  # between ray and normal, 83 degrees: more grazing planes are not tried
GOOD_COST = F32(0.3)  # a pixel that costs less in the sources it kept is not judged in the others
RANDOM_ABOVE = F32(0.5)  # a random plane is tried where the cost is at least this
SAME_SHARE = F32(0.001)
"""Planes nearer than this share of the depth over the whole window are the same: under 0.1 px."""

NEAR_VARIANCE_PX = 25.0
ALIKE_LEVELS = 12.0
"""Widths of the two factors of a sample's weight: distance from the centre, difference in grey."""

NORMAL_SPREAD = F32(20)  # relative change of the normal per relative change of the depth, at most 1
PRIOR_STRENGTH, PRIOR_TEXTURE, PRIOR_SHARE = F32(0.25), F32(20), F32(0.01)
"""Largest cost of leaving the prior's plane; variance of grey at which half of it is left; share of
the depth that counts as leaving it."""


@part(fast=True)
def _prior_cost(
    prior: Any, row: Any, column: Any, w: Any, a: Any, b: Any, lens: Any, variance: Any
) -> Any:
    """Return the cost of leaving the prior's plane, which fades where there is texture."""
    if prior.shape[0] == 0:
        return ZERO
    there = prior[row, column, 0]
    if there <= ZERO:
        return ZERO
    away = (w - there) / (PRIOR_SHARE * there)
    slope_x = (a - prior[row, column, 1]) * lens[0] / there
    slope_y = (b - prior[row, column, 2]) * lens[1] / there
    like = np.exp(-HALF * away * away - TWO * (slope_x * slope_x + slope_y * slope_y))
    return PRIOR_STRENGTH * PRIOR_TEXTURE / (PRIOR_TEXTURE + variance) * (ONE - like)


@part(fast=True)
def _cost_in(
    sources: Any, kept: Any, bound: Any, costs: Any, u: Any, v: Any, w: Any, a: Any, b: Any,
    maps: Any, back_maps: Any, quads: Any, sizes: Any, bases: Any, stride: Any, brightness: Any,
    inverse_depths: Any, geometric: Any, table: Any, found: Any, mean: Any, variance: Any,
) -> Any:  # fmt: skip
    """Return the mean cost in a set of sources (bits), or ``bound`` once it cannot be less."""
    total, limit = ZERO, bound * F32(kept)
    for s in range(maps.shape[0]):
        if (sources >> s) & 1:
            costs[s] = view_cost(
                s, u, v, w, a, b, maps, back_maps, quads, sizes, bases, stride, brightness,
                inverse_depths, geometric, table, found, mean, variance,
            )  # fmt: skip
            total += costs[s]
            if total >= limit:
                return bound
    return total / F32(kept)


@kernel(fast=True)
def sweep(
    grey: np.ndarray, order: np.ndarray, neighbours: np.ndarray, fresh: bool,
    planes: np.ndarray, cost: np.ndarray, best_sources: np.ndarray, variances: np.ndarray,
    maps: np.ndarray, back_maps: np.ndarray, quads: np.ndarray, sizes: np.ndarray,
    bases: np.ndarray, stride: float, brightness: np.ndarray, inverse_depths: np.ndarray,
    geometric: float, lens: np.ndarray, depth_range: np.ndarray, span: float, prior: np.ndarray,
    seed: int,
) -> None:  # fmt: skip
    """Visit the pixels of a photo once and give each the best plane found.

    The present plane is judged in the sources that the pixel kept, and where it costs
    :data:`GOOD_COST` or more there, in all; the best few are kept. A neighbour's plane
    is judged in the sources that the neighbour kept: the pixel's own may be those where the surface
    is hidden. A winner with other sources is judged in all of them again.

    Parameters
    ----------
    grey : (h, w) uint8
    order : (h * w,) int64
        Pixels in the order of the visit.
    neighbours : (k, 2) int64
        Offsets (x, y) from which planes are taken over.
    fresh : bool
        Whether planes are still random: a random one is tried everywhere, and the neighbours' sets
        of sources say nothing yet.
    planes : (h, w, 3) float32
        Changed: w, a, b of each pixel.
    cost, variances : (h, w) float32
        Written: mean cost in the two best sources, brightness left out, and weighted variance of
        the window.
    best_sources : (h, w) uint8
        Changed: bits of the sources kept.
    maps, back_maps : (s, 12) float32
        From this photo to its sources and back.
    quads, sizes, bases, stride
        Of the sources (:func:`~.matching_cost.window_cost`); ``sizes`` is (s, 2) float32, last
        column and row.
    brightness : (s, 2) float32
        Of the sources (:func:`~.matching.brightness_of`).
    inverse_depths : (photos * height * stride,) float32
        Present depths of all photos; not read where ``geometric`` is 0.
    geometric : float32
        Cost of a pixel of forward-backward error.
    lens : (4,) float32
    depth_range : (2,) float32
        Least and largest inverse depth.
    span : float32
        Relative change of the depth in the first refinement.
    prior : (h, w, 3) float32
        Planes that hold where there is no texture, w 0 where there is none; or (0, 0, 3).
    seed : uint32
    """
    width, height = grey.shape[1], grey.shape[0]
    count = maps.shape[0]
    kept = min(KEPT_SOURCES, count)
    least_w, most_w = depth_range[0], depth_range[1]
    has_prior = prior.shape[0] > 0
    state = np.array([seed], np.uint32)
    table, found = np.empty((6, SAMPLES), np.float32), np.empty(SAMPLES, np.int32)
    near, alike = np.empty(SAMPLES, np.float32), np.empty(256, np.float32)
    costs, trial = np.empty(count, np.float32), np.empty(count, np.float32)
    not_compared = np.zeros((count, 2), np.float32)
    for i in range(SAMPLES):
        table[AT_X, i], table[AT_Y, i] = F32(WINDOW[i, 0]), F32(WINDOW[i, 1])
        distance_sq = table[AT_X, i] * table[AT_X, i] + table[AT_Y, i] * table[AT_Y, i]
        near[i] = np.exp(-distance_sq / F32(2.0 * NEAR_VARIANCE_PX))
    for i in range(256):
        alike[i] = np.exp(-F32(i) / F32(ALIKE_LEVELS))
    for visit in range(len(order)):
        row, column = order[visit] // width, order[visit] % width
        u, v = F32(column), F32(row)
        mean, variance = fill_window(grey, row, column, near, alike, table)
        w, a, b = planes[row, column, 0], planes[row, column, 1], planes[row, column, 2]
        best, chosen, judge = ZERO, 0, True
        for step in range(len(neighbours) + REFINEMENTS + 2):
            if judge:
                known = 0 if fresh or step > 0 else int(best_sources[row, column])
                total = ZERO
                for s in range(count):
                    costs[s] = WORST_COST
                for others in range(2):
                    if others == 1 and known != 0 and total < GOOD_COST * F32(kept):
                        break
                    for s in range(count):
                        if (known >> s) & 1 != others:
                            costs[s] = view_cost(
                                s, u, v, w, a, b, maps, back_maps, quads, sizes, bases, stride,
                                brightness, inverse_depths, geometric, table, found, mean,
                                variance,
                            )  # fmt: skip
                            total += costs[s]
                chosen, total = 0, ZERO
                for _ in range(kept):
                    least = -1
                    for s in range(count):
                        if not (chosen >> s) & 1 and (least < 0 or costs[s] < costs[least]):
                            least = s
                    chosen |= 1 << least
                    total += costs[least]
                best = total / F32(kept)
                best += _prior_cost(prior, row, column, w, a, b, lens, variance)
                judge = False
            sources = chosen
            if step < len(neighbours):
                x, y = column + neighbours[step, 0], row + neighbours[step, 1]
                if x < 0 or y < 0 or x >= width or y >= height:
                    continue
                new_a, new_b = planes[y, x, 1], planes[y, x, 2]
                new_w = planes[y, x, 0] + new_a * F32(column - x) + new_b * F32(row - y)
                tilt = REACH_PX * max(abs(new_a - a), abs(new_b - b))
                if max(abs(new_w - w), tilt) < SAME_SHARE * w:
                    continue
                if not fresh:
                    sources = int(best_sources[y, x])
            elif step == len(neighbours):
                if not has_prior or prior[row, column, 0] <= ZERO:
                    continue
                new_w = prior[row, column, 0]
                new_a, new_b = prior[row, column, 1], prior[row, column, 2]
            elif step <= len(neighbours) + REFINEMENTS:
                reach = span * HALF ** F32(step - len(neighbours) - 1)
                nx, ny, nz, _ = normal_of(u, v, w, a, b, lens)
                new_w = w * (ONE + reach * (TWO * random_share(state) - ONE))
                turn = min(reach * NORMAL_SPREAD, ONE)
                nx += turn * (random_share(state) - HALF)
                ny += turn * (random_share(state) - HALF)
                nz += turn * (random_share(state) - HALF)
                new_a, new_b = slopes_of(u, v, new_w, nx, ny, nz, lens)
            else:
                if not fresh and best < RANDOM_ABOVE:
                    continue
                new_w = least_w + (most_w - least_w) * random_share(state)
                nx, ny = TWO * random_share(state) - ONE, TWO * random_share(state) - ONE
                new_a, new_b = slopes_of(u, v, new_w, nx, ny, ONE, lens)
            if not (new_w >= least_w and new_w <= most_w):
                continue
            if normal_of(u, v, new_w, new_a, new_b, lens)[3] < LEAST_COSINE:
                continue
            extra = _prior_cost(prior, row, column, new_w, new_a, new_b, lens, variance)
            if extra >= best:
                continue
            value = extra + _cost_in(
                sources, kept, best - extra, trial, u, v, new_w, new_a, new_b, maps, back_maps,
                quads, sizes, bases, stride, brightness, inverse_depths, geometric, table, found,
                mean, variance,
            )  # fmt: skip
            if value < best:
                w, a, b, best = new_w, new_a, new_b, value
                judge = sources != chosen
                for s in range(count):
                    if (chosen >> s) & 1 and not judge:
                        costs[s] = trial[s]
        planes[row, column, 0], planes[row, column, 1], planes[row, column, 2] = w, a, b
        # What others read of the cost is how well the windows match, however bright they are.
        total = WORST_COST * F32(KEPT_SOURCES - kept)
        for s in range(count):
            if (chosen >> s) & 1:
                total += view_cost(
                    s, u, v, w, a, b, maps, back_maps, quads, sizes, bases, stride, not_compared,
                    inverse_depths, geometric, table, found, mean, variance,
                )  # fmt: skip
        cost[row, column] = total / F32(KEPT_SOURCES)
        best_sources[row, column] = np.uint8(chosen)
        variances[row, column] = variance


# -- All photos at one level of the pyramid, packed for the kernels, and their planes -------------


_NEAREST = ((-1, 0), (0, -1), (1, 0), (0, 1))
_FAR_PX = (3, 5, 9, 7)
"""Distance of the two farther neighbours, in turn from sweep to sweep."""

_FIRST_SPAN, _LATER_SPAN = 0.1, 0.02
"""Relative change of the depth by the first refinement, while planes are random and later."""

_MEAN_PX = 5
"""Side of the window over which grey levels are averaged to compare the brightness of photos."""

_MOST_SEED = 2**32 - 1  # seeds of a sweep lie between 1 and this: the generator would stay at 0
NO_PRIOR = np.zeros((0, 0, 3), np.float32)
NO_DEPTHS = np.zeros(1, np.float32)


def finer_planes(planes: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the planes (h, w, 3) of a photo of twice the size; inverse depths of 0 stay 0."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    above = _above(shape, planes.shape)
    finer = planes[above]
    known = finer[..., 0] > 0
    finer[..., 0] += finer[..., 1] * (0.5 * column - 0.25 - above[1])
    finer[..., 0] += finer[..., 2] * (0.5 * row - 0.25 - above[0])
    finer[..., 1:] *= 0.5
    return np.where(known[..., None], finer, np.float32(0))


def coarser_planes(planes: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the planes (h, w, 3) of a photo of half the size: those of each first pixel of four.

    Those of inverse depth 0 stay so.
    """
    rows, columns = (
        np.minimum(2 * np.arange(size), last - 1)
        for size, last in zip(shape, planes.shape, strict=False)
    )
    coarser = planes[np.ix_(rows, columns)]  # (h, w, 3)
    known = coarser[..., 0] > 0
    coarser[..., 0] += 0.5 * (coarser[..., 1] + coarser[..., 2])
    coarser[..., 1:] *= 2.0
    return np.where(known[..., None], coarser, np.float32(0))


def _above(shape: tuple[int, ...], coarse: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column, at half the size, of the pixels of a photo."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    return np.minimum(row // 2, coarse[0] - 1), np.minimum(column // 2, coarse[1] - 1)


def grey_levels(photo: np.ndarray) -> np.ndarray:
    """Return a photo (h, w, 3) uint8 as (h, w) uint8 grey levels."""
    return np.asarray(photo @ np.array(LUMA) + 0.5, np.uint8)


class MatchingLevel:
    """Planes of all photos at one size.

    Parameters
    ----------
    cameras : sequence of Camera
        Of the photos at this size.
    greys : sequence of (h, w) uint8
    sources : sequence of (k,) int64
        Sources of each photo.
    depth_ranges : (n, 2) float32
        Least and largest inverse depth of each photo.

    Attributes
    ----------
    planes : (n, h, w, 3) float32
        Hypotheses; photos smaller than the largest fill the upper left corner.
    costs, variances : list of (h, w) float32
    confirmed : list of (h, w) uint8
        Bits of the sources that agree, after :meth:`confirm`.
    brightness : list of (k, 2) float32
        Gain and rate of the sources of each photo (:func:`~.matching.brightness_of`), after
        :meth:`compare_brightness`; until then it is not compared.
    """

    def __init__(
        self, cameras: Sequence[Camera], greys: Sequence[np.ndarray], sources: Sequence[np.ndarray],
        depth_ranges: np.ndarray,
    ) -> None:  # fmt: skip
        self.cameras, self.greys, self.sources = list(cameras), list(greys), list(sources)
        self.depth_ranges = depth_ranges.astype(np.float32)
        count = len(self.greys)
        height, width = (max(grey.shape[k] for grey in self.greys) for k in (0, 1))
        quads = np.zeros((count, height, width), np.uint32)
        for quad, grey in zip(quads, self.greys, strict=True):
            wide = np.pad(grey, ((0, 1), (0, 1)), "edge").astype(np.uint32)
            right, below = wide[:-1, 1:] << 8, wide[1:, :-1] << 16
            quad[: grey.shape[0], : grey.shape[1]] = (
                wide[:-1, :-1] | right | below | wide[1:, 1:] << 24
            )
        self._quads, self._stride = quads.reshape(-1).view(np.int32), np.float32(width)
        self._photo_pixels = height * width
        self.planes = np.zeros((count, height, width, 3), np.float32)
        # A photo without sources is never swept: nothing matches there.
        self.costs = [np.full(grey.shape, WORST_COST, np.float32) for grey in self.greys]
        self.variances = [np.zeros(grey.shape, np.float32) for grey in self.greys]
        self._best_sources, self.confirmed = (
            [np.zeros(grey.shape, np.uint8) for grey in self.greys] for _ in range(2)
        )
        self.brightness = [np.tile(NO_BRIGHTNESS, (len(chosen), 1)) for chosen in self.sources]
        self.lenses = [_lens(camera) for camera in self.cameras]
        self._joined = [self._join(view) for view in range(count)]

    def __len__(self) -> int:
        return len(self.greys)

    def planes_of(self, view: int) -> np.ndarray:
        """Return the (h, w, 3) planes of a photo; a view of :attr:`planes`."""
        height, width = self.greys[view].shape
        return self.planes[view, :height, :width]

    def inverse_depths(self) -> np.ndarray:
        """Return a copy of all inverse depths, flat, as kernels read them."""
        return np.ascontiguousarray(self.planes[..., 0]).reshape(-1)

    def sweep(
        self, view: int, turn: int, seed: int, *, fresh: bool = False, geometric: float = 0.0,
        inverse_depths: np.ndarray = NO_DEPTHS, prior: np.ndarray = NO_PRIOR,
    ) -> None:  # fmt: skip
        """Run one sweep over a photo; its number decides direction and farther neighbours.

        ``fresh``, ``geometric``, ``inverse_depths`` and ``prior`` are as in :func:`sweep`.
        """
        if len(self.sources[view]) == 0:
            return
        maps, back_maps, sizes, bases = self._joined[view]
        order, neighbours = _visit(self.greys[view].shape, turn)
        planes = np.ascontiguousarray(self.planes_of(view))
        sweep(
            self.greys[view], order, neighbours, fresh, planes, self.costs[view],
            self._best_sources[view], self.variances[view], maps, back_maps, self._quads, sizes,
            bases, self._stride, self.brightness[view], inverse_depths, np.float32(geometric),
            self.lenses[view], self.depth_ranges[view],
            np.float32(_FIRST_SPAN if fresh else _LATER_SPAN), prior,
            np.uint32(1 + (7919 * (view + 1) + 104729 * turn + 31 * seed) % _MOST_SEED),
        )  # fmt: skip
        self.planes_of(view)[:] = planes

    def confirm(self, view: int, inverse_depths: np.ndarray) -> np.ndarray:
        """Find the sources that agree; return the mean inverse depth over them, (h, w)."""
        shape = self.greys[view].shape
        means = np.zeros(shape, np.float32)
        if len(self.sources[view]):
            maps, back_maps, sizes, bases = self._joined[view]
            confirm(
                np.ascontiguousarray(self.planes_of(view)), maps, back_maps, inverse_depths,
                self.planes.reshape(-1, 3), sizes, bases, self._stride, self.confirmed[view],
                means,
            )  # fmt: skip
        return means

    def confirm_all(self) -> list[np.ndarray]:
        """Do so for all photos with the depths that they have now."""
        depths = self.inverse_depths()
        return [self.confirm(view, depths) for view in range(len(self))]

    def compare_brightness(self) -> None:
        """Measure gains between photos on the confirmed pixels; costs compare them from now on."""
        means = [
            ndimage.uniform_filter(grey.astype(np.float32), _MEAN_PX, mode="nearest")
            for grey in self.greys
        ]
        for view, chosen in enumerate(self.sources):
            self.brightness[view] = brightness_of(
                means[view], self.planes_of(view)[..., 0], self.confirmed[view],
                self._joined[view][0], [means[source] for source in chosen],
            )  # fmt: skip

    def start_from(self, coarse: MatchingLevel, view: int) -> None:
        """Take over planes and brightness of a level of half the size."""
        shape = self.greys[view].shape
        above = _above(shape, coarse.greys[view].shape)
        planes = finer_planes(coarse.planes_of(view), shape)
        planes[..., 0] = planes[..., 0].clip(*self.depth_ranges[view])
        self.planes_of(view)[:] = planes
        self._best_sources[view][:] = coarse._best_sources[view][above]
        self.costs[view][:] = coarse.costs[view][above]
        self.confirmed[view][:] = coarse.confirmed[view][above]
        self.brightness[view] = coarse.brightness[view]

    def _join(self, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return maps to the sources and back (s, 12), their sizes (s, 2) and first pixels (s,)."""
        maps, back_maps, sizes = [], [], []
        for source in self.sources[view]:
            here, there = self.cameras[view], self.cameras[source]
            rotation = there.rotation @ here.rotation.T
            offset = there.cam_from_world[:, 3] - rotation @ here.cam_from_world[:, 3]
            lens_here, lens_there = lens_matrix(here), lens_matrix(there)
            maps.append(_map(lens_there, rotation, offset, lens_here))
            back_maps.append(_map(lens_here, rotation.T, -rotation.T @ offset, lens_there))
            sizes.append((there.width - 1, there.height - 1))
        bases = np.asarray(self.sources[view], np.uint64) * np.uint64(self._photo_pixels)
        forth, back = (np.array(rows, np.float32).reshape(-1, 12) for rows in (maps, back_maps))
        return forth, back, np.array(sizes, np.float32).reshape(-1, 2), bases


def _lens(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5], np.float32)


def _map(
    lens_there: np.ndarray, rotation: np.ndarray, offset: np.ndarray, lens_here: np.ndarray
) -> np.ndarray:
    """(12,) of :mod:`~.matching`: a homography, and what depth adds."""
    homography = lens_there @ rotation @ np.linalg.inv(lens_here)
    return np.concatenate([homography.reshape(-1), lens_there @ offset])


def _visit(shape: tuple[int, ...], turn: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the order of the pixels, forwards and backwards in turn, and the neighbours."""
    order = np.arange(shape[0] * shape[1], dtype=np.int64)
    far = _FAR_PX[turn % len(_FAR_PX)]
    neighbours = np.array([*_NEAREST, (-far, 0), (0, -far)], np.int64)
    return (np.ascontiguousarray(order[::-1]) if turn % 2 else order), neighbours
