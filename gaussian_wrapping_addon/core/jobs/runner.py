# SPDX-License-Identifier: GPL-3.0-or-later
"""Run a job: walk its parts, here or by an engine, and tell how far it is."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from ..devices import DeviceChoice, choose_device
from ..kernels.parallel import default_threads
from ..progress import Progress, ProgressEvent
from .masking.masks_stage import check_mask_model
from .parts.engine import Engine, InProcess
from .parts.graph import Part
from .parts.part_runner import PartRunner
from .parts.part_state import read_state
from .parts.walk import Walk
from .store.job_file import JobFile, reject_region_conflicts
from .store.job_folder import JobFolder

_logger = logging.getLogger(__name__)

STATES_EVERY_S = 1.0
"""How often the states of parts that run elsewhere are read."""
STAGE_OF_KIND = {"plan": "mesh", "points": "mesh", "gather": "mesh", "faces": "mesh"}
"""Stage that people are shown, of parts that are no stage by themselves."""


class _JobProgress:
    """Map the progress of each part onto the whole job and estimate the time left."""

    def __init__(
        self, sink: Callable[[ProgressEvent], None], is_cancelled: Callable[[], bool]
    ) -> None:
        self._sink = sink
        self._is_cancelled = is_cancelled
        self._begun_s = time.monotonic()
        self._offset = 0.0
        self._done = 0.0
        self._total = 1.0
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
                message = f"{first}: {said}{also}; {count} parts are done"
                event = ProgressEvent(stage_of(running[first]), 0.0, message)
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


def run_job(
    folder: JobFolder,
    job: JobFile,
    sink: Callable[[ProgressEvent], None],
    is_cancelled: Callable[[], bool],
) -> None:
    """Run a job to its end in ``folder``; finished stages are re-used.

    Raises
    ------
    WrapError
        Any typed failure of a stage; stages finished so far stay.
    """
    threads = job.settings.threads or default_threads()
    overall = _JobProgress(sink, is_cancelled)
    begun_s = time.time()
    reject_region_conflicts(folder.result, job)
    device = _device_of(job)  # refused before photos are read
    # As is a model for masks that is not there.
    check_mask_model(job, folder, Progress("cameras", sink, is_cancelled))
    runner = PartRunner(
        folder, job, lambda: walk.graph, threads=threads, device=device, begun_s=begun_s
    )
    here: Engine = InProcess(folder.root, runner, overall.part)
    engine = here
    if job.settings.computers:
        from .parts.farm_engine import FarmEngine

        engine = FarmEngine(folder.root, job.settings)
    try:
        report = overall.report if engine is here else overall.side_by_side(folder.root)
        walk = Walk(folder, job, engine, here, report, is_cancelled)
        overall.begin(sum(part.share for part in walk.graph.parts))
        walk.run()
    finally:
        engine.close(cancelled=is_cancelled())
    sink(ProgressEvent("bake" if job.command == "bake" else "export", 1.0, "finished"))


def _device_of(job: JobFile) -> DeviceChoice:
    """Choose the device of a job and log it with the reason.

    Raises
    ------
    DeviceError
        The job names a GPU that cannot be used.
    """
    # Nothing of a bake runs on a GPU: it goes on where the GPU of its training is missing.
    chosen = choose_device("cpu" if job.command == "bake" else job.settings.device)
    _logger.info("device: %s", chosen.sentence())
    return chosen
