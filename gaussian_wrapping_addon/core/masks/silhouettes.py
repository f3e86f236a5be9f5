# SPDX-License-Identifier: GPL-3.0-or-later
"""Silhouettes of the Gaussians that stand in a region, as photos show them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from ..dataset.camera import Camera
from ..gaussians.model import OrientedGaussians
from ..render.projection.projection import RawArrays
from ..render.types.options import RenderOptions
from ..render.types.renderer import Renderer
from ..tolerances import NEAR_Z

WHITE = 0.5 / (0.5 / math.sqrt(math.pi))
"""Coefficient of the constant harmonic of a Gaussian whose colour is 1; minus that, of colour 0."""
CLEAR_SHARE = 0.5
"""Share of the way from a camera to the regions in which nothing stands."""


def marked(gaussians: OrientedGaussians, inside: np.ndarray) -> RawArrays:
    """Return Gaussians that are white where ``inside`` (n,) bool, and black elsewhere."""
    sign = torch.from_numpy(np.where(inside, WHITE, -WHITE).astype(np.float32))  # (n,)
    sh = sign[:, None, None].expand(-1, 1, 3).contiguous()
    return RawArrays.from_gaussians(gaussians.detached().replaced(sh=sh.to(gaussians.sh.dtype)))


def silhouettes(
    gaussians: OrientedGaussians,
    inside: np.ndarray,
    cameras: Sequence[Camera],
    renderer: Renderer,
    *,
    bounds: np.ndarray | None = None,
    threads: int,
) -> Iterator[np.ndarray]:
    """Yield how much of each pixel shows what is inside, (h, w) float32 in [0, 1] a camera.

    The share is the sum of the blending weights of the Gaussians inside: what stands in front of
    them takes its part of the light, and so does what they let through.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame.
    inside : (n,) bool
        Gaussians that belong to the object.
    cameras : sequence of Camera
        Scene frame; silhouettes have their size.
    bounds : (n, 3), optional
        Corners of the regions, scene frame. What is nearer to a camera than half of the way to
        them hides nothing: a short training leaves fog right before single cameras.
    """
    arrays = marked(gaussians, inside)
    for camera in cameras:
        options = RenderOptions(
            depth=False, sh_degree=0, threads=threads, near_z=_near_z(camera, bounds)
        )
        color = renderer.render(arrays, camera, options).color
        yield np.clip(color[..., 0], 0.0, 1.0)


def _near_z(camera: Camera, bounds: np.ndarray | None) -> float:
    """Return the z-depth from which on Gaussians are rendered."""
    if bounds is None:
        return NEAR_Z
    return max(NEAR_Z, CLEAR_SHARE * float(camera.to_camera(bounds)[:, 2].min()))
