# SPDX-License-Identifier: GPL-3.0-or-later
"""The training loop: photos and cameras in, oriented Gaussians out, resumable at any moment."""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from .. import tolerances
from ..dataset.camera import Camera
from ..dataset.scene import Scene
from ..errors import Cancelled, DatasetError, WrapError
from ..evaluation.views.lpips import lpips_if_ready
from ..evaluation.views.view_metrics import score_images
from ..gaussians.initialisation import initial_gaussians
from ..gaussians.mip_filter import mip_filter
from ..gaussians.model import OrientedGaussians
from ..parallel import default_threads
from ..progress import Progress
from ..render.array_store import ArrayStore
from ..render.projection import RawArrays
from ..render.types import ImageGradients, RenderOptions
from ..render.view_renderer import ViewRenderer
from ..settings import TrainingSettings
from .checkpoint import fingerprint, load_checkpoint, save_checkpoint
from .contribution import contributions, least_contributors, prune_contributors
from .density_control import densify_and_prune, reset_opacity
from .losses import color_loss, normal_losses
from .overlap_price import add_overlap_price
from .result import HeldOutFigure, TrainingResult
from .schedule import Schedule
from .state import TrainingState
from .windows import windows
from .wrapping import WrapView, normal_errors, start_orientation, wrap

_logger = logging.getLogger(__name__)

FEW_PHOTOS = 8
"""With fewer photos than this, only one is held out."""

MAX_ROUND_VIEWS = 60
"""Wrapping rounds and the orientation's vote look at no more views, spread evenly."""

ROUND_DIVISOR = 2
VOTE_DIVISOR = 4
SNAPSHOT_EVERY = 100
"""Iterations between two looks at all numbers, and two states to fall back to."""

REPORT_EVERY = 10
AVERAGE_SHARE = 0.05
"""Weight of the newest iteration in the figures of the progress message."""

TOO_SMALL = "The photos are too small for LPIPS."

RESTART_RATE = 0.5
"""Learning rates are multiplied by this after a restart."""


