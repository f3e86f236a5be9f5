# SPDX-License-Identifier: GPL-3.0-or-later
"""Which plane, or which two, a plain segment lies on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from .alignment import Aligner, Part
from .candidates import FULL_SPREAD, LEAST_SPREAD, LEAST_WEIGHT, SPEAKING_SHARE, spreads
from .evidence import ALIKE, PackedPhotos
from .planes import Plane, image_plane, with_ones
from .segments import Segment

LEAST_BORDER = 0.12
"""Share of a segment's known depths, weighed, that its plane must explain."""

PAIR_GAIN = 0.06
"""Share that a second plane must explain besides."""

LEAST_LIKE = 0.85
"""Share of the other photos' votes that must not contradict a plane (:class:`~.evidence.Votes`)."""

MOST_THROUGH, MOST_THROUGH_LATER = 0.015, 0.03
"""Share of the votes that may see through a plane, at first and once planes are known from several
photos."""

LATER_SPREAD = 0.12
"""As :data:`~.candidates.LEAST_SPREAD`, once planes are known from several photos."""

FEW_VIEWS = 2.0
"""A plane of n views counts n / (n + this)."""

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


FAR_DISTANCE = 1e6
"""Of points that stand for what lies too far away for parallax, scene units."""

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

    Parameters
    ----------
    segment : Segment
    known : PlaneSet
    first : bool
        Planes are proposals of single segments still.
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
        found = [
            (self.shares[k], Assignment((k,)))
            for k in order
            if self.spreads[k] >= self.least_spread
        ]
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
    own: Sequence[int],
    segments: Sequence[Segment],
    found: Sequence[Assignment | None],
    colors: dict[int, np.ndarray],
    known: PlaneSet,
) -> dict[int, Assignment]:
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
        near, count = np.unique(
            nearest[segment.rows, segment.columns][close], return_counts=True
        )  # fmt: skip
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
