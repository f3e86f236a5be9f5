# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of a job walked and run, here or by an engine."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from ... import limits
from ...array_file import is_whole
from ...devices import DeviceChoice
from ...devices.checks import is_device_failure
from ...errors import EXIT_CANCELLED, EXIT_DONE, Cancelled, WorkerError, WrapError
from ...farm.dask import DaskTasks, request_of
from ...machine import describe_machine
from ...meshing.tiles.store import is_planned, load_plan
from ...names import TILE_KINDS, region_names
from ...parallel import default_threads
from ...progress import Progress, ProgressEvent, ReportWarning
from ...settings import JobSettings, to_json
from ...settings.job import LOCAL
from ...worker.helper_process import child_command, peak_memory_bytes
from ..stages.cameras import run_cameras
from ..stages.masks import run_masks
from ..stages.meshing import (
    ON_PROCESSOR,
    TILES_FOLDER,
    RegionInputs,
    TileMaker,
    TilesPlanned,
    device_warning,
    load_region,
    reject_short_edges,
    remove_tiles,
    run_mesh,
    tile_file,
)
from ..stages.texture import export_results, require_training, run_bake, run_texture
from ..stages.training import TrainingStages, plan_files
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import Stage, read_done
from .graph import (
    MAY_WORK_ELSEWHERE,
    OTHER_CODE,
    Part,
    PartsGraph,
    PartState,
    PlannedTiles,
    done_state,
    fixed_tiles,
    keep_states,
    plan_parts,
    read_state,
    state_path,
    write_parts,
)
from .lease import PartLease

# -- How far a job is: the progress of its parts, run here or elsewhere, on one scale -------------

STATES_EVERY_S = 1.0
"""How often the states of parts that run elsewhere are read."""
STAGE_OF_KIND = {
    "coarse": "train", "block": "train", "plan": "mesh", "points": "mesh", "gather": "mesh",
    "faces": "mesh",
}  # fmt: skip
"""Stage that people are shown, of parts that are no stage by themselves."""


class JobProgress:
    """Map the progress of each part onto the whole job and estimate the time left."""

    def __init__(
        self, sink: Callable[[ProgressEvent], None], is_cancelled: Callable[[], bool]
    ) -> None:
        self._sink, self._is_cancelled = sink, is_cancelled
        self._begun_s = time.monotonic()
        self._offset, self._done, self._total = 0.0, 0.0, 1.0
        self._read_s = 0.0

    def part(self, part: Part) -> Progress:
        """Return the progress of a part that this process runs."""
        begin, width = self._done, part.share / self._total

        def forward(event: ProgressEvent) -> None:
            self._send(event, begin + width * event.fraction)

        return Progress(stage_of(part), forward, self._is_cancelled)

    def begin(self, total: float) -> None:
        """Take the sum of all shares."""
        self._total = total

    def report(self, done: float, running: Mapping[str, Part], count: int) -> None:
        """Take the share of the job that is done; without running parts it took no time."""
        self._done = done
        if not running:
            self._begun_s = time.monotonic()
            self._offset = done

    def side_by_side(self, root: Path) -> Callable[[float, Mapping[str, Part], int], None]:
        """Return :meth:`report` for parts whose states tell how far they are."""

        def report(done: float, running: Mapping[str, Part], count: int) -> None:
            self.report(done, running, count)
            if running and time.monotonic() - self._read_s > STATES_EVERY_S:
                self._read_s = time.monotonic()
                states = {name: read_state(root, name) for name in running}
                begun = {n: s for n, s in states.items() if s is not None and s.state == "RUNNING"}
                under_way = sum(running[n].share * s.fraction for n, s in begun.items())
                first = next(iter(begun or running))
                said = begun[first].message if first in begun else "waits for a computer"
                also = f" and {len(running) - 1} more" if len(running) > 1 else ""
                message = f"{first}: {said}{also}; parts done: {count}"
                figures = begun[first].figures if first in begun else {}
                event = ProgressEvent(stage_of(running[first]), 0.0, message, figures)
                self._send(event, done + under_way / self._total)

        return report

    def _send(self, event: ProgressEvent, overall: float) -> None:
        elapsed_s = time.monotonic() - self._begun_s
        gained = overall - self._offset
        left_s = elapsed_s * (1.0 - overall) / gained if gained > 0.01 else None
        self._sink(
            ProgressEvent(event.stage, overall, event.message, event.figures, left_s, event.phase)
        )


