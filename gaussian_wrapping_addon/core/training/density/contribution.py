# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure the contribution of each Gaussian to the views and prune the smallest ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ...gaussians.model import OrientedGaussians
from ...render.projection.projection import RawArrays
from ...render.types.options import RenderOptions
from ...render.view_renderer import ViewRenderer
from ..optimizer.adam import Adam
from .wrapping import WrapView


@dataclass(frozen=True)
class Contributions:
    """Blending weights over views, all (n,) float64."""

    share: np.ndarray
    """Mean over the views of the share of the image that the Gaussian fills: sum of its blending
    weights divided by the number of pixels."""
    largest: np.ndarray
    """Largest blending weight at any pixel of any view."""


def contributions(
    gaussians: OrientedGaussians,
    views: Iterable[WrapView],
    renderer: ViewRenderer,
    *,
    threads: int = 0,
) -> Contributions:
    """Measure the contribution of each Gaussian to the images of the views.

    Masked pixels count like all others: Gaussians there are in front of, or behind, something that
    other views train.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame.
    views : iterable of WrapView
    renderer : ViewRenderer
        Overwrites its last view.
    """
    raw = RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=False, sh_degree=0, threads=threads, statistics=True)
    share, largest = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    count = 0
    for view in views:
        statistics = renderer.render(raw, view.camera, options).statistics
        assert statistics is not None
        share += statistics.weight_sum / (view.camera.width * view.camera.height)
        np.maximum(largest, statistics.weight_max, out=largest)
        count += 1
    return Contributions(share / max(1, count), largest)


def least_contributors(
    found: Contributions, total_share: float, weights: np.ndarray | None = None
) -> np.ndarray:
    """Return (n,) bool: the Gaussians of least contribution that add up to a share of the total.

    Removing them changes the images by no more than that share on average, however many they are; a
    fixed number or threshold would depend on the scene (compare the pruning by significance of
    LightGaussian and the blending weights of Mini-Splatting).

    Parameters
    ----------
    total_share : float
        Share of the sum of all contributions, in [0, 1).
    weights : (n,), optional
        Factors on the contributions of the Gaussians.
    """
    share = found.share if weights is None else found.share * weights
    order = np.argsort(share, kind="stable")
    running = np.cumsum(share[order])
    least = np.zeros(len(order), np.bool_)
    least[order[running <= total_share * running[-1]]] = True
    return least


def prune_contributors(adam: Adam, least: np.ndarray) -> int:
    """Remove the Gaussians of a mask, unless that is all of them; return their number."""
    keep = np.flatnonzero(~least)
    if len(keep) == 0 or len(keep) == len(least):
        return 0
    adam.rebuild(keep, np.zeros(len(keep), np.bool_), {})
    return len(least) - len(keep)
