# SPDX-License-Identifier: GPL-3.0-or-later
"""Loss on rendered depths that leave those that stereo confirmed (docs/method.md, section 3.6)."""

from __future__ import annotations

import numpy as np

from ...dataset.camera import Camera
from ...kernels.array_store import ArrayStore
from ...kernels.compiled import kernel
from ...kernels.parallel import default_threads, even_bounds, run_chunks
from ...render.types.gradients import ImageGradients
from ...stereo.depth_priors import DepthPrior

TOLERANCE_SHARE = 0.01
"""Relative difference in depth up to which the loss is quadratic; beyond, it is linear."""

OUTLIER_SHARE = 0.03
"""Relative difference from which the photos are believed: stereo misses what is thin."""

_NO_MASK = np.zeros((0, 0), np.bool_)


@kernel(fast=False, fused=True)
def _prior_rows(
    begin: int, end: int, depth: np.ndarray, lens: np.ndarray, prior: np.ndarray,
    confidence: np.ndarray, prior_lens: np.ndarray, mask: np.ndarray, weight: float,
    sums: np.ndarray, by_depth: np.ndarray,
) -> None:  # fmt: skip
    """Add the loss of each row to ``sums`` (h,) and write its gradient by the depth (h, w).

    ``lens`` and ``prior_lens`` are (4,): fx, fy, cx, cy.
    """
    last_row, last_column = prior.shape[0] - 1, prior.shape[1] - 1
    for row in range(begin, end):
        y = (row + 0.5 - lens[3]) / lens[1] * prior_lens[1] + prior_lens[3]
        prior_row = min(max(int(y), 0), last_row)
        total = 0.0
        for column in range(depth.shape[1]):
            by_depth[row, column] = 0.0
            x = (column + 0.5 - lens[2]) / lens[0] * prior_lens[0] + prior_lens[2]
            prior_column = min(max(int(x), 0), last_column)
            there = float(prior[prior_row, prior_column])
            here = float(depth[row, column])
            if not (there > 0.0 and here > 0.0):
                continue
            if mask.shape[0] > 0 and not mask[row, column]:
                continue
            off = (here - there) / there
            if abs(off) >= OUTLIER_SHARE:
                continue
            trust = weight * confidence[prior_row, prior_column]
            off /= TOLERANCE_SHARE
            if abs(off) < 1.0:
                total += trust * 0.5 * off * off
                slope = off
            else:
                total += trust * (abs(off) - 0.5)
                slope = 1.0 if off > 0.0 else -1.0
            by_depth[row, column] = trust * slope / (TOLERANCE_SHARE * there)
        sums[row] = total


def depth_prior_loss(
    depth: np.ndarray,
    camera: Camera,
    prior: DepthPrior,
    mask: np.ndarray | None = None,
    *,
    weight: float,
    threads: int = 0,
    store: ArrayStore | None = None,
) -> tuple[float, ImageGradients]:
    """Return ``weight mean(c h(|d / d_prior - 1| / 0.01))`` and its gradient on the depth.

    Parameters
    ----------
    depth : (h, w) float32 or float64
        Rendered z-depth; <= 0 where there is none.
    camera : Camera
        Of the rendered image, or window of an image, at the prior's pose.
    prior : DepthPrior
        Of any size; the nearest pixel counts, as interpolation would join what edges separate.
    mask : (h, w) bool, optional
        False pixels count in no term.

    Returns
    -------
    loss : float
    gradients : ImageGradients
        On the depth alone.
    """
    threads = threads or default_threads()
    depth = np.ascontiguousarray(depth)
    by_depth = (
        np.empty_like(depth)
        if store is None
        else store.take("by depth of the prior", depth.shape, depth.dtype)
    )
    flat_mask = _NO_MASK if mask is None else np.ascontiguousarray(mask, np.bool_)
    pixels = max(1, depth.size if mask is None else int(np.count_nonzero(flat_mask)))
    sums = np.zeros(len(depth))
    lens, prior_lens = _lens(camera), _lens(prior.camera)

    def run(begin: int, end: int) -> None:
        _prior_rows(
            begin, end, depth, lens, prior.depth, prior.confidence, prior_lens, flat_mask,
            weight / pixels, sums, by_depth,
        )  # fmt: skip

    run_chunks(run, even_bounds(len(depth), threads, 1), threads)
    return float(sums.sum()), ImageGradients(depth=by_depth)


def _lens(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