def stage_of(part: Part) -> str:
    """Return the stage of a job that people are shown for a part."""
    return STAGE_OF_KIND.get(part.kind, part.kind)


# -- Run single parts of a job in this process, with what earlier parts left in the job folder ----


class BegunAgain(Exception):  # noqa: N818 - no error: the region's parts are planned anew
    """A GPU failed at a tile; the tiles of its region are removed and made on the processor."""


@dataclass(frozen=True)
class PartResult:
    """What a part has made."""

    outputs: tuple[str, ...]
    reused: bool = False


class PartRunner:
    """Runs parts of one job, and keeps what several of them need.

    ``graph`` returns the parts of the job as they are known now; ``device`` is that of this
    process, which need not be the job's; ``begun_s`` the Unix time at which the job began, for the
    report. Where ``is_alone``, no other process runs parts: this one may plan a region anew.
    """

    def __init__(
        self, folder: JobFolder, job: JobFile, graph: Callable[[], PartsGraph], *, threads: int,
        device: DeviceChoice, begun_s: float, is_alone: bool = True,
    ) -> None:  # fmt: skip
        self._folder, self._job, self._graph = folder, job, graph
        self._threads, self._device = threads, device
        self._begun_s, self._is_alone = begun_s, is_alone
        names = region_names(job.settings.regions, job.region_bodies)
        self._requests = dict(zip(names, job.settings.regions, strict=True))
        self._stages: dict[str, Stage] = {}
        self._region: tuple[str, str, RegionInputs] | None = None
        self._tiles: tuple[str, TileMaker] | None = None
        self._fallen_back: dict[str, ReportWarning] = {}

    def run(self, part: Part, progress: Progress) -> PartResult:
        """Run a part whose needs are done.

        Raises BegunAgain: its region is to be planned anew; WrapError: any typed failure of a
        stage.
        """
        if part.kind in TILE_KINDS:
            return self._run_tile(part, progress)
        if part.kind == "plan":
            return self._run_plan(part, progress)
        if part.kind == "mesh":
            return self._run_mesh(part, progress)
        if part.kind == "export":
            return self._run_export(progress)
        return self._finished(part, self._run_stage(part, progress))

    def _run_stage(self, part: Part, progress: Progress) -> Stage:
        """Run a part that is one stage."""
        known, threads = (self._folder, self._job), self._threads
        if part.kind == "cameras":
            return run_cameras(*known, progress, threads=threads)
        if part.kind == "masks":
            cameras = self._stage("cameras")
            return run_masks(*known, cameras, progress, threads=threads, device=self._device)
        cameras = self._cameras()
        training = TrainingStages(*known, cameras, threads, self._device)
        if part.kind == "block":
            return training.block(part.block, progress)
        if part.kind in ("coarse", "train"):
            reject_short_edges(self._job, cameras)
            if part.kind == "coarse":
                return training.coarse(progress)
            if self._job.command == "bake":
                require_training(*known, cameras)
            return training.run(progress)
        trained = self._stage("train")
        if part.kind == "bake":
            return run_bake(*known, cameras, trained, progress, threads=threads)
        meshed = self._stage(f"mesh-{part.region}")
        return run_texture(*known, part.region, cameras, trained, meshed, progress, threads=threads)

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
            TileMaker(planned.stage_folder / TILES_FOLDER).make_all(
                self._inputs(part.region, self._device).field, progress.span(0.1, 0.9)
            )
            return self._finished(part, self._meshed(part.region, progress.span(0.9, 1.0)))
        finally:
            self._region = self._tiles = None  # large

    def _meshed(self, region: str, progress: Progress) -> Stage:
        warning = self._fallen_back.get(region)
        return run_mesh(
            self._folder, self._job, self._requests[region], region, self._stage("train"), progress,
            device=self._device if warning is None else ON_PROCESSOR,
            load=lambda device: self._inputs(region, device),
            tile_processes=self._tile_processes(region),
            warnings=() if warning is None else (warning,),
        )  # fmt: skip

    def _inputs(self, region: str, device: DeviceChoice) -> RegionInputs:
        """Return what a region is made from; that of the last one asked for is kept."""
        request = self._requests[region]
        if self._region is None or self._region[:2] != (request, device.device):
            self._region = None
            inputs = load_region(
                self._job, request, self._cameras(), self._stage("train"), device, self._threads
            )
            self._region = (request, device.device, inputs)
        return self._region[2]

    def _run_tile(self, part: Part, progress: Progress) -> PartResult:
        folder = self._stage_folder(f"plan-{part.region}") / TILES_FOLDER
        path = tile_file(folder, part.kind, part.tile)
        if path.is_file() and is_whole(path):
            return PartResult((self._relative(path),), True)
        warning = self._fallen_back.get(part.region)
        device = self._device if warning is None else ON_PROCESSOR
        if self._tiles is None or self._tiles[0] != part.region:
            self._tiles = (part.region, TileMaker(folder))
        try:
            inputs = self._inputs(part.region, device)
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
        parts = self._graph().of_region(region)
        states = [read_state(self._folder.root, p.name) for p in parts if p.kind in TILE_KINDS]
        return max(1, len({(s.place, s.pid) for s in states if s is not None}))

    def _run_export(self, progress: Progress) -> PartResult:
        regions = [
            (name, self._stage(f"mesh-{name}"), self._stage(f"texture-{name}"))
            for name in self._requests
        ]
        job = self._job
        summary = {
            "command": job.command, "source": Path(job.source).name,
            "settings": to_json(job.settings), "machine": describe_machine(self._threads),
            "device": self._device.device, "device_reason": self._device.reason,
            "started_unix_s": round(self._begun_s, 1),
            "wall_seconds": round(time.time() - self._begun_s, 1),
            "peak_memory_bytes": peak_memory_bytes(),
        }  # fmt: skip
        cameras, trained = self._cameras(), self._stage("train")
        export_results(self._folder, job, cameras, trained, regions, summary, progress)
        return PartResult((self._relative(self._folder.result / "report.json"),))

    def _finished(self, part: Part, stage: Stage) -> PartResult:
        self._stages[part.name] = stage
        # With what blocks read: a part whose outputs are gone is not done.
        paths = (stage.folder, *(s.folder for s in stage.before), *plan_files(stage))
        return PartResult(tuple(self._relative(path) for path in paths), stage.reused)

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
            self._stages[name] = replace(stages[0], before=tuple(stages[1:]))
        return self._stages[name]

    def _stage_folder(self, name: str) -> Path:
        return self._folder.root / self._done_state(name).outputs[0]

    def _done_state(self, name: str) -> PartState:
        state = done_state(self._folder.root, name, self._graph().plan)
        if state is None or not state.outputs:
            raise WorkerError(f"Part {name} is not done yet.", "Run it first, or resume the job.")
        return state


