# SPDX-License-Identifier: GPL-3.0-or-later
"""A colour for every point in space: a checker over a picture with the spectrum of photos."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

VOLUME_SIDE = 64
"""Cells of the periodic volume; its octaves repeat it at finer scales."""
OCTAVES = ((1.0, 24.0), (4.3, 10.0), (17.1, 5.0))
"""Scale and standard deviation: amplitudes fall about as one over the frequency."""
PERIOD = 2.0
"""Side of the volume at the first octave, scene units."""
CHECKER_SIDE = 0.16
CHECKER_CONTRAST = 30.0
MIDDLE = 128.0


class SolidTexture:
    """Colours in [0, 255] as a function of the position, so that a surface needs no UVs.

    Slices of a volume whose power falls with the third power of the frequency have the spectrum
    of photographs (one over the square).
    """

    def __init__(self, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self._volumes = [_volume(random) for _ in range(3)]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return (n, 3) float64 colours of (n, 3) points."""
        checker = np.floor(points / CHECKER_SIDE + 0.31).astype(np.int64).sum(axis=1) & 1
        out = np.empty((len(points), 3))
        for channel, volume in enumerate(self._volumes):
            value = MIDDLE + CHECKER_CONTRAST * (2.0 * checker - 1.0)
            for scale, deviation in OCTAVES:
                places = (points * (scale * VOLUME_SIDE / PERIOD)).T
                value += deviation * map_coordinates(volume, places, order=1, mode="grid-wrap")
            out[:, channel] = value
        return out.clip(0.0, 255.0)


def _volume(random: np.random.Generator) -> np.ndarray:
    """Return a periodic (n, n, n) float32 volume of standard deviation 1."""
    frequency = np.fft.fftfreq(VOLUME_SIDE)
    radius2 = frequency[:, None, None] ** 2 + frequency[:, None] ** 2 + frequency[:VOLUME_SIDE] ** 2
    radius2[0, 0, 0] = np.inf
    noise = np.fft.fftn(random.normal(size=(VOLUME_SIDE,) * 3)) * radius2**-0.75
    volume = np.fft.ifftn(noise).real
    return (volume / volume.std()).astype(np.float32)
