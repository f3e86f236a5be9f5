# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors of a float32 rendering against the definition in float64: images, depth, gradients."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.types.images import Render
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

from .exact import ExactImages, Tiles, exact_images, exact_tiles
from .exact_gradients import (
    IMAGES,
    TRAINED,
    Gradients,
    Weights,
    exact_gradients,
    linear_loss,
)

Renderer = Callable[[OrientedGaussians, Camera, RenderOptions], Render]
LOSSES = ("images", "images, all pixels", "depth", "depth, all pixels")
"""Random weights (mean 1, deviation 1) of all images but the depth, without and with the pixels
where a threshold was decided the other way; of the depth, weighed by its slope where log T is not
flat, and unweighed."""
DEPTH_TOLERANCE = 1e-5
_OFF = 1e-5
"""No rounding of values in [-1, 2] adds up to this; a threshold decided otherwise exceeds it."""
_SYMMETRIC = 1e-6
"""A group whose gradient is below this share of the log_scales' is 0 by symmetry: rounding."""
_FLAT = 0.05
"""Share of the median slope below which log T is all but flat at the crossing."""


@dataclasses.dataclass(frozen=True)
class GradientError:
    """Error of one gradient."""

    l2: float
    """Length of the difference over the length of the exact gradient; nan where both are 0."""
    largest: float
    """Largest difference over the largest exact value."""


@dataclasses.dataclass(frozen=True)
class SceneErrors:
    """Errors of one scene."""

    name: str
    pixels: int
    image_max: float
    """Largest absolute error of colour, normals and alpha."""
    image_off: int
    """Pixels with an error above 1e-5: a threshold was decided the other way."""
    depth_valid: int
    """Pixels with a depth in the exact image."""
    depth_differs: int
    """Pixels with a depth in only one of the two images."""
    depth_within: float
    """Share of the pixels with both depths whose relative error is below 1e-5; nan without any."""
    depth_max: float
    """Largest relative error of the depth."""
    depth_step: float
    """Median over the pixels with a depth: the last bit of the depth as float32, times -d(log T)/dt
    there. Where it is not small, no float32 depth can hold the crossing."""
    gradients: dict[str, dict[str, GradientError]]
    """By loss and parameter group; empty if they were not asked for."""


def leaves(gaussians: OrientedGaussians, dtype: torch.dtype) -> OrientedGaussians:
    """Return copies that collect gradients."""
    return gaussians.replaced(
        **{
            name: value.detach().to(dtype).clone().requires_grad_(name in TRAINED)
            for name, value in gaussians.tensors()
        }
    )


def gradient_error(
    found: torch.Tensor | np.ndarray, exact: torch.Tensor, zero: float = 0.0
) -> GradientError:
    """Compare two gradients of one group; nan where both are at most ``zero`` long."""
    found = torch.as_tensor(found).double()
    difference, length = found - exact, float(exact.norm())
    if length <= zero:
        same = float(found.norm()) <= 1e3 * zero
        return GradientError(*([float("nan") if same else float("inf")] * 2))
    largest = float(difference.abs().max()) / float(exact.abs().max())
    return GradientError(float(difference.norm()) / length, largest)


def image_errors(out: Render, exact: ExactImages) -> np.ndarray:
    """Return the largest absolute error of each pixel (h, w), over all images but the depth."""
    error = np.zeros(exact.alpha.shape)
    for key in IMAGES[:4]:
        values = getattr(out, key).detach().double().numpy() - getattr(exact, key)
        error = np.maximum(error, np.abs(values).reshape(*error.shape, -1).max(2))
    return error


def depth_step(exact: ExactImages) -> float:
    """Return how much log T changes within the last bit of a float32 depth, in the median."""
    valid = exact.depth > 0.0
    if not valid.any():
        return float("nan")
    steps = np.spacing(exact.depth[valid].astype(np.float32)).astype(np.float64)
    return float(np.median(steps * exact.slope[valid]))


