# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages of a training in blocks: the coarse training with its plan, each block, joining.

They lie in a folder of their own, ``stages/blocks-KEY``: a longer training of the same job, or one
with another joint training, joins the same blocks.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...array_file import is_whole
from ...devices import DeviceChoice
from ...errors import UsageError, WorkerError
from ...processes.peak_memory import own_peak_bytes
from ...progress import Progress
from ...report_warning import ReportWarning, read_warnings
from ...settings import TrainingSettings
from ..store.job_file import JobFile
from ..store.stage_folder import Stage, read_done, record_interrupted_time, run_stage
from .oom_retry import within_memory

if TYPE_CHECKING:
    from ...dataset.photos.photo_store import PhotoStore
    from ...dataset.scene import Scene
    from ...gaussians.model import OrientedGaussians
    from ...stereo.depth_priors import DepthPrior
    from ...training.blocks.block_plan import BlockPlan
    from ...training.devices.backend import Backend
    from ...training.result import TrainingResult
    from ...training.rounds import Inside

COARSE, COARSE_KEY = "coarse", "all"
BLOCK = "block"
GAUSSIANS_NAME = "gaussians.npz"
"""In the folder of a block: what it has trained."""


@dataclass(frozen=True)
class BlockStages:
    """The stages of one training in blocks.

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
        from ...training.blocks.plan_file import ARRAYS_NAME, PLAN_NAME

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
        from ...dataset.refined_scene import with_poses
        from ...training.blocks.coarse_training import train_coarse
        from ...training.blocks.plan_blocks import plan_blocks
        from ...training.blocks.plan_file import save_plan
        from ...training.checkpoint import remove_checkpoints

        settings, blocks = self._settings, self._blocks
        coarse_settings, scene = blocks.coarse(settings), self._scene()
        backend = self._backend()
        coarse = train_coarse(
            scene, _photos(scene, coarse_settings), coarse_settings, folder,
            progress.span(0.0, 0.9), seed=self.job.settings.seed, threads=self.threads,
            inside=inside, backend=backend,
        )  # fmt: skip
        if coarse.poses is not None:
            scene = with_poses(scene, coarse.poses)
        plan = plan_blocks(
            coarse, scene, _photos(scene, settings), settings, blocks, progress.span(0.9, 1.0),
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
            return done.get("plan") == self._plan().digest and is_whole(folder / GAUSSIANS_NAME)

        key = f"{index:04d}"

        def work(folder: Path, progress: Progress) -> dict[str, Any]:
            with self._noted(BLOCK, key), within_memory(f"Block {index}"):
                return self._train_block(index, folder, progress, inside)

        return run_stage(self.root, BLOCK, key, progress, work, whole=whole)

    def _train_block(
        self, index: int, folder: Path, progress: Progress, inside: Inside | None
    ) -> dict[str, Any]:
        from ...gaussians.gaussian_file import save_gaussians
        from ...training.blocks.train_block import train_block
        from ...training.checkpoint import remove_checkpoints

        plan, settings = self._plan(), self._settings
        scene = self._refined(plan)
        result = train_block(
            plan, index, scene, _photos(scene, settings), settings, folder, progress,
            seed=self.job.settings.seed, threads=self.threads,
            priors=self._priors(plan, scene, plan.blocks[index].views), inside=inside,
            backend=self._backend(),
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
        from ...gaussians.gaussian_file import load_gaussians
        from ...training.blocks.join_blocks import join_blocks

        stages = self.finished()
        if len(stages) < self._settings.blocks + 1:
            raise WorkerError("Blocks of the training are missing.", "Resume the job.")
        plan, settings = self._plan(), self._settings
        scene = self._refined(plan)

        def parts() -> Iterator[OrientedGaussians]:
            for stage in stages[1:]:
                if stage.done.get("plan") != plan.digest:
                    raise WorkerError(
                        f"Block {stage.key} was trained for another plan.", "Resume the job."
                    )
                yield load_gaussians(stage.folder / GAUSSIANS_NAME)

        with within_memory("Joining the blocks"):
            result = join_blocks(
                plan, parts(), scene, _photos(scene, settings), settings, self._blocks, folder,
                progress, seed=self.job.settings.seed, threads=self.threads,
                priors=self._priors(plan, scene, plan.views), backend=self._backend(),
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

    @property
    def _blocks(self) -> Any:
        from ...training.blocks.block_settings import BlockSettings

        return BlockSettings.of(self._settings)

    def _plan(self) -> BlockPlan:
        from ...training.blocks.plan_file import PLAN_NAME, load_plan

        if not (self.root / PLAN_NAME).is_file():
            raise WorkerError("The training is not divided into blocks yet.", "Resume the job.")
        return load_plan(self.root)

    def _scene(self) -> Scene:
        from ...dataset.scene_file import load_saved_scene

        return load_saved_scene(self.cameras.folder)

    def _refined(self, plan: BlockPlan) -> Scene:
        from ...dataset.refined_scene import with_poses

        scene, poses = self._scene(), plan.coarse.poses
        return scene if poses is None else with_poses(scene, poses)

    def _priors(
        self, plan: BlockPlan, scene: Scene, views: tuple[int, ...]
    ) -> dict[int, DepthPrior]:
        from ...training.blocks.coarse_training import confirmed_depths

        settings = self._blocks.coarse(self._settings)
        folder = self.root / f"{COARSE}-{COARSE_KEY}"
        photos = _photos(scene, settings)
        return confirmed_depths(plan.coarse, folder, photos, settings, plan.views, views)

    def _backend(self) -> Backend:
        from ...training.devices.chosen import chosen_backend

        return chosen_backend(
            self.device.device, self.threads, or_processor=self.job.settings.device == "auto"
        )


def plan_files(stage: Stage) -> list[Path]:
    """Return the files of the plan beside a coarse training; none beside another stage."""
    from ...training.blocks.plan_file import ARRAYS_NAME, PLAN_NAME

    if stage.name != COARSE:
        return []
    return [stage.folder.parent / name for name in (PLAN_NAME, ARRAYS_NAME)]


def _photos(scene: Scene, settings: TrainingSettings) -> PhotoStore:
    from ...dataset.photos.photo_store import PhotoStore

    return PhotoStore(scene, settings.max_image_px)
