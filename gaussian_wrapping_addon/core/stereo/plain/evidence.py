# SPDX-License-Identifier: GPL-3.0-or-later
"""All photos packed, to ask them what they say about points on a plane."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...dataset.camera import Camera
from ...dataset.view_split import evenly_spaced
from ..depth_maps import DepthMap
from .evidence_kernels import (
    AGREEING,
    AGREEING_SHARE,
    ALIKE,
    NEARER,
    THROUGH,
    UNLIKE,
    count_votes,
)
from .planes import LEAST_INVERSE_DEPTH, lifted_pixels

MOST_ASKED = 40
"""Photos asked about the points of one; a regular choice of more."""

LEAST_SHOWN = 0.9
"""Share of the pixels that must show a plane; photos need not be asked about another."""

GAIN_PIXELS, LEAST_PAIRS = 600, 30
"""Confirmed pixels of a photo that gains are measured on, and least number of a pair of photos."""

_DARK = 4.0
"""Added to colours before ratios are taken, so that dark pixels do not decide."""


@dataclass(frozen=True)
class Votes:
    """What the other photos say about points, as shares of all that could contradict."""

    like: float
    """Depth agrees, or nothing is known there and the colour is like."""
    through: float
    """The depth there lies behind."""


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

        Parameters
        ----------
        pixels : (n, 2) float64
            Centres whole.
        inverse_depths : (n,) float64, positive
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
    photos = PackedPhotos(
        cameras,
        np.array([_projection(camera) for camera in cameras]),
        np.array([(camera.width, camera.height) for camera in cameras], np.int64),
        depths,
        images,
        np.ones((len(cameras), 3)),
    )
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


__all__ = [
    "AGREEING",
    "ALIKE",
    "NEARER",
    "THROUGH",
    "PackedPhotos",
    "Votes",
    "packed",
    "photos_asked",
]
