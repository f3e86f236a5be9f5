# SPDX-License-Identifier: GPL-3.0-or-later
"""Which sources confirm the depth of a pixel, and how bright they show it.

See docs/method.md, sections 11.4 and 11.2.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from ..kernels.compiled import kernel
from .plane_kernels import F32, HALF, NEAREST_Z, ONE, ZERO, back_error_px

AGREEING_PX = F32(1)
AGREEING_SHARE = F32(0.01)
"""Largest forward-backward error and relative difference in depth of two views that agree."""

LEAST_LEVEL = 16.0
"""Darker pixels tell no gain."""

LEAST_TOLERANCE_LEVELS = 2.0
TOLERANCE_PER_SPREAD = 3.0
"""Difference in grey levels that is as bad as any larger one: so many times the median difference
of agreeing pixels, and at least that."""

LEAST_PAIRS = 50
"""Agreeing pixels of two photos below which their brightness is not compared."""

MOST_PAIRS = 20_000
"""Pixels of a photo that are looked at, at most."""

GAIN, RATE = 0, 1
"""Columns of a brightness: factor of the source's grey levels, and one over the tolerance, 0 where
brightness is not compared."""

NO_BRIGHTNESS = np.array([1.0, 0.0], np.float32)


@kernel(fast=True)
def confirm(
    planes: np.ndarray, maps: np.ndarray, back_maps: np.ndarray, inverse_depths: np.ndarray,
    all_planes: np.ndarray, sizes: np.ndarray, bases: np.ndarray, stride: float,
    sources: np.ndarray, means: np.ndarray,
) -> None:  # fmt: skip
    """Find the sources whose own depth agrees with that of each pixel.

    Parameters
    ----------
    planes : (h, w, 3) float32
    maps, back_maps : (s, 12) float32
    inverse_depths : (p,) float32, all_planes : (p, 3) float32
        Of all pixels of all photos.
    sizes, bases, stride
        Of the sources (:func:`~.sweep.sweep`).
    sources : (h, w) uint8
        Written: bits of those that agree.
    means : (h, w) float32
        Written: mean inverse depth over the pixel and those.
    """
    for row in range(planes.shape[0]):
        for column in range(planes.shape[1]):
            u, v, w = F32(column), F32(row), planes[row, column, 0]
            total, count, bits = w, ONE, 0
            for s in range(maps.shape[0]):
                m = maps[s]
                z = m[6] * u + m[7] * v + m[8] + w * m[11]
                if z <= NEAREST_Z:
                    continue
                x = (m[0] * u + m[1] * v + m[2] + w * m[9]) / z
                y = (m[3] * u + m[4] * v + m[5] + w * m[10]) / z
                if x < ZERO or y < ZERO or x >= sizes[s, 0] or y >= sizes[s, 1]:
                    continue
                error_px = back_error_px(s, u, v, x, y, back_maps, inverse_depths, bases[s], stride)
                if error_px > AGREEING_PX:
                    continue
                nearest_x, nearest_y = np.int32(x + HALF), np.int32(y + HALF)
                there = bases[s] + np.uint64(nearest_y * np.int32(stride) + nearest_x)
                other = inverse_depths[there]
                other += all_planes[there, 1] * (x - F32(nearest_x))
                other += all_planes[there, 2] * (y - F32(nearest_y))
                if abs(other * z - w) > AGREEING_SHARE * w:
                    continue
                bits |= 1 << s
                total += other * z
                count += ONE
            sources[row, column] = np.uint8(bits)
            means[row, column] = total / count


def brightness_of(
    means: np.ndarray,
    inverse_depths: np.ndarray,
    confirmed: np.ndarray,
    maps: np.ndarray,
    other_means: list[np.ndarray],
) -> np.ndarray:
    """Return (s, 2) float32: gain and rate of each source of a photo.

    A window on a smooth plain surface shows a ramp of shading, and a ramp correlates with itself at
    any shift. How bright it is does tell the shift, as far as light and exposure are the same.

    Parameters
    ----------
    means : (h, w) float32
        Mean grey level around each pixel.
    inverse_depths : (h, w) float32
        Where ``confirmed`` is not 0.
    confirmed : (h, w) uint8
        Bits of the sources whose own depth agrees.
    maps : (s, 12) float32
        From the photo to its sources (:mod:`~.plane_kernels`).
    other_means : list of (h', w') float32
        As ``means``, of the sources.
    """
    found = np.tile(NO_BRIGHTNESS, (len(maps), 1))
    row, column = np.nonzero(confirmed)
    step = max(1, -(-len(row) // MOST_PAIRS))
    row, column = row[::step], column[::step]
    pixels = np.stack([column, row, np.ones_like(row)], 1).astype(np.float64)  # (n, 3)
    inverse = inverse_depths[row, column].astype(np.float64)
    for number, (m, there) in enumerate(zip(maps.astype(np.float64), other_means, strict=True)):
        place = pixels @ m[:9].reshape(3, 3).T + inverse[:, None] * m[9:]  # (n, 3)
        good = ((confirmed[row, column] >> number) & 1 > 0) & (place[:, 2] > NEAREST_Z)
        at = place[good, :2] / place[good, 2:]
        inside = ((at >= 0) & (at <= (there.shape[1] - 1, there.shape[0] - 1))).all(1)
        own = means[row[good][inside], column[good][inside]]
        other = ndimage.map_coordinates(there, at[inside, ::-1].T, order=1)
        bright = (own >= LEAST_LEVEL) & (other >= LEAST_LEVEL)
        own, other = own[bright], other[bright]
        if len(own) < LEAST_PAIRS:
            continue
        gain = np.exp(np.median(np.log(own / other)))
        spread = np.median(np.abs(gain * other - own))
        tolerance = max(LEAST_TOLERANCE_LEVELS, TOLERANCE_PER_SPREAD * spread)
        found[number] = gain, 1.0 / tolerance
    return found
