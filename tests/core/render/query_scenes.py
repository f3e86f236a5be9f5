# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes and positions for depth queries, with reference results from Sigma, mu and rays."""

from __future__ import annotations

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render import reference
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.first_principles import FirstPrinciples
from tests.core.render.scenes import isotropic, look_at, random_gaussians

SHAPES = ("means", "log_scales", "quats", "opacity_logits")
EYE = (2.2, 1.0, 0.8)
# Keyword arguments of random_gaussians, number of Gaussians, camera position.
SCENES = {
    "generic": ({}, 120, EYE),
    "thin": ({"scale": (0.002, 0.4), "opacity": (0.3, 0.97)}, 150, EYE),
    "inside": ({"scale": (0.1, 0.8), "opacity": (0.02, 0.3)}, 25, (0.7, 0.3, 0.2)),
    "opaque": ({"opacity": (0.95, 0.9999)}, 60, EYE),
}


def thin_layers() -> tuple[OrientedGaussians, Camera]:
    """Return turned sheets of a hundredth of their distance and less, one behind the other."""
    gaussians = random_gaussians(90, seed=4, dtype=torch.float32, opacity=(0.2, 0.6))
    thickness = torch.linspace(-7.0, -4.0, 90)
    logs = torch.stack([torch.full((90,), -0.5), torch.full((90,), -1.0), thickness], 1)
    return gaussians.replaced(log_scales=logs), look_at((2.2, 1.0, 0.8), width=33, height=17)


def opaque_stack() -> tuple[OrientedGaussians, Camera]:
    """Return more Gaussians on every ray than a warp takes at once, and an opaque wall in them."""
    count = 150
    means = [(0.0, 0.02 * i, 0.0) for i in range(count)]
    gaussians = isotropic(means, [0.5] * count, [0.03] * 70 + [0.95] * 80, torch.float32)
    logs = gaussians.log_scales + torch.tensor([0.3, -1.0, 0.1])
    quats = torch.tensor([[0.9, 0.1, -0.2, 0.3]]).repeat(count, 1)
    return gaussians.replaced(log_scales=logs, quats=quats), Camera(
        "front", 33, 17, 40.0, 40.0, 16.0, 8.0, look_at((0.0, -4.0, 0.0)).cam_from_world
    )


def one_tile() -> tuple[OrientedGaussians, Camera]:
    """Return more Gaussians in one tile than a block has threads."""
    gaussians = random_gaussians(400, seed=6, dtype=torch.float32, opacity=(0.02, 0.2))
    return gaussians, look_at((2.2, 1.0, 0.8), width=16, height=16, focal=30.0)


HARD = {"thin layers": thin_layers, "opaque stack": opaque_stack, "one tile": one_tile}


def scene(name: str, seed: int = 3) -> tuple[OrientedGaussians, Camera]:
    """Return float32 Gaussians and a camera of several tiles, the last ones cut."""
    if name in HARD:
        return HARD[name]()
    values, count, eye = SCENES[name]
    gaussians = random_gaussians(count, seed=seed, dtype=torch.float32, sh_degree=1, **values)  # type: ignore[arg-type]
    return gaussians, look_at(eye, width=50, height=40, focal=60.0)


def random_positions(camera: Camera, count: int, seed: int = 0) -> np.ndarray:
    """Return (count, 2) float32 positions, a few of them beyond each side of the image."""
    random = np.random.default_rng(seed)
    size = np.array([camera.width, camera.height])
    return (random.uniform(-0.03, 1.03, (count, 2)) * size).astype(np.float32)


def reference_depth_at(
    gaussians: OrientedGaussians, camera: Camera, positions: torch.Tensor, options: RenderOptions
) -> torch.Tensor:
    """Return the depth of ``render_reference`` at (m, 2) positions; 0 where there is none."""
    screen = reference.reference_projection(gaussians, camera, options)
    chosen = torch.nonzero(screen.usable)[:, 0]
    order = chosen[torch.argsort(screen.depths[chosen].float(), stable=True)]
    size = positions.new_tensor([camera.width, camera.height])
    seen = torch.nonzero(((positions >= 0.0) & (positions <= size)).all(1))[:, 0]
    rays = reference._evaluate_rays(screen.params[order], *positions[seen].unbind(1))
    depth = reference._depth(rays, options)
    return positions.new_zeros(len(positions)).index_put((seen,), depth)


def true_depth(gaussians: OrientedGaussians, camera: Camera, positions: np.ndarray) -> np.ndarray:
    """Return the z-depths (m,) from first principles; 0 where there is none and off the image."""
    on_image = ((positions >= 0) & (positions <= [camera.width, camera.height])).all(1)
    depth = np.zeros(len(positions))
    depth[on_image] = FirstPrinciples(gaussians, camera).at(positions[on_image]).depth
    return depth


def assert_depths(found: np.ndarray, wanted: np.ndarray) -> None:
    """Check validity and the error's distribution."""
    # A float32 alpha may fall on the other side of 1/255, a float32 T on that of 0.45.
    assert ((found > 0) != (wanted > 0)).mean() <= 1e-3
    both = (found > 0) & (wanted > 0)
    error = np.abs(found - wanted)[both] / wanted[both]
    assert both.mean() > 0.2
    assert (error < 1e-5).mean() >= 0.999
    assert error.max() < 1e-3
