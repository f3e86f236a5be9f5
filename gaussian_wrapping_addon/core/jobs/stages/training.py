# SPDX-License-Identifier: GPL-3.0-or-later
"""The stages of a training, in one piece or in blocks; less when memory is short."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from ...array_file import is_whole
from ...devices import DeviceChoice
from ...errors import ParseError, ResourceError, UsageError, WorkerError
from ...files import read_json, write_json
from ...progress import Progress, ReportWarning, read_warnings
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
from .training_cost import compile_if_needed, estimated_cost, fitting_device

if TYPE_CHECKING:
    import numpy as np

    from ...gaussians.model import OrientedGaussians
    from ...photos.store import PhotoStore
    from ...scene.scene import Scene
    from ...stereo.depth_maps import DepthPrior
    from ...training.backend import Backend
    from ...training.block_plan import BlockPlan
    from ...training.rounds import Inside
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
    if not isinstance(error, RuntimeError):
        return False
    text = str(error).lower()
    return any(message in text for message in _TORCH_OOM_MESSAGES)


def reduced_settings(settings: TrainingSettings) -> TrainingSettings | None:
    """Return settings with fewer Gaussians and smaller images; ``None`` at the lower bounds."""
    gaussians = max(MIN_GAUSSIANS, round(GAUSSIANS_FACTOR * settings.max_gaussians))
    side_px = max(MIN_IMAGE_PX, round(IMAGE_FACTOR * settings.max_image_px))
    gaussians = min(gaussians, settings.max_gaussians)
    side_px = min(side_px, settings.max_image_px)
    if (gaussians, side_px) == (settings.max_gaussians, settings.max_image_px):
        return None
    return replace(settings, max_gaussians=gaussians, max_image_px=side_px)


def train_with_oom_retry(
    train: Callable[[TrainingSettings], Result],
    settings: TrainingSettings,
    folder: Path,
    discard_checkpoints: Callable[[], None],
) -> Trained[Result]:
    """Train; after running out of memory, train again with reduced settings, at most twice.

    The retries are recorded in the folder, so that an interrupted run resumes with the same
    settings.

    Parameters
    ----------
    train : callable
        Takes the settings; trains from the start or the last checkpoint.
    settings : TrainingSettings
        The requested settings.
    folder : Path
        Of the training stage.
    discard_checkpoints : callable
        Removes the checkpoints of the failed attempt, which fit no other settings.

    Raises
    ------
    ResourceError
        The last retry also ran out of memory. Other exceptions of ``train`` propagate.
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
def within_memory(what: str) -> Iterator[None]:
    """Turn running out of memory into an error with the next step, for a part of a training.

    Raises
    ------
    ResourceError
        Memory did not suffice: the part may work elsewhere.
    """
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
    reduced = reduced_settings(settings)
    number = settings.max_gaussians if reduced is None else reduced.max_gaussians
    return (
        "Close other programs and resume, which continues from the last checkpoint; or resume with "
        f"--max-gaussians {number}, which trains anew with fewer."
    )


def killed_mesh_hint(meshing: MeshingSettings, *, kept: bool) -> str:
    """Return the hint for a killed worker that was meshing or texturing.

    Parameters
    ----------
    kept : bool
        Whether the folder has the result of an earlier job.
    """
    alternatives = "fewer --points, a larger --edge-length, or --set tiles=N with more tiles"
    if meshing.method == "pivots":
        alternatives = "a smaller region, or --set method=pam with fewer --points"
    elif meshing.tiles == "auto":
        alternatives = "fewer --points, a larger --edge-length, or --set tiles=N"
    unchanged = " The earlier result is unchanged." if kept else ""
    return f"Close other programs and resume; or use mesh with {alternatives}.{unchanged}"


# -- Stages of a training in blocks: the coarse training with its plan, each block, joining -------
#
# They lie in a folder of their own, ``stages/blocks-KEY``: a longer training of the same job, or
# one with another joint training, joins the same blocks.


COARSE, COARSE_KEY = "coarse", "all"
BLOCK = "block"
GAUSSIANS_NAME = "gaussians.npz"
"""In the folder of a block: what it has trained."""


