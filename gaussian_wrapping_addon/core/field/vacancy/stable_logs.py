# SPDX-License-Identifier: GPL-3.0-or-later
"""Numerically stable log G and log(1 - G)."""

from __future__ import annotations

import numpy as np

LOG_HALF = -0.6931471805599453


def log_gaussian(log_alpha: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return ``log G = log alpha - q / 2``.

    Parameters
    ----------
    log_alpha : (...) array, <= 0
    q : (...) array
        Squared Mahalanobis distance, >= 0.
    """
    return np.asarray(log_alpha, np.float64) - 0.5 * np.asarray(q, np.float64)


def log_one_minus(log_g: np.ndarray) -> np.ndarray:
    """Return ``log(1 - G)`` of ``log G``.

    Parameters
    ----------
    log_g : (...) array, <= 0

    Returns
    -------
    (...) float64, <= 0
        ``-inf`` where ``log_g`` is 0 (docs/method.md, section 5.4).
    """
    log_g = np.asarray(log_g, np.float64)
    # Both forms are computed and one is chosen: for small G, 1 - G rounds, which log1p avoids; for
    # G near 1, exp(log G) rounds, which expm1 avoids.
    with np.errstate(divide="ignore"):
        near_zero = np.log1p(-np.exp(log_g))
        near_one = np.log(-np.expm1(log_g))
    return np.where(log_g < LOG_HALF, near_zero, near_one)
