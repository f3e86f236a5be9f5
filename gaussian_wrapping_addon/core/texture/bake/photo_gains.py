# SPDX-License-Identifier: GPL-3.0-or-later
"""Gain of each photo and channel, from surface points seen by several photos."""

from __future__ import annotations

import numpy as np

MIN_GAIN_SPREAD = 0.02
"""Gains with a smaller spread of logarithms are due to noise and highlights and not applied."""
MAX_LOG_GAIN = 0.7
"""A factor of two either way; more is a mismatch and not an exposure."""
PRIOR_POINTS = 20.0
"""Weight of the prior gain 1, in points."""
DARKEST, BRIGHTEST = 10, 245
"""Values outside are clipped or noise and not used."""
ROUNDS = 20
ROBUST_LOG = 0.05


def solve_gains(colors: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit gains that equalise the photos' colours of the same points.

    Robust least squares of ``log c[i, p] = a[i] - log gain[p]`` by alternation, with weights
    ``1 / max(|residual|, 0.05)``. The median of the log gains is 0, so the texture has the exposure
    of most photos; with a mean of 0 and two groups of exposures, white in the darker photos would
    exceed 255.

    Parameters
    ----------
    colors : (n, photos, 3) uint8
        Colour of point i in photo p.
    valid : (n, photos) bool
        Whether the photo sees it.

    Returns
    -------
    gains : (photos, 3) float64
        Factors to multiply with; all 1 if exposures do not differ.
    spread : float
        Standard deviation of the fitted log gains.
    """
    photos = valid.shape[1]
    gains = np.ones((photos, 3))
    shared = valid.sum(axis=1) >= 2
    if not shared.any():
        return gains, 0.0
    log_gains = np.zeros((photos, 3))
    for channel in range(3):
        values = colors[shared, :, channel]
        usable = valid[shared] & (values >= DARKEST) & (values <= BRIGHTEST)
        values_log = np.log(np.maximum(values, 1).astype(np.float32))
        log_gains[:, channel] = _solve(values_log, usable)
        sees = usable.any(axis=0)
        if sees.any():
            log_gains[sees, channel] -= np.median(log_gains[sees, channel])
    spread = float(log_gains.std())
    if spread < MIN_GAIN_SPREAD:
        return gains, spread
    return np.exp(np.clip(log_gains, -MAX_LOG_GAIN, MAX_LOG_GAIN)), spread


def _solve(values: np.ndarray, usable: np.ndarray) -> np.ndarray:
    gain = np.zeros(values.shape[1])
    weight = usable.astype(np.float32)  # (n, photos)
    for _ in range(ROUNDS):
        total = np.maximum(weight.sum(axis=1), 1e-9)
        level = (weight * (values + gain)).sum(axis=1) / total  # (n,)
        offset = level[:, None] - values
        per_photo = weight.sum(axis=0)
        gain = (weight * offset).sum(axis=0) / (per_photo + PRIOR_POINTS)
        seen = per_photo > 0
        gain[seen] -= gain[seen].mean() if seen.any() else 0.0
        residual = np.abs(offset - gain)
        weight = usable * np.minimum(1.0, ROBUST_LOG / np.maximum(residual, 1e-6))
    return gain
