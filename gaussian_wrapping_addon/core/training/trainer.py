# SPDX-License-Identifier: GPL-3.0-or-later
"""The loop of a training: start or resume, fall back, save, measure."""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from ..devices.checks import is_device_failure, is_memory_failure
from ..errors import Cancelled, DatasetError, WrapError
from ..gaussians.model import OrientedGaussians, gaussians_at
from ..loading.other_inputs import fibonacci_directions
from ..parallel import default_threads
from ..photos.store import decoded_in
from ..progress import Progress, ReportWarning
from ..render.projection import RawArrays
from ..render.types import Renderer, RenderOptions
from ..render.view_renderer import ViewRenderer
from ..scene.scene import (
    FEW_PHOTOS,
    PhotoSource,
    Scene,
    evenly_spaced,
    held_out_views,
    training_views,
)
from ..settings import TrainingSettings
from ..stereo.depth_maps import DepthPrior
from .backend import Backend
from .camera_poses import PosedPhotos
from .cpu_backend import CpuBackend
from .exposure import Exposure
from .exposure_selection import first_decisions
from .focus import Focus, favour
from .image_size_selection import photo_detail, select_image_size
from .iteration import NotFinite, Stepper, trimmed
from .live_view import LiveView, divisor_for, held_out_metrics, measure_held_out
from .model_selection import Decision, start_poses
from .multi_view import find_neighbours
from .rounds import Rounds
from .schedule import SMALLEST_SIDE_PX, Schedule
from .splat_start import start_from_splat, wrapping_settings
from .start import LEAST_REACH, Handover, PointStart, onto_sphere
from .state import (
    CancellablePhotos,
    Snapshot,
    TrainingResult,
    TrainingState,
    cancellable,
    fingerprint,
    load_checkpoint,
    save_checkpoint,
)

_logger = logging.getLogger(__name__)

# -- Training loop: from photos and cameras to oriented Gaussians, resumable at any iteration -----

SNAPSHOT_EVERY = 100
"""Iterations between checks that all values are finite; each one takes a snapshot."""

MEASURE_EVERY = 500
"""Iterations between measurements of held-out photos for the history."""

REPORT_EVERY = 10

DETAIL_PHOTOS = 8
"""Number of photos, evenly spread, whose detail is measured."""

RESTART_RATE = 0.5
"""Factor on the learning rates after a restart."""


def train(
    scene: Scene, photos: PhotoSource, settings: TrainingSettings, folder: Path, progress: Progress,
    *, seed: int = 0, threads: int = 0, start: Path | Handover | None = None,
    focus: Focus | None = None, backend: Backend | None = None,
) -> TrainingResult:  # fmt: skip
    """Train oriented Gaussians on the photos of a scene.

    Resumes from the newest checkpoint in ``folder``; the result is then bit for bit that of an
    uninterrupted run on the same machine, unless values become non-finite after resuming: the
    snapshot to restart from is then the resumed state. The last checkpoint is kept, so that the
    training can be continued.

    Parameters
    ----------
    photos : PhotoStore
        Photos, masks and cameras of the scene's views.
    folder : Path
        Receives checkpoints and preview pictures.
    progress : Progress
        Updated every few iterations; checked for cancellation in each one.
    seed, threads : int
        0 threads uses every core. The result does not depend on ``threads``.
    start : Path or Handover, optional
        PLY of Gaussians in the world frame of the photos to start from; the training is then short
        and does not densify (:func:`~.splat_start.wrapping_settings`). Or what another training of
        the scene has found; nothing is started or decided then, and the result's ``poses`` are
        ``None``.
    focus : Focus, optional
        What the training is for; ``settings.region_weight`` applies there.
    backend : Backend, optional
        Where to train; by default on the processor. A checkpoint goes on on any. One that fails
        (memory, driver) is replaced by the processor, with a warning in the result.

    Raises
    ------
    Cancelled
        After a checkpoint was written.
    DatasetError
        There is no photo to train on, or masks cover all of them; or the splat does not match the
        photos.
    ParseError
        The splat cannot be read.
    WrapError
        Values became non-finite twice.
    """
    threads = threads or default_threads()
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with decoded_in(photos, folder):
            run = _Trainer(
                scene, photos, settings, folder, seed, threads, start, focus, progress, backend
            )
            return run.run()
    finally:
        torch.set_num_threads(before)


