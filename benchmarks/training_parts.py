# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses, optimiser and whole training iterations as parts for ``benchmarks.iteration``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.mip_filter import mip_filter
from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians
from gaussian_wrapping_addon.core.kernels.array_store import ArrayStore
from gaussian_wrapping_addon.core.render.projection.projection import RawArrays
from gaussian_wrapping_addon.core.render.raster.blend import (
    Images,
    RenderBuffers,
    blend,
    write_intersection_gradients,
)
from gaussian_wrapping_addon.core.render.render import project_view
from gaussian_wrapping_addon.core.render.simd.raster_math import ROW_VALUES
from gaussian_wrapping_addon.core.render.types.gradients import ImageGradients
from gaussian_wrapping_addon.core.render.types.options import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewPass, ViewRenderer
from gaussian_wrapping_addon.core.training.density.density_control import DensityStatistics
from gaussian_wrapping_addon.core.training.losses.losses import color_loss, normal_losses
from gaussian_wrapping_addon.core.training.optimizer.adam import Adam

Part = tuple[str, Callable[[], object]]

RASTER = "raster kernels alone"
WHOLE = "whole iteration"


class Iteration:
    """Training iterations of one view, as the trainer runs them.

    Learning rates are so small that the Gaussians stay what they are, so that each repeat has the
    same work.

    Parameters
    ----------
    depth : bool
        Isosurface depth and both normal losses.
    statistics : bool
        The screen gradients that density control asks for, in the first part of a training.
    """

    def __init__(
        self,
        gaussians: OrientedGaussians,
        camera: Camera,
        threads: int,
        *,
        depth: bool = False,
        statistics: bool = False,
    ) -> None:
        self.camera, self.threads, self.depth = camera, threads, depth
        self.options = RenderOptions(depth=depth, threads=threads, screen_gradients=statistics)
        self.adam, self.renderer, self.store = Adam(gaussians), ViewRenderer(), ArrayStore()
        self.statistics = DensityStatistics.zeros(len(gaussians))
        columns = {name: self.adam.array(name)[:1].size for name in TRAINED}
        self.rates = {name: np.full(count, 1e-12, np.float32) for name, count in columns.items()}
        self.photo = noisy_photo(self.forward())

    def forward(self) -> ViewPass:
        """Project, bin and blend."""
        raw = RawArrays.from_gaussians(self.adam.gaussians())
        return self.renderer.render(raw, self.camera, self.options)

    def losses(self, image: ViewPass) -> ImageGradients:
        """Return what the losses say about the images."""
        _, by_color, _ = color_loss(image.color, self.photo, threads=self.threads, store=self.store)
        if not self.depth:
            return ImageGradients(color=by_color)
        _, gradients, _ = normal_losses(
            image.depth,
            image.geometric_normal,
            image.normal,
            image.alpha,
            self.camera,
            threads=self.threads,
            store=self.store,
        )
        return dataclasses.replace(gradients, color=by_color)

    def run(self) -> None:
        """Run one whole iteration."""
        image = self.forward()
        seen = image.backward(self.losses(image))
        if image.statistics is not None:
            self.statistics.add(image.statistics, self.camera.width, self.camera.height)
        self.adam.step_rows(seen, self.rates, threads=self.threads)

    def raster(self) -> Callable[[], None]:
        """Return the forward and backward raster kernels of this iteration, nothing else."""
        image = self.forward()
        grads = self.losses(image)
        incoming = []
        for name in ("color", "normal", "geometric_normal", "alpha", "depth"):
            grad = getattr(grads, name)
            incoming.append(np.zeros_like(getattr(image, name)) if grad is None else grad)
        view = project_view(image.gaussians, self.camera, self.options)
        images, buffers = Images.allocate(self.camera, self.options), RenderBuffers()
        intersections = np.zeros((len(view.lists.gaussian_ids), ROW_VALUES), np.float32)
        absolute = image.statistics is not None

        def run() -> None:
            blend(view, images, buffers)
            write_intersection_gradients(
                view, images, incoming, buffers, intersections, depth=self.depth, absolute=absolute
            )

        return run


def noisy_photo(image: ViewPass) -> np.ndarray:
    """Return a photo that the view resembles, (h, w, 3) uint8."""
    noise = np.random.default_rng(0).normal(size=image.color.shape)
    return np.clip(255 * (image.color + 0.1 * noise), 0, 255).astype(np.uint8)


def training_parts(gaussians: OrientedGaussians, camera: Camera, threads: int) -> list[Part]:
    """Return the losses with their gradients, one Adam step of what is seen, and the 3D filter."""
    whole = Iteration(gaussians, camera, threads, depth=True)
    image, photo = whole.forward(), whole.photo
    seen = image.backward(whole.losses(image))
    normals = (image.depth, image.geometric_normal, image.normal, image.alpha)
    store = ArrayStore()
    adam, rates, means = whole.adam, whole.rates, gaussians.means.numpy()
    return [
        (
            "L1 + SSIM and gradient",
            lambda: color_loss(image.color, photo, threads=threads, store=store),
        ),
        (
            "both normal losses, gradient",
            lambda: normal_losses(*normals, camera, threads=threads, store=store),
        ),
        ("Adam, seen Gaussians", lambda: adam.step_rows(seen, rates, threads=threads)),
        ("3D filter, 50 cameras", lambda: mip_filter(means, [camera] * 50, threads=threads)),
    ]


def iteration_parts(gaussians: OrientedGaussians, camera: Camera, threads: int) -> list[Part]:
    """Return whole iterations, and the raster kernels of each alone."""
    parts: list[Part] = []
    for name, depth, statistics in (
        ("colour", False, False),
        ("colour, AbsGS", False, True),
        ("depth + normals", True, False),
    ):
        whole = Iteration(gaussians, camera, threads, depth=depth, statistics=statistics)
        alone = Iteration(gaussians, camera, threads, depth=depth, statistics=statistics)
        parts += [(f"{WHOLE}, {name}", whole.run), (f"  {RASTER}, {name}", alone.raster())]
    return parts
