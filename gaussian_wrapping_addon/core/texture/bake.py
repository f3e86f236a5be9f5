# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos become a texture: samples blended, exposure evened out, coverage."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from ..compiled import kernel, part
from ..filters import pyramid
from ..parallel import even_bounds, run_chunks
from ..progress import Progress
from ..scene.scene import PhotoSource
from ..settings import TextureSettings
from .atlas import AtlasRaster
from .fill import surface_positions
from .photo_samples import (
    LAST_RESORT_BELOW,
    PhotoView,
    SurfaceArrays,
    SurfacePoints,
    photo_visibility,
    sample_photo,
)
from .unwrap.unwrap import Unwrap

# -- Colours of surface points from photos: occlusion test, best views, robust blending -----------


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
    rejected: int
    """Number of kept views rejected as outliers."""


@dataclass(frozen=True)
class PhotoPreparation:
    """Photos that show the mesh, and their colour correction."""

    used_photos: list[tuple[int, int]]
    """Index of each photo that shows the mesh, and the divisor of the level at which it is read."""
    factors: np.ndarray
    """(photos, gh, gw, 3) float64 colour factors of each photo, on a grid over the photo."""
    statistics: dict[str, Any]
    """Plain JSON values: photos used, standard deviations of the log corrections, and whether these
    are applied."""


def bake(
    points: SurfacePoints, surface: SurfaceArrays, photos: PhotoSource,
    preparation: PhotoPreparation, progress: Progress, *, threads: int,
) -> BakedColors:  # fmt: skip
    """Blend the best views of each point, in texture order, by a robust mean.

    Photos are read one at a time, at the level that matches the texel size. The weight of a view is
    (cosine x useful pixels per texel)^2, reduced near silhouettes and the image border. The best
    ``KEPT_VIEWS`` are kept; with three or more, those far from their median are rejected
    (docs/method.md, section 8.2).
    """
    used_photos = preparation.used_photos
    colors = np.zeros((len(points), 3), np.uint8)
    views, rejected, clearance = (np.zeros(len(points), np.uint8) for _ in range(3))
    reliable = np.zeros(len(points), np.bool_)
    blocks = max(1, math.ceil(len(points) / POINTS_PER_BLOCK))
    bounds = np.linspace(0, len(points), blocks + 1).astype(int).tolist()
    steps = max(1, blocks * len(used_photos))
    for block, (begin, end) in enumerate(pairwise(bounds)):
        block_points = points.part(slice(begin, end))
        weights = np.zeros((end - begin, KEPT_VIEWS), np.float32)
        kept = np.zeros((end - begin, KEPT_VIEWS, 3), np.uint8)
        for step, (index, divisor) in enumerate(used_photos):
            fraction = 0.95 * (block * len(used_photos) + step) / steps
            progress.update(fraction, f"texture: photo {step + 1} of {len(used_photos)}")
            sample_photo(
                block_points, surface, _view(photos, index, divisor, surface, threads),
                preparation.factors[index], weights, kept, clearance[begin:end], threads,
            )  # fmt: skip
        progress.update(0.95 * (block + 1) / blocks, "blending views")
        reliable[begin:end] = weights.max(axis=1) > LAST_RESORT_BELOW
        _blend_block(
            weights, kept, colors[begin:end], views[begin:end], rejected[begin:end], threads
        )
    outliers = int(rejected.sum(dtype=np.int64))
    return BakedColors(colors, views, clearance >= CLEAR_PX, reliable, outliers)


def _view(
    photos: PhotoSource, index: int, divisor: int, surface: SurfaceArrays, threads: int
) -> PhotoView:
    camera = photos.camera(index, divisor)
    mask = photos.mask(index, divisor)
    return PhotoView(
        camera, photos.camera(index, 1).fx, pyramid(photos.photo(index, divisor)),
        np.ones((1, 1), np.bool_) if mask is None else mask,
        *photo_visibility(surface.vertices, surface.faces, camera, threads),
    )  # fmt: skip