@dataclass
class BlockStages:
    """The stages of one training in blocks; scene and plan are loaded once.

    Parameters
    ----------
    root : Path
        Their folder.
    cameras : Stage
    threads : int
    device : DeviceChoice
    """

    root: Path
    job: JobFile
    cameras: Stage
    threads: int
    device: DeviceChoice

    @cached_property
    def scene(self) -> Scene:
        """The scene with the poses that it came with."""
        from ...scene.scene import load_saved_scene

        return load_saved_scene(self.cameras.folder)

    def fit_device(self, gaussians: int | None = None) -> None:
        """Train on the processor where the GPU's memory does not suffice for so many Gaussians."""
        self.device = fitting_device(self.scene, self.job, self.device, gaussians)

    def coarse(
        self,
        progress: Progress,
        *,
        inside: Inside | None,
        estimated: Mapping[str, Any],
        warnings: Sequence[ReportWarning],
    ) -> Stage:
        """Train the whole scene coarsely and divide it, or re-use that.

        Parameters
        ----------
        estimated, warnings
            Of the cost of the whole training, for the report.

        Raises
        ------
        UsageError
            The scene cannot be divided into so many blocks.
        ResourceError
            Memory does not suffice.
        """
        from ...training.block_plan import ARRAYS_NAME, PLAN_NAME

        def whole(folder: Path) -> bool:
            return (self.root / PLAN_NAME).is_file() and is_whole(self.root / ARRAYS_NAME)

        def work(folder: Path, progress: Progress) -> dict[str, Any]:
            with self._noted(COARSE, COARSE_KEY), within_memory("The coarse training"):
                done = self._train_coarse(folder, progress, inside)
            listed = [warning.to_json() for warning in warnings]
            return {**done, "estimate": estimated, "warnings": [*listed, *done["warnings"]]}

        return run_stage(self.root, COARSE, COARSE_KEY, progress, work, whole=whole)

    def _train_coarse(
        self, folder: Path, progress: Progress, inside: Inside | None
    ) -> dict[str, Any]:
        from ...scene.scene import with_poses
        from ...training.block_plan import coarse_settings, plan_blocks, save_plan, train_coarse
        from ...training.state import remove_checkpoints

        settings, scene = self._settings, self.scene
        less = coarse_settings(settings)
        backend = self._backend()
        coarse = train_coarse(
            scene, _photos(scene, less), less, folder,
            progress.span(0.0, 0.9), seed=self.job.settings.seed, threads=self.threads,
            inside=inside, backend=backend,
        )  # fmt: skip
        if coarse.poses is not None:
            scene = with_poses(scene, coarse.poses)
        plan = plan_blocks(
            coarse, scene, _photos(scene, settings), settings, progress.span(0.9, 1.0),
            threads=self.threads,
        )  # fmt: skip
        save_plan(self.root, plan)
        remove_checkpoints(folder)
        return {
            "gaussians": len(coarse.gaussians),
            "photos": [len(block.views) for block in plan.blocks],
            "trained": [len(block.trained) for block in plan.blocks],
            "still": [len(block.still) for block in plan.blocks],
            "warnings": [warning.to_json() for warning in coarse.warnings],
            "peak_memory_bytes": own_peak_bytes(),
        }

    def block(self, index: int, progress: Progress, *, inside: Inside | None) -> Stage:
        """Train a block, or re-use it.

        Raises
        ------
        UsageError
            There is no such block.
        WorkerError
            The coarse training is not finished.
        ParseError
            Its files are damaged.
        ResourceError
            Memory does not suffice.
        """

        if not 0 <= index < self._settings.blocks:
            raise UsageError(
                f"The training has no block {index}, but {self._settings.blocks} blocks.",
                "Plan the parts again: batch.py parts DIR.",
            )

        def whole(folder: Path) -> bool:
            done = read_done(folder) or {}
            # A coarse training that was done again, on another machine, may divide differently.
            return done.get("plan") == self._plan.digest and is_whole(folder / GAUSSIANS_NAME)

        key = f"{index:04d}"

        def work(folder: Path, progress: Progress) -> dict[str, Any]:
            with self._noted(BLOCK, key), within_memory(f"Block {index}"):
                return self._train_block(index, folder, progress, inside)

        return run_stage(self.root, BLOCK, key, progress, work, whole=whole)

    def _train_block(
        self, index: int, folder: Path, progress: Progress, inside: Inside | None
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
            seed=self.job.settings.seed, threads=self.threads, inside=inside,
            backend=self._backend(), start=handover,
        )  # fmt: skip
        save_gaussians(folder / GAUSSIANS_NAME, result.gaussians)
        remove_checkpoints(folder)
        block = plan.blocks[index]
        return {
            "plan": plan.digest,
            "photos": len(block.views),
            "still": len(block.still),
            "gaussians": len(result.gaussians),
            "iterations": result.iterations,
            "device": result.device,
            "warnings": [warning.to_json() for warning in result.warnings],
            "peak_memory_bytes": own_peak_bytes(),
        }

    def finished(self, *, reused: bool = False) -> list[Stage]:
        """Return the stages that are finished and still there, the coarse one first.

        Parameters
        ----------
        reused : bool
            Whether they are noted as of an earlier run.
        """
        names = [(COARSE, COARSE_KEY)]
        names += [(BLOCK, f"{index:04d}") for index in range(self._settings.blocks)]
        found = []
        for name, key in names:
            folder = self.root / f"{name}-{key}"
            done = read_done(folder)
            if done is not None:
                found.append(Stage(name, key, folder, done, reused))
        return found

    def figures(self, joined_s: float) -> dict[str, Any]:
        """Return what the report tells of the blocks, and the estimate made before them.

        Parameters
        ----------
        joined_s : float
            Seconds of the joint training.
        """
        coarse, *blocks = self.finished()
        names = ("photos", "still", "gaussians", "iterations", "seconds", "peak_memory_bytes")
        coarse_s = float(coarse.done["seconds"])
        blocks_s = sum(float(stage.done["seconds"]) for stage in blocks)
        return {
            "estimate": coarse.done["estimate"],
            "blocks": [{name: stage.done[name] for name in names} for stage in blocks],
            "seconds_coarse": coarse_s,
            "seconds_training": round(coarse_s + blocks_s + joined_s, 3),
        }

    def join(self, folder: Path, progress: Progress) -> TrainingResult:
        """Join all blocks and train them together.

        Returns
        -------
        TrainingResult
            With the poses that the coarse training refined.

        Raises
        ------
        WorkerError
            A block is not finished.
        """
        from ...gaussians.files import load_gaussians
        from ...training.blocks import joint_training
        from ...training.trainer import train

        stages = self.finished()
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

        with within_memory("Joining the blocks"):
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
        return dataclasses.replace(
            result, poses=plan.coarse.poses, warnings=(*earlier, *result.warnings)
        )

    @contextlib.contextmanager
    def _noted(self, name: str, key: str) -> Iterator[None]:
        """Note the time of a run that is interrupted, for the report."""
        begun_s = time.monotonic()
        try:
            yield
        except BaseException:
            record_interrupted_time(self.root, name, key, time.monotonic() - begun_s)
            raise

    @property
    def _settings(self) -> TrainingSettings:
        return self.job.settings.training

    @cached_property
    def _plan(self) -> BlockPlan:
        from ...training.block_plan import PLAN_NAME, load_plan

        if not (self.root / PLAN_NAME).is_file():
            raise WorkerError("The training is not divided into blocks yet.", "Resume the job.")
        return load_plan(self.root)

    def _refined(self, plan: BlockPlan) -> Scene:
        from ...scene.scene import with_poses

        scene, poses = self.scene, plan.coarse.poses
        return scene if poses is None else with_poses(scene, poses)

    def _priors(
        self, plan: BlockPlan, scene: Scene, views: tuple[int, ...]
    ) -> dict[int, DepthPrior]:
        from ...training.block_plan import coarse_settings, confirmed_depths

        settings = coarse_settings(self._settings)
        folder = self.root / f"{COARSE}-{COARSE_KEY}"
        photos = _photos(scene, settings)
        return confirmed_depths(plan.coarse, folder, photos, settings, plan.views, views)

    def _backend(self) -> Backend:
        from ...training.device_backend import chosen_backend

        return chosen_backend(
            self.device.device, self.threads, or_processor=self.job.settings.device == "auto"
        )