def _stage_in(folder: Path) -> Stage:
    done = read_done(folder)
    if done is None:
        raise WorkerError(f"Stage {folder.name} is not finished.", "Resume the job.")
    name, _, key = folder.name.rpartition("-")
    return Stage(name, key, folder, done, True)


def planned_tiles(folder: JobFolder, plan: PartState) -> PlannedTiles | None:
    """Return what is known of the tiles of a region whose plan is done; ``None`` if it is whole."""
    if not plan.outputs:
        return None
    tiles = folder.root / plan.outputs[0] / TILES_FOLDER
    if not is_planned(tiles):
        return None
    loaded, noted = load_plan(tiles)
    estimate = noted.get("estimate", {})
    return PlannedTiles(
        len(loaded.tiling), estimate.get("tiled_memory_bytes"), estimate.get("seconds_high")
    )


# -- What runs parts: the interface, the engine of this process, and that of a Dask cluster -------

PART_MODULE = "jobs.part_process"


@dataclass(frozen=True)
class Outcome:
    """How a part ended."""

    part: Part
    code: int
    """0 done; else one of the exit codes of ``run-part``, or negative: a signal."""
    reused: bool = False
    error: str = ""
    hint: str = ""
    place: str = ""
    begun_again: bool = False
    """Whether the region of the part is to be planned anew."""


