# SPDX-License-Identifier: GPL-3.0-or-later
"""One training iteration: render a window of a photo, compute the losses, step the Gaussians."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..gaussians.model import OrientedGaussians
from ..render.types import ImageGradients, RenderOptions
from ..scene.camera import Camera
from ..scene.scene import PhotoSource
from ..stereo.depth_maps import DepthPrior
from .adam import add_image_gradients
from .backend import Backend, Shown, Window, windows
from .background import draw_background
from .camera_poses import pose_rate_px
from .exposure import exposure_rate
from .focus import SURROUNDINGS_SHARE
from .multi_view import MultiViewOptions
from .schedule import Schedule
from .state import TrainingState

AVERAGE_SHARE = 0.05
"""Weight of the newest iteration in the moving averages of the progress message."""


class NotFinite(Exception):  # noqa: N818 - asks for a restart, caught in trainer.py
    """A loss is not finite."""


@dataclass(frozen=True)
class _Sample:
    """Training sample of one iteration: a window of a view."""

    view: int
    divisor: int
    whole: Camera
    window: Window
    camera: Camera
    shown: Shown
    of_surroundings: bool


class Stepper:
    """Run training iterations. All that the next one depends on is in the state.

    Parameters
    ----------
    views : sequence of int
        Training views.
    neighbours : dict of int to (k,) array
        For each training view, the views that the multi-view terms compare it with.
    backend : Backend
        Computes; the samples drawn do not depend on it.
    rectangles : callable, optional
        Returns those that most iterations are for, by photo and divisor
        (:meth:`~.focus.Focus.rectangles`); without it windows are drawn evenly over all pixels.
    """

    def __init__(
        self, photos: PhotoSource, schedule: Schedule, views: Sequence[int],
        neighbours: dict[int, np.ndarray], backend: Backend, threads: int,
        rectangles: Callable[[int, int], list[Window]] | None = None,
    ) -> None:  # fmt: skip
        self.photos, self.schedule, self.views = photos, schedule, list(views)
        self.settings, self.threads = schedule.settings, threads
        self.neighbours, self.backend, self.rectangles = neighbours, backend, rectangles
        self.priors: dict[int, DepthPrior] = {}
        """Confirmed depths of views that training started on."""
        self.multi_view = MultiViewOptions.of_settings(schedule.settings)

    @property
    def renderer(self) -> Any:
        """Renderer of whole views, in the memory that iterations use as well."""
        return self.backend.renderer

    def step(self, state: TrainingState) -> None:
        """Run one iteration.

        Raises
        ------
        NotFinite
            The loss is not finite; the state must be discarded.
        """
        iteration, schedule, adam = state.iteration, self.schedule, state.adam
        backend = self.backend
        sample = self._draw_sample(state)
        oriented = schedule.is_oriented(iteration)
        gathers, uses_depth = schedule.gathers_statistics(iteration), schedule.uses_depth(iteration)
        options = RenderOptions(
            depth=uses_depth, sh_degree=state.degree, threads=self.threads, screen_gradients=gathers
        )
        image = backend.render(adam, sample.camera, options)
        value, gradients, mean_squared = self._compare_colors(state, sample, image)
        other: Any = None
        if uses_depth:
            normal_value, by_normals = backend.normal_losses(
                image, sample.camera, sample.shown,
                lambda_depth_normal=self.settings.lambda_depth_normal,
                lambda_normal=self.settings.lambda_normal if oriented else 0,
            )  # fmt: skip
            value = value + normal_value
            gradients = add_image_gradients(by_normals, gradients)
            weight, prior = schedule.prior_weight(iteration), self.priors.get(sample.view)
            if weight > 0.0 and prior is not None:
                prior_value, by_prior = backend.prior_loss(
                    image, sample.camera, prior, sample.shown, weight
                )
                value = value + prior_value
                gradients = add_image_gradients(by_prior, gradients)
            if self._compares_views(state, sample):
                shared_value, by_views, other = self._compare_views(state, sample, image)
                value = value + shared_value
                gradients = add_image_gradients(gradients, by_views)
        if isinstance(value, float) and not math.isfinite(value):
            raise NotFinite()
        seen = backend.backward(image, gradients)
        # Before merging the other view's gradients: culled Gaussians have no boxes in this view.
        price = self.settings.overlap_price if self.schedule.controls_density else 0.0
        opacity_weight = schedule.opacity_weight(iteration)
        if not state.model_selection.chose("dense_start"):
            opacity_weight = 0.0
        backend.add_priors(image, seen, adam, price, opacity_weight)
        by_pose = None
        if state.poses is not None and schedule.refines_poses(iteration):
            by_pose = backend.pose_gradient(sample.camera, seen, adam)
        if other is not None:
            seen = backend.merged(seen, other, len(adam))
        if gathers:
            whole, shown = sample.whole, sample.camera
            part = shown.width * shown.height / (whole.width * whole.height)
            backend.add_statistics(state.statistics, image, whole.width, whole.height, part)
        rates = schedule.rates(iteration, state.rate_factor)
        if not oriented:
            rates.pop("orientation", None)
        backend.step(adam, seen, rates, state.degree)
        found = backend.numbers(value, mean_squared, *([] if by_pose is None else [by_pose]))
        if not math.isfinite(found[0]):
            raise NotFinite()
        if by_pose is not None:
            self._step_pose(state, sample, found[2])
        if state.exposure is not None:
            rate = exposure_rate(iteration, self.settings.iterations, len(self.views))
            state.exposure.step(sample.view, state.rate_factor * rate)
        state.iteration = iteration + 1
        if self._is_empty(sample) or sample.of_surroundings:
            return  # no pixel was compared, or only pixels that training is not for
        error = float(found[1])
        share = AVERAGE_SHARE if state.error_average > 0.0 else 1.0
        state.error_average += share * (error - state.error_average)
        state.loss_average += share * (float(found[0]) - state.loss_average)

    def _step_pose(self, state: TrainingState, sample: _Sample, by_pose: np.ndarray) -> None:
        """Move the photo's camera; at the end of an epoch take out what all cameras share."""
        poses = state.poses
        assert poses is not None
        rate_px = pose_rate_px(state.iteration, self.settings.iterations, len(self.views))
        whole = self.photos.camera(sample.view, 1)
        poses.step(sample.view, whole, by_pose, state.rate_factor * rate_px)
        if not state.order:
            poses.anchor()

    def _draw_sample(self, state: TrainingState) -> _Sample:
        view = state.next_view(self.views)
        divisor = self.schedule.divisor(state.iteration)
        boxes = self._boxes(state, view, divisor)
        if boxes == []:
            divisor = self.schedule.coarser(divisor)
        whole, mask = self.photos.camera(view, divisor), self.photos.mask(view, divisor)
        choices = [
            dataclasses.replace(part, left=part.left + box.left, top=part.top + box.top)
            for box in boxes or [Window(0, 0, whole.width, whole.height)]
            for part in windows(box.width, box.height, self.settings.pixels_per_iteration)
        ]
        useful = choices
        if mask is not None and self.settings.mask_mode == "ignore":
            useful = [window for window in choices if window.of(mask).any()] or choices
        window = useful[int(state.random.integers(len(useful)))]
        part = None if len(choices) == 1 and not boxes else window
        seen = self.backend.shown(self.photos, view, divisor, part)
        return _Sample(view, divisor, whole, window, window.camera(whole), seen, boxes == [])

    def _boxes(self, state: TrainingState, view: int, divisor: int) -> list[Window] | None:
        """Return the rectangles of the regions in a photo to train on this time.

        ``None``: there is nothing to prefer in it; empty: it is for the surroundings, coarser.
        """
        if self.rectangles is None:
            return None
        boxes = self.rectangles(view, divisor)
        whole = self.photos.camera(view, divisor)
        if boxes == [Window(0, 0, whole.width, whole.height)]:
            return None
        return boxes if boxes and state.random.random() >= SURROUNDINGS_SHARE else []

    def _is_empty(self, sample: _Sample) -> bool:
        """Return whether the mask leaves no pixel to compare."""
        return self.settings.mask_mode == "ignore" and sample.shown.pixels == 0

    def _compare_colors(
        self, state: TrainingState, sample: _Sample, image: Any
    ) -> tuple[Any, ImageGradients, Any]:
        """Return the colour loss, its gradients on colour and alpha, and the mean squared error."""
        empty = self.settings.mask_mode == "background"
        return self.backend.compare_colors(
            image, sample.shown, self.settings.lambda_dssim,
            exposure=None if state.exposure is None else (state.exposure, sample.view),
            background=draw_background(state.random) if empty else None, over_emptiness=empty,
        )  # fmt: skip

    def _compares_views(self, state: TrainingState, sample: _Sample) -> bool:
        if not state.model_selection.chose("multi_view") or len(self.neighbours[sample.view]) == 0:
            return False
        if sample.of_surroundings:
            return False
        return self.schedule.compares_views(state.iteration)

    def _compare_views(
        self, state: TrainingState, sample: _Sample, image: Any
    ) -> tuple[Any, ImageGradients, Any]:
        choices = self.neighbours[sample.view]
        other = int(choices[int(state.random.integers(len(choices)))])
        return self.backend.compare_views(
            image, state.adam, sample.camera, sample.shown,
            self.photos.camera(other, sample.divisor),
            self.backend.shown(self.photos, other, sample.divisor, None), self.multi_view,
            state.random,
        )  # fmt: skip


def trimmed(gaussians: OrientedGaussians, degree: int) -> OrientedGaussians:
    """Return the Gaussians without the harmonics above a degree, which were never used."""
    used = (degree + 1) ** 2
    return dataclasses.replace(gaussians, sh=gaussians.sh[:, :used].contiguous())
