# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians in space that photos see through (docs/method.md, section 4.6)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ... import tolerances
from ...stereo.depth_priors import DepthPrior
from ...stereo.plain.evidence import photos_asked
from ...stereo.plain.evidence_kernels import AGREEING_SHARE, THROUGH_SHARE


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
    for prior in (priors[views[k]] for k in photos_asked(len(views))):
        shown, row, column, own = prior.camera.shown(means)
        through[shown] += prior.free[row, column] > (1.0 + THROUGH_SHARE) * own
        agreeing[shown] += np.abs(prior.known[row, column] - own) < AGREEING_SHARE * own
    near = np.linalg.norm(means, axis=1) < tolerances.FAR_RADIUS
    return near & (through >= least_views) & (through > agreeing)