def loss_weights(
    exact: ExactImages, found: np.ndarray, agree: np.ndarray, seed: int
) -> dict[str, Weights]:
    """Return random weights for each loss; the depth counts where both images have one.

    ``found`` is the other depth image, ``agree`` where no threshold was decided the other way.

    A depth's gradient is something well conditioned over the slope of log T. Weighed by the
    slope, pixels count alike; those where log T is all but flat are left out.
    """
    random = torch.Generator().manual_seed(seed)

    def draw(shape: tuple[int, ...]) -> torch.Tensor:
        # Not around 0: the gradient of a lone Gaussian would be what is left of a cancellation.
        return 1.0 + torch.randn(shape, generator=random, dtype=torch.float32)

    images = {name: draw(getattr(exact, name).shape) for name in IMAGES[:4]}
    valid = (exact.depth > 0.0) & (found > 0.0)
    typical = float(np.median(exact.slope[valid])) if valid.any() else 1.0
    relative = exact.slope / max(typical, 1e-300)
    scaled = np.where(valid & agree & (relative > _FLAT), np.minimum(relative, 1e3), 0.0)
    noise = draw(exact.depth.shape)
    mask = torch.from_numpy(agree.astype(np.float32))

    def masked(weights: torch.Tensor) -> torch.Tensor:
        return weights * (mask if weights.ndim == 2 else mask[..., None])

    return {
        "images": {name: masked(weights) for name, weights in images.items()},
        "images, all pixels": images,
        "depth": {"depth": noise * torch.from_numpy(scaled.astype(np.float32))},
        "depth, all pixels": {"depth": noise * torch.from_numpy(valid.astype(np.float32))},
    }


def scene_errors(
    name: str,
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions,
    renderer: Renderer,
    *,
    gradients: bool = True,
    seed: int = 0,
) -> SceneErrors:
    """Render float32 Gaussians with ``renderer`` and compare with the definition in float64."""
    return compare(name, gaussians, camera, options, renderer, gradients=gradients, seed=seed)[0]


@dataclasses.dataclass(frozen=True)
class Exact:
    """The definition's side of a comparison, to compare several renderers with."""

    tiles: Tiles
    images: ExactImages
    weights: dict[str, Weights]
    gradients: list[Gradients] | None


def compare(
    name: str,
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions,
    renderer: Renderer,
    *,
    gradients: bool,
    seed: int,
    exact: Exact | None = None,
) -> tuple[SceneErrors, Exact]:
    """Compare one rendering; return the definition's side too, to be handed in again."""
    leaf = leaves(gaussians, torch.float32)
    out = renderer(leaf, camera, options)
    depth = out.depth.detach().double().numpy()
    if exact is None:
        tiles = exact_tiles(gaussians, camera, options)
        images = exact_images(gaussians, camera, options, tiles)
        weights = loss_weights(images, depth, image_errors(out, images) <= _OFF, seed)
        slow = None
        if gradients:
            losses = [weights[loss] for loss in LOSSES]
            slow = exact_gradients(gaussians, camera, options, losses, tiles)
        exact = Exact(tiles, images, weights, slow)
    images = exact.images
    error = image_errors(out, images)
    both = (depth > 0.0) & (images.depth > 0.0)
    relative = np.abs(depth - images.depth)[both] / images.depth[both]
    found: dict[str, dict[str, GradientError]] = {}
    if gradients and exact.gradients is not None:
        for loss, slow_gradients in zip(LOSSES, exact.gradients, strict=True):
            fast = torch.autograd.grad(
                linear_loss(out, exact.weights[loss]),
                [getattr(leaf, group) for group in TRAINED],
                retain_graph=True,
                materialize_grads=True,
            )
            zero = _SYMMETRIC * float(slow_gradients["log_scales"].norm())
            found[loss] = {
                group: gradient_error(value, slow_gradients[group], zero)
                for group, value in zip(TRAINED, fast, strict=True)
            }
    errors = SceneErrors(
        name,
        error.size,
        float(error.max()),
        int((error > _OFF).sum()),
        int((images.depth > 0.0).sum()),
        int(((depth > 0.0) != (images.depth > 0.0)).sum()),
        float((relative < DEPTH_TOLERANCE).mean()) if both.any() else float("nan"),
        float(relative.max()) if both.any() else float("nan"),
        depth_step(images),
        found,
    )
    return errors, exact
