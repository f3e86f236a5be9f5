# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes through plain parts of photos: assigned to segments, depths filled."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from ..progress import Progress
from .depth_maps import DepthMap
from .matching_cost import WORST_COST
from .plane_evidence import AGREEING, ALIKE, NEARER, THROUGH, Aligner, PackedPhotos, Part, packed
from .plane_fitting import (
    FULL_SPREAD,
    LEAST_INVERSE_DEPTH,
    LEAST_SPREAD,
    LEAST_WEIGHT,
    SPEAKING_SHARE,
    Plane,
    Segment,
    image_plane,
    lifted_pixels,
    numbered,
    pooled,
    proposed_planes,
    refined,
    segments_of,
    spreads,
    with_ones,
)

# -- Which plane, or which two, a plain segment lies on -------------------------------------------


LEAST_BORDER = 0.12  # share of a segment's known depths, weighed, that its plane must explain
PAIR_GAIN = 0.06  # share that a second plane must explain besides
LEAST_LIKE = 0.85
"""Share of the other photos' votes that must not contradict a plane (:class:`.Votes`)."""

MOST_THROUGH, MOST_THROUGH_LATER = 0.015, 0.03
"""Share of the votes that may see through a plane, at first and once planes are known from several
photos."""

LATER_SPREAD = 0.12
"""As :data:`~.plane_fitting.LEAST_SPREAD`, once planes are known from several photos."""

FEW_VIEWS = 2.0  # a plane of n views counts n / (n + this)
MOST_RANKED, MOST_PAIRED, MOST_TRIED = 14, 6, 20
"""Planes of a segment that are looked at, of these put together in pairs, and choices whose votes
are counted."""

LEAST_RANKED = 0.05
"""Share of a segment's known depths, weighed, that a plane explains which is looked at."""

VOTING_PIXELS = 200

GAP_PX, LIKE_LEVELS = 9, 8.0
"""A segment takes over the planes of another one so near, whose median colour is so like: the
ground goes on beyond a rod."""
NEIGHBOURS, SPREADING_TURNS = 3, 4


FAR_DISTANCE = 1e6  # of points that stand for what lies too far away for parallax, scene units
FAR_SHARE, FAR_VOTES = 0.85, 2.0
"""Share of the other photos' votes that must be for the same colour and unknown depth, and votes a
pixel needs on average, for a segment without a plane to lie far away: photos see the sky alike in
one direction from everywhere."""


@dataclass(frozen=True)
class Assignment:
    """The planes of a segment; of two, each pixel takes the nearer or the farther one.

    Without planes the segment lies too far away for parallax.
    """

    planes: tuple[int, ...]
    nearer: bool = False

    @property
    def far(self) -> bool:
        """Whether there is no parallax."""
        return not self.planes

    def inverse_depths(self, each: np.ndarray) -> np.ndarray:
        """Return (n,) inverse depths from those on each plane, (n, planes)."""
        return each.max(1) if self.nearer else each.min(1)

    def owners(self, each: np.ndarray) -> np.ndarray:
        """Return (n,) which plane of :attr:`planes` each pixel lies on."""
        return each.argmax(1) if self.nearer else each.argmin(1)


@dataclass(frozen=True)
class PlaneSet:
    """Planes, and who tells whether a segment lies on them."""

    planes: Sequence[Plane]
    photos: PackedPhotos
    aligner: Aligner | None = None
    """Asked about the texture of segments, once the planes are aligned."""

    def on_planes(self, segment: Segment, assignment: Assignment) -> np.ndarray:
        """Return (p, planes) inverse depths of a segment's pixels on each of its planes."""
        camera = self.photos.cameras[segment.view]
        q = np.array([image_plane(self.planes[number], camera) for number in assignment.planes])
        return with_ones(segment.pixels) @ q.T

    def parts(self, segment: Segment, assignment: Assignment) -> list[tuple[int, Part]]:
        """Return the number of each plane of a segment with the pixels on it; none if it is far."""
        if assignment.far:
            return []
        owners = assignment.owners(self.on_planes(segment, assignment))
        return [
            (number, Part(segment.view, segment.pixels[owners == place]))
            for place, number in enumerate(assignment.planes)
        ]

    def is_false(self, segment: Segment, assignment: Assignment) -> bool:
        """Tell whether the texture of a part is that of no surface on its plane."""
        if self.aligner is None:
            return False
        return any(
            self.aligner.contradicts(self.planes[number], part)
            for number, part in self.parts(segment, assignment)
        )


