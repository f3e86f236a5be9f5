# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes through plain parts of photos: evidence of other photos, alignment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..compiled import kernel
from ..progress import Progress
from ..resampling import grey_of
from ..scene.camera import Camera
from ..scene.scene import evenly_spaced
from .depth_maps import DepthMap
from .plane_fitting import (
    LEAST_INVERSE_DEPTH,
    Plane,
    Segment,
    image_plane,
    lifted_pixels,
    numbered,
    smoothed_noise,
    with_ones,
)

# -- Kernels that look points up in all photos ----------------------------------------------------


AGREEING, ALIKE, THROUGH, UNLIKE, NEARER = range(5)  # columns of what :func:`count_votes` counts
AGREEING_SHARE = 0.02
"""Largest relative difference of a point's depth and a photo's own, of those that agree."""

THROUGH_SHARE = 0.03
"""A known depth this much larger than a point's sees through it, one this much smaller hides it."""

ALIKE_LEVELS = 16
"""Largest difference of colours, exposure taken out, of pixels that may show one point."""

_NEAREST_Z = 1e-9


@kernel(fast=False)
def count_votes(
    points: np.ndarray, colors: np.ndarray, own: int, others: np.ndarray,
    projections: np.ndarray, sizes: np.ndarray, depths: np.ndarray, images: np.ndarray,
    agreeing_share: float, counts: np.ndarray,
) -> None:  # fmt: skip
    """Count what other photos say about points.

    Parameters
    ----------
    points : (n, 3) float64
    colors : (n, 3) uint8
        What the points look like in their own photo.
    own : int
        Number of that photo, which is left out.
    others : (m,) int64
        Photos to ask.
    projections : (photos, 3, 4) float64
        From points to pixels times depth; the first pixel's corner at 0.
    sizes : (photos, 2) int64
        Width and height.
    depths : (photos, h, w) float32
        Known depths, 0 where nothing is known.
    images : (photos, h, w, 3) uint8
        Colours, exposure taken out.
    counts : (n, 5) int32
        Added to: photos whose depth agrees; unknown depth and like colour; depth behind the point;
        unknown depth and another colour; depth before the point.
    """
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for j in range(others.shape[0]):
            v = others[j]
            if v == own:
                continue
            p = projections[v]
            depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if depth <= _NEAREST_Z:
                continue
            u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / depth
            w = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / depth
            if not (u >= 0.0 and w >= 0.0 and u < sizes[v, 0] and w < sizes[v, 1]):
                continue
            column, row = int(u), int(w)
            known = depths[v, row, column]
            if known > 0.0:
                if abs(known / depth - 1.0) < agreeing_share:
                    counts[i, AGREEING] += 1
                elif known > (1.0 + THROUGH_SHARE) * depth:
                    counts[i, THROUGH] += 1
                elif known < (1.0 - THROUGH_SHARE) * depth:
                    counts[i, NEARER] += 1
                continue
            alike = True
            for k in range(3):
                step = np.int32(images[v, row, column, k]) - np.int32(colors[i, k])
                if abs(step) >= ALIKE_LEVELS:
                    alike = False
            counts[i, ALIKE if alike else UNLIKE] += 1


