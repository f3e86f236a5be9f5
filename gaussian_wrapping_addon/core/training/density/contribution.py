# SPDX-License-Identifier: GPL-3.0-or-later
"""What each Gaussian contributes to the photos, and removing those that together show nothing."""

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
    """Mean over the views of the part of the image that the Gaussian fills: sum of its blending
    weights by the number of pixels."""
    largest: np.ndarray
    """Largest blending weight at any pixel of any view."""


def contributions(
    gaussians: OrientedGaussians,
    views: Iterable[WrapView],
    renderer: ViewRenderer,
    *,
    threads: int = 0,
) -> Contributions:
    """Measure what each Gaussian contributes to the images of the views.

    Pixels outside a mask count like all others: what stands there is in front of, or behind,
    something that other views train.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame.
    views : iterable of WrapView
    renderer : ViewRenderer
        Its last view is overwritten.
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
    """Return (n,) bool: the Gaussians of least contribution that together make up a share of all.

    Removing them changes no image by more than that share on average, however many they are; a
    fixed number or threshold would depend on the scene (compare the pruning by significance of
    LightGaussian and the blending weights of Mini-Splatting).

    Parameters
    ----------
    total_share : float
        In [0, 1): of the sum of all contributions.
    weights : (n,), optional
        What the contribution of each Gaussian is worth.
    """
    share = found.share if weights is None else found.share * weights
    order = np.argsort(share, kind="stable")
    running = np.cumsum(share[order])
    least = np.zeros(len(order), np.bool_)
    least[order[running <= total_share * running[-1]]] = True
    return least


def prune_contributors(adam: Adam, least: np.ndarray) -> int:
    """Remove the Gaussians of a mask, but never all of them; return how many."""
    keep = np.flatnonzero(~least)
    if len(keep) == 0 or len(keep) == len(least):
        return 0
    adam.rebuild(keep, np.zeros(len(keep), np.bool_), {})
    return len(least) - len(keep)
