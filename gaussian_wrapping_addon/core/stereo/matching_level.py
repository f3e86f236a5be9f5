# SPDX-License-Identifier: GPL-3.0-or-later
"""All photos at one level of the pyramid, packed for the kernels, and their planes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from ..dataset.camera import Camera
from ..imaging.luma import LUMA
from .consistency import NO_BRIGHTNESS, brightness_of, confirm
from .matching_cost import WORST_COST
from .sweep import sweep

_NEAREST = ((-1, 0), (0, -1), (1, 0), (0, 1))
_FAR_PX = (3, 5, 9, 7)
"""Distance of the two farther neighbours, in turn from sweep to sweep."""

_FIRST_SPAN, _LATER_SPAN = 0.1, 0.02
"""Relative change of the depth by the first refinement, while planes are random and later."""

_MEAN_PX = 5
"""Side of the window over which grey levels are averaged to compare the brightness of photos."""

_MOST_SEED = 2**32 - 1
"""Seeds of a sweep lie between 1 and this: the generator would stay at 0."""

NO_PRIOR = np.zeros((0, 0, 3), np.float32)
NO_DEPTHS = np.zeros(1, np.float32)


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
        Gain and rate of the sources of each photo (:func:`~.consistency.brightness_of`), after
        :meth:`compare_brightness`; until then it is not compared.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        greys: Sequence[np.ndarray],
        sources: Sequence[np.ndarray],
        depth_ranges: np.ndarray,
    ) -> None:
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
        self,
        view: int,
        turn: int,
        seed: int,
        *,
        fresh: bool = False,
        geometric: float = 0.0,
        inverse_depths: np.ndarray = NO_DEPTHS,
        prior: np.ndarray = NO_PRIOR,
    ) -> None:
        """Run one sweep over a photo.

        Parameters
        ----------
        turn : int
            Number of the sweep: it decides direction and farther neighbours.
        seed : int
        fresh, geometric, inverse_depths, prior
            As in :func:`~.sweep.sweep`.
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
        height, width = self.greys[view].shape
        last_row, last_column = (n - 1 for n in coarse.greys[view].shape)
        row, column = np.mgrid[:height, :width]
        above = np.minimum(row // 2, last_row), np.minimum(column // 2, last_column)
        planes = coarse.planes_of(view)[above]  # (h, w, 3)
        planes[..., 0] += planes[..., 1] * (0.5 * column - 0.25 - above[1])
        planes[..., 0] += planes[..., 2] * (0.5 * row - 0.25 - above[0])
        planes[..., 0] = planes[..., 0].clip(*self.depth_ranges[view])
        planes[..., 1:] *= 0.5
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
            lens_here, lens_there = _matrix(here), _matrix(there)
            maps.append(_map(lens_there, rotation, offset, lens_here))
            back_maps.append(_map(lens_here, rotation.T, -rotation.T @ offset, lens_there))
            sizes.append((there.width - 1, there.height - 1))
        bases = np.asarray(self.sources[view], np.uint64) * np.uint64(self._photo_pixels)
        return (
            np.array(maps, np.float32).reshape(-1, 12),
            np.array(back_maps, np.float32).reshape(-1, 12),
            np.array(sizes, np.float32).reshape(-1, 2),
            bases,
        )


def _matrix(camera: Camera) -> np.ndarray:
    """(3, 3) pixels from camera coordinates; centres of pixels at whole numbers."""
    return np.array(
        [[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]]
    )


def _lens(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5], np.float32)


def _map(
    lens_there: np.ndarray, rotation: np.ndarray, offset: np.ndarray, lens_here: np.ndarray
) -> np.ndarray:
    """(12,) of :mod:`~.plane_kernels`: a homography, and what depth adds."""
    homography = lens_there @ rotation @ np.linalg.inv(lens_here)
    return np.concatenate([homography.reshape(-1), lens_there @ offset])


def _visit(shape: tuple[int, ...], turn: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the order of the pixels, forwards and backwards in turn, and the neighbours."""
    order = np.arange(shape[0] * shape[1], dtype=np.int64)
    far = _FAR_PX[turn % len(_FAR_PX)]
    neighbours = np.array([*_NEAREST, (-far, 0), (0, -far)], np.int64)
    return (np.ascontiguousarray(order[::-1]) if turn % 2 else order), neighbours
