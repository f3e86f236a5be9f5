# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure the contribution of each Gaussian to the views and prune the smallest ones."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ...gaussians.model import OrientedGaussians
from ...render.projection.projection import RawArrays
from ...render.types.options import RenderOptions
from ...render.types.renderer import Renderer
from ..optimizer.adam import Adam
from .wrapping import WrapView


def contributions(
    gaussians: OrientedGaussians,
    views: Iterable[WrapView],
    renderer: Renderer,
    *,
    threads: int = 0,
) -> np.ndarray:
    """Return the contribution of each Gaussian to the images of the views.

    Masked pixels count like all others: Gaussians there are in front of, or behind, something that
    other views train.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame.
    views : iterable of WrapView
    renderer : Renderer
        Overwrites its last view.

    Returns
    -------
    (n,) float64
        Mean over the views of the share of the image that the Gaussian fills: sum of its blending
        weights divided by the number of pixels.
    """
    raw = RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=False, sh_degree=0, threads=threads, statistics=True)
    share = np.zeros(len(gaussians))
    count = 0
    for view in views:
        statistics = renderer.render(raw, view.camera, options).statistics
        assert statistics is not None
        share += statistics.weight_sum / (view.camera.width * view.camera.height)
        count += 1
    return share / max(1, count)


def largest_contributors(weights: np.ndarray, share: float) -> np.ndarray:
    """Return the Gaussians that a view needs: all but the least, which make up ``share`` of it.

    Parameters
    ----------
    weights : (n,) float64
        Contribution of each Gaussian to the view, at least 0.
    share : float
        In [0, 1).

    Returns
    -------
    (k,) int64
    """
    seen = np.flatnonzero(weights > 0.0)
    if len(seen) == 0:
        return seen
    amount = weights[seen]
    order = np.argsort(amount, kind="stable")
    running = np.cumsum(amount[order])
    return seen[order[running > share * running[-1]]]


def needed_by_a_view(
    gaussians: OrientedGaussians,
    views: Iterable[WrapView],
    renderer: Renderer,
    share: float,
    weights: np.ndarray | None = None,
    *,
    threads: int = 0,
) -> np.ndarray:
    """Tell which Gaussians any view needs (docs/method.md, section 4.3).

    A view does not need its least contributors, which together make up ``share`` of its blending
    weights. The Gaussians that any view needs therefore keep at least ``1 - share`` of the weights
    of every view, however many views there are, and however few of them see a part of the scene.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame.
    views : iterable of WrapView
        All training views.
    renderer : Renderer
        Overwrites its last view.
    share : float
        In [0, 1).
    weights : (n,), optional
        Factors on the contributions of the Gaussians.

    Returns
    -------
    (n,) bool
    """
    raw = RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=False, sh_degree=0, threads=threads, statistics=True)
    needed = np.zeros(len(gaussians), np.bool_)
    for view in views:
        statistics = renderer.render(raw, view.camera, options).statistics
        assert statistics is not None
        amount = statistics.weight_sum.astype(np.float64)
        if weights is not None:
            amount *= weights
        needed[largest_contributors(amount, share)] = True
    return needed


def prune_contributors(adam: Adam, needed: np.ndarray) -> int:
    """Keep the Gaussians of a mask, unless it is empty; return the number of those removed.

    Frozen Gaussians are kept, and the mask of the others must not be empty.
    """
    if not needed[adam.frozen :].any():
        return 0
    keep = np.flatnonzero(needed | (np.arange(len(needed)) < adam.frozen))
    if len(keep) == len(needed):
        return 0
    adam.rebuild(keep, np.zeros(len(keep), np.bool_), {})
    return len(needed) - len(keep)