def plan_files(stage: Stage) -> list[Path]:
    """Return the files of the plan beside a coarse training; none beside another stage."""
    from ...training.block_plan import ARRAYS_NAME, PLAN_NAME

    if stage.name != COARSE:
        return []
    return [stage.folder.parent / name for name in (PLAN_NAME, ARRAYS_NAME)]


def _photos(scene: Scene, settings: TrainingSettings) -> PhotoStore:
    from ...photos.store import PhotoStore

    return PhotoStore(scene, settings.max_image_px)


# -- Training stage: continue a shorter training, retry when out of memory, join blocks -----------


REFINED = "poses_refined"
"""Entry of ``done.json``: whether refined camera poses lie beside the Gaussians."""


def run_training(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    progress: Progress,
    *,
    version: int,
    threads: int,
    device: DeviceChoice,
) -> Stage:
    """Train, or re-use a finished training.

    Parameters
    ----------
    device : DeviceChoice
        The job's. A training that was begun elsewhere continues here: no key depends on it.

    Raises
    ------
    UsageError
        The job continues a training, and there is no training to continue.
    ResourceError
        The disk is too full, or memory does not suffice even with reduced settings.
    """
    key, base_key = training_keys(version, cameras.key, job)
    extra = job.settings.training.extra_iterations

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        if extra and not checkpoints(stage_folder):
            shorter = shorter_training(folder.stages, base_key, extra)
            if shorter is not None:
                link_checkpoints(shorter, stage_folder, (RETRIES_FILE,))
            elif job.command == "more":
                raise nothing_to_continue(folder)
        begun_s = time.monotonic()
        try:
            if job.settings.training.blocks > 1:
                blocks = _blocks(folder, job, cameras, version, threads, device)
                done = _join(stage_folder, blocks, progress)
            else:
                done = _train(stage_folder, job, cameras, progress, threads, device)
        except BaseException:
            record_interrupted_time(folder.stages, "train", key, time.monotonic() - begun_s)
            raise
        return {**done, "lineage": lineage(base_key, extra)}

    trained = run_stage(folder.stages, "train", key, progress, work, whole=_is_whole)
    if job.settings.training.blocks == 1:
        return trained
    before = _blocks(folder, job, cameras, version, threads, device).finished(reused=trained.reused)
    return replace(trained, before=tuple(before))


