# SPDX-License-Identifier: GPL-3.0-or-later
"""How bright other photos show a surface, measured where they agree (docs/method.md, section 11.2).

A window on a smooth plain surface shows a ramp of shading, and a ramp correlates with itself at any
shift. How bright it is does tell the shift, as far as light and exposure are the same in both
photos.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from .plane_kernels import NEAREST_Z

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


def brightness_of(
    means: np.ndarray,
    inverse_depths: np.ndarray,
    confirmed: np.ndarray,
    maps: np.ndarray,
    other_means: list[np.ndarray],
) -> np.ndarray:
    """Return (s, 2) float32: gain and rate of each source of a photo.

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
