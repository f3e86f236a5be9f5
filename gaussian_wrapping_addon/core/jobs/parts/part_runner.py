# SPDX-License-Identifier: GPL-3.0-or-later
"""Run single parts of a job in this process, with what earlier parts left in the job folder."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...devices import DeviceChoice
from ...errors import WorkerError
from ...machine import describe_machine
from ...meshing.tiles.kinds import TILE_KINDS
from ...names import region_names
from ...processes.peak_memory import peak_memory_bytes
from ...progress import Progress
from ...report_warning import ReportWarning
from ...settings import to_json
from ..baking.bake_stage import require_training, run_bake
from ..masking.masks_stage import run_masks
from ..stages.cameras_stage import run_cameras
from ..stages.mesh_stage import ON_PROCESSOR, device_warning, run_mesh
from ..stages.region_field import load_region, reject_short_edges
from ..stages.region_meshing import TILES_FOLDER, TilesPlanned, remove_tiles
from ..stages.texture_stage import run_texture
from ..stages.tile_tasks import TileMaker, tile_file
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import STAGE_VERSIONS, Stage, read_done
from ..training.block_stages import plan_files
from ..training.training_stage import run_block, run_coarse, run_training
from .graph import Part, PartsGraph
from .part_state import PartState, read_state
from .planning import PlannedTiles

if TYPE_CHECKING:
    from ..stages.region_field import RegionInputs


class BegunAgain(Exception):  # noqa: N818 - no error: the region's parts are planned anew
    """A GPU failed at a tile; the tiles of its region are removed and made on the processor."""

    def __init__(self, region: str) -> None:
        super().__init__(region)
        self.region = region


@dataclasses.dataclass(frozen=True)
class PartResult:
    """What a part has made."""

    outputs: tuple[str, ...]
    reused: bool = False


class PartRunner:
    """Runs parts of one job, and keeps what several of them need.

    Parameters
    ----------
    graph : callable
        Returns the parts of the job as they are known now.
    threads : int
    device : DeviceChoice
        Of this process, which need not be that of the job.
    begun_s : float
        Unix time at which the job began, for the report.
    is_alone : bool
        Whether no other process runs parts of the job: then this one may plan a region anew.
    """

    def __init__(
        self,
        folder: JobFolder,
        job: JobFile,
        graph: Callable[[], PartsGraph],
        *,
        threads: int,
        device: DeviceChoice,
        begun_s: float,
        is_alone: bool = True,
    ) -> None:
        self._folder = folder
        self._is_alone = is_alone
        self._job = job
        self._graph = graph
        self._threads = threads
        self._device = device
        self._begun_s = begun_s
        names = region_names(job.settings.regions, job.region_bodies)
        self._requests = dict(zip(names, job.settings.regions, strict=True))
        self._stages: dict[str, Stage] = {}
        self._region: tuple[str, str, RegionInputs] | None = None
        self._tiles: tuple[str, TileMaker] | None = None
        self._fallen_back: dict[str, ReportWarning] = {}

    def run(self, part: Part, progress: Progress) -> PartResult:
        """Run a part whose needs are done.

        Raises
        ------
        BegunAgain
            The region of the part is to be planned anew.
        WrapError
            Any typed failure of a stage.
        WorkerError
            What it needs is not there.
        """
        if part.kind in TILE_KINDS:
            return self._run_tile(part, progress)
        work: dict[str, Callable[[Part, Progress], PartResult]] = {
            "cameras": self._run_cameras, "masks": self._run_masks, "coarse": self._run_coarse,
            "block": self._run_block, "train": self._run_training,
            "plan": self._run_plan, "mesh": self._run_mesh, "texture": self._run_texture,
            "bake": self._run_bake, "export": self._run_export,
        }  # fmt: skip
        return work[part.kind](part, progress)

    def _run_cameras(self, part: Part, progress: Progress) -> PartResult:
        stage = run_cameras(self._folder, self._job, progress, threads=self._threads)
        return self._finished(part, stage)

    def _run_masks(self, part: Part, progress: Progress) -> PartResult:
        stage = run_masks(
            self._folder, self._job, self._stage("cameras"), progress, threads=self._threads,
            device=self._device,
        )  # fmt: skip
        return self._finished(part, stage)

    def _run_coarse(self, part: Part, progress: Progress) -> PartResult:
        cameras = self._cameras()
        reject_short_edges(self._job, cameras.folder)
        stage = run_coarse(
            self._folder, self._job, cameras, progress, version=STAGE_VERSIONS["train"],
            threads=self._threads, device=self._device,
        )  # fmt: skip
        result = self._finished(part, stage)
        # What blocks read: a part whose outputs are gone is not done.
        plan = tuple(self._relative(path) for path in plan_files(stage))
        return dataclasses.replace(result, outputs=(*result.outputs, *plan))

    def _run_block(self, part: Part, progress: Progress) -> PartResult:
        stage = run_block(
            self._folder, self._job, self._cameras(), part.block, progress,
            version=STAGE_VERSIONS["train"], threads=self._threads, device=self._device,
        )  # fmt: skip
        return self._finished(part, stage)

    def _run_training(self, part: Part, progress: Progress) -> PartResult:
        cameras = self._cameras()
        reject_short_edges(self._job, cameras.folder)
        if self._job.command == "bake":
            require_training(self._folder, self._job, cameras)
        stage = run_training(
            self._folder, self._job, cameras, progress, version=STAGE_VERSIONS["train"],
            threads=self._threads, device=self._device,
        )  # fmt: skip
        return self._finished(part, stage)

    def _run_plan(self, part: Part, progress: Progress) -> PartResult:
        try:
            return self._finished(part, self._meshed(part.region, progress))
        except TilesPlanned as planned:
            self._tiles = None
            return PartResult((self._relative(planned.stage_folder),))

    def _run_mesh(self, part: Part, progress: Progress) -> PartResult:
        planned = self._stage_folder(f"plan-{part.region}")
        if read_done(planned) is not None:  # whole, by the part that would have planned its tiles
            self._region = self._tiles = None
            return self._finished(part, self._stage(f"plan-{part.region}"))
        try:
            return self._finished(part, self._meshed(part.region, progress.span(0.0, 0.1)))
        except TilesPlanned as planned:
            if any(p.kind in TILE_KINDS for p in self._graph().of_region(part.region)):
                raise WorkerError(
                    f"Tiles of region {part.region} are missing.", "Resume the job: it makes them."
                ) from None
            # A list of parts that cannot grow was made before the plan.
            inputs = self._inputs(
                self._job, self._requests[part.region], self._cameras(), self._stage("train"),
                self._device, self._threads,
            )  # fmt: skip
            TileMaker(planned.stage_folder / TILES_FOLDER).make_all(
                inputs.field, progress.span(0.1, 0.9)
            )
            return self._finished(part, self._meshed(part.region, progress.span(0.9, 1.0)))
        finally:
            self._region = self._tiles = None  # large

    def _meshed(self, region: str, progress: Progress) -> Stage:
        warning = self._fallen_back.get(region)
        return run_mesh(
            self._folder, self._job, self._requests[region], region, self._cameras(),
            self._stage("train"), progress, threads=self._threads,
            device=self._device if warning is None else ON_PROCESSOR, load=self._inputs,
            tile_processes=self._tile_processes(region),
            warnings=() if warning is None else (warning,),
        )  # fmt: skip

    def _inputs(self, *given: Any) -> RegionInputs:
        """Return what a region is made from; that of the last one asked for is kept."""
        request, device = str(given[1]), given[4].device
        if self._region is None or self._region[:2] != (request, device):
            self._region = None
            self._region = (request, device, load_region(*given))
        return self._region[2]

    def _run_tile(self, part: Part, progress: Progress) -> PartResult:
        from ...array_file import is_whole
        from ...devices.failures import is_device_failure

        folder = self._stage_folder(f"plan-{part.region}") / TILES_FOLDER
        path = tile_file(folder, part.kind, part.tile)
        if path.is_file() and is_whole(path):
            return PartResult((self._relative(path),), True)
        warning = self._fallen_back.get(part.region)
        device = self._device if warning is None else ON_PROCESSOR
        if self._tiles is None or self._tiles[0] != part.region:
            self._tiles = (part.region, TileMaker(folder))
        request = self._requests[part.region]
        cameras, trained = self._cameras(), self._stage("train")
        try:
            inputs = self._inputs(self._job, request, cameras, trained, device, self._threads)
            path = self._tiles[1].make(part.kind, part.tile, inputs.field, progress)
        except Exception as error:
            if not (self._is_alone and device.is_cuda and is_device_failure(error)):
                raise
            self._fallen_back[part.region] = device_warning(device, part.region, error)
            self._region = self._tiles = None
            # Tiles of two devices differ by rounding where they join.
            remove_tiles(folder.parent)
            raise BegunAgain(part.region) from error
        return PartResult((self._relative(path),))

    def _tile_processes(self, region: str) -> int:
        """Return how many processes have made the tiles of a region."""
        tiles = [part for part in self._graph().of_region(region) if part.kind in TILE_KINDS]
        states = [read_state(self._folder.root, part.name) for part in tiles]
        return max(1, len({(s.place, s.pid) for s in states if s is not None}))

    def _run_texture(self, part: Part, progress: Progress) -> PartResult:
        stage = run_texture(
            self._folder, self._job, part.region, self._cameras(), self._stage("train"),
            self._stage(f"mesh-{part.region}"), progress, threads=self._threads,
        )  # fmt: skip
        return self._finished(part, stage)

    def _run_bake(self, part: Part, progress: Progress) -> PartResult:
        stage = run_bake(
            self._folder, self._job, self._cameras(), self._stage("train"), progress,
            threads=self._threads,
        )  # fmt: skip
        return self._finished(part, stage)

    def _run_export(self, part: Part, progress: Progress) -> PartResult:
        from ..stages.export_stage import export_results

        regions = [
            (name, self._stage(f"mesh-{name}"), self._stage(f"texture-{name}"))
            for name in self._requests
        ]
        job = self._job
        summary = {
            "command": job.command,
            "source": Path(job.source).name,
            "settings": to_json(job.settings),
            "machine": describe_machine(self._threads),
            "device": self._device.device,
            "device_reason": self._device.reason,
            "started_unix_s": round(self._begun_s, 1),
            "wall_seconds": round(time.time() - self._begun_s, 1),
            "peak_memory_bytes": peak_memory_bytes(),
        }
        cameras, trained = self._cameras(), self._stage("train")
        export_results(self._folder, job, cameras, trained, regions, summary, progress)
        return PartResult((self._relative(self._folder.result / "report.json"),))

    def _finished(self, part: Part, stage: Stage) -> PartResult:
        self._stages[part.name] = stage
        folders = (stage.folder, *(earlier.folder for earlier in stage.before))
        return PartResult(tuple(self._relative(path) for path in folders), stage.reused)

    def _relative(self, path: Path) -> str:
        return path.relative_to(self._folder.root).as_posix()

    def _cameras(self) -> Stage:
        """Return the stage of the scene: with its masks, where the job makes some."""
        return self._stage("masks" if self._job.settings.masks_are_made else "cameras")

    def _stage(self, name: str) -> Stage:
        """Return the finished stage of a part, which another process may have run."""
        if name not in self._stages:
            state = self._done_state(name)
            stages = [_stage_in(self._folder.root / output) for output in state.outputs]
            first, *before = stages
            self._stages[name] = dataclasses.replace(first, before=tuple(before))
        return self._stages[name]

    def _stage_folder(self, name: str) -> Path:
        return self._folder.root / self._done_state(name).outputs[0]

    def _done_state(self, name: str) -> PartState:
        state = read_state(self._folder.root, name)
        plan = self._graph().plan
        if state is None or not state.outputs or not state.done_in(self._folder.root, plan):
            raise WorkerError(f"Part {name} is not done yet.", "Run it first, or resume the job.")
        return state


def _stage_in(folder: Path) -> Stage:
    done = read_done(folder)
    if done is None:
        raise WorkerError(f"Stage {folder.name} is not finished.", "Resume the job.")
    name, _, key = folder.name.rpartition("-")
    return Stage(name, key, folder, done, True)


def planned_tiles(folder: JobFolder, plan: PartState | None) -> PlannedTiles | None:
    """Return what is known of the tiles of a region whose plan is done; ``None`` if it is whole."""
    from ...meshing.tiles.store import is_planned, load_plan

    if plan is None or plan.state != "DONE" or not plan.outputs:
        return None
    tiles = folder.root / plan.outputs[0] / TILES_FOLDER
    if not is_planned(tiles):
        return None
    loaded, noted = load_plan(tiles)
    estimate = noted.get("estimate", {})
    return PlannedTiles(
        len(loaded.tiling), estimate.get("tiled_memory_bytes"), estimate.get("seconds_high")
    )