def run_coarse(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    progress: Progress,
    *,
    version: int,
    threads: int,
    device: DeviceChoice,
) -> Stage:
    """Train coarsely and divide the scene into blocks, or re-use that or the finished training.

    Raises
    ------
    UsageError
        The scene cannot be divided into so many blocks.
    ResourceError
        The disk is too full, or memory does not suffice.
    """
    from ...training.block_plan import coarse_settings

    most = coarse_settings(job.settings.training).max_gaussians
    blocks = _opened(folder, job, cameras, most, version, threads, device)
    if isinstance(blocks, Stage):
        return blocks
    blocks.root.mkdir(parents=True, exist_ok=True)
    estimated, warnings = estimated_cost(
        blocks.scene, job, blocks.root, progress, threads, blocks.device
    )
    inside = _inside_regions(job, blocks.scene)
    return blocks.coarse(progress, inside=inside, estimated=estimated, warnings=warnings)


def run_block(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    index: int,
    progress: Progress,
    *,
    version: int,
    threads: int,
    device: DeviceChoice,
) -> Stage:
    """Train a block, or re-use it or the finished training.

    Raises
    ------
    WorkerError
        The coarse training is not finished.
    ResourceError
        Memory does not suffice.
    """
    from ...training.estimate import gaussians_of_block

    most = gaussians_of_block(job.settings.training)
    blocks = _opened(folder, job, cameras, most, version, threads, device)
    if isinstance(blocks, Stage):
        return blocks
    compile_if_needed(job, blocks.root, progress, threads, blocks.device)
    return blocks.block(index, progress, inside=_inside_regions(job, blocks.scene))


def _opened(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    gaussians: int,
    version: int,
    threads: int,
    device: DeviceChoice,
) -> BlockStages | Stage:
    """Return the blocks, or the finished training that they are for: they may be gone then."""
    key, _ = training_keys(version, cameras.key, job)
    path = folder.stages / f"train-{key}"
    done = read_done(path)
    if done is not None and _is_whole(path):
        return Stage("train", key, path, done, True)
    blocks = _blocks(folder, job, cameras, version, threads, device)
    blocks.fit_device(gaussians)
    return blocks


def _is_whole(stage_folder: Path) -> bool:
    from ...scene.scene import POSES_NAME

    done = read_done(stage_folder) or {}
    names = [GAUSSIANS_NAME, *([POSES_NAME] if done.get(REFINED) else [])]
    return all(is_whole(stage_folder / name) for name in names)


