# SPDX-License-Identifier: GPL-3.0-or-later
"""The backend of the processor: compiled kernels on numpy arrays, in reused memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..parallel import ArrayStore
from ..render.projection import RawArrays
from ..render.types import ImageGradients, RenderOptions, VisibleGradients
from ..render.view_renderer import ViewPass, ViewRenderer
from ..scene.camera import Camera
from ..scene.scene import PhotoSource
from ..stereo.depth_maps import DepthPrior
from .adam import Adam, merge_gradients
from .backend import Backend, Shown, Window, counts_of
from .background import background_gradient, composited
from .camera_poses import pose_gradient
from .density import DensityStatistics
from .exposure import Exposure
from .losses import (
    add_footprint_regulariser,
    add_opacity_prior,
    color_loss,
    depth_prior_loss,
    footprint_shares,
    normal_losses,
)
from .multi_view import MultiViewOptions, PhotoView, multi_view_losses


class CpuBackend(Backend):
    """Runs on the processor; methods as in :class:`.Backend`.

    Parameters
    ----------
    threads : int
        The result does not depend on it.
    """

    name = "cpu"

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self.renderer, self.store = ViewRenderer(), ArrayStore()

    def adopted(self, adam: Adam) -> Adam:
        return adam.on_host()

    def adopted_statistics(self, statistics: DensityStatistics) -> DensityStatistics:
        return statistics.on_host()

    def shown(self, photos: PhotoSource, view: int, divisor: int, window: Window | None) -> Shown:
        photo, mask = photos.photo(view, divisor), photos.mask(view, divisor)
        if window is not None:
            photo, mask = window.of(photo), None if mask is None else window.of(mask)
        return Shown(photo, mask, *counts_of(mask, *photo.shape[:2]))

    def render(self, adam: Adam, camera: Camera, options: RenderOptions) -> ViewPass:
        return self.renderer.render(RawArrays.from_gaussians(adam.gaussians()), camera, options)

    def compare_colors(
        self, image: ViewPass, shown: Shown, lambda_dssim: float, *,
        exposure: tuple[Exposure, int] | None, background: np.ndarray | None, over_emptiness: bool,
    ) -> tuple[float, ImageGradients, float]:  # fmt: skip
        alpha = image.alpha if over_emptiness else None
        color, threads = image.color, self.threads
        if exposure is not None:
            color = exposure[0].corrected(exposure[1], image.color, alpha, threads=threads)
        photo, mask = shown.photo, shown.mask
        if background is not None:
            color, photo = composited(color, image.alpha, photo, mask, background, store=self.store)
            mask = None
        value, by_color, mean_squared = color_loss(
            color, photo, mask, lambda_dssim=lambda_dssim, threads=threads, store=self.store
        )
        by_alpha = None if background is None else background_gradient(by_color, background)
        if exposure is not None:
            by_color, more = exposure[0].backward(
                exposure[1], image.color, by_color, alpha, threads=threads
            )
            if by_alpha is not None and more is not None:
                by_alpha += more
        return value, ImageGradients(color=by_color, alpha=by_alpha), mean_squared

    def normal_losses(
        self, image: ViewPass, camera: Camera, shown: Shown, *, lambda_depth_normal: float,
        lambda_normal: float,
    ) -> tuple[float, ImageGradients]:  # fmt: skip
        return normal_losses(
            image.depth, image.geometric_normal, image.normal, image.alpha, camera, shown.mask,
            lambda_depth_normal=lambda_depth_normal, lambda_normal=lambda_normal,
            threads=self.threads, store=self.store,
        )  # fmt: skip

    def prior_loss(
        self, image: ViewPass, camera: Camera, prior: DepthPrior, shown: Shown, weight: float
    ) -> tuple[float, ImageGradients]:
        return depth_prior_loss(
            image.depth, camera, prior, shown.mask, weight=weight,
            threads=self.threads, store=self.store,
        )  # fmt: skip

    def compare_views(
        self, image: ViewPass, adam: Adam, camera: Camera, shown: Shown, other_camera: Camera,
        other: Shown, options: MultiViewOptions, random: np.random.Generator,
    ) -> tuple[float, ImageGradients, VisibleGradients | None]:  # fmt: skip
        found = multi_view_losses(
            image, image.gaussians, PhotoView(camera, shown.photo, shown.mask),
            PhotoView(other_camera, other.photo, other.mask), options, random,
            threads=self.threads, store=self.store,
        )  # fmt: skip
        return found.value, found.gradients, found.other

    def backward(self, image: ViewPass, gradients: ImageGradients) -> VisibleGradients:
        return image.backward(gradients)

    def add_priors(
        self, image: ViewPass, gradients: VisibleGradients, adam: Adam, price: float,
        opacity_weight: float,
    ) -> None:  # fmt: skip
        if price <= 0.0 and opacity_weight <= 0.0:
            return
        height, width = image.alpha.shape
        shares = footprint_shares(image.screen.boxes[gradients.ids], (width, height))
        if price > 0.0:
            add_footprint_regulariser(gradients, adam.array("log_scales"), shares, price)
        if opacity_weight > 0.0:
            add_opacity_prior(gradients, adam.array("opacity_logits"), shares, opacity_weight)

    def pose_gradient(self, camera: Camera, gradients: VisibleGradients, adam: Adam) -> np.ndarray:
        pose = np.asarray(camera.cam_from_world, np.float64)
        return pose_gradient(pose, gradients, adam.array("means"), adam.array("quats"))

    def merged(
        self, gradients: VisibleGradients, other: VisibleGradients, count: int
    ) -> VisibleGradients:
        return merge_gradients(gradients, other, count, threads=self.threads, store=self.store)

    def add_statistics(
        self, statistics: DensityStatistics, image: ViewPass, width: int, height: int, part: float
    ) -> None:
        assert image.statistics is not None
        statistics.add(image.statistics, width, height, part)

    def step(
        self,
        adam: Adam,
        gradients: VisibleGradients,
        rates: Mapping[str, np.ndarray],
        sh_degree: int,
    ) -> None:
        adam.step_rows(gradients, rates, sh_degree=sh_degree, threads=self.threads)

    def numbers(self, *values: Any) -> list[np.ndarray]:
        return [np.asarray(value, np.float64) for value in values]