class _Trainer:
    """One training run. Its attributes follow from the inputs; all else is in the state."""

    def __init__(
        self, scene: Scene, photos: PhotoSource, settings: TrainingSettings, folder: Path,
        seed: int, threads: int, start: Path | Handover | None = None,
        focus: Focus | None = None, progress: Progress | None = None,
        backend: Backend | None = None,
    ) -> None:  # fmt: skip
        handover = start if isinstance(start, Handover) else None
        start_splat = start if isinstance(start, Path) else None
        if start_splat is not None:
            settings = wrapping_settings(settings)
        settings = dataclasses.replace(settings, mask_mode=scene.mask_mode(settings.mask_mode))
        self.scene, self.settings = scene, settings
        self.posed = PosedPhotos(photos)
        self.progress = progress or Progress()
        self.photos = CancellablePhotos(self.posed, self.progress)
        self.folder, self.seed, self.threads = folder, seed, threads
        self.start_splat, self.handover, self.focus = start_splat, handover, focus
        if handover is not None and handover.views is not None:
            self.held_out, self.views = [], list(handover.views)
        else:
            self.held_out = held_out_views(scene, settings.holdout_every)
            self.views = training_views(scene, self.photos, settings.holdout_every)
        if not self.views:
            raise DatasetError("No photo is left to train on.", "Add photos or check the masks.")
        sizes = [photos.camera(i, 1) for i in self.views]
        side_px = max(max(c.width, c.height) for c in sizes)
        found = find_neighbours(sizes, settings, points=scene.points)
        numbers = np.array(self.views)
        self.neighbours = {v: numbers[near] for v, near in zip(self.views, found, strict=True)}
        self.image_decision, finest = self._image_size(side_px)
        self.favour = favour(
            focus, sizes, lambda: any(photos.mask(view, 1) is not None for view in self.views),
            refines=start_splat is not None,
        )  # fmt: skip
        self.schedule = Schedule(
            settings, side_px, finest, start_splat is not None, self.favour.budget_share
        )
        self.stepper = Stepper(
            self.posed, self.schedule, self.views, self.neighbours,
            backend or CpuBackend(threads), threads,
            None if self.favour.focus is None else self.favour.focus.rectangles_in(photos),
        )  # fmt: skip
        self.live_figures: dict[str, float] = {}
        self.live = LiveView(
            self.posed, self.held_out, folder, settings, threads,
            renderer=self.stepper.renderer, otherwise=self.views[0] if self._is_part else 0,
        )  # fmt: skip
        self.recovery = DeviceRecovery(self.stepper, self.posed, self.live, threads)

    @property
    def _is_part(self) -> bool:
        return self.handover is not None and self.handover.views is not None

    def _image_size(self, side_px: int) -> tuple[Decision, int]:
        """Decide whether to train at full or half size."""
        chosen = evenly_spaced(self.views, DETAIL_PHOTOS)
        found = select_image_size(
            [photo_detail(self.photos.photo(v, 1), self.photos.mask(v, 1)) for v in chosen]
        )
        decision = found.decision(self.settings.full_size)
        if side_px < 2 * SMALLEST_SIDE_PX:
            evidence = f"{decision.evidence} Half of this size is too small to train on."
            size = f"{side_px} px"
            return dataclasses.replace(decision, chosen=size, evidence=evidence), 1
        return decision, 1 if found.uses_full_size(self.settings.full_size) else 2

    # -- the run ----------------------------------------------------------------------------------

    def run(self) -> TrainingResult:
        """Start or resume, iterate to the end, measure the held-out photos."""
        handover = self.handover
        taken_over = "" if handover is None else handover.digest
        key = fingerprint(self.scene, self.settings, self.seed, self.start_splat, taken_over)
        self.progress.update(0.0, "preparing the Gaussians")
        rounds = Rounds(
            self.stepper, self.progress,
            None if handover is None else handover.filter_views, self.favour.focus,
        )  # fmt: skip
        state = load_checkpoint(self.folder, key)
        if state is None:
            state = self._start(rounds, key)
        else:
            _logger.info("resuming at iteration %d", state.iteration)
            self.stepper.priors = self._saved_priors(state, key)

        def again() -> TrainingState:
            found = load_checkpoint(self.folder, key)
            return self._start(rounds, key) if found is None else found

        snapshot = self.recovery.begun(state)
        begun_s = saved_s = time.monotonic()
        spent_s, begun_at = state.seconds, state.iteration
        total, consistent = self.schedule.total, True
        try:
            while state.iteration < total:
                self.progress.check()
                try:
                    try:
                        rounds.before_step(state)
                        consistent = False
                        self.stepper.step(state)
                        rounds.after_step(state)
                        self._record(state)
                        consistent = True
                        if state.iteration % SNAPSHOT_EVERY == 0 or state.iteration == total:
                            if not state.adam.is_finite():
                                raise NotFinite()
                            snapshot = state.snapshot()
                        now_s = time.monotonic()
                        state.seconds = spent_s + now_s - begun_s
                        if state.iteration % REPORT_EVERY == 0 or state.iteration == total:
                            speed = (state.iteration - begun_at) / max(now_s - begun_s, 1e-9)
                            self._report(state, speed)
                        if now_s - saved_s >= self.settings.checkpoint_every_s:
                            if not state.adam.is_finite():
                                raise NotFinite()
                            save_checkpoint(self.folder, state, key)
                            saved_s = time.monotonic()
                    except NotFinite:
                        state = self._restart(state, snapshot)
                        snapshot, consistent = self.recovery.begun(state), True
                except (WrapError, RuntimeError) as error:
                    if not self.recovery.is_device_failure(error):
                        raise
                    state = self.recovery.without_device(error, snapshot, again)
                    snapshot, consistent = self.recovery.begun(state), True
        except Cancelled:
            # Save a consistent state, not one of a half-finished round or with non-finite values.
            try:
                if not (consistent and state.adam.is_finite()):
                    state = TrainingState.of_snapshot(snapshot)
                save_checkpoint(self.folder, state, key)
            except (WrapError, RuntimeError) as lost:
                if not self.recovery.is_device_failure(lost):
                    raise
                _logger.warning("%s failed: the last checkpoint stands", self.stepper.backend.name)
            raise
        save_checkpoint(self.folder, state, key)
        while True:
            try:
                return self._result(rounds, state, spent_s + time.monotonic() - begun_s)
            except (WrapError, RuntimeError) as error:
                if not self.recovery.is_device_failure(error):
                    raise
                # Both the snapshot and the checkpoint are of the last iteration.
                state = self.recovery.without_device(error, snapshot, again)

    def _result(self, rounds: Rounds, state: TrainingState, seconds: float) -> TrainingResult:
        """Finish the Gaussians and measure the held-out photos."""
        gaussians = self._finished(rounds, state)
        self.live.update(gaussians, state.iteration, state.exposure is not None, force=True)
        names = {view: self.scene.views[view].camera.name for view in self.held_out}
        held_out, lpips_note = held_out_metrics(
            gaussians, self.photos, names, self.progress,
            threads=self.threads, renderer=self.stepper.renderer,
            exposed=state.exposure is not None, focus=self.focus,
        )  # fmt: skip
        return TrainingResult(
            gaussians, self.schedule.total, tuple(state.history), tuple(held_out), seconds,
            tuple(state.warnings), lpips_note, state.model_selection, state.exposure is not None,
            None if state.poses is None else state.poses.moved(), self.stepper.backend.name,
        )  # fmt: skip

    def _start(self, rounds: Rounds, key: str) -> TrainingState:
        if self.handover is not None:
            return self._taken_over(self.handover, rounds)
        warnings: list[ReportWarning] = []
        if self.settings.holdout_every > 0 and len(self.scene.views) < FEW_PHOTOS:
            count = len(self.scene.views)
            text = f"Few photos ({count}): {len(self.held_out)} held out for measuring."
            warnings.append(ReportWarning("few-photos", text, "Take more photos, from all around."))
        dense_start = None
        if self.start_splat is None:
            found = self._point_start().gaussians(key, self.progress)
            gaussians, dense_start, self.stepper.priors = found
        else:
            gaussians, of_splat = start_from_splat(
                self.start_splat, self.scene, self.photos, self.views, self.settings,
                self.progress,
                threads=self.threads,
            )  # fmt: skip
            warnings += of_splat
        state = TrainingState.start(gaussians, self.seed)
        state.warnings = warnings
        if self.start_splat is not None:
            state.degree = self.settings.sh_degree  # a splat keeps its own harmonics
        state.model_selection, state.exposure = first_decisions(
            self.scene, self.photos, self.views, self.neighbours, self.settings,
            self.image_decision,
        )  # fmt: skip
        for decision in (dense_start, self.favour.decision):
            if decision is not None:
                state.model_selection = state.model_selection.with_decision(decision)
        state.poses, state.model_selection = start_poses(
            self.settings.refine_poses, self.scene, self.views, state.model_selection
        )
        rounds.filter(state)
        return state

    def _taken_over(self, handover: Handover, rounds: Rounds) -> TrainingState:
        state = TrainingState.start(handover.gaussians, self.seed)
        state.adam.frozen, state.iteration = handover.frozen, handover.iteration
        state.degree, state.model_selection = handover.degree, handover.model_selection
        state.rate_factor = handover.rate_factor
        if handover.exposure is not None:
            state.exposure = Exposure.restore(handover.exposure.to_arrays())
            state.exposure.active = False
        self.stepper.priors = dict(handover.priors)
        rounds.filter(state)
        return state

    def _finished(self, rounds: Rounds, state: TrainingState) -> OrientedGaussians:
        """Return the trained Gaussians; those of a dense start with a backdrop."""
        gaussians = trimmed(rounds.filtered(state), state.degree)
        if self._is_part:
            return gaussians.select(torch.arange(state.adam.frozen, len(gaussians)))
        if self.settings.mask_mode == "background":
            return gaussians
        if not state.model_selection.chose("dense_start"):
            return gaussians  # the large Gaussians of a sparse start reach beyond the photos
        views = cancellable(self.views, self.progress)
        return with_backdrop(
            gaussians, self.photos, views, self.stepper.renderer, threads=self.threads
        )

    def _point_start(self) -> PointStart:
        return PointStart(
            self.scene, self.photos, self.views, self.settings, self.folder,
            self.schedule.divisor(0), self.schedule.growth_limit(), self.seed, self.threads,
            self.favour.focus,
        )  # fmt: skip

    def _saved_priors(self, state: TrainingState, key: str) -> dict[int, DepthPrior]:
        """Return the confirmed depths of a resumed training."""
        if self.handover is not None:
            return dict(self.handover.priors)
        start = self._point_start()
        if not (state.model_selection.chose("dense_start") and start.uses_priors):
            return {}
        return start.saved_priors(key, self.progress)

    def _restart(self, state: TrainingState, snapshot: Snapshot) -> TrainingState:
        """Restore the last snapshot with lower rates and another view order, at most once."""
        if state.restarts > 0:
            raise WrapError(
                f"Training diverged twice, the second time at iteration {state.iteration}: values "
                "are not finite.",
                "Check the camera poses; try fewer Gaussians or another seed.",
            )
        _logger.warning("non-finite values at iteration %d: going back", state.iteration)
        restored = TrainingState.of_snapshot(snapshot)
        restored.restarts = state.restarts + 1
        self.recovery.adopt(restored)
        restored.rate_factor = state.rate_factor * RESTART_RATE
        restored.order = []
        restored.random = np.random.Generator(np.random.PCG64([self.seed, 3]))
        restored.warnings.append(
            ReportWarning(
                "training-went-back",
                f"Training went back from iteration {state.iteration} to {restored.iteration} "
                "once, because values were not finite.",
                "If the figures below are poor, train again with another seed.",
            )
        )
        return restored

    # -- figures ----------------------------------------------------------------------------------

    def _record(self, state: TrainingState) -> None:
        """Append to the history, at fixed iterations."""
        last = state.iteration == self.schedule.total
        if state.iteration % SNAPSHOT_EVERY and not last:
            return
        figures = self._figures(state)
        if (state.iteration % MEASURE_EVERY == 0 or last) and self.held_out:
            quality = measure_held_out(
                state.adam.gaussians(), self.photos, self.held_out, threads=self.threads,
                renderer=self.stepper.renderer,
                exposed=state.exposure is not None,
            )  # fmt: skip
            if math.isfinite(quality):
                figures["held_out_psnr"] = quality
        state.history.append(figures)

    def _figures(self, state: TrainingState) -> dict[str, float]:
        return {
            "iteration": float(state.iteration),
            "loss": state.loss_average,
            "psnr": -10.0 * math.log10(max(state.error_average, 1e-10)),
            "gaussians": float(len(state.adam)),
        }

    def _report(self, state: TrainingState, speed: float) -> None:
        total, figures = self.schedule.total, self._figures(state)
        figures |= {"iterations": float(total), "iterations_per_s": speed}
        if self.live.is_due():
            live_figures = self.live.update(
                state.adam.gaussians(), state.iteration, state.exposure is not None
            )
            self.live_figures = live_figures or self.live_figures
        figures |= self.live_figures
        held_out = ""
        if "held_out_psnr" in self.live_figures:
            held_out = f" · held-out {self.live_figures['held_out_psnr']:.1f} dB"
        self.progress.update(
            state.iteration / total,
            f"iteration {state.iteration}/{total} · loss {state.loss_average:.4f} · "
            f"PSNR {figures['psnr']:.1f} dB{held_out} · {len(state.adam)} Gaussians · "
            f"{speed:.1f} it/s",
            **figures,
        )


