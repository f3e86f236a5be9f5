# SPDX-License-Identifier: GPL-3.0-or-later
"""Orientation of Gaussians, and rounds of flipped clones."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch

from .. import limits
from ..gaussians.model import OrientedGaussians
from ..render.projection import RawArrays
from ..render.types import Renderer, RenderOptions
from ..render.view_renderer import ViewRenderer
from ..scene.camera import Camera
from ..settings import TrainingSettings
from .adam import Adam
from .losses import normals_from_depth

# -- Orientation without training: the shortest axis, with its sign by a vote of the cameras ------

FIRST_SIGN = TrainingSettings.first_sign
"""Magnitude of the sign parameter after the vote of views of a splat."""


def voted_orientation(
    gaussians: OrientedGaussians, cameras: Iterable[Camera], renderer: Renderer | None = None, *,
    first_sign: float = FIRST_SIGN, threads: int = 0,
) -> np.ndarray:  # fmt: skip
    """Return orientation parameters, direction and sign (n, 4), where orientation was not trained.

    The direction is the shortest axis. Each camera, in the frame of the Gaussians, votes for the
    side that it sees, weighted by the Gaussian's blending weight; the sign parameter is
    +-``first_sign``, or 0 if no camera sees it (docs/method.md, section 1.3).
    """
    gaussians = gaussians.detached()
    shortest = torch.argmin(gaussians.log_scales, dim=1)  # (n,)
    axes = gaussians.rotations()  # (n, 3, 3)
    direction = axes[torch.arange(len(gaussians)), :, shortest].numpy()  # (n, 3)
    means = gaussians.means.numpy()
    votes = np.zeros(len(gaussians))
    renderer, raw = renderer or ViewRenderer(), RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=False, sh_degree=0, threads=threads, statistics=True)
    for camera in cameras:
        statistics = renderer.render(raw, camera, options).statistics
        assert statistics is not None
        toward = camera.center - means  # (n, 3)
        votes += statistics.weight_sum * np.sign((toward * direction).sum(1))
    sign = first_sign * np.sign(votes)  # (n,)
    return np.concatenate([direction, sign[:, None]], axis=1).astype(np.float32)


def orient(
    gaussians: OrientedGaussians, cameras: Iterable[Camera], *, threads: int = 0
) -> OrientedGaussians:
    """Return the Gaussians with :func:`voted_orientation`, so that a splat can be meshed."""
    orientation = voted_orientation(gaussians, cameras, threads=threads)
    return gaussians.replaced(orientation=torch.from_numpy(orientation))


# -- Wrapping: initial orientations, and clones of opposite orientation where normals disagree ----

SHIFT = 0.1
"""Original and clone are each moved by this many standard deviations along the normal."""

MIN_VIEWS = 2
"""Least divisor of the mean error of a Gaussian, so that one bad view of a rarely seen Gaussian
does not rank first (docs/method.md, section 4.2)."""

_SATURATED = 20.0
"""tanh of this is 1 in float32: normals of unit length."""


@dataclass(frozen=True)
class WrapView:
    """Camera and mask of a training view."""

    camera: Camera
    mask: np.ndarray | None
    """(h, w) bool."""


def start_orientation(
    adam: Adam, views: Iterable[WrapView], renderer: Renderer | None = None, *,
    first_sign: float = FIRST_SIGN, threads: int = 0,
) -> None:  # fmt: skip
    """Give the Gaussians without orientation that of :func:`voted_orientation`.

    Gaussians that are oriented already, those of a splat, keep their orientation, and so do frozen
    ones.
    """
    gaussians = adam.gaussians()
    length = np.linalg.norm(gaussians.detached().normals().numpy(), axis=1)  # (n,)
    missing = length < limits.ORIENTED_MIN_NORM
    missing[: adam.frozen] = False
    if not missing.any():
        return
    cameras = (view.camera for view in views)
    voted = voted_orientation(gaussians, cameras, renderer, first_sign=first_sign, threads=threads)
    adam.array("orientation")[missing] = voted[missing]
    adam.reset_moments("orientation")


def normal_errors(
    gaussians: OrientedGaussians,
    views: Iterable[WrapView],
    renderer: Renderer | None = None,
    *,
    threads: int = 0,
) -> np.ndarray:
    """Return (n,) mean normal error of each Gaussian over the views (docs/method.md, section 4.2).

    ``1 - N . n_depth`` with unit normals; each pixel is assigned to the Gaussian with the largest
    blending weight.
    """
    count = len(gaussians)
    unit = gaussians.orientation.detach().clone()
    unit[:, 3] = _SATURATED * torch.sign(unit[:, 3])
    oriented = RawArrays.from_gaussians(gaussians.detached().replaced(orientation=unit))
    renderer = renderer or ViewRenderer()
    options = RenderOptions(depth=True, sh_degree=0, threads=threads, statistics=True)
    total, seen = np.zeros(count), np.zeros(count)
    for view in views:
        image = renderer.render(oriented, view.camera, options)
        assert image.statistics is not None
        assert image.statistics.strongest is not None
        normals, valid = normals_from_depth(image.depth, view.camera, threads=threads)
        if view.mask is not None:
            valid &= view.mask
        strongest = image.statistics.strongest
        valid &= strongest >= 0
        error = 1.0 - (image.normal * normals).sum(2)[valid]
        owner = strongest[valid]
        pixels = np.bincount(owner, minlength=count)
        sums = np.bincount(owner, weights=error, minlength=count)
        total += sums / np.maximum(pixels, 1)
        seen += pixels > 0
    return total / np.maximum(seen, MIN_VIEWS)


def wrap(adam: Adam, errors: np.ndarray, share: float, limit: int) -> int:
    """Clone the Gaussians of largest normal error with the opposite orientation; return how many.

    See docs/method.md, section 4.2. Original and clone are shrunk along the normal to half the
    volume and each moved by 0.1 standard deviations along it, the clone backwards; clones start
    with zero moments. Gaussians without orientation are skipped, and frozen ones, which neither
    share nor limit counts.

    Parameters
    ----------
    errors : (n,) float64
        From :func:`normal_errors`.
    share : float
        Largest share of the Gaussians to clone.
    limit : int
        Largest number of Gaussians.
    """
    gaussians = adam.gaussians().detached()
    count = len(gaussians)
    trained = count - adam.frozen
    room = min(math.floor(share * trained), limit - trained)
    normals = gaussians.normals().numpy().astype(np.float64)
    length = np.linalg.norm(normals, axis=1)
    usable = (errors > 0.0) & (length >= limits.ORIENTED_MIN_NORM)
    usable[: adam.frozen] = False
    room = min(room, int(usable.sum()))
    if room <= 0:
        return 0
    ranked = np.argsort(-np.where(usable, errors, -1.0), kind="stable")
    chosen = np.sort(ranked[:room])
    unit = normals[chosen] / length[chosen, None]  # (m, 3)
    axes = gaussians.rotations().numpy()[chosen].astype(np.float64)  # columns are axes
    along_sq = np.einsum("nij,ni->nj", axes, unit) ** 2  # (m, 3), sums to 1
    log_scales = adam.array("log_scales").copy()
    log_scales[chosen] += (math.log(0.5) * along_sq).astype(np.float32)
    filter_sq = gaussians.filter_3d.numpy()[chosen, None].astype(np.float64) ** 2
    effective_sq = np.exp(2.0 * log_scales[chosen].astype(np.float64)) + filter_sq
    sigma = np.sqrt((along_sq * effective_sq).sum(1))
    shift = (SHIFT * sigma[:, None] * unit).astype(np.float32)
    parents = np.concatenate([np.arange(count), chosen])
    fresh = np.arange(len(parents)) >= count
    means = adam.array("means")[parents].copy()
    means[chosen] += shift
    means[count:] -= shift
    orientation = adam.array("orientation")[parents].copy()
    orientation[count:, 3] *= -1.0
    adam.rebuild(
        parents,
        fresh,
        {"means": means, "log_scales": log_scales[parents], "orientation": orientation},
    )
    return room
