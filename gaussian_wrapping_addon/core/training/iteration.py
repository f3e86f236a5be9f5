# SPDX-License-Identifier: GPL-3.0-or-later
"""One training iteration: render a window of a photo, compute the losses, step the Gaussians."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..dataset.camera import Camera
from ..dataset.photo_source import PhotoSource
from ..gaussians.model import OrientedGaussians
from ..kernels.array_store import ArrayStore
from ..render.projection.projection import RawArrays
from ..render.types.gradients import ImageGradients, VisibleGradients
from ..render.types.options import RenderOptions
from ..render.view_renderer import ViewPass, ViewRenderer
from ..stereo.depth_priors import DepthPrior
from .appearance.background import background_gradient, composited, draw_background
from .appearance.photo_exposure import exposure_rate
from .losses.depth_prior_loss import depth_prior_loss
from .losses.footprint_regulariser import add_footprint_regulariser, footprint_shares
from .losses.losses import color_loss, normal_losses
from .losses.multi_view import (
    MultiViewOptions,
    add_image_gradients,
    merge_gradients,
    multi_view_losses,
)
from .losses.opacity_prior import add_opacity_prior
from .poses.camera_poses import pose_rate_px
from .poses.pose_gradient import pose_gradient
from .schedule import Schedule
from .state import TrainingState
from .windows import Window, windows

AVERAGE_SHARE = 0.05
"""Weight of the newest iteration in the moving averages of the progress message."""

_MAX_WINDOWS = 1 << 12
"""Upper bound of the windows per photo; combines view and window into one history index."""


def is_oriented(schedule: Schedule, state: TrainingState) -> bool:
    """Tell whether the orientation is trained now: from its start on, unless wrapping is off."""
    wrapping = state.model_selection.get("wrapping")
    off = wrapping is not None and wrapping.chosen == "off"
    return not off and schedule.is_oriented(state.iteration)


def may_wrap(schedule: Schedule, state: TrainingState) -> bool:
    """Tell whether a wrapping round may clone now: oriented, and decided where photos decide."""
    undecided = state.model_selection.get("wrapping") is None
    waits = undecided and schedule.settings.wrapping == "auto"
    return not waits and is_oriented(schedule, state)


class NotFinite(Exception):  # noqa: N818 - asks for a restart, caught in trainer.py
    """A loss is not finite."""


@dataclass(frozen=True)
class _Sample:
    """Training sample of one iteration: a window of a view."""

    view: int
    divisor: int
    whole: Camera
    window: Window
    number: int
    camera: Camera
    photo: np.ndarray  # (h, w, 3) uint8
    mask: np.ndarray | None  # (h, w) bool


class Stepper:
    """Run training iterations. All that the next one depends on is in the state.

    Parameters
    ----------
    photos : PhotoStore
    schedule : Schedule
    views : sequence of int
        Training views.
    neighbours : dict of int to (k,) array
        For each training view, the views that the multi-view terms compare it with.
    threads : int
    """

    def __init__(
        self,
        photos: PhotoSource,
        schedule: Schedule,
        views: Sequence[int],
        neighbours: dict[int, np.ndarray],
        threads: int,
    ) -> None:
        self.photos, self.schedule, self.views = photos, schedule, list(views)
        self.settings, self.threads = schedule.settings, threads
        self.neighbours = neighbours
        self.renderer, self.store = ViewRenderer(), ArrayStore()
        self.priors: dict[int, DepthPrior] = {}
        """Confirmed depths of views that training started on."""
        self.multi_view = MultiViewOptions.of_settings(schedule.settings)

    def step(self, state: TrainingState) -> None:
        """Run one iteration.

        Raises
        ------
        NotFinite
            The loss is not finite; the state must be discarded.
        """
        iteration, schedule, adam = state.iteration, self.schedule, state.adam
        sample = self._draw_sample(state)
        oriented = is_oriented(schedule, state)
        gathers, uses_depth = schedule.gathers_statistics(iteration), schedule.uses_depth(iteration)
        options = RenderOptions(
            depth=uses_depth, sh_degree=state.degree, threads=self.threads, screen_gradients=gathers
        )
        gaussians = RawArrays.from_gaussians(adam.gaussians())
        image = self.renderer.render(gaussians, sample.camera, options)
        value, gradients, mean_squared = self._compare_colors(state, sample, image)
        other: VisibleGradients | None = None
        if uses_depth:
            normal_value, by_normals, _ = normal_losses(
                image.depth,
                image.geometric_normal,
                image.normal,
                image.alpha,
                sample.camera,
                sample.mask,
                lambda_depth_normal=self.settings.lambda_depth_normal,
                lambda_normal=self.settings.lambda_normal if oriented else 0,
                threads=self.threads,
                store=self.store,
            )
            value += normal_value
            gradients = add_image_gradients(by_normals, gradients)
            weight, prior = schedule.prior_weight(iteration), self.priors.get(sample.view)
            if weight > 0.0 and prior is not None:
                prior_value, by_prior = depth_prior_loss(
                    image.depth, sample.camera, prior, sample.mask, weight=weight,
                    threads=self.threads, store=self.store,
                )  # fmt: skip
                value += prior_value
                gradients = add_image_gradients(by_prior, gradients)
            if self._compares_views(state, sample):
                shared = self._compare_views(state, sample, image, gaussians)
                value += shared[0]
                gradients, other = add_image_gradients(gradients, shared[1]), shared[2]
        if not math.isfinite(value):
            raise NotFinite()
        seen = image.backward(gradients)
        # Before merging the other view's gradients: culled Gaussians have no boxes in this view.
        price = self.settings.overlap_price if self.schedule.compact else 0.0
        opacity_weight = schedule.opacity_weight(iteration)
        if not state.model_selection.chose("dense_start"):
            opacity_weight = 0.0
        if price > 0.0 or opacity_weight > 0.0:
            size_px = (sample.camera.width, sample.camera.height)
            shares = footprint_shares(image.screen.boxes[seen.ids], size_px)
            if price > 0.0:
                add_footprint_regulariser(seen, adam.array("log_scales"), shares, price)
            if opacity_weight > 0.0:
                add_opacity_prior(seen, adam.array("opacity_logits"), shares, opacity_weight)
        if state.poses is not None and schedule.refines_poses(iteration):
            self._step_pose(state, sample, seen)
        if other is not None:
            seen = merge_gradients(seen, other, len(adam), threads=self.threads, store=self.store)
        if gathers:
            assert image.statistics is not None
            part = (
                sample.camera.width
                * sample.camera.height
                / (sample.whole.width * sample.whole.height)
            )
            state.statistics.add(image.statistics, sample.whole.width, sample.whole.height, part)
        rates = schedule.rates(iteration, state.rate_factor)
        if not oriented:
            rates.pop("orientation", None)
        adam.step_rows(seen, rates, sh_degree=state.degree, threads=self.threads)
        if state.exposure is not None:
            rate = exposure_rate(iteration, self.settings.iterations, len(self.views))
            state.exposure.step(sample.view, state.rate_factor * rate)
        state.iteration = iteration + 1
        if self._is_empty(sample):
            return  # no pixel was compared, so there is no error to record
        window_id = sample.view * _MAX_WINDOWS + sample.number
        state.error_history.add(iteration, window_id, len(adam), mean_squared, sample.divisor)
        share = AVERAGE_SHARE if state.error_average > 0.0 else 1.0
        state.error_average += share * (mean_squared - state.error_average)
        state.loss_average += share * (value - state.loss_average)

    def _step_pose(
        self, state: TrainingState, sample: _Sample, gradients: VisibleGradients
    ) -> None:
        """Move the photo's camera; at the end of an epoch take out what all cameras share."""
        adam, poses = state.adam, state.poses
        assert poses is not None
        pose = np.asarray(sample.camera.cam_from_world, np.float64)
        by_pose = pose_gradient(pose, gradients, adam.array("means"), adam.array("quats"))
        rate_px = pose_rate_px(state.iteration, self.settings.iterations, len(self.views))
        whole = self.photos.camera(sample.view, 1)
        poses.step(sample.view, whole, by_pose, state.rate_factor * rate_px)
        if not state.order:
            poses.anchor()

    def _draw_sample(self, state: TrainingState) -> _Sample:
        view = state.next_view(self.views)
        divisor = self.schedule.divisor(state.iteration)
        whole, mask = self.photos.camera(view, divisor), self.photos.mask(view, divisor)
        choices = windows(whole.width, whole.height, self.settings.pixels_per_iteration)
        numbers = np.arange(len(choices))
        if mask is not None and self.settings.mask_mode == "ignore":
            shown = np.array([bool(window.of(mask).any()) for window in choices])
            numbers = np.flatnonzero(shown) if shown.any() else numbers
        number = int(numbers[int(state.random.integers(len(numbers)))])
        window = choices[number]
        return _Sample(
            view,
            divisor,
            whole,
            window,
            number,
            window.camera(whole),
            window.of(self.photos.photo(view, divisor)),
            None if mask is None else window.of(mask),
        )

    def _is_empty(self, sample: _Sample) -> bool:
        """Return whether the mask leaves no pixel to compare."""
        ignores = self.settings.mask_mode == "ignore"
        return ignores and sample.mask is not None and not sample.mask.any()

    def _compare_colors(
        self, state: TrainingState, sample: _Sample, image: ViewPass
    ) -> tuple[float, ImageGradients, float]:
        """Return the colour loss, its gradients on colour and alpha, and the mean squared error."""
        empty = self.settings.mask_mode == "background"
        alpha = image.alpha if empty else None
        color, exposure = image.color, state.exposure
        if exposure is not None:
            color = exposure.corrected(sample.view, image.color, alpha, threads=self.threads)
        photo, mask = sample.photo, sample.mask
        background = draw_background(state.random) if empty else None
        if background is not None:
            color, photo = composited(color, image.alpha, photo, mask, background, store=self.store)
            mask = None
        value, by_color, figures = color_loss(
            color,
            photo,
            mask,
            lambda_dssim=self.settings.lambda_dssim,
            threads=self.threads,
            store=self.store,
        )
        by_alpha = None if background is None else background_gradient(by_color, background)
        if exposure is not None:
            by_color, more = exposure.backward(
                sample.view, image.color, by_color, alpha, threads=self.threads
            )
            if by_alpha is not None and more is not None:
                by_alpha += more
        return value, ImageGradients(color=by_color, alpha=by_alpha), figures.mean_squared

    def _compares_views(self, state: TrainingState, sample: _Sample) -> bool:
        if not state.model_selection.chose("multi_view") or len(self.neighbours[sample.view]) == 0:
            return False
        return self.schedule.compares_views(state.iteration)

    def _compare_views(
        self, state: TrainingState, sample: _Sample, image: ViewPass, gaussians: RawArrays
    ) -> tuple[float, ImageGradients, VisibleGradients | None]:
        choices = self.neighbours[sample.view]
        other = int(choices[int(state.random.integers(len(choices)))])
        found = multi_view_losses(
            image,
            gaussians,
            sample.camera,
            sample.photo,
            sample.mask,
            self.photos.camera(other, sample.divisor),
            self.photos.photo(other, sample.divisor),
            self.photos.mask(other, sample.divisor),
            self.multi_view,
            state.random,
            threads=self.threads,
            store=self.store,
        )
        return found.value, found.gradients, found.other


def trimmed(gaussians: OrientedGaussians, degree: int) -> OrientedGaussians:
    """Return the Gaussians without the harmonics above a degree, which were never used."""
    used = (degree + 1) ** 2
    return dataclasses.replace(gaussians, sh=gaussians.sh[:, :used].contiguous())
