# SPDX-License-Identifier: GPL-3.0-or-later
"""Orientation without training: the shortest axis, with its sign by a vote of the cameras."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch

from ...dataset.camera import Camera
from ...gaussians.model import OrientedGaussians
from ...render.projection.projection import RawArrays
from ...render.types.options import RenderOptions
from ...render.types.renderer import Renderer
from ...render.view_renderer import ViewRenderer
from ...settings import TrainingSettings

FIRST_SIGN = TrainingSettings.first_sign
"""Magnitude of the sign parameter after the vote of views of a splat."""


def voted_orientation(
    gaussians: OrientedGaussians,
    cameras: Iterable[Camera],
    renderer: Renderer | None = None,
    *,
    first_sign: float = FIRST_SIGN,
    threads: int = 0,
) -> np.ndarray:
    """Return orientation parameters for Gaussians whose orientation was not trained.

    The direction is the shortest axis. Each camera votes for the side that it sees, weighted by the
    Gaussian's blending weight; the sign parameter is +-``first_sign``, or 0 if no camera sees it
    (docs/method.md, section 1.3).

    Parameters
    ----------
    gaussians : OrientedGaussians
        float32; in the frame of the cameras.

    Returns
    -------
    (n, 4) float32
        Direction and sign parameter.
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