def assigned(segment: Segment, known: PlaneSet, *, first: bool) -> Assignment | None:
    """Return the planes that explain most of what is known around a segment and pass the votes.

    At ``first`` planes are proposals of single segments still.
    """
    if not known.planes or segment.weights.sum() < LEAST_WEIGHT:
        return None
    through = MOST_THROUGH if first else MOST_THROUGH_LATER
    choices = _Choices(segment, known, LEAST_SPREAD if first else LATER_SPREAD)
    for assignment in choices.best():
        inverse = assignment.inverse_depths(choices.sampled_on(assignment))
        votes = known.photos.votes(segment.view, choices.sampled, inverse)
        passes = votes.like >= LEAST_LIKE and votes.through <= through
        if passes and not known.is_false(segment, assignment):
            return assignment
    return None


class _Choices:
    """Single planes and pairs that a segment may lie on."""

    def __init__(self, segment: Segment, known: PlaneSet, least_spread: float) -> None:
        self.segment, self.least_spread = segment, least_spread
        planes = known.planes
        self.trust = np.array([len(p.views) / (len(p.views) + FEW_VIEWS) for p in planes])
        camera = known.photos.cameras[segment.view]
        self.image_planes = np.array([image_plane(plane, camera) for plane in planes])
        step = max(1, len(segment.pixels) // VOTING_PIXELS)
        self.sampled = segment.pixels[::step]
        self.on_sampled = with_ones(self.sampled) @ self.image_planes.T
        self.on_places = with_ones(segment.places) @ self.image_planes.T  # (b, k)
        difference = self.on_places / segment.inverse_depths[:, None] - 1.0
        self.speaking = np.abs(difference) < SPEAKING_SHARE
        self.total = segment.weights.sum()
        self.shares = segment.weights @ self.speaking / self.total
        self.spreads = spreads(self.speaking.T, segment)

    def sampled_on(self, assignment: Assignment) -> np.ndarray:
        return self.on_sampled[:, list(assignment.planes)]

    def best(self) -> list[Assignment]:
        """Return the choices that explain enough, the best first."""
        rank = self.shares * np.minimum(self.spreads / FULL_SPREAD, 1.0)
        order = [int(k) for k in np.argsort(-rank)[:MOST_RANKED] if self.shares[k] > LEAST_RANKED]
        wide = [k for k in order if self.spreads[k] >= self.least_spread]
        found = [(self.shares[k], Assignment((k,))) for k in wide]
        found += list(self._pairs(order[:MOST_PAIRED]))
        found = [choice for choice in found if choice[0] >= LEAST_BORDER]
        found.sort(key=lambda c: -c[0] * self.trust[list(c[1].planes)].min())
        return [assignment for _, assignment in found[:MOST_TRIED]]

    def _pairs(self, order: Sequence[int]) -> Iterator[tuple[float, Assignment]]:
        for place, first in enumerate(order):
            for second in order[place + 1 :]:
                for nearer in (False, True):
                    assignment = Assignment((first, second), nearer)
                    share = self._pair_share(assignment)
                    alone = max(self.shares[first], self.shares[second])
                    if share > alone + PAIR_GAIN:
                        yield share - PAIR_GAIN, assignment

    def _pair_share(self, assignment: Assignment) -> float:
        """Return the share that a pair explains, 0 where one of the two explains an edge alone."""
        numbers = list(assignment.planes)
        owners = assignment.owners(self.on_places[:, numbers])
        speaking = self.speaking[:, numbers][np.arange(len(owners)), owners]
        share = float(self.segment.weights @ speaking / self.total)
        sampled_owners = assignment.owners(self.on_sampled[:, numbers])
        for own in range(2):
            chosen, part = speaking & (owners == own), self.sampled[sampled_owners == own]
            if chosen.sum() < 6 or len(part) < 4:
                return 0.0
            if spreads(chosen[None], self.segment, np.cov(part.T))[0] < self.least_spread:
                return 0.0
        return share


def lies_far(segment: Segment, photos: PackedPhotos) -> bool:
    """Tell whether photos see a segment alike in the same directions, whatever their place."""
    pixels = segment.pixels[:: max(1, len(segment.pixels) // VOTING_PIXELS)]
    counts = photos.counts(segment.view, pixels, np.full(len(pixels), 1.0 / FAR_DISTANCE))
    total = counts.sum()
    return bool(total >= FAR_VOTES * len(pixels) and counts[:, ALIKE].sum() >= FAR_SHARE * total)


def continued(
    segments: Sequence[Segment], found: Sequence[Assignment | None], known: PlaneSet
) -> list[Assignment | None]:
    """Return the assignments with those that segments take over from like ones nearby."""
    found = list(found)
    for view in sorted({segment.view for segment in segments}):
        own = [number for number, segment in enumerate(segments) if segment.view == view]
        colors = {n: np.median(_colors(segments[n], known.photos), axis=0) for n in own}
        for _ in range(SPREADING_TURNS):
            taken = _taken_over(own, segments, found, colors, known)
            if not taken:
                break
            for number, assignment in taken.items():
                found[number] = assignment
    return found


def _colors(segment: Segment, photos: PackedPhotos) -> np.ndarray:
    return photos.images[segment.view][segment.rows, segment.columns]


def _taken_over(
    own: Sequence[int], segments: Sequence[Segment], found: Sequence[Assignment | None],
    colors: dict[int, np.ndarray], known: PlaneSet,
) -> dict[int, Assignment]:  # fmt: skip
    """Return the assignments that segments of one photo take over in one turn."""
    camera = known.photos.cameras[segments[own[0]].view]
    done = np.zeros((camera.height, camera.width), np.int64)
    for number in own:
        if found[number] is not None:
            done[segments[number].rows, segments[number].columns] = number + 1
    if not done.any():
        return {}
    distance, (row, column) = ndimage.distance_transform_edt(done == 0, return_indices=True)
    nearest = done[row, column] - 1
    taken = {}
    for number in own:
        segment = segments[number]
        close = distance[segment.rows, segment.columns] <= GAP_PX
        if found[number] is not None or not close.any():
            continue
        near, count = np.unique(nearest[segment.rows, segment.columns][close], return_counts=True)
        for other in near[np.argsort(-count)][:NEIGHBOURS]:
            if np.abs(colors[number] - colors[int(other)]).max() > LIKE_LEVELS:
                continue
            assignment = found[int(other)]
            assert assignment is not None  # or it would not be the nearest
            if _may_have(segment, assignment, known) and not known.is_false(segment, assignment):
                taken[number] = assignment
                break
    return taken


def _may_have(segment: Segment, assignment: Assignment, known: PlaneSet) -> bool:
    if assignment.far:
        return lies_far(segment, known.photos)
    step = max(1, len(segment.pixels) // VOTING_PIXELS)
    inverse = assignment.inverse_depths(known.on_planes(segment, assignment)[::step])
    votes = known.photos.votes(segment.view, segment.pixels[::step], inverse)
    return votes.like >= LEAST_LIKE and votes.through <= MOST_THROUGH_LATER


# -- Depth maps whose plain parts lie on planes (docs/method.md, section 11.12) -------------------


_logger = logging.getLogger(__name__)

LEAST_UNKNOWN = 0.4
"""Share of a large segment's pixels without confirmed depth from which it is looked into."""

TURNS = 3  # Turns of assigning segments and fitting planes; the planes are aligned after the last.
LEAST_VIEWS = 2  # photos whose segments a plane needs after the first turn
NORMAL_COSINE = 0.95  # of a confirmed pixel's normal with that of a plane it is fitted to
FITTED_SHARE = 0.03  # distance of such a pixel from the plane over that from the camera, at most
FITTED_PIXELS, LEAST_FITTED = 1500, 300
"""Of a segment at most; known depths of any normal are taken where a plane has fewer in all."""

GROWN_PX, GROWN_LEVELS = 4.5, 6.0
"""Pixels so near a filled segment whose colour is so like that of the nearest smooth part of it lie
on its plane, too. Windows there see the thing before the plane, and give them its depth."""
GROWN_SMOOTHING_PX = 1.0

CHECKED_SHARE = 0.015
"""Largest relative difference to a depth of another photo, known or filled, that agrees."""
AGREEING_PER_THROUGH, AGREEING_PER_NEARER = 2, 0.5
"""Photos that must agree with a filled pixel for each that sees through it or shows something
before it."""

KEPT_SHARE = 0.003  # a confirmed depth that differs less from the plane is kept
FILLED_CONFIDENCE, FILLED_AGREEING = 0.5, 2

BEHIND_MARGIN_PX, BEHIND_VIEWS, BEHIND_PER_AGREEING = 2, 2, 2
"""Photos that must see a plane or something far away behind a confirmed point, so far from its
border, for the point to be none; and photos whose own depth agrees with it that each outweighs. A
plane that takes in a bit of a thing of like colour in two photos must not erase it from thirty."""

_NOBODY, _FAR = -1, -2
"""Owners of pixels that lie on no plane: nothing is known, or too far away for parallax."""


def fill_plain_parts(
    depth_maps: Sequence[DepthMap], points: np.ndarray, progress: Progress, *, seed: int = 0
) -> list[DepthMap]:
    """Return the depth maps with depths and normals of planes where there is no texture.

    Confirmed depths within filled parts that differ from the plane are replaced. Those within
    large plain parts without a plane lose their confirmation: they are borrowed from what lies
    beside. So do those that other photos see through, onto a plane or onto what lies too far away
    for parallax, as the sky.

    The sparse points (n, 3) are in the scene frame; progress is told once, at its end, and checked
    for cancellation.
    """
    if len(depth_maps) < LEAST_VIEWS:
        return list(depth_maps)
    random = np.random.default_rng([seed, 7])
    segments = segments_of(depth_maps, points)
    tried = [s for s in segments if s.large and s.unknown >= LEAST_UNKNOWN]
    if not tried:
        return list(depth_maps)
    progress.update(1.0, "looking for planes of walls and ground")
    photos = packed(depth_maps, random)
    known = PlaneSet(_proposals(tried, photos, random, progress), photos)
    for turn in range(TURNS):
        found = _assigned(tried, known, progress, first=turn == 0)
        if turn + 1 < TURNS:
            known = PlaneSet(pooled(_fitted(known, tried, found, depth_maps)), photos)
    aligner = Aligner(photos, segments, random, progress)
    known = PlaneSet(_aligned(known, tried, found, aligner, progress), photos, aligner)
    found = _assigned(tried, known, progress, first=False)
    every = [*tried, *(s for s in segments if not s.large)]
    found = [*found, *[None] * (len(every) - len(tried))]
    found = continued(every, found, known)
    found = [
        Assignment(()) if one is None and segment.large and lies_far(segment, photos) else one
        for segment, one in zip(every, found, strict=True)
    ]
    found = continued(every, found, known)
    filled = _Filled(known)
    for segment, assignment in zip(every, found, strict=True):
        if assignment is not None:
            filled.put(segment, assignment)
    filled.grow()
    filled.check(progress)
    whole = sum(int((layer > 0).sum()) for layer in filled.inverse)
    _logger.info(
        "stereo: %d planes through plain parts, %.0f %% of the pixels",
        len(known.planes), 100.0 * whole / sum(m.depth.size for m in depth_maps),
    )  # fmt: skip
    borrowed = numbered(tried, photos.depths.shape) > 0
    behind = filled.behind()
    return [
        filled.applied(depth_map, view, borrowed, behind)
        for view, depth_map in enumerate(depth_maps)
    ]


def _proposals(
    segments: Sequence[Segment], photos: PackedPhotos, random: np.random.Generator,
    progress: Progress,
) -> list[Plane]:  # fmt: skip
    found: list[Plane] = []
    for segment in segments:
        progress.check()
        found += proposed_planes(segment, photos.cameras[segment.view], random)
    return pooled(found)


def _assigned(
    segments: Sequence[Segment], known: PlaneSet, progress: Progress, *, first: bool
) -> list[Assignment | None]:
    found = []
    for segment in segments:
        progress.check()
        found.append(assigned(segment, known, first=first))
    return found


def _fitted(
    on: PlaneSet, segments: Sequence[Segment], found: Sequence[Assignment | None],
    depth_maps: Sequence[DepthMap],
) -> list[Plane]:  # fmt: skip
    """Return the planes of several photos, fitted to the confirmed pixels that are tilted alike."""
    result = []
    for number, plane in enumerate(on.planes):
        exact: list[tuple[np.ndarray, np.ndarray]] = []
        known: list[tuple[np.ndarray, np.ndarray]] = []
        views, support = set(), 0.0
        for segment, assignment in zip(segments, found, strict=True):
            if assignment is None or number not in assignment.planes:
                continue
            camera = on.photos.cameras[segment.view]
            on_plane = with_ones(segment.places) @ image_plane(plane, camera)
            near = np.abs(on_plane / segment.inverse_depths - 1.0) < SPEAKING_SHARE
            if near.sum() < 8:
                continue
            views.add(segment.view)
            support += float(segment.weights[near].sum())
            exact.append(_tilted_alike(plane, segment, depth_maps[segment.view]))
            inverse = segment.inverse_depths[near]
            at = lifted_pixels(camera, segment.places[near], inverse)
            known.append((at, segment.weights[near] * inverse**2))
        if len(views) < LEAST_VIEWS:
            continue
        if sum(len(part[0]) for part in exact) < LEAST_FITTED:
            exact = known + exact
        points, weights = (np.concatenate(parts) for parts in zip(*exact, strict=True))
        evidence = replace(
            plane, points=points, weights=weights, support=support, views=frozenset(views)
        )
        result.append(refined(evidence))
    return result


def _tilted_alike(
    plane: Plane, segment: Segment, depth_map: DepthMap
) -> tuple[np.ndarray, np.ndarray]:
    """Return confirmed points of a segment that lie on a plane and have its normal.

    Of the segment alone: what hangs on a wall is textured, parallel to it, and before it.
    """
    camera = depth_map.camera
    confirmed = depth_map.confidence[segment.rows, segment.columns] > 0
    row, column = segment.rows[confirmed], segment.columns[confirmed]
    depth = depth_map.depth[row, column].astype(np.float64)
    points = lifted_pixels(camera, segment.pixels[confirmed], 1.0 / depth)
    away = np.sign(plane.offset - plane.normal @ camera.center)
    cosine = -away * (depth_map.normal[row, column] @ plane.normal)
    distance = np.abs(points @ plane.normal - plane.offset)
    near = distance < FITTED_SHARE * np.linalg.norm(points - camera.center, axis=1)
    chosen = np.flatnonzero((cosine > NORMAL_COSINE) & near)
    chosen = chosen[:: max(1, len(chosen) // FITTED_PIXELS)]
    weights = depth_map.confidence[row, column][chosen] / depth[chosen] ** 2
    return points[chosen], weights


def _aligned(
    known: PlaneSet, segments: Sequence[Segment], found: Sequence[Assignment | None],
    aligner: Aligner, progress: Progress,
) -> list[Plane]:  # fmt: skip
    """Return the planes where the texture of their segments matches; those of no surface go."""
    parts: list[list[Part]] = [[] for _ in known.planes]
    for segment, assignment in zip(segments, found, strict=True):
        if assignment is not None:
            for number, part in known.parts(segment, assignment):
                parts[number].append(part)
    result = []
    for plane, own in zip(known.planes, parts, strict=True):
        progress.check()
        moved = aligner.aligned(plane, own)
        if moved is not None:
            result.append(moved)
    return pooled(result, fit=False)


class _Filled:
    """Inverse depths on planes, 0 elsewhere, and which plane."""

    def __init__(self, known: PlaneSet) -> None:
        self.known, self.photos, self.planes = known, known.photos, known.planes
        shapes = [(camera.height, camera.width) for camera in self.photos.cameras]
        self.inverse = [np.zeros(shape) for shape in shapes]
        self.owner = [np.full(shape, _NOBODY, np.int32) for shape in shapes]

    def put(self, segment: Segment, assignment: Assignment) -> None:
        """Fill a segment."""
        if assignment.far:
            self.owner[segment.view][segment.rows, segment.columns] = _FAR
            return
        each = self.known.on_planes(segment, assignment)
        at = (segment.rows, segment.columns)
        self.inverse[segment.view][at] = np.maximum(assignment.inverse_depths(each), 0.0)
        self.owner[segment.view][at] = np.array(assignment.planes)[assignment.owners(each)]

    def grow(self) -> None:
        """Fill pixels beside filled segments that look like them."""
        for view, camera in enumerate(self.photos.cameras):
            owner = self.owner[view]
            if (owner == _NOBODY).all():
                continue
            distance, nearest = ndimage.distance_transform_edt(
                owner == _NOBODY, return_indices=True
            )
            row, column = np.nonzero((distance > 0) & (distance <= GROWN_PX))
            near_row, near_column = nearest[:, row, column]
            image = self.photos.images[view, : camera.height, : camera.width].astype(np.float32)
            smooth = ndimage.gaussian_filter(image, (GROWN_SMOOTHING_PX, GROWN_SMOOTHING_PX, 0))
            difference = np.abs(image[row, column] - smooth[near_row, near_column]).max(-1)
            like = difference < GROWN_LEVELS
            row, column = row[like], column[like]
            number = owner[near_row[like], near_column[like]]
            owner[row, column] = number
            for plane in np.unique(number[number >= 0]):
                own = number == plane
                pixels = np.stack([column[own], row[own]], 1).astype(np.float64)
                inverse = with_ones(pixels) @ image_plane(self.planes[plane], camera)
                self.inverse[view][row[own], column[own]] = np.maximum(inverse, 0.0)

    def check(self, progress: Progress) -> None:
        """Empty the pixels that other photos do not agree with."""
        known = self.photos.depths.copy()
        for view, inverse in enumerate(self.inverse):
            row, column = np.nonzero(inverse > LEAST_INVERSE_DEPTH)
            known[view][row, column] = 1.0 / inverse[row, column]
            known[view][self._padded(self.owner[view] == _FAR)] = FAR_DISTANCE
        photos = self.photos.with_depths(known)
        for view, inverse in enumerate(self.inverse):
            progress.check()
            row, column = np.nonzero(inverse > LEAST_INVERSE_DEPTH)
            pixels = np.stack([column, row], 1).astype(np.float64)
            counts = photos.counts(view, pixels, inverse[row, column], CHECKED_SHARE)
            agree = counts[:, AGREEING]
            good = (agree > 0) & (agree > AGREEING_PER_THROUGH * counts[:, THROUGH])
            good &= agree >= AGREEING_PER_NEARER * counts[:, NEARER]
            kept = np.zeros_like(inverse)
            kept[row[good], column[good]] = inverse[row[good], column[good]]
            self.inverse[view] = kept

    def seen_through(self, depth_map: DepthMap, view: int, behind: PackedPhotos) -> np.ndarray:
        """Return (h, w) bool: confirmed, on no plane, and photos see something behind the point."""
        found = np.zeros(depth_map.depth.shape, bool)
        row, column = np.nonzero((depth_map.confidence > 0) & (self.owner[view] < 0))
        if len(row):
            pixels = np.stack([column, row], 1).astype(np.float64)
            inverse = 1.0 / depth_map.depth[row, column].astype(np.float64)
            through = behind.counts(view, pixels, inverse)[:, THROUGH]
            asked = np.flatnonzero(through >= BEHIND_VIEWS)
            agree = self.photos.counts(view, pixels[asked], inverse[asked])[:, AGREEING]
            lost = asked[BEHIND_PER_AGREEING * through[asked] > agree]
            found[row[lost], column[lost]] = True
        return found

    def behind(self) -> PackedPhotos:
        """Return the photos with depths of planes and what is far alone, but for their borders."""
        known = np.zeros_like(self.photos.depths)
        for view, (inverse, owner) in enumerate(zip(self.inverse, self.owner, strict=True)):
            far = owner == _FAR
            inner = ndimage.binary_erosion(
                far | (inverse > LEAST_INVERSE_DEPTH), iterations=BEHIND_MARGIN_PX
            )
            depth = np.where(far, FAR_DISTANCE, 1.0 / np.maximum(inverse, LEAST_INVERSE_DEPTH))
            known[view, : far.shape[0], : far.shape[1]] = np.where(inner, depth, 0.0)
        return self.photos.with_depths(known)

    def _padded(self, layer: np.ndarray) -> np.ndarray:
        padded = np.zeros(self.photos.depths.shape[1:], bool)
        padded[: layer.shape[0], : layer.shape[1]] = layer
        return padded

    def applied(
        self, depth_map: DepthMap, view: int, borrowed: np.ndarray, behind: PackedPhotos
    ) -> DepthMap:
        """Return a depth map with what is filled and without what is borrowed."""
        inverse, camera = self.inverse[view], depth_map.camera
        confirmed = depth_map.confidence > 0
        filled = inverse > LEAST_INVERSE_DEPTH
        filled &= ~(confirmed & (np.abs(depth_map.depth * inverse - 1.0) < KEPT_SHARE))
        if depth_map.mask is not None:
            filled &= depth_map.mask
        depth, normal = depth_map.depth.copy(), depth_map.normal.copy()
        depth[filled] = 1.0 / inverse[filled]
        for number in np.unique(self.owner[view][filled]):
            plane = self.planes[number]
            away = np.sign(plane.offset - plane.normal @ camera.center)
            normal[filled & (self.owner[view] == number)] = -away * plane.normal
        lost = borrowed[view, : camera.height, : camera.width] & (inverse <= LEAST_INVERSE_DEPTH)
        far = (self.owner[view] == _FAR) | self.seen_through(depth_map, view, behind)
        if depth_map.mask is not None:
            far &= depth_map.mask
        confidence = np.where(lost | far, np.float32(0), depth_map.confidence)
        confidence[filled] = FILLED_CONFIDENCE
        agreeing = np.where(filled, np.uint8(FILLED_AGREEING), depth_map.agreeing)
        return replace(
            depth_map, depth=depth, normal=normal, confidence=confidence,
            agreeing=np.where(far, np.uint8(0), agreeing),
            cost=np.where(far, WORST_COST, depth_map.cost),
            free=behind.depths[view, : camera.height, : camera.width]
            * (np.float32(1) if depth_map.mask is None else depth_map.mask),
        )  # fmt: skip