class Photos(Protocol):
    """What the trainer asks of :class:`~..dataset.photos.PhotoStore`."""

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Return the camera of a level."""

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """Return (h, w, 3) uint8."""

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        """Return (h, w) bool or ``None``."""


class _NotFinite(Exception):  # noqa: N818 - caught inside this module only
    pass


def held_out_views(scene: Scene, every: int) -> list[int]:
    """Return the views that are measured and never trained on.

    Every n-th photo of the list sorted by name; the first alone where there are fewer than
    :data:`FEW_PHOTOS`; none where ``every`` is 0 or too few would be left.
    """
    count = len(scene.views)
    if every <= 0 or count < 3:
        return []
    ranked = sorted(range(count), key=lambda i: (scene.views[i].camera.name, i))
    if count < FEW_PHOTOS or every == 1:
        return ranked[:1]
    return sorted(ranked[::every])


def train(
    scene: Scene,
    photos: Photos,
    settings: TrainingSettings,
    folder: Path,
    progress: Progress,
    *,
    seed: int = 0,
    threads: int = 0,
) -> TrainingResult:
    """Train oriented Gaussians on the photos of a scene.

    Resumes from the newest checkpoint in ``folder``; the result is then bit for bit that of a run
    without interruption on the same machine.

    Parameters
    ----------
    scene : Scene
    photos : PhotoStore
        Photos, masks and cameras of the scene's views. Masked pixels count nowhere.
    settings : TrainingSettings
    folder : Path
        Checkpoints are written here.
    progress : Progress
        Told every few iterations; asked for cancelling in every one.
    seed, threads : int
        0 threads uses every core. The result does not depend on ``threads``.

    Returns
    -------
    TrainingResult

    Raises
    ------
    Cancelled
        After a checkpoint was written.
    DatasetError
        There is no photo to train on, or masks leave nothing of all of them.
    WrapError
        The numbers stopped being finite twice.
    """
    threads = threads or default_threads()
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return _Trainer(scene, photos, settings, folder, seed, threads).run(progress)
    finally:
        torch.set_num_threads(before)


class _Trainer:
    """One run. What it holds beside the state follows from the inputs alone."""

    def __init__(
        self,
        scene: Scene,
        photos: Photos,
        settings: TrainingSettings,
        folder: Path,
        seed: int,
        threads: int,
    ) -> None:
        self.scene, self.photos, self.settings = scene, photos, settings
        self.folder, self.seed, self.threads = folder, seed, threads
        self.renderer, self.store = ViewRenderer(), ArrayStore()
        self.held_out = held_out_views(scene, settings.holdout_every)
        kept = set(self.held_out)
        self.views = [i for i in range(len(scene.views)) if i not in kept and self._shows(i)]
        if not self.views:
            raise DatasetError("No photo is left to train on.", "Add photos or check the masks.")
        sizes = [photos.camera(i, 1) for i in self.views]
        self.schedule = Schedule(settings, max(max(c.width, c.height) for c in sizes))
        self.warnings: list[str] = []
        if settings.holdout_every > 0 and len(scene.views) < FEW_PHOTOS:
            self.warnings.append(
                f"Only {len(scene.views)} photos: {len(self.held_out)} held out for measuring."
            )

    def _shows(self, index: int) -> bool:
        mask = self.photos.mask(index, 1)
        return mask is None or bool(mask.any())

    # -- the run ----------------------------------------------------------------------------------

    def run(self, progress: Progress) -> TrainingResult:
        """Start or resume, iterate to the end, measure."""
        key = fingerprint(self.scene, self.settings, self.seed)
        progress.update(0.0, "preparing the Gaussians")
        state = load_checkpoint(self.folder, key)
        if state is None:
            state = self._start()
        else:
            _logger.info("resuming at iteration %d", state.iteration)
        begun_s = saved_s = time.monotonic()
        spent_s = state.seconds
        good = (state.to_arrays(), state.to_json())
        total = self.settings.iterations
        try:
            while state.iteration < total:
                progress.check()
                try:
                    self._iterate(state)
                    if state.iteration % SNAPSHOT_EVERY == 0 or state.iteration == total:
                        if not state.adam.is_finite():
                            raise _NotFinite()
                        good = (state.to_arrays(), state.to_json())
                except _NotFinite:
                    state = self._fall_back(state, good)
                    continue
                state.seconds = spent_s + time.monotonic() - begun_s
                if state.iteration % REPORT_EVERY == 0 or state.iteration == total:
                    self._report(state, progress)
                if time.monotonic() - saved_s >= self.settings.checkpoint_every_s:
                    save_checkpoint(self.folder, state, key)
                    saved_s = time.monotonic()
        except Cancelled:
            save_checkpoint(self.folder, state, key)
            raise
        gaussians = state.adam.gaussians().detached()
        held_out, lpips_note = self._measure(gaussians, progress)
        return TrainingResult(
            gaussians,
            total,
            tuple(state.history),
            tuple(held_out),
            spent_s + time.monotonic() - begun_s,
            tuple(self.warnings),
            lpips_note,
        )

    def _start(self) -> TrainingState:
        small = self.schedule.divisor(0)
        gaussians = initial_gaussians(
            self.scene,
            self.views,
            lambda i: (
                self.photos.camera(i, small),
                self.photos.photo(i, small),
                self.photos.mask(i, small),
            ),
            max_gaussians=self.schedule.growth_limit(),
            sh_degree=self.settings.sh_degree,
            seed=self.seed,
        )
        state = TrainingState.start(gaussians, self.seed)
        self._filter(state)
        return state

    def _fall_back(
        self, state: TrainingState, good: tuple[dict[str, np.ndarray], dict[str, object]]
    ) -> TrainingState:
        """Return the last good state with lower rates and another view order, once."""
        if state.restarts > 0:
            raise WrapError(
                f"Training broke down twice, at iteration {state.iteration}: the numbers are not "
                "finite any more.",
                "Check the camera poses; try fewer Gaussians or another seed.",
            )
        _logger.warning("numbers not finite at iteration %d: going back", state.iteration)
        restored = TrainingState.restore(good[0], good[1])
        restored.restarts = state.restarts + 1
        restored.rate_factor = state.rate_factor * RESTART_RATE
        restored.order = []
        restored.random = np.random.Generator(np.random.PCG64([self.seed, 3]))
        self.warnings.append(
            f"Training went back from iteration {state.iteration} to {restored.iteration} once, "
            "because numbers were not finite."
        )
        return restored

    # -- one iteration ----------------------------------------------------------------------------

    def _iterate(self, state: TrainingState) -> None:
        iteration = state.iteration
        schedule, settings, adam = self.schedule, self.settings, state.adam
        if iteration > 0 and schedule.divisor(iteration) != schedule.divisor(iteration - 1):
            self._filter(state)
        if schedule.starts_orientation(iteration):
            start_orientation(adam, self._round_views(VOTE_DIVISOR), threads=self.threads)
        view = state.next_view(self.views)
        divisor = schedule.divisor(iteration)
        whole, mask = self.photos.camera(view, divisor), self.photos.mask(view, divisor)
        choices = windows(whole.width, whole.height, settings.pixels_per_iteration)
        window = choices[int(state.random.integers(len(choices)))]
        camera = window.camera(whole)
        if mask is not None:
            mask = window.of(mask)
        gathers = schedule.gathers_statistics(iteration)
        uses_depth = schedule.uses_depth(iteration)
        degree = schedule.sh_degree(iteration)
        options = RenderOptions(
            depth=uses_depth, sh_degree=degree, threads=self.threads, screen_gradients=gathers
        )
        image = self.renderer.render(RawArrays.from_gaussians(adam.gaussians()), camera, options)
        value, by_color, figures = color_loss(
            image.color,
            window.of(self.photos.photo(view, divisor)),
            mask,
            lambda_dssim=settings.lambda_dssim,
            threads=self.threads,
            store=self.store,
        )
        gradients = ImageGradients(color=by_color)
        if uses_depth:
            oriented = schedule.is_oriented(iteration)
            normal_value, by_normals, _ = normal_losses(
                image.depth,
                image.geometric_normal,
                image.normal,
                image.alpha,
                camera,
                mask,
                lambda_depth_normal=settings.lambda_depth_normal,
                lambda_normal=settings.lambda_normal if oriented else 0.0,
                threads=self.threads,
                store=self.store,
            )
            value += normal_value
            gradients = dataclasses.replace(by_normals, color=by_color)
        if not math.isfinite(value):
            raise _NotFinite()
        seen = image.backward(gradients)
        if gathers:
            assert image.statistics is not None
            part = camera.width * camera.height / (whole.width * whole.height)
            state.statistics.add(image.statistics, whole.width, whole.height, part)
        if settings.overlap_price > 0.0:
            state.overlap_average = add_overlap_price(
                seen,
                adam.array("log_scales"),
                image.screen.boxes,
                (camera.width, camera.height),
                settings.overlap_price,
            )
        rates = schedule.rates(iteration, state.rate_factor)
        adam.step_rows(seen, rates, sh_degree=degree, threads=self.threads)
        state.iteration = iteration + 1
        share = AVERAGE_SHARE if iteration > 0 else 1.0
        state.error_average += share * (figures.mean_squared - state.error_average)
        state.loss_average += share * (value - state.loss_average)
        self._after_step(state)

    def _after_step(self, state: TrainingState) -> None:
        """Change the set of Gaussians where it is due."""
        iteration, schedule, adam = state.iteration, self.schedule, state.adam
        if iteration >= self.settings.iterations:
            self._filter(state)
            return
        changed = False
        if schedule.densifies(iteration):
            densify_and_prune(adam, state.statistics, schedule.budget(iteration), state.random)
            changed = True
        if schedule.prunes(iteration):
            found = contributions(
                adam.gaussians().detached(),
                self._round_views(ROUND_DIVISOR),
                self.renderer,
                threads=self.threads,
            )
            gone = prune_contributors(adam, least_contributors(found, self.settings.prune_share))
            _logger.info("iteration %d: %d Gaussians removed", iteration, gone)
            changed = True
        if schedule.wraps(iteration) and schedule.is_oriented(iteration):
            errors = normal_errors(
                adam.gaussians(), self._round_views(ROUND_DIVISOR), threads=self.threads
            )
            wrap(adam, errors, self.settings.wrap_share, self.settings.max_gaussians)
            changed = True
        if changed:
            state.clear_statistics()
        if changed or schedule.refilters(iteration):
            self._filter(state)
        if schedule.resets_opacity(iteration):
            reset_opacity(adam)

    def _round_views(self, divisor: int) -> Iterator[WrapView]:
        """Yield the training views at a size, at most :data:`MAX_ROUND_VIEWS` of them."""
        count = min(len(self.views), MAX_ROUND_VIEWS)
        spread = np.linspace(0, len(self.views) - 1, count).round().astype(int)
        side = self.schedule.long_side_px
        divisor = divisor if side / divisor >= 2 * tolerances.TILE_PX else 1
        for position in spread.tolist():
            view = self.views[position]
            yield WrapView(self.photos.camera(view, divisor), self.photos.mask(view, divisor))

    def _filter(self, state: TrainingState) -> None:
        """Compute the 3D filter for the cameras of the coming iteration's image size."""
        divisor = self.schedule.divisor(min(state.iteration, self.settings.iterations - 1))
        cameras = [self.photos.camera(i, divisor) for i in self.views]
        filter_3d = state.adam.array("filter_3d")
        filter_3d[:] = mip_filter(state.adam.array("means"), cameras, threads=self.threads)

    # -- figures ----------------------------------------------------------------------------------

    def _report(self, state: TrainingState, progress: Progress) -> None:
        total, count = self.settings.iterations, len(state.adam)
        quality = -10.0 * math.log10(max(state.error_average, 1e-10))
        figures = {
            "iteration": float(state.iteration),
            "loss": state.loss_average,
            "psnr": quality,
            "gaussians": float(count),
        }
        if state.iteration % SNAPSHOT_EVERY == 0 or state.iteration == total:
            state.history.append(figures)
        progress.update(
            state.iteration / total,
            f"iteration {state.iteration}/{total} · loss {state.loss_average:.4f} · "
            f"PSNR {quality:.1f} dB · {count} Gaussians · ov {state.overlap_average:.0f}",
            **figures,
        )

    def _measure(
        self, gaussians: OrientedGaussians, progress: Progress
    ) -> tuple[list[HeldOutFigure], str]:
        """Return the figures of the held-out photos, and why they have no LPIPS."""
        figures = []
        lpips, reason = lpips_if_ready() if self.held_out else (None, "")
        options = RenderOptions(depth=False, threads=self.threads)
        raw = RawArrays.from_gaussians(gaussians)
        for view in self.held_out:
            progress.update(1.0, f"measuring {self.scene.views[view].camera.name}")
            mask = self.photos.mask(view, 1)
            if mask is not None and not mask.any():
                continue
            image = self.renderer.render(raw, self.photos.camera(view, 1), options).color
            photo = self.photos.photo(view, 1)
            scores = score_images(image, photo, mask, lpips=lpips, threads=self.threads)
            name = self.scene.views[view].camera.name
            figures.append(HeldOutFigure(name, scores.psnr, scores.ssim, scores.lpips))
        if not figures or any(figure.lpips is not None for figure in figures):
            return figures, ""
        return figures, reason or TOO_SMALL