# -- What a training does when the device fails that it runs on: less of its memory, or none of it


class DeviceRecovery:
    """Brings states to the backend that computes, and to another where that fails.

    The stepper's backend is then replaced by the processor's, and the live view renders where it
    computes; the photos follow the poses of the state in use.
    """

    def __init__(self, stepper: Stepper, photos: PosedPhotos, live: LiveView, threads: int) -> None:
        self.stepper, self.photos, self.live, self.threads = stepper, photos, live, threads

    def adopt(self, state: TrainingState) -> None:
        """Bring a state to where the backend computes, and the photos to its poses."""
        backend = self.stepper.backend
        state.adam = backend.adopted(state.adam)
        state.statistics = backend.adopted_statistics(state.statistics)
        self.photos.poses = state.poses

    def begun(self, state: TrainingState) -> Snapshot:
        """Adopt a state and return its snapshot; on the processor where the device fails at it."""
        before = state.adam, state.statistics
        try:
            self.adopt(state)
            return state.snapshot()
        except (WrapError, RuntimeError) as error:
            if not self.is_device_failure(error):
                raise
            name = self.stepper.backend.name
            self._use_processor()
            state.adam, state.statistics = before
            self.adopt(state)
            _note(state, name, error, "on the processor")
            return state.snapshot()

    def is_device_failure(self, error: Exception) -> bool:
        """Tell whether the device that trains failed, so that the training can do without it."""
        return not isinstance(self.stepper.backend, CpuBackend) and is_device_failure(error)

    def without_device(
        self, error: Exception, snapshot: Snapshot, again: Callable[[], TrainingState]
    ) -> TrainingState:
        """Go back to what a failing device has left: with less of its memory, or without it.

        That is the last snapshot, unless a driver that was reset took it along: then ``again``
        returns the state of the last checkpoint, or of a new start.
        """
        backend = self.stepper.backend
        smaller = is_memory_failure(error) and backend.use_less_memory()
        if not smaller:
            self._use_processor()
        try:
            state = TrainingState.of_snapshot(snapshot)
            self.adopt(state)
        except (WrapError, RuntimeError) as lost:
            # The snapshot is lost, or there is no room for its copy.
            if not is_device_failure(lost):
                raise
            smaller = False
            self._use_processor()
            self.photos.poses = None  # as at the first start
            state = again()
            self.adopt(state)
        _note(state, backend.name, error, "with less memory" if smaller else "on the processor")
        return state

    def _use_processor(self) -> None:
        self.stepper.backend = CpuBackend(self.threads)
        self.live.renderer = self.stepper.renderer


