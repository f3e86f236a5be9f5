# SPDX-License-Identifier: GPL-3.0-or-later
"""Sharpness of frames: fine detail in each direction, and which frames lack it.

docs/method.md, section 14.2.
"""

from __future__ import annotations

import numpy as np

SHARPNESS_SIDE_PX = 960
"""Long side of the pictures that sharpness is measured in."""
_COARSE = 4
"""Pixels of the coarse picture are this many wide: usual blur leaves its detail."""
_NOISE_STEP = 3
"""Noise is looked for at every third pixel of every third row."""
_LEAST = 1e-2
"""Detail below this, levels squared, is none: noise and rounding."""
_LOCAL_S = 2.0
_LOCAL_MOTION = 0.25
"""Frames whose content is alike: so near in time, seconds, and so little moved, sides."""
_REFERENCE_PERCENTILE = 90.0
_BLURRED_LOCALLY = np.log(0.5)
"""Less than half of the detail, in some direction, of the sharp frames around it."""
_BLURRED_OVERALL = np.log(0.2)
"""Fine detail against coarse, as a share of that of the video's sharp frames: finds blur that
lasts so long that no frame around it is sharp."""


def details(grey: np.ndarray) -> np.ndarray:
    """Return (2, 4) float64: log energy of second differences in each direction, fine and coarse.

    Across, down and the two diagonals, since camera shake takes the detail of one direction.

    Parameters
    ----------
    grey : (h, w) float32
        Brightness, 0 to 255.
    """
    height, width = (side - side % _COARSE for side in grey.shape)
    cut = grey[:height, :width]
    coarse = cut.reshape(height // _COARSE, _COARSE, width // _COARSE, _COARSE).mean((1, 3))
    fine = _energies(grey) - 6.0 * _noise_variance(grey)  # 1 + 4 + 1: of (1, -2, 1) on noise
    return np.log(np.maximum(np.stack([fine, _energies(coarse)]), _LEAST))


def relative_sharpness(details: np.ndarray, times_s: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return the detail of each frame over that of the sharp frames around it, (n,) log.

    The worst direction counts. Only frames with the same content are compared.

    Parameters
    ----------
    details : (n, 2, 4) float64
        Of :func:`details`.
    times_s, ways : (n,) float64
        Time, and way of the picture so far in its sides.
    """
    fine = details[:, 0]
    relative = np.zeros(len(fine))
    first = np.searchsorted(times_s, times_s - _LOCAL_S)
    last = np.searchsorted(times_s, times_s + _LOCAL_S, side="right")
    first = np.maximum(first, np.searchsorted(ways, ways - _LOCAL_MOTION))
    last = np.minimum(last, np.searchsorted(ways, ways + _LOCAL_MOTION, side="right"))
    for i in range(len(fine)):
        around = fine[first[i] : last[i]]
        reference = np.percentile(around, _REFERENCE_PERCENTILE, axis=0)
        relative[i] = (fine[i] - reference).min()
    return relative


def are_blurred(details: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Tell which frames are blurred, (n,) bool; parameters as of :func:`relative_sharpness`."""
    ratio = details[:, 0] - details[:, 1]  # (n, 4)
    overall = (ratio - np.percentile(ratio, _REFERENCE_PERCENTILE, axis=0)).min(1)
    return (relative < _BLURRED_LOCALLY) | (overall < _BLURRED_OVERALL)


def _energies(grey: np.ndarray) -> np.ndarray:
    """Return the mean squared second differences across, down and along the diagonals, (4,)."""
    middle = 2.0 * grey[1:-1, 1:-1]
    pairs = (
        (grey[1:-1, :-2], grey[1:-1, 2:]), (grey[:-2, 1:-1], grey[2:, 1:-1]),
        (grey[:-2, :-2], grey[2:, 2:]), (grey[:-2, 2:], grey[2:, :-2]),
    )  # fmt: skip
    return np.array([float(np.mean((a + b - middle) ** 2)) for a, b in pairs])


def _noise_variance(grey: np.ndarray) -> float:
    """Estimate the variance of noise by a mask that edges and slopes leave 0, mostly."""
    rows = grey[:-2] - 2.0 * grey[1:-1] + grey[2:]
    both = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    median = float(np.median(np.abs(both[::_NOISE_STEP, ::_NOISE_STEP])))
    return (1.4826 * median / 6.0) ** 2  # of a normal distribution; the mask has the norm 6