class Engine(Protocol):
    """Runs parts, one or several at a time."""

    @property
    def slots(self) -> int:
        """Parts that it runs at a time."""

    @property
    def trusts_states(self) -> bool:
        """Whether finished parts of an interrupted job are not asked again."""

    def start(self, part: Part, plan: str, attempt: int) -> None:
        """Begin a part, or queue it."""

    def wait(self, seconds: float) -> list[Outcome]:
        """Return what has ended; wait at most so long for the first."""

    def close(self, *, cancelled: bool) -> None:
        """End what still runs and give everything back."""


@dataclass
class InProcess:
    """The engine of this process: one part after the other.

    Its errors are raised as they are: they end the job.
    """

    root: Path
    runner: PartRunner
    progress_of: Callable[[Part], Progress]
    slots: int = 1
    trusts_states: bool = False
    _queue: list[tuple[Part, str, int]] = field(default_factory=list)

    def start(self, part: Part, plan: str, attempt: int) -> None:
        """Queue a part."""
        self._queue.append((part, plan, attempt))

    def wait(self, seconds: float) -> list[Outcome]:
        """Run the next part, however long it takes; there must be one."""
        part, plan, attempt = self._queue.pop(0)
        lease = PartLease(self.root, part.name, plan, attempt)
        lease.take()
        try:
            result = self.runner.run(part, self.progress_of(part))
        except BegunAgain:
            lease.finish("FAILED", error="It is begun again on the processor.")
            return [Outcome(part, EXIT_DONE, begun_again=True)]
        except Exception as error:
            lease.finish(
                "FAILED", error=str(getattr(error, "message", error)),
                hint=getattr(error, "hint", ""), exit_code=getattr(error, "exit_code", None),
            )  # fmt: skip
            raise
        state = lease.finish("DONE", fraction=1.0, exit_code=EXIT_DONE, outputs=result.outputs)
        return [Outcome(part, EXIT_DONE, reused=result.reused, place=state.host)]

    def close(self, *, cancelled: bool) -> None:
        """Forget what is queued."""
        self._queue.clear()


