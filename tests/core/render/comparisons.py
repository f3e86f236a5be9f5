# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare the renderers with first principles: images, and gradients of one loss over all images.

Where an alpha is within rounding of 1/255, or a transmittance of 1e-4 or of the depth's limit,
images jump; which side float32 takes is not an error. Those pixels are left out by margins that
each test states, and never more than a stated share of the image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import render_reference
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import Render, RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.first_principles import IMAGES, TRAINED, FirstPrinciples, Truth

BLENDED = IMAGES[:4]
Renderer = Callable[[OrientedGaussians, Camera, RenderOptions], Render]


def narrowed(gaussians: OrientedGaussians) -> OrientedGaussians:
    """Return the Gaussians with values that float32 holds exactly, in float64."""
    return OrientedGaussians(**{k: v.float().double() for k, v in gaussians.tensors()})


def leaves(gaussians: OrientedGaussians, dtype: torch.dtype) -> OrientedGaussians:
    """Return copies that collect gradients."""
    return OrientedGaussians(
        **{
            name: tensor.detach().to(dtype).clone().requires_grad_(name != "filter_3d")
            for name, tensor in gaussians.tensors()
        }
    )


def images_of(view: Render) -> dict[str, np.ndarray]:
    """Return the images in float64."""
    return {name: getattr(view, name).detach().double().numpy() for name in IMAGES}


def gradients_of(
    renderer: Renderer,
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions,
    weights: Mapping[str, np.ndarray],
    dtype: torch.dtype,
) -> dict[str, np.ndarray]:
    """Return gradients of ``sum(weights * images)`` by autograd, float64 arrays."""
    leaf = leaves(gaussians, dtype)
    view = renderer(leaf, camera, options)
    total = torch.zeros((), dtype=dtype)
    for name, weight in weights.items():
        total = total + (getattr(view, name) * torch.from_numpy(weight).to(dtype)).sum()
    total.backward()
    return {name: getattr(leaf, name).grad.double().numpy() for name in TRAINED}


def random_weights(
    truth: Truth, *, margin: float, steepness: float = 0.05
) -> dict[str, np.ndarray]:
    """Return weights of a loss, float32 values, 0 where an image jumps within ``margin``.

    The gradient of a depth is a well conditioned one over the slope of log T. Depths are weighed by
    that slope (in shares of the pixel's largest 1 / sigma), so that no pixel with an all but flat T
    rules the sum, and count only where the slope exceeds ``steepness``.
    """
    random = np.random.default_rng(5)
    clear = (truth.margin > margin) & (truth.kink > margin)
    weights = {}
    for name in IMAGES:
        image = truth.image(name)
        weight = random.normal(size=image.shape)
        if name == "depth":
            share = np.where(truth.depth > 0, truth.slope, 0) / np.where(
                truth.depth > 0, truth.sharpest, 1
            )
            share = share.astype(np.float64)
            weight *= np.where((share > steepness) & (truth.limit_margin > margin), share, 0.0)
        weight = weight * clear.reshape(clear.shape + (1,) * (weight.ndim - 2))
        weights[name] = weight.astype(np.float32).astype(np.float64)
    return weights


def relative_l2(
    found: np.ndarray | torch.Tensor, wanted: np.ndarray | torch.Tensor, whole: float = 0.0
) -> float:
    """Return |found - wanted| / |wanted|.

    A gradient that vanishes by symmetry (a round Gaussian's rotation) is a difference of terms as
    large as the other parameters': it is judged by ``whole``, the length of the whole gradient.
    """
    found, wanted = np.asarray(found), np.asarray(wanted)
    size = float(np.linalg.norm(wanted.astype(np.float64)))
    error = float(np.linalg.norm((found - wanted).astype(np.float64)))
    size = size if size > 1e-15 * whole else whole
    if size == 0.0:
        return 0.0 if error == 0.0 else np.inf
    return error / size


