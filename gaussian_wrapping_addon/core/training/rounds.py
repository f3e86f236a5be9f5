# SPDX-License-Identifier: GPL-3.0-or-later
"""Updates between iterations: density control, wrapping, 3D filter."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from .. import limits
from ..gaussians.model import OrientedGaussians, mip_filter
from ..progress import Progress
from ..scene.scene import PhotoSource
from .density import (
    contradicted,
    densify_and_prune,
    needed_by_a_view,
    prune_contributors,
    reset_opacity,
)
from .focus import Focus
from .iteration import Stepper
from .model_selection import select_poses
from .schedule import Schedule
from .state import TrainingState, cancellable
from .wrapping import WrapView, normal_errors, start_orientation, wrap

_logger = logging.getLogger(__name__)

PRUNE_DIVISOR = 2
VOTE_DIVISOR = 4
"""Divisors of the image size at which views are rendered for pruning and for the vote."""


class Rounds:
    """Updates of the set of Gaussians. They depend on the state and the inputs alone.

    Parameters
    ----------
    progress : Progress
        Checked for cancellation before every view of a round.
    filter_views : sequence of int, optional
        Views whose pixels the 3D filter follows; by default the training views.
    focus : Focus, optional
        Gaussians in its regions count ``region_weight`` times.
    """

    def __init__(
        self,
        stepper: Stepper,
        progress: Progress,
        filter_views: Sequence[int] | None = None,
        focus: Focus | None = None,
    ) -> None:
        self.stepper, self.focus = stepper, focus
        self.filter_views = stepper.views if filter_views is None else list(filter_views)
        self.photos: PhotoSource = stepper.photos
        self.schedule: Schedule = stepper.schedule
        self.settings, self.views, self.threads = (
            self.schedule.settings, stepper.views, stepper.threads,
        )  # fmt: skip
        self.progress = progress

    def before_step(self, state: TrainingState) -> None:
        """Update the state before an iteration."""
        iteration, schedule = state.iteration, self.schedule
        if iteration > 0 and schedule.divisor(iteration) != schedule.divisor(iteration - 1):
            self.filter(state)
        if schedule.starts_orientation(iteration):
            start_orientation(
                state.adam, self._views(VOTE_DIVISOR), self.stepper.renderer,
                first_sign=self.settings.first_sign, threads=self.threads,
            )  # fmt: skip
        if self.settings.harmonics == "on":
            state.degree = schedule.sh_degree(iteration)

    def after_step(self, state: TrainingState) -> None:
        """Apply the updates that are due after an iteration."""
        iteration, schedule, adam = state.iteration, self.schedule, state.adam
        if iteration >= self.settings.iterations:
            if schedule.refilters(iteration):
                self.filter(state)
            return
        changed = False
        if schedule.densifies(iteration):
            self._densify(state)
            changed = True
        if schedule.prunes(iteration):
            self._prune(state)
            changed = True
        if changed:
            self._empty_free_space(state)
        if schedule.decides_poses(iteration):
            self._decide_poses(state)
        if schedule.wraps(iteration) and schedule.is_oriented(iteration):
            changed |= self._wrap(state)
        if changed:
            state.clear_statistics()
        if changed or schedule.refilters(iteration):
            self.filter(state)
        if schedule.resets_opacity(iteration):
            reset_opacity(adam)

    def filter(self, state: TrainingState) -> None:
        """Compute the 3D filter for the image size of the coming iteration."""
        state.adam.array("filter_3d")[:] = self._filter_of(state)

    def filtered(self, state: TrainingState) -> OrientedGaussians:
        """Return the Gaussians with an updated filter; the state is unchanged and can train on."""
        fresh = torch.from_numpy(self._filter_of(state).astype(np.float32))
        return state.adam.gaussians().detached().replaced(filter_3d=fresh)

    def _filter_of(self, state: TrainingState) -> np.ndarray:
        divisor = self.schedule.divisor(min(state.iteration, self.schedule.total - 1))
        cameras = [self.photos.camera(i, divisor) for i in self.filter_views]
        widths = mip_filter(
            state.adam.array("means"),
            cameras,
            variance_px=self.settings.filter_variance,
            threads=self.threads,
        )
        frozen = state.adam.frozen
        widths[:frozen] = state.adam.array("filter_3d")[:frozen]
        return widths

    def _decide_poses(self, state: TrainingState) -> None:
        if state.poses is None or self.settings.refine_poses != "auto":
            return
        cameras = {view: self.photos.camera(view, 1) for view in self.views}
        decision = select_poses(state.poses, cameras, state.adam.array("means"))
        state.model_selection = state.model_selection.with_decision(decision)

    def _densify(self, state: TrainingState) -> None:
        change = densify_and_prune(
            state.adam, state.statistics, self.schedule.budget(state.iteration), state.random,
            self._region_weights(state), least_score=self.settings.densify_score,
            min_opacity=self.settings.min_opacity,
        )  # fmt: skip
        _logger.debug(
            "iteration %d: cloned %d, split %d, pruned %d Gaussians",
            state.iteration, change.cloned, change.split, change.pruned,
        )  # fmt: skip

    def _prune(self, state: TrainingState) -> None:
        """Remove the Gaussians that no training view needs."""
        needed = needed_by_a_view(
            state.adam.gaussians().detached(), self._views(PRUNE_DIVISOR), self.stepper.renderer,
            self.settings.prune_share, self._region_weights(state), threads=self.threads,
        )  # fmt: skip
        gone = prune_contributors(state.adam, needed)
        _logger.info("iteration %d: pruned %d Gaussians", state.iteration, gone)

    def _empty_free_space(self, state: TrainingState) -> None:
        """Remove the Gaussians in space that photos see through, where that is known."""
        priors, least_views = self.stepper.priors, self.settings.free_views
        if priors and least_views:
            inside = contradicted(state.adam.array("means"), priors, least_views)
            gone = prune_contributors(state.adam, ~inside)
            _logger.info("iteration %d: %d Gaussians in free space", state.iteration, gone)

    def _normal_errors(self, state: TrainingState) -> np.ndarray:
        views = self._views(self.settings.wrap_divisor)
        return normal_errors(
            state.adam.gaussians(), views, self.stepper.renderer, threads=self.threads
        )

    def _wrap(self, state: TrainingState) -> bool:
        """Clone Gaussians with the opposite orientation; return whether there are new ones."""
        errors = self._normal_errors(state)
        limit = self.schedule.most_gaussians
        return wrap(state.adam, errors, self.settings.wrap_share, limit) > 0

    def _region_weights(self, state: TrainingState) -> np.ndarray | None:
        """Return (n,) weights of the Gaussians, or ``None`` if all weigh the same."""
        if self.focus is None:
            return None
        within = self.focus.contains(state.adam.array("means").astype(np.float64))
        return np.where(within, self.settings.region_weight, 1.0)

    def _views(self, divisor: int) -> Iterator[WrapView]:
        """Yield all training views at reduced size.

        All of them, however many: what only the views left out show would count as unseen.
        """
        side = self.schedule.long_side_px
        divisor = divisor if side / divisor >= 2 * limits.TILE_PX else 1
        for view in cancellable(self.views, self.progress):
            yield WrapView(self.photos.camera(view, divisor), self.photos.mask(view, divisor))