def _blocks(
    folder: JobFolder,
    job: JobFile,
    cameras: Stage,
    version: int,
    threads: int,
    device: DeviceChoice,
) -> BlockStages:
    root = folder.stages / f"blocks-{blocks_key(version, cameras.key, job)}"
    return BlockStages(root, job, cameras, threads, device)


def _train(
    stage_folder: Path,
    job: JobFile,
    cameras: Stage,
    progress: Progress,
    threads: int,
    device: DeviceChoice,
) -> dict[str, Any]:
    """Train in one piece; return the content of ``done.json``."""
    from ...photos.store import PhotoStore
    from ...scene.scene import load_saved_scene
    from ...training.device_backend import chosen_backend
    from ...training.state import remove_checkpoints
    from ...training.trainer import train
    from .cameras import start_splat_of

    scene = load_saved_scene(cameras.folder)
    device = fitting_device(scene, job, device)
    estimated, warnings = estimated_cost(scene, job, stage_folder, progress, threads, device)
    inside = _inside_regions(job, scene)
    _logger.info("training on %s", device.device)

    def attempt(settings: TrainingSettings) -> TrainingResult:
        photos = PhotoStore(scene, settings.max_image_px)
        return train(
            scene, photos, settings, stage_folder, progress,
            seed=job.settings.seed, threads=threads, start=start_splat_of(job), inside=inside,
            backend=chosen_backend(
                device.device, threads, or_processor=job.settings.device == "auto"
            ),
        )  # fmt: skip

    trained = train_with_oom_retry(
        attempt, job.settings.training, stage_folder, lambda: remove_checkpoints(stage_folder)
    )
    done = _written(stage_folder, cameras, trained, threads, device)
    earlier = [warning.to_json() for warning in (*warnings, *trained.warnings)]
    return {**done, "warnings": [*earlier, *done["warnings"]], "estimate": estimated}


def _join(stage_folder: Path, blocks: BlockStages, progress: Progress) -> dict[str, Any]:
    """Join the blocks of a training; return the content of ``done.json``."""
    blocks.fit_device()
    compile_if_needed(blocks.job, stage_folder, progress, blocks.threads, blocks.device)
    trained = Trained(blocks.join(stage_folder, progress), blocks.job.settings.training, ())
    done = _written(stage_folder, blocks.cameras, trained, blocks.threads, blocks.device)
    return {**done, **blocks.figures(trained.result.seconds)}


def _written(
    stage_folder: Path,
    cameras: Stage,
    trained: Trained[TrainingResult],
    threads: int,
    device: DeviceChoice,
) -> dict[str, Any]:
    """Write Gaussians, poses and pictures of held-out photos; return the figures."""
    from ...devices.checks import with_renderer
    from ...evaluation.report.pictures import write_held_out
    from ...gaussians.files import save_gaussians
    from ...photos.store import PhotoStore
    from ...scene.scene import held_out_views, load_refined_scene, save_poses

    result = trained.result
    save_gaussians(stage_folder / GAUSSIANS_NAME, result.gaussians)
    save_poses(stage_folder, result.poses)
    scene = load_refined_scene(cameras.folder, stage_folder)
    measured = {figure.name: figure.psnr for figure in result.held_out}
    shown = [
        (index, scene.views[index].camera.name, measured[scene.views[index].camera.name])
        for index in held_out_views(scene, trained.settings.holdout_every)
        if scene.views[index].camera.name in measured
    ]
    photos = PhotoStore(scene, trained.settings.max_image_px)
    pictures = with_renderer(
        result.device,
        "Pictures of held-out photos",
        lambda renderer: write_held_out(
            result.gaussians, photos, shown, stage_folder, threads=threads, renderer=renderer
        ),
    )
    return {
        **result.to_json(),
        REFINED: result.poses is not None,
        "device": result.device,
        "device_reason": device.reason,
        "pictures": pictures,
        "settings": to_json(trained.settings),
    }


def _inside_regions(job: JobFile, scene: Scene) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the test whether points lie in the job's weighted regions, scene frame, if any."""
    from ...regions.scene_regions import parse_region, region_in_scene

    focus = job.settings.training.focus
    if not focus:
        return None
    regions = [
        region_in_scene(parse_region(body, Path("job.json")), scene.world_from_scene)
        for body in json.loads(focus)
    ]

    def inside(points: np.ndarray) -> np.ndarray:
        found = regions[0].contains(points, 0.0)
        for region in regions[1:]:
            found |= region.contains(points, 0.0)
        return found

    return inside
