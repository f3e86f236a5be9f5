# SPDX-License-Identifier: GPL-3.0-or-later
"""The stages of a training, in one piece or in blocks; less when memory is short."""

from __future__ import annotations

import contextlib
import gc
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from ...array_file import is_whole
from ...devices import DeviceChoice, stage_device
from ...errors import ParseError, ResourceError, UsageError, WorkerError
from ...files import read_json, write_json
from ...progress import COMPILING, Progress, ReportWarning, read_warnings
from ...settings import MeshingSettings, TrainingSettings, to_json
from ...worker.helper_process import own_peak_bytes
from ..store.job_file import JobFile, blocks_key, training_keys
from ..store.job_folder import JobFolder
from ..store.rollback import (
    checkpoints,
    lineage,
    link_checkpoints,
    nothing_to_continue,
    shorter_training,
)
from ..store.stage_folder import Stage, read_done, record_interrupted_time, run_stage

if TYPE_CHECKING:
    from ...gaussians.model import OrientedGaussians
    from ...photos.store import PhotoStore
    from ...scene.scene import Scene
    from ...stereo.depth_maps import DepthPrior
    from ...training.backend import Backend
    from ...training.block_plan import BlockPlan
    from ...training.focus import Focus
    from ...training.state import TrainingResult


# -- Retry a training with reduced settings after it runs out of memory ---------------------------

_logger = logging.getLogger(__name__)

MAX_RETRIES = 2
GAUSSIANS_FACTOR = 0.6
IMAGE_FACTOR = 0.75
"""Each retry keeps 0.6 of the Gaussians and 0.56 of the pixels: about half of the memory that
grows with them."""

MIN_GAUSSIANS = 1000
MIN_IMAGE_PX = 96
RETRIES_FILE = "smaller.json"

_TORCH_OOM_MESSAGES = ("out of memory", "can't allocate memory", "not enough memory")

Result = TypeVar("Result")


@dataclass(frozen=True)
class Trained(Generic[Result]):
    """A result with the settings it was finally trained with."""

    result: Result
    settings: TrainingSettings
    warnings: tuple[ReportWarning, ...]
    """One for each retry."""


def is_out_of_memory(error: BaseException) -> bool:
    """Tell whether an error means that memory ran out.

    A :class:`ResourceError` raised by training is a limit of the renderer: too many intersections
    of Gaussians and tiles, or a full GPU.
    """
    if isinstance(error, (MemoryError, ResourceError)):
        return True
    text = str(error).lower()
    return isinstance(error, RuntimeError) and any(words in text for words in _TORCH_OOM_MESSAGES)


def reduced_settings(settings: TrainingSettings) -> TrainingSettings | None:
    """Return settings with fewer Gaussians and smaller images; ``None`` at the lower bounds."""
    most, longest = settings.max_gaussians, settings.max_image_px
    gaussians = min(most, max(MIN_GAUSSIANS, round(GAUSSIANS_FACTOR * most)))
    side_px = min(longest, max(MIN_IMAGE_PX, round(IMAGE_FACTOR * longest)))
    if (gaussians, side_px) == (most, longest):
        return None
    return replace(settings, max_gaussians=gaussians, max_image_px=side_px)


def train_with_oom_retry(
    train: Callable[[TrainingSettings], Result], settings: TrainingSettings, folder: Path,
    discard_checkpoints: Callable[[], None],
) -> Trained[Result]:  # fmt: skip
    """Train; after running out of memory, train again with reduced settings, at most twice.

    The retries are recorded in the folder of the stage: an interrupted run resumes with the same
    settings. ``discard_checkpoints`` removes those of the failed attempt, which fit no other
    settings. Raises ResourceError: the last retry also ran out of memory.
    """
    reasons = _read_retries(folder)
    for _ in reasons:
        settings = reduced_settings(settings) or settings
    while True:
        try:
            result = train(settings)
            warnings = tuple(ReportWarning("memory-step-down", reason) for reason in reasons)
            return Trained(result, settings, warnings)
        except (MemoryError, ResourceError, RuntimeError) as error:
            # Keep only the text: the exception would hold the memory of the failed training.
            if not is_out_of_memory(error):
                raise
            reduced = reduced_settings(settings)
            if reduced is None or len(reasons) >= MAX_RETRIES:
                raise ResourceError(
                    f"Memory did not suffice, even with at most {settings.max_gaussians} Gaussians "
                    f"and photos of {settings.max_image_px} px ({_first_line(error)}).",
                    "Close other programs, or choose a smaller preset.",
                ) from error
            reasons.append(_reason(error, settings, reduced))
        _logger.warning("%s", reasons[-1])
        discard_checkpoints()
        write_json(folder / RETRIES_FILE, {"reasons": reasons})
        gc.collect()
        settings = reduced


