# SPDX-License-Identifier: GPL-3.0-or-later
"""Projection of small scenes: shared views, and a single Gaussian in front of a camera."""

from __future__ import annotations

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    ScreenGaussians,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.scenes import isotropic, look_at

CAMERA = look_at((2.0, 0.6, 0.9))
OPTIONS = RenderOptions(threads=1)
AXIS = Camera("axis", 64, 48, 60.0, 66.0, 32.5, 23.5, np.eye(3, 4))


def project(
    gaussians: OrientedGaussians, camera: Camera = CAMERA, options: RenderOptions = OPTIONS
) -> ScreenGaussians:
    """Return the rows of a view."""
    return project_gaussians(RawArrays.from_gaussians(gaussians), camera, options)


def single(**changes: object) -> OrientedGaussians:
    """One Gaussian in front of AXIS, with entries exchanged."""
    gaussians = isotropic([(0.1, -0.2, 3.0)], [0.1], [0.8])
    values = {k: torch.tensor([v], dtype=torch.float64) for k, v in changes.items()}
    return gaussians.replaced(**values)
