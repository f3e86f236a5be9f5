# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth maps whose plain parts lie on planes (docs/method.md, section 11.12)."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from ...progress import Progress
from ..depth_maps import DepthMap
from ..matching_cost import WORST_COST
from .alignment import Aligner, Part
from .assignment import FAR_DISTANCE, Assignment, PlaneSet, assigned, continued, lies_far
from .candidates import SPEAKING_SHARE, proposed_planes
from .evidence import AGREEING, NEARER, THROUGH, PackedPhotos, packed
from .planes import (
    LEAST_INVERSE_DEPTH,
    Plane,
    image_plane,
    lifted_pixels,
    pooled,
    refined,
    with_ones,
)
from .segments import BORDER_PX, Segment, numbered, segments_of

_logger = logging.getLogger(__name__)

LEAST_UNKNOWN = 0.4
"""Share of a large segment's pixels without confirmed depth from which it is looked into."""

TURNS = 3
"""Turns of assigning segments and fitting planes; the planes are aligned after the last."""

LEAST_VIEWS = 2
"""Photos whose segments a plane needs after the first turn."""

NORMAL_COSINE = 0.95
"""Of a confirmed pixel's normal with that of a plane it is fitted to."""
FITTED_SHARE = 0.03
"""Distance of such a pixel from the plane over that from the camera, at most."""
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

KEPT_SHARE = 0.003
"""A confirmed depth that differs less from the plane is kept."""

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

    Parameters
    ----------
    depth_maps : sequence of DepthMap
    points : (n, 3) float64
        Sparse points, scene frame.
    progress : Progress
        Told once, at its end; checked for cancellation.
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
            tilted = _tilted_alike(plane, segment, depth_maps[segment.view])
            if len(tilted[0]):
                exact.append(tilted)
            else:
                inverse = segment.inverse_depths[near]
                points = lifted_pixels(camera, segment.places[near], inverse)
                known.append((points, segment.weights[near] * inverse**2))
        if len(views) < LEAST_VIEWS:
            continue
        if sum(len(part[0]) for part in exact) < LEAST_FITTED:
            exact = known + exact
        if not exact:
            continue
        evidence = Plane(
            plane.normal, plane.offset, plane.center,
            np.concatenate([part[0] for part in exact]),
            np.concatenate([part[1] for part in exact]),
            support, frozenset(views), plane.distance,
        )  # fmt: skip
        result.append(refined(evidence))
    return result


def _tilted_alike(
    plane: Plane, segment: Segment, depth_map: DepthMap
) -> tuple[np.ndarray, np.ndarray]:
    """Return confirmed points in and around a segment that lie on a plane and have its normal."""
    camera = depth_map.camera
    top, left = max(segment.rows.min() - BORDER_PX, 0), max(segment.columns.min() - BORDER_PX, 0)
    box = (
        slice(top, segment.rows.max() + BORDER_PX + 1),
        slice(left, segment.columns.max() + BORDER_PX + 1),
    )
    row, column = np.nonzero(depth_map.confidence[box] > 0)
    row, column = row + top, column + left
    depth = depth_map.depth[row, column].astype(np.float64)
    points = lifted_pixels(camera, np.stack([column, row], 1).astype(np.float64), 1.0 / depth)
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
        return dataclasses.replace(
            depth_map, depth=depth, normal=normal, confidence=confidence,
            agreeing=np.where(far, np.uint8(0), agreeing),
            cost=np.where(far, WORST_COST, depth_map.cost),
            free=behind.depths[view, : camera.height, : camera.width]
            * (np.float32(1) if depth_map.mask is None else depth_map.mask),
        )  # fmt: skip