@contextlib.contextmanager
def _within_memory(what: str) -> Iterator[None]:
    """Turn running out of memory into a ``ResourceError`` with the next step: for a part."""
    try:
        yield
    except (MemoryError, ResourceError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise ResourceError(
            f"{what} ran out of memory ({_first_line(error)}).",
            "Choose a larger --set blocks=N, fewer --max-gaussians or a smaller --max-image-px; "
            "or close other programs and resume.",
        ) from error


def _reason(error: BaseException, before: TrainingSettings, after: TrainingSettings) -> str:
    return (
        f"Memory did not suffice ({_first_line(error)}): trained again with at most "
        f"{after.max_gaussians} Gaussians and photos of {after.max_image_px} px, instead of "
        f"{before.max_gaussians} and {before.max_image_px} px."
    )


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


def _read_retries(folder: Path) -> list[str]:
    try:
        values: Any = read_json(folder / RETRIES_FILE)
        return [str(reason) for reason in values["reasons"]][:MAX_RETRIES]
    except (OSError, ParseError, KeyError, TypeError):
        return []


def killed_hint(settings: TrainingSettings) -> str:
    """Return the hint for a training worker that the system killed, probably for its memory."""
    number = (reduced_settings(settings) or settings).max_gaussians
    return (
        "Close other programs and resume, which continues from the last checkpoint; or resume with "
        f"--max-gaussians {number}, which trains anew with fewer."
    )


def killed_mesh_hint(meshing: MeshingSettings, *, kept: bool) -> str:
    """Return the hint for a killed worker that was meshing or texturing.

    ``kept`` tells whether the folder has the result of an earlier job.
    """
    alternatives = "fewer --points, a larger --edge-length, or --set tiles=N with more tiles"
    if meshing.method == "pivots":
        alternatives = "a smaller region, or --set method=pam with fewer --points"
    elif meshing.tiles == "auto":
        alternatives = "fewer --points, a larger --edge-length, or --set tiles=N"
    unchanged = " The earlier result is unchanged." if kept else ""
    return f"Close other programs and resume; or use mesh with {alternatives}.{unchanged}"


# -- Stages of a training: in one piece; or coarse with a plan, each block, and joining -----------

COARSE, COARSE_KEY = "coarse", "all"
BLOCK = "block"
GAUSSIANS_NAME = "gaussians.npz"
"""In the folder of a training or a block: what it has trained."""
REFINED = "poses_refined"
"""Entry of ``done.json``: whether refined camera poses lie beside the Gaussians."""


@dataclass
class TrainingStages:
    """The stages of one training; each is run, or re-used. Scene and plan are loaded once.

    A training that was begun on another device continues on this one: no key depends on it. Each
    stage raises ResourceError: the disk is too full, or memory does not suffice, not even with
    reduced settings.
    """

    folder: JobFolder
    job: JobFile
    cameras: Stage
    threads: int
    device: DeviceChoice

    def run(self, progress: Progress) -> Stage:
        """Train in one piece or join the blocks.

        Raises UsageError: the job continues a training, and there is no training to continue;
        WorkerError: a block is not finished.
        """
        extra = self._settings.extra_iterations
        _, base_key = self._keys

        def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
            if extra and not checkpoints(stage_folder):
                shorter = shorter_training(self.folder.stages, base_key, extra)
                if shorter is not None:
                    link_checkpoints(shorter, stage_folder, (RETRIES_FILE,))
                elif self.job.command == "more":
                    raise nothing_to_continue(self.folder)
            with _time_noted(stage_folder):
                train = self._in_one_piece if self._settings.blocks == 1 else self._joined
                done = train(stage_folder, progress)
            return {**done, "lineage": lineage(base_key, extra)}

        key, stages = self._keys[0], self.folder.stages
        trained = run_stage(stages, "train", key, progress, work, whole=_is_whole)
        if self._settings.blocks == 1:
            return trained
        return replace(trained, before=tuple(self._finished(reused=trained.reused)))

    def coarse(self, progress: Progress) -> Stage:
        """Train the whole scene coarsely and divide it; or return the finished whole training.

        Raises UsageError: the scene cannot be divided into so many blocks.
        """
        from ...training.block_plan import ARRAYS_NAME, PLAN_NAME, coarse_settings

        if (trained := self._whole_training()) is not None:
            return trained
        self._fit_device(coarse_settings(self._settings).max_gaussians)
        self._root.mkdir(parents=True, exist_ok=True)
        estimated, warnings = self._estimated(self._root, progress)
        focus = self._focus()

        def whole(folder: Path) -> bool:
            return (self._root / PLAN_NAME).is_file() and is_whole(self._root / ARRAYS_NAME)

        def work(folder: Path, progress: Progress) -> dict[str, Any]:
            with _time_noted(folder), _within_memory("The coarse training"):
                done = self._train_coarse(folder, progress, focus)
            listed = [warning.to_json() for warning in warnings]
            return {**done, "estimate": estimated, "warnings": [*listed, *done["warnings"]]}

        return run_stage(self._root, COARSE, COARSE_KEY, progress, work, whole=whole)

    def _train_coarse(
        self, folder: Path, progress: Progress, focus: Focus | None
    ) -> dict[str, Any]:
        from ...scene.scene import with_poses
        from ...training.block_plan import coarse_settings, plan_blocks, save_plan, train_coarse
        from ...training.state import remove_checkpoints

        settings, scene = self._settings, self._scene
        less = coarse_settings(settings)
        coarse = train_coarse(
            scene, _photos(scene, less), less, folder,
            progress.span(0.0, 0.9), seed=self.job.settings.seed, threads=self.threads,
            focus=focus, backend=self._backend(),
        )  # fmt: skip
        if coarse.poses is not None:
            scene = with_poses(scene, coarse.poses)
        plan = plan_blocks(
            coarse, scene, _photos(scene, settings), settings, progress.span(0.9, 1.0),
            threads=self.threads,
        )  # fmt: skip
        save_plan(self._root, plan)
        remove_checkpoints(folder)
        return {
            "gaussians": len(coarse.gaussians),
            "photos": [len(block.views) for block in plan.blocks],
            "trained": [len(block.trained) for block in plan.blocks],
            "still": [len(block.still) for block in plan.blocks],
            "warnings": [warning.to_json() for warning in coarse.warnings],
            "peak_memory_bytes": own_peak_bytes(),
        }

    def block(self, index: int, progress: Progress) -> Stage:
        """Train a block; or return the finished whole training.

        Raises UsageError: there is no such block; WorkerError: the coarse training is not finished;
        ParseError: its files are damaged.
        """
        from ...training.estimate import gaussians_of_block

        if (trained := self._whole_training()) is not None:
            return trained
        self._fit_device(gaussians_of_block(self._settings))
        compile_if_needed(self._settings, self._root, progress, self.threads, self.device)
        if not 0 <= index < self._settings.blocks:
            raise UsageError(
                f"The training has no block {index}, but {self._settings.blocks} blocks.",
                "Plan the parts again: batch.py parts DIR.",
            )
        focus = self._focus()

        def whole(folder: Path) -> bool:
            done = read_done(folder) or {}
            # A coarse training that was done again, on another machine, may divide differently.
            return done.get("plan") == self._plan.digest and is_whole(folder / GAUSSIANS_NAME)

        def work(folder: Path, progress: Progress) -> dict[str, Any]:
            with _time_noted(folder), _within_memory(f"Block {index}"):
                return self._train_block(index, folder, progress, focus)

        return run_stage(self._root, BLOCK, f"{index:04d}", progress, work, whole=whole)

    def _train_block(
        self, index: int, folder: Path, progress: Progress, focus: Focus | None
    ) -> dict[str, Any]:
        from ...gaussians.files import save_gaussians
        from ...training.blocks import block_training
        from ...training.state import remove_checkpoints
        from ...training.trainer import train

        plan, settings = self._plan, self._settings
        scene = self._refined(plan)
        priors = self._priors(plan, scene, plan.blocks[index].views)
        shorter, handover = block_training(plan, index, settings, priors)
        result = train(
            scene, _photos(scene, settings), shorter, folder, progress,
            seed=self.job.settings.seed, threads=self.threads, focus=focus,
            backend=self._backend(), start=handover,
        )  # fmt: skip
        save_gaussians(folder / GAUSSIANS_NAME, result.gaussians)
        remove_checkpoints(folder)
        block = plan.blocks[index]
        return {
            "plan": plan.digest, "photos": len(block.views), "still": len(block.still),
            "gaussians": len(result.gaussians), "iterations": result.iterations,
            "device": result.device, "warnings": [w.to_json() for w in result.warnings],
            "peak_memory_bytes": own_peak_bytes(),
        }  # fmt: skip

    def _whole_training(self) -> Stage | None:
        """Return the finished training that the blocks are for: they may be gone then."""
        path = self.folder.stages / f"train-{self._keys[0]}"
        done = read_done(path)
        if done is None or not _is_whole(path):
            return None
        return Stage("train", self._keys[0], path, done, True)

    def _finished(self, *, reused: bool = True) -> list[Stage]:
        """Return the stages that are finished and still there, the coarse one first."""
        names = [(COARSE, COARSE_KEY)]
        names += [(BLOCK, f"{index:04d}") for index in range(self._settings.blocks)]
        found = []
        for name, key in names:
            folder = self._root / f"{name}-{key}"
            done = read_done(folder)
            if done is not None:
                found.append(Stage(name, key, folder, done, reused))
        return found

    def _joined(self, stage_folder: Path, progress: Progress) -> dict[str, Any]:
        """Join the blocks; return the content of ``done.json``."""
        self._fit_device(self._settings.max_gaussians)
        compile_if_needed(self._settings, stage_folder, progress, self.threads, self.device)
        result = self._join(stage_folder, progress)
        done = self._written(stage_folder, Trained(result, self._settings, ()))
        coarse, *blocks = self._finished()
        names = ("photos", "still", "gaussians", "iterations", "seconds", "peak_memory_bytes")
        coarse_s = float(coarse.done["seconds"])
        blocks_s = sum(float(stage.done["seconds"]) for stage in blocks)
        return {
            **done,
            "estimate": coarse.done["estimate"],
            "blocks": [{name: stage.done[name] for name in names} for stage in blocks],
            "seconds_coarse": coarse_s,
            "seconds_training": round(coarse_s + blocks_s + result.seconds, 3),
        }

    def _join(self, folder: Path, progress: Progress) -> TrainingResult:
        """Train all blocks together; the poses are those that the coarse training refined."""
        from ...gaussians.files import load_gaussians
        from ...training.blocks import joint_training
        from ...training.trainer import train

        stages = self._finished()
        if len(stages) < self._settings.blocks + 1:
            raise WorkerError("Blocks of the training are missing.", "Resume the job.")
        plan, settings = self._plan, self._settings
        scene = self._refined(plan)

        def parts() -> Iterator[OrientedGaussians]:
            for stage in stages[1:]:
                if stage.done.get("plan") != plan.digest:
                    raise WorkerError(
                        f"Block {stage.key} was trained for another plan.", "Resume the job."
                    )
                yield load_gaussians(stage.folder / GAUSSIANS_NAME)

        with _within_memory("Joining the blocks"):
            photos, backend = _photos(scene, settings), self._backend()
            last, handover = joint_training(
                plan, parts(), photos, settings, progress.span(0.0, 0.05), backend.renderer,
                threads=self.threads, priors=self._priors(plan, scene, plan.views),
            )  # fmt: skip
            result = train(
                scene, photos, last, folder, progress.span(0.05, 1.0),
                seed=self.job.settings.seed, threads=self.threads, backend=backend,
                start=handover,
            )  # fmt: skip
        earlier = [w for stage in stages for w in read_warnings(stage.done.get("warnings"))]
        return replace(result, poses=plan.coarse.poses, warnings=(*earlier, *result.warnings))

    def _in_one_piece(self, stage_folder: Path, progress: Progress) -> dict[str, Any]:
        """Train the whole scene; return the content of ``done.json``."""
        from ...training.state import remove_checkpoints
        from ...training.trainer import train
        from .cameras import start_splat_of

        self._fit_device(self._settings.max_gaussians)
        scene = self._scene
        estimated, warnings = self._estimated(stage_folder, progress)
        focus = self._focus()
        _logger.info("training on %s", self.device.device)

        def attempt(settings: TrainingSettings) -> TrainingResult:
            return train(
                scene, _photos(scene, settings), settings, stage_folder, progress,
                seed=self.job.settings.seed, threads=self.threads,
                start=start_splat_of(self.job), focus=focus, backend=self._backend(),
            )  # fmt: skip

        trained = train_with_oom_retry(
            attempt, self._settings, stage_folder, lambda: remove_checkpoints(stage_folder)
        )
        done = self._written(stage_folder, trained)
        earlier = [warning.to_json() for warning in (*warnings, *trained.warnings)]
        return {**done, "warnings": [*earlier, *done["warnings"]], "estimate": estimated}

    def _written(self, stage_folder: Path, trained: Trained[TrainingResult]) -> dict[str, Any]:
        """Write Gaussians, poses and pictures of held-out photos; return the figures."""
        from ...devices.checks import with_renderer
        from ...evaluation.report.pictures import write_held_out
        from ...gaussians.files import save_gaussians
        from ...scene.scene import held_out_views, load_refined_scene, save_poses

        result = trained.result
        save_gaussians(stage_folder / GAUSSIANS_NAME, result.gaussians)
        save_poses(stage_folder, result.poses)
        scene = load_refined_scene(self.cameras.folder, stage_folder)
        measured = {figure.name: figure.psnr for figure in result.held_out}
        shown = [
            (index, scene.views[index].camera.name, measured[scene.views[index].camera.name])
            for index in held_out_views(scene, trained.settings.holdout_every)
            if scene.views[index].camera.name in measured
        ]
        photos = _photos(scene, trained.settings)
        pictures = with_renderer(
            result.device,
            "Pictures of held-out photos",
            lambda renderer: write_held_out(
                result.gaussians, photos, shown, stage_folder, threads=self.threads,
                renderer=renderer,
            ),
        )  # fmt: skip
        return {
            **result.to_json(), REFINED: result.poses is not None, "device": result.device,
            "device_reason": self.device.reason, "pictures": pictures,
            "settings": to_json(trained.settings),
        }  # fmt: skip

    @property
    def _settings(self) -> TrainingSettings:
        return self.job.settings.training

    @cached_property
    def _keys(self) -> tuple[str, str]:
        return training_keys(self.cameras.key, self.job)

    @cached_property
    def _root(self) -> Path:
        """The folder of the blocks.

        A longer training of the same job, or one with another joint training, joins the same ones.
        """
        return self.folder.stages / f"blocks-{blocks_key(self.cameras.key, self.job)}"

    @cached_property
    def _scene(self) -> Scene:
        """The scene with the poses that it came with."""
        from ...scene.scene import load_saved_scene

        return load_saved_scene(self.cameras.folder)

    @cached_property
    def _plan(self) -> BlockPlan:
        from ...training.block_plan import PLAN_NAME, load_plan

        if not (self._root / PLAN_NAME).is_file():
            raise WorkerError("The training is not divided into blocks yet.", "Resume the job.")
        return load_plan(self._root)

    def _refined(self, plan: BlockPlan) -> Scene:
        from ...scene.scene import with_poses

        return (
            self._scene if plan.coarse.poses is None else with_poses(self._scene, plan.coarse.poses)
        )

    def _priors(
        self, plan: BlockPlan, scene: Scene, views: tuple[int, ...]
    ) -> dict[int, DepthPrior]:
        from ...training.block_plan import coarse_settings, confirmed_depths

        settings = coarse_settings(self._settings)
        folder = self._root / f"{COARSE}-{COARSE_KEY}"
        photos = _photos(scene, settings)
        return confirmed_depths(plan.coarse, folder, photos, settings, plan.views, views)

    def _fit_device(self, gaussians: int) -> None:
        """Train on the processor where the GPU's memory does not suffice for so many Gaussians."""
        from ...training.estimate import gpu_bytes, scene_facts

        if self.device.is_cuda:
            needed = gpu_bytes(scene_facts(self._scene), self._settings, gaussians)
            setting = self.job.settings.device
            self.device = stage_device(self.device, setting, needed, "Training")

    def _estimated(
        self, stage_folder: Path, progress: Progress
    ) -> tuple[dict[str, Any], list[ReportWarning]]:
        """Estimate the cost, for ``done.json``, or raise where the disk is too full.

        The renderer is compiled for it.
        """
        from ...training import estimate
        from ...training.splat_start import wrapping_settings
        from .cameras import start_splat_of

        training, threads = self._settings, self.threads
        if start_splat_of(self.job) is not None:
            training = wrapping_settings(training)
        compile_if_needed(self._settings, stage_folder, progress, threads, self.device)
        progress.update(0.0, "timing this machine")
        speeds = estimate.speeds(threads, self.device.device)
        machine = estimate.this_machine(stage_folder, *speeds)
        done = [int(path.stem.rpartition("-")[2]) for path in checkpoints(stage_folder)]
        facts, first = estimate.scene_facts(self._scene), max(done, default=0)
        expected = estimate.estimate_training(facts, training, machine, first=first)
        warnings = estimate.check_resources(expected, machine)
        _logger.info("estimate: %s", expected.sentence())
        for warning in warnings:
            _logger.warning("%s", warning.text)
        progress.update(0.0, f"training will take {expected.span()}")
        return {**asdict(expected), "speed": machine.speed}, warnings

    def _backend(self) -> Backend:
        from ...training.device_backend import chosen_backend

        return chosen_backend(
            self.device.device, self.threads, or_processor=self.job.settings.device == "auto"
        )

    def _focus(self) -> Focus | None:
        """Return the regions that the training is for, if any."""
        from ...training.focus import Focus
        from .cameras import regions_listed

        if not self._settings.focus or self._settings.region_weight == 1.0:
            return None
        return Focus(regions_listed(self._settings.focus, self._scene))


def compile_if_needed(
    settings: TrainingSettings, folder: Path, progress: Progress, threads: int, device: DeviceChoice
) -> None:
    """Compile the renderer if that was never done on this machine, and say so."""
    from ...training.estimate import renderer_is_compiled
    from ...training.warm_up import compile_kernels

    if device.is_cuda or renderer_is_compiled():
        return
    progress.enter(COMPILING, "compiling the renderer, about a minute, only this once")
    compile_kernels(settings, folder, progress, threads=threads)


def plan_files(stage: Stage) -> list[Path]:
    """Return the files of the plan beside a coarse training; none beside another stage."""
    if stage.name != COARSE:
        return []
    from ...training.block_plan import ARRAYS_NAME, PLAN_NAME

    return [stage.folder.parent / name for name in (PLAN_NAME, ARRAYS_NAME)]


def _photos(scene: Scene, settings: TrainingSettings) -> PhotoStore:
    from ...photos.store import PhotoStore

    return PhotoStore(scene, settings.max_image_px)


@contextlib.contextmanager
def _time_noted(stage_folder: Path) -> Iterator[None]:
    """Note the time of a run that is interrupted, for the report."""
    begun_s = time.monotonic()
    try:
        yield
    except BaseException:
        record_interrupted_time(stage_folder, time.monotonic() - begun_s)
        raise


def _is_whole(stage_folder: Path) -> bool:
    from ...scene.scene import POSES_NAME

    refined = (read_done(stage_folder) or {}).get(REFINED)
    names = [GAUSSIANS_NAME, *([POSES_NAME] if refined else [])]
    return all(is_whole(stage_folder / name) for name in names)