def correction_sample_count(count: int) -> int:
    """Return the number of points that :func:`prepare_photos` needs for a number of photos."""
    return max(1, min(CORRECTION_POINTS, MAX_CORRECTION_SAMPLES // max(count, 1)))


def prepare_photos(
    sample: SurfacePoints, surface: SurfaceArrays, photos: PhotoSource, count: int,
    progress: Progress, *, threads: int,
) -> PhotoPreparation:  # fmt: skip
    """Find which of ``count`` photos show the mesh, their level, and their colour correction.

    The sample is :func:`correction_sample_count` points spread evenly over the surface.
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
        hit = view.depth[np.isfinite(view.depth)]
        if len(hit) == 0:
            continue
        # At this level, a texel near the camera still has one pixel.
        near = float(np.percentile(hit, 2.0))
        divisor = max(1, int(full.fx * surface.texel_size / near))
        used_photos.append((index, min(divisor, full.width, full.height)))
        weights = np.zeros((wanted, 1), np.float32)
        one = np.zeros((wanted, 1, 3), np.uint8)
        unused = np.zeros(wanted, np.uint8)
        sample_photo(sample, surface, view, np.ones((1, 1, 3)), weights, one, unused, threads)
        valid[:, index] = weights[:, 0] > LAST_RESORT_BELOW
        colors[:, index] = one[:, 0]
        image_positions[:, index] = full.project(positions)[0] / [full.width, full.height]
    gains, gain_spread = solve_gains(colors, valid)
    fields, spread = solve_low_frequency_correction(colors, valid, image_positions, gains)
    statistics = {
        "photos_used": len(used_photos),
        "exposure_spread": gain_spread,
        "exposure_corrected": bool((gains != 1.0).any()),
        "brightness_spread_within_photos": spread,
        "brightness_evened_within_photos": bool((fields != 1.0).any()),
    }
    return PhotoPreparation(used_photos, gains[:, None, None] * fields, statistics)


def _blend_block(
    weights: np.ndarray, kept: np.ndarray, colors: np.ndarray, views: np.ndarray,
    rejected: np.ndarray, threads: int,
) -> None:  # fmt: skip
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


# -- Gain of each photo and channel, from surface points seen by several photos -------------------


MIN_GAIN_SPREAD = 0.02
"""Gains with a smaller spread of logarithms are due to noise and highlights and not applied."""
MAX_LOG_GAIN = 0.7
"""A factor of two either way; more is a mismatch and not an exposure."""
PRIOR_POINTS = 20.0
"""Weight of the prior gain 1, in points."""
DARKEST, BRIGHTEST = 10, 245
"""Values outside are clipped or noise and not used."""
ROUNDS = 20
ROBUST_LOG = 0.05


def solve_gains(colors: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit gains that equalise the photos' colours of the same points.

    Robust least squares of ``log c[i, p] = a[i] - log gain[p]`` by alternation, with weights
    ``1 / max(|residual|, 0.05)``. The median of the log gains is 0, so the texture has the exposure
    of most photos; with a mean of 0 and two groups of exposures, white in the darker photos would
    exceed 255.

    Of the (n, photos, 3) uint8 colours of point i in photo p, and (n, photos) bool whether the
    photo sees it: returns the (photos, 3) float64 factors to multiply with, all 1 if exposures do
    not differ, and the standard deviation of the fitted log gains.
    """
    photos = valid.shape[1]
    gains = np.ones((photos, 3))
    shared = valid.sum(axis=1) >= 2
    if not shared.any():
        return gains, 0.0
    log_gains = np.zeros((photos, 3))
    for channel in range(3):
        values = colors[shared, :, channel]
        usable = valid[shared] & (values >= DARKEST) & (values <= BRIGHTEST)
        values_log = np.log(np.maximum(values, 1).astype(np.float32))
        log_gains[:, channel] = _solve_gains(values_log, usable)
        sees = usable.any(axis=0)
        if sees.any():
            log_gains[sees, channel] -= np.median(log_gains[sees, channel])
    spread = float(log_gains.std())
    if spread < MIN_GAIN_SPREAD:
        return gains, spread
    return np.exp(np.clip(log_gains, -MAX_LOG_GAIN, MAX_LOG_GAIN)), spread


def _solve_gains(values: np.ndarray, usable: np.ndarray) -> np.ndarray:
    gain = np.zeros(values.shape[1])
    weight = usable.astype(np.float32)  # (n, photos)
    for _ in range(ROUNDS):
        total = np.maximum(weight.sum(axis=1), 1e-9)
        level = (weight * (values + gain)).sum(axis=1) / total  # (n,)
        offset = level[:, None] - values
        per_photo = weight.sum(axis=0)
        gain = (weight * offset).sum(axis=0) / (per_photo + PRIOR_POINTS)
        seen = per_photo > 0
        gain[seen] -= gain[seen].mean() if seen.any() else 0.0
        residual = np.abs(offset - gain)
        weight = usable * np.minimum(1.0, ROBUST_LOG / np.maximum(residual, 1e-6))
    return gain


# -- Low-frequency colour correction within photos (vignetting, gradients) ------------------------
#
# Lenses darken the corners, glass reflects, the sun moves: after one gain per photo, two photos
# of a wall still differ by a smooth factor, which would show as a seam wherever the best view
# changes. Each photo is multiplied by a smooth field that matches it to the blend of all photos
# of the same points. The photos then agree in the low band, and the best view may dominate in the
# high band without a seam. The fields are fitted at surface points, so nothing is blurred across
# silhouettes.


GRID = (9, 12)
"""Rows and columns of nodes over a photo: a twelfth of it is low band; smaller may be detail."""
MAX_LOG_CORRECTION = 0.4
"""A factor of 1.5 either way; more is a mismatch and not brightness."""
SMOOTHNESS = 20.0
"""Weight of the smoothness between neighbouring nodes, in points."""
CORRECTION_PRIOR_POINTS = 2.0
"""Weight of the prior factor 1 of a node, in points."""
MIN_CORRECTION_SPREAD = 0.008
"""Fields with a smaller spread of logarithms are noise and not applied. Exact photos of a checker
gave 0.002, samples with noise of 10 % 0.004, dark corners and gradients of 8 % 0.025."""
CORRECTION_ROUNDS = 12
MIN_VIEWS = 2


def solve_low_frequency_correction(
    colors: np.ndarray, valid: np.ndarray, image_positions: np.ndarray, gains: np.ndarray
) -> tuple[np.ndarray, float]:
    """Fit smooth factors within each photo that equalise the photos' colours of the same points.

    Robust least squares of ``log c[i, p] + log gain[p] + f[p](x[i, p]) = a[i]`` by alternation,
    with the image position ``x``; ``f`` is bilinear between the nodes of a grid, smooth, and near 0
    without data.

    Parameters
    ----------
    colors, valid, gains
        Arguments and result of :func:`solve_gains`.
    image_positions : (n, photos, 2) float32
        Position in the photo, in shares of width and height.

    Returns
    -------
    fields : (photos, gh, gw, 3) float64
        Factors at grid nodes, on top of the gains; all 1 (with one node) if the photos agree.
    spread : float
        Standard deviation of the log factors at the points.
    """
    photos = valid.shape[1]
    shared = np.flatnonzero(valid.sum(axis=1) >= MIN_VIEWS)
    ones = np.ones((photos, 1, 1, 3))
    if len(shared) == 0:
        return ones, 0.0
    seen = [np.flatnonzero(valid[shared, p]) for p in range(photos)]
    bases = [_basis(image_positions[shared[rows], p]) for p, rows in enumerate(seen)]
    stiffness, variances = _stiffness(), []
    logs = np.zeros((photos, GRID[0] * GRID[1], 3))
    for channel in range(3):
        values = colors[shared, :, channel]
        usable = valid[shared] & (values >= DARKEST) & (values <= BRIGHTEST)
        target = np.log(np.maximum(values, 1).astype(np.float32))
        target += np.log(gains[:, channel]).astype(np.float32)
        logs[:, :, channel], variance = _solve_correction(target, usable, seen, bases, stiffness)
        variances.append(variance)
    spread = float(np.sqrt(np.mean(variances)))
    if spread < MIN_CORRECTION_SPREAD:
        return ones, spread
    corrections = np.exp(np.clip(logs, -MAX_LOG_CORRECTION, MAX_LOG_CORRECTION))
    return corrections.reshape(photos, *GRID, 3), spread


def _basis(image_positions: np.ndarray) -> csr_matrix:
    """Return the (n, nodes) bilinear weights of positions in [0, 1]."""
    rows, columns = GRID
    x = image_positions[:, 0].clip(0.0, 1.0) * (columns - 1)
    y = image_positions[:, 1].clip(0.0, 1.0) * (rows - 1)
    ix = np.minimum(x.astype(np.int64), columns - 2)
    iy = np.minimum(y.astype(np.int64), rows - 2)
    tx, ty = x - ix, y - iy
    first = iy * columns + ix
    nodes = np.stack([first, first + 1, first + columns, first + columns + 1], axis=1)
    weights = np.stack([(1 - tx) * (1 - ty), tx * (1 - ty), (1 - tx) * ty, tx * ty], axis=1)
    begins = np.arange(len(nodes) + 1) * 4
    return csr_matrix((weights.ravel(), nodes.ravel(), begins), (len(nodes), rows * columns))


def _stiffness() -> np.ndarray:
    """Return the (nodes, nodes) matrix of the smoothness term and the prior."""
    rows, columns = GRID
    number = np.arange(rows * columns).reshape(rows, columns)
    matrix = CORRECTION_PRIOR_POINTS * np.eye(rows * columns)
    for ends, begins in ((number[:, 1:], number[:, :-1]), (number[1:], number[:-1])):
        for one, other in zip(ends.ravel().tolist(), begins.ravel().tolist(), strict=True):
            matrix[[one, other], [one, other]] += SMOOTHNESS
            matrix[[one, other], [other, one]] -= SMOOTHNESS
    return matrix


def _solve_correction(
    values: np.ndarray, usable: np.ndarray, seen: list[np.ndarray], bases: list[csr_matrix],
    stiffness: np.ndarray,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Return (photos, nodes) log factors and their mean square at the points."""
    correction = np.zeros_like(values)  # (n, photos)
    weight = usable.astype(np.float32)
    nodes = np.zeros((values.shape[1], len(stiffness)))
    for _ in range(CORRECTION_ROUNDS):
        total = np.maximum(weight.sum(axis=1), 1e-9)
        level = (weight * (values + correction)).sum(axis=1) / total
        for photo, (rows, basis) in enumerate(zip(seen, bases, strict=True)):
            if len(rows) == 0:
                continue
            own = weight[rows, photo]
            offset = level[rows] - values[rows, photo]
            normal = (basis.multiply(own[:, None]).T @ basis).toarray()
            nodes[photo] = np.linalg.solve(normal + stiffness, basis.T @ (own * offset))
            correction[rows, photo] = basis @ nodes[photo]
        residual = np.abs(level[:, None] - values - correction)
        weight = usable * np.minimum(1.0, ROBUST_LOG / np.maximum(residual, 1e-6))
    points = max(int(usable.sum()), 1)
    return nodes, float((np.where(usable, correction, 0.0) ** 2).sum(dtype=np.float64)) / points


# -- Texture coverage statistics, accumulated over atlases ----------------------------------------


class CoverageStatistics:
    """Counts of texels and faces over the atlases of a mesh with a number of ``faces``."""

    def __init__(self, faces: int) -> None:
        self._with_texel, self._face_seen = np.zeros(faces, np.bool_), np.zeros(faces, np.bool_)
        self._counts: Counter[str] = Counter()

    def add(self, points: SurfacePoints, baked: BakedColors, overlaps: int) -> None:
        """Add one atlas, in which ``overlaps`` texels are used twice."""
        seen = baked.views > 0
        self._with_texel[points.face] = True
        self._face_seen[points.face[seen]] = True
        self._counts.update(
            used=len(points), seen=int(seen.sum()), overlaps=overlaps, rejected=baked.rejected,
            outlines=int((baked.reliable & ~baked.clear).sum()),
            badly=int((seen & ~baked.reliable).sum()),
            views=int(baked.views.sum(dtype=np.int64)),
        )  # fmt: skip

    def statistics(
        self, size_px: int, settings: TextureSettings, unwrapped: Unwrap, areas: np.ndarray
    ) -> dict[str, Any]:
        """Return plain JSON values over all atlases, for the (f,) areas of the faces."""
        with_texel, face_seen = self._with_texel, self._face_seen
        counts = self._counts
        used, seen, views, rejected = (counts[n] for n in ("used", "seen", "views", "rejected"))
        area_with_texel = float(areas[with_texel].sum())
        return {
            "size_px": size_px, "size_automatic": settings.size_px == 0,
            "atlases": unwrapped.atlases,
            "unwrap": unwrapped.method, "unwrap_fallback_reason": unwrapped.reason,
            "charts": int(unwrapped.charts.max()) + 1,
            "gutter_px": round(unwrapped.gutter_px, 2),
            "utilisation": used / (unwrapped.atlases * size_px**2),
            "texels_used": used, "texels_seen": seen, "texels_filled": used - seen,
            "texels_seen_at_outlines_only": counts["outlines"],
            "texels_seen_badly": counts["badly"],
            "texels_overlapping": counts["overlaps"],
            "coverage": seen / max(used, 1),
            "faces_seen_share": float(face_seen.sum()) / max(int(with_texel.sum()), 1),
            # Over faces with a texel: visibility of the others is unknown.
            "area_seen_share": (
                float(areas[face_seen].sum()) / area_with_texel if area_with_texel else 0.0
            ),
            "area_without_texel_share": float(areas[~with_texel].sum() / areas.sum()),
            "faces_without_texel": int((~with_texel).sum()),
            "views_per_seen_texel": views / seen if seen else 0.0,
            "views_rejected_share": rejected / max(views + rejected, 1),
        }  # fmt: skip


# -- Texels of one atlas that belong to a face, as surface points ---------------------------------


BLOCK_TEXELS = 4_000_000
"""Texels processed at once: numpy widens 32-bit indices to 64 bits whenever they are used."""


@dataclass(frozen=True)
class AtlasPoints:
    """Texels with a face, in order."""

    texels: np.ndarray  # (n,) int32 flat indices
    points: SurfacePoints
    chart: np.ndarray  # (size, size) int32 chart of each texel, -1 between charts


def atlas_points(raster: AtlasRaster, charts: np.ndarray) -> AtlasPoints:
    """Extract the points of a raster; its face indices are replaced by (f,) charts in place."""
    flat, bary = raster.face.reshape(-1), raster.bary.reshape(-1, 2)
    count = int(np.count_nonzero(flat >= 0))
    texels, face = np.empty(count, np.int32), np.empty(count, np.int32)
    weights = np.empty((count, 2), np.float32)
    filled = 0
    for begin in range(0, len(flat), BLOCK_TEXELS):
        block = flat[begin : begin + BLOCK_TEXELS]
        found = np.flatnonzero(block >= 0)
        rows = slice(filled, filled + len(found))
        texels[rows] = found + begin
        face[rows] = block[found]
        weights[rows] = bary[begin : begin + BLOCK_TEXELS][found]
        block[found] = charts[block[found]]
        filled += len(found)
    return AtlasPoints(texels, SurfacePoints(face, weights), raster.face)


def blocks_of(count: int) -> list[slice]:
    """Return slices of at most :data:`BLOCK_TEXELS`."""
    return [slice(b, min(b + BLOCK_TEXELS, count)) for b in range(0, count, BLOCK_TEXELS)]
