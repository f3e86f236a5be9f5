# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam for values of single photos: exposures, camera poses.

A step moves the values of one photo only, so that each photo has its own moments and count of
steps, and the rate follows from how many turns a photo has.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

BETAS = (0.9, 0.99)
"""Decay rates of the moments. A photo has only some dozens of steps in a short run, and its
gradient, a mean over all its pixels, has little noise: a shorter memory than 0.999 works better."""

_STATE = ("first", "second", "steps")


def photo_rate(
    iteration: int,
    iterations: int,
    photos: int,
    *,
    travel: float,
    bounds: tuple[float, float],
    last_share: float,
) -> float:
    """Return the learning rate of an iteration.

    Parameters
    ----------
    photos : int
        Number of photos that take turns.
    travel : float
        Total of a photo's steps if its rate stayed at the first one.
    bounds : (float, float)
        Smallest and largest first rate.
    last_share : float
        Ratio of the last rate to the first; between them the rate falls log-linearly.
    """
    turns = max(1.0, iterations / max(1, photos))
    first = min(bounds[1], max(bounds[0], travel / turns))
    return first * last_share ** min(1.0, iteration / max(1, iterations))


class PhotoAdam:
    """Moments of the values of all photos.

    Parameters
    ----------
    count : int
        Number of the scene's views.
    values : int
        Number of values per view.
    dtype : numpy dtype
        Of the moments.
    epsilon : float
        Added to the root of the second moment.
    """

    def __init__(self, count: int, values: int, dtype: type[np.floating], epsilon: float) -> None:
        self.first = np.zeros((count, values), dtype)
        self.second = np.zeros((count, values), dtype)
        self.steps = np.zeros(count, np.int64)
        self._dtype, self._epsilon = dtype, epsilon

    def step(self, view: int, gradient: np.ndarray, rate: float) -> np.ndarray:
        """Take in a photo's (values,) gradient; return the (values,) float64 to subtract."""
        gradient = gradient.astype(self._dtype)
        self.steps[view] += 1
        taken = int(self.steps[view])
        shares = [self._dtype(1.0 - beta) for beta in BETAS]
        self.first[view] += shares[0] * (gradient - self.first[view])
        self.second[view] += shares[1] * (gradient**2 - self.second[view])
        mean = self.first[view].astype(np.float64) / (1.0 - BETAS[0] ** taken)
        size = np.sqrt(self.second[view].astype(np.float64) / (1.0 - BETAS[1] ** taken))
        return rate * mean / (size + self._epsilon)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays that the next step depends on, by name."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over arrays of :meth:`to_arrays`.

        Raises
        ------
        KeyError, ValueError
            An array is missing, or its shape or type is another.
        """
        for name in _STATE:
            own, given = getattr(self, name), arrays[name]
            if given.shape != own.shape or given.dtype != own.dtype:
                raise ValueError(f"{name} of the photos' steps: {given.dtype} {given.shape}")
            own[...] = given