def _note(state: TrainingState, device: str, error: Exception, onward: str) -> None:
    _logger.warning(
        "%s failed (%s): going on %s from iteration %d", device, error, onward, state.iteration
    )
    state.warnings.append(
        ReportWarning(
            "device-failed",
            f"{device} failed in the training ({error}); it went on {onward} from iteration "
            f"{state.iteration}.",
            "Close other programs that use the GPU, or choose fewer Gaussians.",
        )
    )


# -- Colours far behind everything, where no photo shows what is there ----------------------------
#
# A view from a new place looks past the border of what the photos show, and sees black there. A
# coarse sphere in the colours that the photos have in these directions looks right more often. It
# comes after the training, which needs the black: only before black must a surface become opaque
# to look right. See docs/method.md, section 11.11.

DIRECTIONS = 2000
"""Cells of the sphere, 4.5 degrees apart."""

LONGEST_PX = 144
"""Long side of the training views that are rendered."""

CLEAR_TRANSMITTANCE = 0.03
"""A cell is left open where any photo sees through more than this, on average: training has found
its colour with black behind, and would be too bright with another."""

REACH_FACTOR = 2.0
"""Radius of the sphere over the distance of the farthest Gaussian."""

NEAREST = 6
"""Filled cells met by rays of photos, that lend their colours to a cell."""