@kernel(fast=False)
def correlate(
    points: np.ndarray, values: np.ndarray, others: np.ndarray, projections: np.ndarray,
    sizes: np.ndarray, textures: np.ndarray, limit: float,
) -> tuple[float, int]:  # fmt: skip
    """Correlate faint texture at points with that of other photos.

    Parameters
    ----------
    points : (n, 3) float64
    values : (n,) float32
        Texture of the points in their own photo.
    others : (m,) int64
    projections, sizes
        As in :func:`count_votes`.
    textures : (photos, h, w) float32
        NaN where a photo is not plain.
    limit : float32
        Values are clipped at this, so that single steps do not outweigh the rest.

    Returns
    -------
    total : float
        Sum over photos of correlation times number of points.
    count : int
        Points compared.
    """
    total, count = 0.0, 0
    for j in range(others.shape[0]):
        v = others[j]
        p = projections[v]
        ab, aa, bb, found = 0.0, 0.0, 0.0, 0
        for i in range(points.shape[0]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if depth <= _NEAREST_Z:
                continue
            u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / depth - 0.5
            w = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / depth - 0.5
            if not (u >= 0.0 and w >= 0.0 and u < sizes[v, 0] - 1 and w < sizes[v, 1] - 1):
                continue
            column, row = int(u), int(w)
            s, t = u - column, w - row
            top = (1.0 - s) * textures[v, row, column] + s * textures[v, row, column + 1]
            low = (1.0 - s) * textures[v, row + 1, column] + s * textures[v, row + 1, column + 1]
            b = (1.0 - t) * top + t * low
            if not np.isfinite(b):
                continue
            a = min(max(values[i], -limit), limit)
            b = min(max(b, -limit), limit)
            ab += a * b
            aa += a * a
            bb += b * b
            found += 1
        if aa > 0.0 and bb > 0.0:
            total += found * ab / np.sqrt(aa * bb)
        count += found
    return total, count


# -- All photos packed, to ask them what they say about points on a plane -------------------------


MOST_ASKED = 40  # Photos asked about the points of one; a regular choice of more.
LEAST_SHOWN = 0.9
"""Share of the pixels that must show a plane; photos need not be asked about another."""

GAIN_PIXELS, LEAST_PAIRS = 600, 30
"""Confirmed pixels of a photo that gains are measured on, and least number of a pair of photos."""

_DARK = 4.0  # added to colours before ratios are taken, so that dark pixels do not decide


@dataclass(frozen=True)
class Votes:
    """What the other photos say about points, as shares of all that could contradict."""

    like: float  # depth agrees, or nothing is known there and the colour is like
    through: float  # the depth there lies behind


@dataclass(frozen=True)
class PackedPhotos:
    """Depths and colours of all photos in arrays of the largest size."""

    cameras: tuple[Camera, ...]
    projections: np.ndarray  # (n, 3, 4) float64
    sizes: np.ndarray  # (n, 2) int64
    depths: np.ndarray  # (n, h, w) float32, 0 where unknown
    images: np.ndarray  # (n, h, w, 3) uint8, exposure taken out
    gains: np.ndarray  # (n, 3) float64, by which that was done

    def asked(self) -> np.ndarray:
        """Return (m,) int64 numbers of the photos to ask."""
        return photos_asked(len(self.cameras))

    def counts(
        self, view: int, pixels: np.ndarray, inverse_depths: np.ndarray,
        agreeing_share: float = AGREEING_SHARE,
    ) -> np.ndarray:  # fmt: skip
        """Return (n, 5) int32 counts of :func:`count_votes` for pixels of a photo.

        Pixels are (n, 2) float64, centres whole; their inverse depths (n,) are positive.
        """
        counts = np.zeros((len(pixels), 5), np.int32)
        column, row = pixels.astype(np.int64).T
        count_votes(
            lifted_pixels(self.cameras[view], pixels, inverse_depths),
            self.images[view][row, column], view, self.asked(), self.projections, self.sizes,
            self.depths, self.images, agreeing_share, counts,
        )  # fmt: skip
        return counts

    def votes(self, view: int, pixels: np.ndarray, inverse_depths: np.ndarray) -> Votes:
        """Return what the other photos say about a plane's inverse depths at pixels."""
        good = inverse_depths > LEAST_INVERSE_DEPTH
        if good.mean() < LEAST_SHOWN:
            return Votes(0.0, 1.0)
        total = self.counts(view, pixels[good], inverse_depths[good]).sum(0)
        all_votes = total[[AGREEING, ALIKE, THROUGH, UNLIKE]].sum()
        if all_votes == 0:
            return Votes(0.0, 0.0)
        return Votes(
            float((total[AGREEING] + total[ALIKE]) / all_votes), float(total[THROUGH] / all_votes)
        )

    def with_depths(self, depths: np.ndarray) -> PackedPhotos:
        """Return the same photos with other known depths."""
        return dataclasses.replace(self, depths=depths)


def photos_asked(count: int) -> np.ndarray:
    """Return (m,) int64: which of so many photos are asked, a regular choice."""
    return np.array(evenly_spaced(range(count), MOST_ASKED), np.int64)


def packed(depth_maps: Sequence[DepthMap], random: np.random.Generator) -> PackedPhotos:
    """Pack photos; their exposure is taken out by gains between confirmed pixels."""
    cameras = tuple(depth_map.camera for depth_map in depth_maps)
    height, width = max(c.height for c in cameras), max(c.width for c in cameras)
    depths = np.zeros((len(cameras), height, width), np.float32)
    images = np.zeros((len(cameras), height, width, 3), np.uint8)
    for view, found in enumerate(depth_maps):
        part = (view, slice(cameras[view].height), slice(cameras[view].width))
        depths[part] = np.where(found.confidence > 0, found.depth, 0.0)
        images[part] = found.color
    projections = np.array([_projection(camera) for camera in cameras])
    sizes = np.array([(camera.width, camera.height) for camera in cameras], np.int64)
    photos = PackedPhotos(cameras, projections, sizes, depths, images, np.ones((len(cameras), 3)))
    gains = np.exp(-_log_gains(photos, random))  # (n, 3)
    for view, gain in enumerate(gains):
        corrected = (images[view].astype(np.float32) + _DARK) * gain.astype(np.float32) - _DARK
        images[view] = np.clip(corrected + 0.5, 0, 255).astype(np.uint8)
    return dataclasses.replace(photos, gains=gains)


def _projection(camera: Camera) -> np.ndarray:
    lens = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return lens @ camera.cam_from_world


def _log_gains(photos: PackedPhotos, random: np.random.Generator) -> np.ndarray:
    """Return (n, 3) logarithms of the photos' gains, with a mean of 0 per channel."""
    count = len(photos.cameras)
    equations, values = [np.ones(count)], [np.zeros(3)]
    for view in range(count):
        row, column = np.nonzero(photos.depths[view])
        if len(row) < LEAST_PAIRS:
            continue
        chosen = random.choice(len(row), min(GAIN_PIXELS, len(row)), replace=False)
        row, column = row[chosen], column[chosen]
        inverse = 1.0 / photos.depths[view][row, column].astype(np.float64)
        pixels = np.stack([column, row], 1).astype(np.float64)
        points = lifted_pixels(photos.cameras[view], pixels, inverse)
        color = photos.images[view][row, column] + _DARK
        for other in photos.asked():
            if other == view:
                continue
            ratio = _ratio(photos, int(other), points, color)
            if ratio is not None:
                equation = np.zeros(count)
                equation[other], equation[view] = 1.0, -1.0
                equations.append(equation)
                values.append(ratio)
    return np.linalg.lstsq(np.array(equations), np.array(values), rcond=None)[0]


def _ratio(
    photos: PackedPhotos, other: int, points: np.ndarray, color: np.ndarray
) -> np.ndarray | None:
    """Return (3,) median log ratio of colours where another photo's depth agrees, or ``None``."""
    shown, row, column, depth = photos.cameras[other].shown(points)
    agree = np.abs(photos.depths[other][row, column] / depth - 1.0) < AGREEING_SHARE / 2
    if agree.sum() < LEAST_PAIRS:
        return None
    there = photos.images[other][row, column][agree] + _DARK
    return np.median(np.log(there / color[shown][agree]), axis=0)


# -- Planes moved until the faint texture of their segments matches between photos ----------------
#
# A window of 11 x 11 pixels on a plain wall shows less texture than noise; thousands of pixels
# that are known to lie on one plane show enough to place it (docs/method.md, section 11.12).


SCALES_PX = ((1.5, 8.0), (0.7, 5.0))
"""Standard deviations of the two Gaussians whose difference is the texture, coarse and fine, of
photos without noise."""

MOST_NOISE_LEVELS, MOST_COARSENING = 0.2, 4.0
"""Noise of a texture, grey levels, from which its scale is made coarser, and the largest factor.
Noise lowers every correlation: those of a rendered room's true planes fell to .13 to .31
where its photos were matched at full size."""

NOISY_PHOTOS = 0.8  # quantile of the photos' noise that the scales are made for
STEPS = ((0.01, 0.005), (0.0025, 0.00125, 0.0006, 0.0003))
"""Of the search at each scale, as shares of the depth at the edges of the plane's segments."""
TURNS = 6  # most turns of the search with one step
PENALTY, PENALTY_STEP = 0.03, 0.015
"""Correlation that a change of the plane by such a share of the depth must gain at least."""

CLIPPED_LEVELS = 4.0  # texture is clipped at this many grey levels
MOST_SAMPLES, LEAST_SAMPLES = 1200, 200  # pixels of a segment that take part, and that it needs to
MOST_SOURCES = 6
LEAST_INSIDE = 0.3
"""Share of a segment's samples that must land on plain pixels of a source."""
ANGLES = (0.03, 0.8)
"""Range of the baseline over the depth of sources; those up to :data:`_WIDE` preferred."""
_WIDE = 0.3

LEAST_GAIN, LEAST_CORRELATION, LEAST_TEXTURE_SHARE = 0.01, 0.6, 0.2
"""Gain of correlation by a move, and correlation after it, for which a plane is moved, if its
texture has such a share of the power besides noise."""

FALSE_CORRELATION, LEAST_TEXTURE, NOISE_MARGIN = 0.4, 0.12, 1.25
"""A plane whose texture correlates less at both scales is no surface, unless it stands out (below),
if there is texture of so many grey levels (root mean square) besides noise, taken so many times as
large as measured. The fine scale alone refuses planes that are off by a pixel, and walls whose
finest texture is that of rounding to whole levels."""

ELSEWHERE, LEAST_CONTRAST, LEAST_LEFT = (0.05, 0.08, 0.12), 0.1, 0.5
"""Shares of the depth by which a plane is moved before and behind, how much more than at any of
these places the coarse texture must correlate for a plane to stand out, and share of the samples
that must be left there. JPEG and what cameras do against noise leave more of it in large squares
than those of one and two pixels tell: the texture of a true ground (thin-d3 of the zoo, as a camera
takes it) correlated by .23 where .84 were expected, and by at most .04 elsewhere."""

MANY_VIEWS = 6
"""Photos that must show a plane which stays because it stands out: few may be alike by chance."""


@dataclass(frozen=True)
class Part:
    """Pixels of one photo on a plane."""

    view: int
    pixels: np.ndarray  # (n, 2) float64, centres whole


@dataclass(frozen=True)
class _Sampled:
    """A part with what the search needs."""

    view: int
    rays: np.ndarray  # (n, 3) scene frame
    at: np.ndarray  # (n,) int64 index into the flattened photo
    others: np.ndarray  # (m,) int64


class Aligner:
    """Moves planes to where the texture of all plain segments matches best.

    ``progress`` is checked for cancellation while textures are drawn only.
    """

    def __init__(
        self, photos: PackedPhotos, segments: Sequence[Segment], random: np.random.Generator,
        progress: Progress,
    ) -> None:  # fmt: skip
        numbers = numbered(segments, photos.depths.shape)
        self.photos, self.plain, self.random = photos, numbers > 0, random
        noise = np.zeros(len(numbers))
        for segment in segments:
            noise[segment.view] = segment.noise
        noise *= grey_of(photos.gains)  # textures are of photos whose exposure is taken out
        scales = np.array(SCALES_PX)
        # White noise falls with the standard deviation of the Gaussian that smooths it.
        left = smoothed_noise(np.quantile(noise, NOISY_PHOTOS), scales[:, 0])  # (2,)
        self.coarsening = np.clip(left / MOST_NOISE_LEVELS, 1.0, MOST_COARSENING)
        scales *= self.coarsening[:, None]
        self.noise = smoothed_noise(noise, scales[:, :1])
        """(2, n) standard deviation of the noise of both textures of each photo, grey levels."""
        self.textures = np.full((len(scales), *numbers.shape), np.nan, np.float32)
        """(2, n, h, w) both textures of each photo, NaN outside of its segments."""
        for view, own in enumerate(numbers):
            progress.check()
            grey = grey_of(photos.images[view])
            for level, scale in enumerate(scales):
                _draw_texture(grey, own, scale, self.textures[level, view])

    def aligned(self, plane: Plane, parts: Sequence[Part]) -> Plane | None:
        """Return the plane where it matches best, or ``None`` where it is no surface.

        Planes without parts large enough, or with hardly any texture, stay as they are.
        """
        sampled = [found for part in parts if (found := self._sampled(plane, part)) is not None]
        if not sampled:
            return plane
        search = _Search(self, plane, sampled)
        start = search.score(np.zeros(3), 1)
        place, best = np.zeros(3), start
        for level, steps in enumerate(STEPS):
            place, best = search.climbed(place, level, steps)
        many = len({part.view for part in sampled}) >= MANY_VIEWS
        if search.is_false(place) and not (many and search.stands_out(place)):
            return None
        # Noise takes its share of every correlation.
        share = search.texture_share(1, 1.0)
        clear = search.texture_share(1, NOISE_MARGIN) > LEAST_TEXTURE_SHARE
        if clear and best > start + LEAST_GAIN * share and best > LEAST_CORRELATION * share:
            return plane.moved(*search.plane(place))
        return plane

    def contradicts(self, plane: Plane, part: Part) -> bool:
        """Tell whether the texture of a part is that of no surface on a plane."""
        sampled = self._sampled(plane, part)
        if sampled is None:
            return False
        search, place = _Search(self, plane, [sampled]), np.zeros(3)
        return search.is_false(place) and not search.stands_out(place)

    def _sampled(self, plane: Plane, part: Part) -> _Sampled | None:
        """Choose samples, and sources that see them as plain pixels from elsewhere."""
        if len(part.pixels) < LEAST_SAMPLES:
            return None
        count = min(MOST_SAMPLES, len(part.pixels))
        pixels = part.pixels[self.random.choice(len(part.pixels), count, replace=False)]
        camera = self.photos.cameras[part.view]
        inverse = with_ones(pixels) @ image_plane(plane, camera)
        if not (inverse > LEAST_INVERSE_DEPTH).all():
            return None
        points = lifted_pixels(camera, pixels, inverse)
        depth = float(np.median(np.linalg.norm(points - camera.center, axis=1)))
        found = []
        for other in self.photos.asked():
            if other == part.view:
                continue
            angle = float(np.linalg.norm(self.photos.cameras[other].center - camera.center)) / depth
            if not ANGLES[0] < angle < ANGLES[1]:
                continue
            share = self._seen_plain(int(other), points)
            if share > LEAST_INSIDE:
                found.append((share * min(angle, _WIDE), int(other)))
        if not found:
            return None
        column, row = pixels.astype(np.int64).T
        others = np.array([other for _, other in sorted(found, reverse=True)[:MOST_SOURCES]])
        rays = camera.rays_at(pixels + 0.5) @ camera.rotation
        return _Sampled(part.view, rays, row * self.plain.shape[2] + column, others)

    def _seen_plain(self, other: int, points: np.ndarray) -> float:
        """Return the share of points that land on plain pixels which nothing known hides."""
        _, row, column, depth = self.photos.cameras[other].shown(points)
        known = self.photos.depths[other][row, column]
        hidden = (known > 0) & (known < (1.0 - THROUGH_SHARE) * depth)
        return float((self.plain[other][row, column] & ~hidden).sum() / len(points))


class _Search:
    """Correlation of a plane's texture as a function of three small changes of the plane."""

    def __init__(self, aligner: Aligner, plane: Plane, parts: Sequence[_Sampled]) -> None:
        self.aligner, self.parts, self.normal = aligner, parts, plane.normal
        self.centers = [aligner.photos.cameras[part.view].center for part in parts]
        points = np.concatenate(
            [
                center + part.rays * ((plane.offset - plane.normal @ center) /
                                      (part.rays @ plane.normal))[:, None]
                for part, center in zip(parts, self.centers, strict=True)
            ]
        )  # fmt: skip
        self.center = points.mean(0)
        self.offset_at_center = plane.offset - plane.normal @ self.center
        around = points - self.center
        self.axes = np.linalg.svd(around.T @ around)[0][:, :2].T  # (2, 3) along the plane
        self.extents = np.maximum(np.std(around @ self.axes.T, axis=0), 1e-9)
        self.scale = float(np.median([np.linalg.norm(self.center - c) for c in self.centers]))
        self.counts: dict[int, int] = {}

    def plane(self, place: np.ndarray) -> tuple[np.ndarray, float]:
        """Return normal and offset: moved along the normal, turned about the two axes."""
        turn = self.scale * (place[1:] / self.extents) @ self.axes
        normal = self.normal + turn
        offset = normal @ self.center + self.offset_at_center + place[0] * self.scale
        length = np.linalg.norm(normal)
        return normal / length, float(offset / length)

    def score(self, place: np.ndarray, level: int) -> float:
        """Return the mean correlation less the penalty; samples that get lost count as 0."""
        total, count = self._correlated(place, level)
        least = self.counts.setdefault(level, count)
        penalty = PENALTY * float(((place / PENALTY_STEP) ** 2).sum())
        return total / max(count, least, 1) - penalty

    def _correlated(self, place: np.ndarray, level: int) -> tuple[float, int]:
        """Return the sum of the correlations and the number of samples that were compared."""
        normal, offset = self.plane(place)
        photos, textures = self.aligner.photos, self.aligner.textures[level]
        total, count = 0.0, 0
        for part, center in zip(self.parts, self.centers, strict=True):
            along = (offset - normal @ center) / (part.rays @ normal)
            found = correlate(
                center + part.rays * along[:, None],
                textures[part.view].reshape(-1)[part.at],
                part.others, photos.projections, photos.sizes, textures, CLIPPED_LEVELS,
            )  # fmt: skip
            total, count = total + found[0], count + found[1]
        return total, count

    def climbed(
        self, place: np.ndarray, level: int, steps: Sequence[float]
    ) -> tuple[np.ndarray, float]:
        """Return the place and the score after a search along the coordinates."""
        best = self.score(place, level)
        for step in steps:
            for _ in range(TURNS):
                before = best
                for change in np.concatenate([np.eye(3), -np.eye(3)]) * step:
                    value = self.score(place + change, level)
                    if value > best + 1e-5:
                        place, best = place + change, value
                if best == before:
                    break
        return place, best

    def is_false(self, place: np.ndarray) -> bool:
        """Tell whether both textures correlate so little that there is no surface at a place."""
        spoken = False
        for level in range(len(STEPS)):
            share = self.texture_share(level, NOISE_MARGIN)
            if share * self.texture_levels(level) ** 2 <= LEAST_TEXTURE**2:
                # Once it is made coarser, the fine scale may refuse alone.
                if self.aligner.coarsening[1] > 1.0:
                    continue
                return False
            if self.score(place, level) >= FALSE_CORRELATION * share:
                return False
            spoken = True
        return spoken

    def stands_out(self, place: np.ndarray) -> bool:
        """Tell whether the coarse texture matches clearly better here than before and behind.

        The depths of all pixels change by the same shares, however slanting the plane is seen.
        Never true where too few samples are left to compare with.
        """
        normal, offset = self.plane(place)
        depth = float(np.median([abs(offset - normal @ center) for center in self.centers]))
        total, count = self._correlated(place, 0)
        for step in ELSEWHERE:
            for sign in (-1.0, 1.0):
                move = np.array([sign * step * depth / self.scale, 0.0, 0.0])
                other, left = self._correlated(place + move, 0)
                if left < max(LEAST_LEFT * count, 1):
                    return False
                if total / max(count, 1) < other / left + LEAST_CONTRAST:
                    return False
        return True

    def texture_share(self, level: int, margin: float) -> float:
        """Return the share of a texture's power that is not noise, taken ``margin`` times.

        Of the photos of the parts and of those compared with, the geometric mean: as noise lowers
        a correlation.
        """
        power = max(self.texture_levels(level) ** 2, 1e-12)
        own = np.array([part.view for part in self.parts])
        others = np.concatenate([part.others for part in self.parts])
        shares = [
            max(0.0, 1.0 - float(np.mean((margin * self.aligner.noise[level, views]) ** 2)) / power)
            for views in (own, others)
        ]
        return float(np.sqrt(shares[0] * shares[1]))

    def texture_levels(self, level: int) -> float:
        """Return the root mean square of a texture at the samples, grey levels."""
        textures = self.aligner.textures[level]
        values = [textures[part.view].reshape(-1)[part.at] for part in self.parts]
        clipped = np.clip(np.concatenate(values), -CLIPPED_LEVELS, CLIPPED_LEVELS)
        return float(np.sqrt(np.mean(clipped**2)))


def _draw_texture(
    grey: np.ndarray, numbers: np.ndarray, sigmas_px: np.ndarray, band: np.ndarray
) -> None:
    """Write the band of the grey levels (h, w) of each segment alone, between two Gaussians.

    The sky beside a wall would otherwise be a step in the wall's own texture, and shading would be
    one at its border: a linear fit is taken out.
    """
    for number, box in enumerate(ndimage.find_objects(numbers), 1):
        own = numbers[box] == number
        weight = own.astype(np.float32)
        weighted = np.zeros_like(weight)
        weighted[own] = _without_slope(own, grey[box][own])
        means = [
            ndimage.gaussian_filter(weighted, sigma, mode="constant")
            / np.maximum(ndimage.gaussian_filter(weight, sigma, mode="constant"), 1e-3)
            for sigma in sigmas_px
        ]
        band[box][own] = (means[0] - means[1])[own]


def _without_slope(own: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (p,) at the pixels of a mask less their linear fit."""
    places = np.stack(np.nonzero(own), 1).astype(np.float64)
    places = np.column_stack([places - places.mean(0), np.ones(len(places))])  # (p, 3)
    fit = np.linalg.lstsq(places.T @ places, places.T @ values, rcond=None)[0]
    return values - places @ fit
