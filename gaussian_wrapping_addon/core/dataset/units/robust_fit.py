# SPDX-License-Identifier: GPL-3.0-or-later
"""Robust similarity from scene points to metric points, with its uncertainty.

Errors of GPS are not known beforehand: the inlier threshold is halved for as long as enough pairs
agree (docs/method.md, section 13.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...errors import DatasetError
from ..frames.similarity_fit import fit_similarity, umeyama_ransac
from ..similarity import Similarity

MIN_AGREEING_SHARE = 2.0 / 3.0
"""Share of the pairs that a threshold has to keep: with fewer, most of a set may be wrong alike."""
INLIER_SIGMAS = 3.0
"""Pairs within this many standard deviations of the final fit are used."""
ITERATIONS = 2000
"""Triples: with a third of outliers, all fail with a probability of 1e-300."""
_ROUNDS = 10
_PARAMETERS = 7
"""Of a similarity."""


@dataclass(frozen=True)
class RobustFit:
    """A similarity, the pairs that it rests on, and how well these determine it."""

    target_from_source: Similarity
    used: np.ndarray
    """(n,) bool."""
    residuals: np.ndarray
    """(n,) distances of all pairs, units of the target."""
    sigma: float
    """Standard deviation of a coordinate of the used pairs, units of the target; at least the
    noise that was stated beforehand."""
    scale_error: float
    """Relative standard deviation of the scale."""
    tilt_error_deg: float
    """Standard deviation of the rotation about its least determined axis."""
    reach: float
    """Root mean square distance of the used pairs from their middle, units of the target."""
    lever: float
    """The same from the line through them that they lie closest to."""

    @property
    def median(self) -> float:
        """Median residual of all pairs, units of the target."""
        return float(np.median(self.residuals))


def robust_similarity(
    source: np.ndarray,
    target: np.ndarray,
    *,
    largest_error: float,
    noise: float,
) -> RobustFit:
    """Fit a similarity to pairs of which up to a third are wrong.

    Parameters
    ----------
    source, target : (n, 3) float64
    largest_error : float
        Error, units of the target, beyond which a pair is wrong in any case.
    noise : float
        Smallest standard deviation of a target coordinate to reckon with, units of the target:
        residuals of few pairs may be small by chance.

    Raises
    ------
    DatasetError
        Fewer than three pairs, all on one line or in one place, or no agreement of two thirds.
    """
    needed = max(3, math.ceil(MIN_AGREEING_SHARE * len(source)))
    threshold, best = largest_error, None
    while threshold >= noise:
        try:
            found = umeyama_ransac(
                source, target, threshold=threshold, iterations=ITERATIONS, seed=0, with_scale=True
            )
        except DatasetError:
            if best is None:
                raise
            break  # a threshold below the errors leaves nothing
        if int(found.inliers.sum()) < needed:
            break
        best = found
        threshold *= 0.5
    if best is None:
        raise DatasetError(
            f"Fewer than two thirds of the {len(source)} positions agree within "
            f"{largest_error:.3g} m."
        )
    return refined_similarity(source, target, best.inliers, noise=noise)


def refined_similarity(
    source: np.ndarray, target: np.ndarray, used: np.ndarray, *, noise: float
) -> RobustFit:
    """Refit to the used pairs until these are all those within :data:`INLIER_SIGMAS`.

    Parameters as of :func:`robust_similarity`; ``used`` (n,) bool is where to begin.
    """
    for _ in range(_ROUNDS):
        fit = fit_similarity(source[used], target[used], True)
        residuals = np.linalg.norm(fit.points(source) - target, axis=1)
        sigma = _sigma(residuals[used], noise)
        within = residuals <= INLIER_SIGMAS * math.sqrt(3.0) * sigma
        if (within == used).all() or within.sum() < 3:
            break
        used = within
    fit = fit_similarity(source[used], target[used], True)
    residuals = np.linalg.norm(fit.points(source) - target, axis=1)
    sigma = _sigma(residuals[used], noise)
    local = fit.points(source[used])
    local = local - local.mean(0)
    extents = np.linalg.eigvalsh(local.T @ local)  # ascending
    # About an axis, a rotation moves points by their distance from it; the least determined axis
    # is that of the largest extent.
    lever = math.sqrt(max(float(extents[0] + extents[1]), 0.0))
    reach = math.sqrt(float(extents.sum()))
    tilt = math.degrees(sigma / lever) if lever > 0.0 else math.inf
    root = math.sqrt(len(local))
    return RobustFit(fit, used, residuals, sigma, sigma / reach, tilt, reach / root, lever / root)


def _sigma(residuals: np.ndarray, noise: float) -> float:
    """Return the standard deviation of one coordinate, from (n,) distances."""
    freedom = max(3 * len(residuals) - _PARAMETERS, 1)
    return max(math.sqrt(float((residuals**2).sum()) / freedom), noise)