SIZE_SHARE = 0.7
FLATNESS = 0.15
OPACITY = 0.95
"""Standard deviations along the sphere, over the distance of cells, and across it; opacity."""


def with_backdrop(
    gaussians: OrientedGaussians, photos: PhotoSource, views: Iterable[int],
    renderer: Renderer | None = None, *, threads: int = 0,
) -> OrientedGaussians:  # fmt: skip
    """Return trained Gaussians with a sphere behind them, open where the photos see through.

    ``views`` are the training views. A renderer given overwrites its last view.
    """
    farthest = float(gaussians.means.norm(dim=1).max()) if len(gaussians) else 0.0
    radius = max(LEAST_REACH, REACH_FACTOR * farthest)
    directions = fibonacci_directions(DIRECTIONS)
    tree = cKDTree(directions)
    through, seen = np.zeros(DIRECTIONS), np.zeros(DIRECTIONS)
    colors = np.zeros((DIRECTIONS, 3))
    raw, renderer = RawArrays.from_gaussians(gaussians.detached()), renderer or ViewRenderer()
    options = RenderOptions(depth=False, threads=threads)
    for view in views:
        camera = photos.camera(view, divisor_for(photos, view, LONGEST_PX))
        image = renderer.render(raw, camera, options)
        rays = (camera.rays() @ camera.rotation).reshape(-1, 3)  # (p, 3) scene frame
        cell = tree.query(onto_sphere(camera.center, rays, radius))[1]
        pixels = np.bincount(cell, minlength=DIRECTIONS)
        passed = np.bincount(cell, 1.0 - image.alpha.reshape(-1), minlength=DIRECTIONS)
        np.maximum(through, passed / np.maximum(pixels, 1), out=through)
        seen += pixels
        for channel in range(3):
            values = image.color[..., channel].reshape(-1)
            colors[:, channel] += np.bincount(cell, values, minlength=DIRECTIONS)
    filled = through <= CLEAR_TRANSMITTANCE
    met = np.flatnonzero(filled & (seen > 0))  # open cells would lend black
    if len(met) == 0:
        return gaussians
    count, step = int(filled.sum()), np.sqrt(4.0 * np.pi / DIRECTIONS)
    known = colors[met] / seen[met, None]
    away, nearest = cKDTree(directions[met]).query(directions[filled], k=min(NEAREST, len(met)))
    away, nearest = away.reshape(count, -1), nearest.reshape(count, -1)
    weight = 1.0 / (away**2 + (0.5 * step) ** 2)  # (count, k)
    color = (known[nearest] * weight[..., None]).sum(1) / weight.sum(1, keepdims=True)
    _logger.info("backdrop: %d Gaussians where no photo sees through", count)
    sphere = gaussians_at(
        radius * directions[filled], np.clip(color, 0.0, 1.0),
        np.full(count, SIZE_SHARE * radius * step), gaussians.sh_degree,
        normals=-directions[filled], flatness=FLATNESS, opacities=OPACITY,
    )  # fmt: skip
    return gaussians.joined(sphere)