class FarmEngine:
    """Runs each part by ``run-part`` on a Dask cluster; all its computers see the folder ``root``.

    Raises MissingExtraError, UsageError, WorkerError: as :class:`~.dask.DaskTasks`.
    """

    trusts_states = True

    def __init__(self, root: Path, settings: JobSettings) -> None:
        self._root, self._settings = root, settings
        self._is_local = settings.computers == LOCAL
        self._tasks = DaskTasks(settings.computers, settings.processes, settings.certificates)
        self._parts: dict[str, Part] = {}
        self._begun_s = time.time()

    @property
    def slots(self) -> int:
        """Parts that run at a time."""
        return self._tasks.slots

    def start(self, part: Part, plan: str, attempt: int) -> None:
        """Submit a part."""
        arguments: dict[str, Any] = {
            "part": part.name, "threads": self._threads(part), "device": self._settings.device,
            "attempt": attempt, "driven": True,
        }  # fmt: skip
        command = child_command(PART_MODULE)[:-1] if self._is_local else None
        self._parts[part.name] = part
        # The same part of another walk is another task: what it left is not known to Dask.
        key = f"{part.name}-{plan}-{attempt}-{int(self._begun_s * 1000):x}"
        self._tasks.submit(part.name, key, request_of(self._root, PART_MODULE, arguments, command))

    def _threads(self, part: Part) -> int:
        """Return the threads of a part: all there are, or a share where others run beside it."""
        if self._settings.threads or not self._is_local or not part.is_one_of_many:
            return self._settings.threads
        return max(1, default_threads() // self._settings.processes)

    def wait(self, seconds: float) -> list[Outcome]:
        """Return what has ended."""
        return [
            Outcome(self._parts.pop(e.name), e.code, error=e.error, hint=e.hint, place=e.host)
            for e in self._tasks.ended(seconds)
        ]

    def close(self, *, cancelled: bool) -> None:
        """End all parts: they see the cancel file, or that nobody holds the folder."""
        self._tasks.close(limits.CANCEL_ALONE_S if cancelled else 0.0)


# -- Walk the parts of a job: start what is ready, take what has ended, plan what came to light
#
# A part that may work elsewhere is begun again, at most :data:`MOST_ATTEMPTS` times in all. One
# that never will holds up what needs it; everything else is done first.

_logger = logging.getLogger(__name__)

MOST_ATTEMPTS = 3
POLL_S = 0.25
HERE = ("bake", "export")
"""Kinds that change the result of a job: only the process that holds the folder runs them."""
CHECKED_AGAIN = ("cameras", "masks")
"""Kinds whose input people change between two runs: photos and masks. Where nothing has changed,
they are finished at once."""


class PartError(WrapError):
    """Parts of a job have failed for good."""

    can_resume = True

    def __init__(self, outcome: Outcome, count: int) -> None:
        """Take how the first of them ended, and how many there are."""
        where = f" on {outcome.place}" if outcome.place else ""
        more = f" {count - 1} more failed." if count > 1 else ""
        super().__init__(
            f"Part {outcome.part.name} failed{where}: {outcome.error}{more}",
            f"{outcome.hint} Everything else is done: resume makes what is missing.".strip(),
        )


@dataclass
class Walk:
    """One walk through the parts of a job."""

    folder: JobFolder
    job: JobFile
    engine: Engine
    here: Engine
    """What runs the parts of :data:`HERE`; may be the same."""
    report: Callable[[float, Mapping[str, Part], int], None]
    """Takes the share of the job that is done, the parts that run, and how many are done."""
    is_cancelled: Callable[[], bool]
    graph: PartsGraph = field(init=False)
    _tiles: dict[str, PlannedTiles] = field(default_factory=dict)
    _done: set[str] = field(default_factory=set)
    _running: dict[str, Part] = field(default_factory=dict)
    _failed: dict[str, Outcome] = field(default_factory=dict)
    _attempts: dict[str, int] = field(default_factory=dict)
    _earlier: dict[str, PartState] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._tiles = fixed_tiles(self.job)
        self._plan()
        if self.engine.trusts_states:
            self._earlier = self._finished_earlier()
        kinds = {part.name: part.kind for part in self.graph.parts}
        kept = {name for name in self._earlier if kinds[name] not in CHECKED_AGAIN}
        keep_states(self.folder.root, kept)

    def run(self) -> None:
        """Run all parts.

        Raises Cancelled; PartError: parts failed for good; all that do not need them are done.
        """
        while True:
            if self.is_cancelled():
                raise Cancelled()
            self._start_ready()
            if not self._running:
                break
            for engine in self._at_work():
                for outcome in engine.wait(POLL_S):
                    self._take(outcome)
            self.report(self._fraction(), self._running, len(self._done))
        if self._failed:
            raise PartError(next(iter(self._failed.values())), len(self._failed))
        if len(self._done) < len(self.graph.parts):
            raise WorkerError("Parts of the job wait for each other.", "Start the job again.")

    def _at_work(self) -> list[Engine]:
        engines = [self._engine_of(part) for part in self._running.values()]
        return [e for i, e in enumerate(engines) if not any(e is other for other in engines[:i])]

    def _plan(self) -> None:
        self.graph = plan_parts(self.folder.root, self.job, self._tiles)
        write_parts(self.folder.root, self.graph)

    def _finished_earlier(self) -> dict[str, PartState]:
        """Return the states of parts that an interrupted walk of the same plan has finished."""
        for part in self.graph.parts:
            if part.kind == "plan":
                self._note_tiles(part)
        self._plan()
        root, plan = self.folder.root, self.graph.plan
        states = {part.name: done_state(root, part.name, plan) for part in self.graph.parts}
        return {name: state for name, state in states.items() if state is not None}

    def _note_tiles(self, part: Part) -> None:
        state = done_state(self.folder.root, part.name, self.graph.plan)
        if state is None:
            return
        known = planned_tiles(self.folder, state)
        self._tiles.pop(part.region, None)
        self._tiles |= {} if known is None else {part.region: known}

    def _start_ready(self) -> None:
        """Start what is ready, as far as engines have room; what was finished earlier is done."""
        for part in self.graph.parts:  # in an order in which they can be done
            if not self._is_ready(part):
                continue
            if part.name in self._earlier and part.kind not in CHECKED_AGAIN:
                self._done.add(part.name)
                continue
            engine = self._engine_of(part)
            taken = sum(self._engine_of(other) is engine for other in self._running.values())
            if taken >= engine.slots:
                continue
            attempt = self._attempts.get(part.name, 0) + 1
            self._attempts[part.name] = attempt
            self._running[part.name] = part
            engine.start(part, self.graph.plan, attempt)

    def _is_ready(self, part: Part) -> bool:
        begun = part.name in self._running or part.name in self._failed
        return not begun and part.name not in self._done and set(part.needs) <= self._done

    def _engine_of(self, part: Part) -> Engine:
        return self.here if part.kind in HERE else self.engine

    def _take(self, outcome: Outcome) -> None:
        part = outcome.part
        self._running.pop(part.name, None)
        if outcome.begun_again:
            self._begin_again(part.region)
            return
        if outcome.code == EXIT_DONE:
            self._done.add(part.name)
            if part.kind in CHECKED_AGAIN and self._has_changed(part):
                self._earlier = {}
                keep_states(self.folder.root, self._done)
            if part.kind == "plan":
                self._note_tiles(part)
                self._plan()
            if outcome.reused:
                self.report(self._fraction(), {}, len(self._done))
            return
        if outcome.code == EXIT_CANCELLED and self.is_cancelled():
            raise Cancelled()
        attempt = self._attempts[part.name]
        may_work = outcome.code in (MAY_WORK_ELSEWHERE, OTHER_CODE) or outcome.code < 0
        _logger.warning(
            "part %s ended with code %d (attempt %d): %s", part.name, outcome.code, attempt,
            outcome.error,
        )  # fmt: skip
        if not may_work or attempt >= MOST_ATTEMPTS:
            self._failed[part.name] = outcome

    def _has_changed(self, part: Part) -> bool:
        """Return whether a part that was asked again has made something else than before."""
        state, earlier = read_state(self.folder.root, part.name), self._earlier.get(part.name)
        return state is None or earlier is None or state.outputs != earlier.outputs

    def _begin_again(self, region: str) -> None:
        """Forget the parts of a region, and plan it anew."""
        for part in self.graph.of_region(region):
            self._done.discard(part.name)
            self._attempts.pop(part.name, None)
            state_path(self.folder.root, part.name).unlink(missing_ok=True)
        self._tiles.pop(region, None)
        self._tiles |= {k: v for k, v in fixed_tiles(self.job).items() if k == region}
        self._plan()

    def _fraction(self) -> float:
        done = sum(part.share for part in self.graph.parts if part.name in self._done)
        return done / sum(part.share for part in self.graph.parts)
