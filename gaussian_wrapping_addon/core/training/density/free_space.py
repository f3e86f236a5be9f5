# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians in space that photos see through (docs/method.md, section 4.6)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ... import tolerances
from ...stereo.depth_priors import DepthPrior

BEFORE_SHARE = 0.03
"""A Gaussian lies before a free depth if that is larger by this share at least."""

AGREEING_SHARE = 0.02
"""Largest relative difference of its depth and a confirmed one that agrees."""

MOST_ASKED = 40
"""Photos asked; a regular choice of more."""


def contradicted(
    means: np.ndarray, priors: Mapping[int, DepthPrior], least_views: int
) -> np.ndarray:
    """Tell which Gaussians stand where photos show nothing.

    Parameters
    ----------
    means : (n, 3) array
        Scene frame.
    priors : mapping of int to DepthPrior
        By view.
    least_views : int
        Photos that must see through a Gaussian; more of them than of those whose confirmed depth
        agrees with its own.

    Returns
    -------
    (n,) bool
        Never true beyond the smallest radius of the far shell: what lies there may be the sky.
    """
    means = np.asarray(means, np.float64)
    through, agreeing = (np.zeros(len(means), np.int32) for _ in range(2))
    views = sorted(priors)
    chosen = np.unique(np.linspace(0, len(views) - 1, min(MOST_ASKED, len(views))).astype(np.int64))
    for prior in (priors[views[k]] for k in chosen):
        pixels, depth = prior.camera.project(means)
        size = (prior.camera.width, prior.camera.height)
        shown = np.flatnonzero((depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1))
        column, row = pixels[shown].astype(np.int64).T
        own = depth[shown]
        through[shown] += prior.free[row, column] > (1.0 + BEFORE_SHARE) * own
        agreeing[shown] += np.abs(prior.known[row, column] - own) < AGREEING_SHARE * own
    near = np.linalg.norm(means, axis=1) < tolerances.FAR_RADIUS
    return near & (through >= least_views) & (through > agreeing)