@dataclass(frozen=True)
class Verdict:
    """How far the float32 kernels are from first principles in one view."""

    truth: Truth
    found: dict[str, np.ndarray]
    blended: dict[str, float]  # largest difference of each image over its clear pixels
    depth: float  # largest relative difference over the pixels with a depth
    same_depth_pixels: bool  # a depth exactly where there is one, away from the limit
    clear: float  # share of pixels that count
    depth_count: int
    gradients: dict[str, float]  # L2-relative by parameter, of a loss over the blended images
    depth_gradients: dict[str, float]  # of a loss over the depth
    sizes: dict[str, float]  # lengths of the true gradients of the blended loss

    def __str__(self) -> str:
        def row(values: Mapping[str, float]) -> str:
            return ", ".join(f"{name} {value:.1e}" for name, value in values.items())

        return (
            f"images: {row(self.blended)}; depth {self.depth:.1e} over {self.depth_count} pixels; "
            f"clear {self.clear:.3f}; gradients of images: {row(self.gradients)}; "
            f"of the depth: {row(self.depth_gradients)}"
        )

    def assert_within(
        self,
        *,
        blended: float = 2e-6,
        depth: float = 1e-5,
        gradient: float = 1e-4,
        depth_gradient: float = 1e-4,
        clear: float = 0.98,
        depth_count: int = 0,
    ) -> None:
        """Assert the stated tolerances, and that the scene shows something."""
        assert self.clear >= clear, str(self)
        assert max(self.blended.values()) <= blended, str(self)
        assert self.same_depth_pixels, str(self)
        assert self.depth <= depth, str(self)
        assert self.depth_count >= depth_count, str(self)
        assert max(self.gradients.values(), default=0.0) <= gradient, str(self)
        assert max(self.depth_gradients.values(), default=0.0) <= depth_gradient, str(self)


def judge(
    gaussians: OrientedGaussians,
    camera: Camera,
    *,
    digits: int = 0,
    gradient_digits: int | None = None,
    gradients: bool = True,
    margin: float = 1e-4,
    limit: float = 0.45,
    near_z: float = 0.2,
    background: tuple[float, float, float] = (0.2, 0.5, 0.1),
    nearer_than: float = np.inf,
    renderer: Renderer = render,
) -> Verdict:
    """Render with the kernels and from first principles and compare.

    Gradients are compared with differences in arithmetic of ``gradient_digits`` digits (by default
    ``digits``); where that is 0, with autograd of the definition in float64, which
    ``test_first_principles.py`` proves. With ``nearer_than`` the loss over the depth weighs
    all depths below it alike, flat or not.
    """
    options = RenderOptions(
        background=background, near_z=near_z, depth_valid_transmittance=limit, threads=1
    )
    exact = narrowed(gaussians)
    oracle = FirstPrinciples(
        exact, camera, near_z=near_z, background=background, limit=limit, digits=digits
    )
    truth = oracle.images()
    with torch.no_grad():
        found = images_of(renderer(leaves(exact, torch.float32), camera, options))
    clear = truth.margin > margin
    blended = {}
    for name in BLENDED:
        assert np.isfinite(found[name]).all(), name
        error = abs(found[name] - truth.image(name).astype(np.float64))
        blended[name] = float(error[clear].max(initial=0.0))
    sure = clear & (truth.limit_margin > margin)
    depth = truth.depth.astype(np.float64)
    has = sure & (depth > 0) & (found["depth"] > 0)
    relative = abs(found["depth"] - depth)[has] / depth[has]
    of_images: dict[str, float] = {}
    of_depth: dict[str, float] = {}
    sizes: dict[str, float] = {}
    if gradients:
        weights = random_weights(truth, margin=margin)
        if nearer_than < np.inf:
            near = has & (depth < nearer_than)
            weights["depth"] = np.where(near, np.random.default_rng(7).normal(size=near.shape), 0.0)
        losses = [{name: weights[name] for name in BLENDED}, {"depth": weights["depth"]}]
        fast = [gradients_of(renderer, exact, camera, options, w, torch.float32) for w in losses]
        if digits if gradient_digits is None else gradient_digits:
            wanted = oracle.gradients(losses)
        else:
            wanted = [
                gradients_of(render_reference, exact, camera, options, w, torch.float64)
                for w in losses
            ]
        for errors, one, other in zip((of_images, of_depth), fast, wanted, strict=True):
            lengths = {name: float(np.linalg.norm(other[name])) for name in TRAINED}
            sizes = sizes or lengths
            for name in TRAINED:
                assert np.isfinite(one[name]).all(), name
                errors[name] = relative_l2(
                    one[name], other[name], float(np.linalg.norm(list(lengths.values())))
                )
    return Verdict(
        truth,
        found,
        blended,
        float(relative.max(initial=0.0)),
        bool(np.array_equal(found["depth"][sure] > 0, depth[sure] > 0)),
        float(clear.mean()),
        int(has.sum()),
        of_images,
        of_depth,
        sizes,
    )
