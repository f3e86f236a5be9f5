# SPDX-License-Identifier: GPL-3.0-or-later
"""Small scenes and cameras shared by the renderer's tests."""

from __future__ import annotations

import math

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.render.projection import ScreenGaussians
from gaussian_wrapping_addon.core.render.tiles import TileBinning, TileLists
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.poses import look_at_pose


def look_at(
    eye: tuple[float, float, float],
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    width: int = 40,
    height: int = 30,
    focal: float = 45.0,
    name: str = "camera",
) -> Camera:
    """Return a camera at ``eye`` looking at ``target``, Z up, off-centre principal point."""
    return Camera(
        name,
        width,
        height,
        focal,
        1.03 * focal,
        0.5 * width + 0.7,
        0.5 * height - 0.4,
        look_at_pose(eye, target),
    )


def bin_gaussians(screen: ScreenGaussians, width: int, height: int, threads: int = 1) -> TileLists:
    """Return the lists of all tiles of an image."""
    binning = TileBinning(screen, width, height, threads, ArrayStore())
    return binning.lists(0, len(binning.tile_counts))


def front_camera(
    width: int = 6, height: int = 5, *, focal: float = 9.0, distance: float = 4.0
) -> Camera:
    """Return a camera on the -y axis that looks along y at the origin, in the image's centre."""
    pose = look_at_pose((0.0, -distance, 0.0))
    return Camera("front", width, height, focal, focal, width / 2, height / 2, pose)


def random_gaussians(
    count: int,
    seed: int = 0,
    *,
    dtype: torch.dtype = torch.float64,
    sh_degree: int = 2,
    spread: float = 0.8,
    scale: tuple[float, float] = (0.04, 0.3),
    opacity: tuple[float, float] = (0.05, 0.95),
    filter_size: float = 0.01,
) -> OrientedGaussians:
    """Return anisotropic oriented Gaussians in a box of half side ``spread`` around 0."""
    random = np.random.default_rng(seed)
    alpha = random.uniform(*opacity, count)
    values = {
        "means": random.uniform(-spread, spread, (count, 3)),
        "log_scales": random.uniform(np.log(scale[0]), np.log(scale[1]), (count, 3)),
        "quats": random.normal(size=(count, 4)) * random.uniform(0.5, 2.0, (count, 1)),
        "opacity_logits": np.log(alpha / (1.0 - alpha)),
        "sh": random.normal(size=(count, (sh_degree + 1) ** 2, 3)) * 0.3,
        "orientation": random.normal(size=(count, 4)),
        "filter_3d": np.full(count, filter_size),
    }
    return OrientedGaussians(**{k: torch.as_tensor(v).to(dtype) for k, v in values.items()})


def isotropic(
    means: list[tuple[float, float, float]],
    sigmas: list[float],
    opacities: list[float],
    dtype: torch.dtype = torch.float64,
) -> OrientedGaussians:
    """Return round Gaussians with effective standard deviations and opacities as given."""
    count = len(means)
    alpha = torch.tensor(opacities, dtype=dtype)
    quats = torch.zeros((count, 4), dtype=dtype)
    quats[:, 0] = 1.0
    return OrientedGaussians(
        torch.tensor(means, dtype=dtype),
        torch.log(torch.tensor(sigmas, dtype=dtype))[:, None].repeat(1, 3),
        quats,
        torch.log(alpha) - torch.log1p(-alpha),
        torch.zeros((count, 1, 3), dtype=dtype),
        torch.tensor([[0.0, 0.0, 1.0, 0.5]], dtype=dtype).repeat(count, 1),
        torch.zeros(count, dtype=dtype),
    )


def coloured(gaussians: OrientedGaussians, seed: int = 0) -> OrientedGaussians:
    """Return the Gaussians with random constant colours and learned normals."""
    random = np.random.default_rng(seed)
    count = len(gaussians)
    return gaussians.replaced(
        sh=torch.from_numpy(random.normal(size=(count, 1, 3)) * 0.5).to(gaussians.sh),
        orientation=torch.from_numpy(random.normal(size=(count, 4))).to(gaussians.orientation),
    )


def one_gaussian(
    scales: tuple[float, float, float],
    opacity: float,
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0),
    turn: float = 0.0,
    axis: int = 2,
) -> OrientedGaussians:
    """Return a coloured float64 Gaussian turned about a world axis, its quaternion not of unit
    length."""
    quat = torch.zeros((1, 4), dtype=torch.float64)
    quat[0, 0], quat[0, 1 + axis] = 1.3 * math.cos(turn / 2), 1.3 * math.sin(turn / 2)
    return coloured(isotropic([mean], [1.0], [opacity])).replaced(
        log_scales=torch.tensor([scales], dtype=torch.float64).log(), quats=quat
    )
