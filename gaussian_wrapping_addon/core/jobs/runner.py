# SPDX-License-Identifier: GPL-3.0-or-later
"""Run a job: walk its parts, here or by an engine, and tell how far it is."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from ..devices import choose_device
from ..parallel import default_threads
from ..progress import Progress, ProgressEvent
from .parts.runner import Engine, FarmEngine, InProcess, JobProgress, PartRunner, Walk
from .stages.masks import check_mask_model
from .store.job_file import JobFile, reject_region_conflicts
from .store.job_folder import JobFolder

_logger = logging.getLogger(__name__)


def run_job(
    folder: JobFolder, job: JobFile, sink: Callable[[ProgressEvent], None],
    is_cancelled: Callable[[], bool],
) -> None:  # fmt: skip
    """Run a job to its end in ``folder``; finished stages are re-used.

    Raises WrapError: any typed failure of a stage; stages finished so far stay.
    """
    threads = job.settings.threads or default_threads()
    overall = JobProgress(sink, is_cancelled)
    begun_s = time.time()
    reject_region_conflicts(folder.result, job)
    # Nothing of a bake runs on a GPU: it goes on where the GPU of its training is missing.
    device = choose_device("cpu" if job.command == "bake" else job.settings.device)
    _logger.info("device: %s", device.sentence())
    # A GPU and a model for masks that are not there are refused before photos are read.
    check_mask_model(job, folder, Progress("cameras", sink, is_cancelled))
    runner = PartRunner(
        folder, job, lambda: walk.graph, threads=threads, device=device, begun_s=begun_s
    )
    here: Engine = InProcess(folder.root, runner, overall.part)
    engine = FarmEngine(folder.root, job.settings) if job.settings.computers else here
    try:
        report = overall.report if engine is here else overall.side_by_side(folder.root)
        walk = Walk(folder, job, engine, here, report, is_cancelled)
        overall.begin(sum(part.share for part in walk.graph.parts))
        walk.run()
    finally:
        engine.close(cancelled=is_cancelled())
    sink(ProgressEvent("bake" if job.command == "bake" else "export", 1.0, "finished"))
