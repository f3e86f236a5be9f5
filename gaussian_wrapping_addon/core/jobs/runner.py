# SPDX-License-Identifier: GPL-3.0-or-later
"""Run the stages of a job in order: cameras, train, mesh, texture, export."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..devices import DeviceChoice, choose_device
from ..kernels.parallel import default_threads
from ..machine import describe_machine
from ..names import region_names
from ..processes.peak_memory import peak_memory_bytes
from ..progress import Progress, ProgressEvent
from ..settings import to_json
from .baking.bake_stage import require_training, run_bake
from .masking.masks_stage import check_mask_model, run_masks
from .stages.cameras_stage import run_cameras
from .stages.mesh_stage import run_mesh
from .stages.region_field import reject_short_edges
from .stages.texture_stage import run_texture
from .stages.training_stage import run_training
from .store.job_file import JobFile, reject_region_conflicts
from .store.job_folder import JobFolder
from .store.stage_folder import STAGE_VERSIONS, Stage

_logger = logging.getLogger(__name__)

# Shares of a job's time, for the overall bar: measured on the demo scene, 2 cores.
STAGE_SHARES = {"cameras": 0.12, "train": 0.60, "mesh": 0.14, "texture": 0.12, "export": 0.02}
MASKS_SHARE = 0.1
"""Of the time of a job that makes masks; taken from the training's."""
BAKE_BEGINS = 0.02
"""Share of the overall bar before the bake stage."""


@dataclass(frozen=True)
class _Span:
    """Part of the overall bar that belongs to one stage."""

    begin: float
    end: float


class _JobProgress:
    """Map the progress of each stage onto the whole job and estimate the time left."""

    def __init__(
        self, sink: Callable[[ProgressEvent], None], is_cancelled: Callable[[], bool]
    ) -> None:
        self._sink = sink
        self._is_cancelled = is_cancelled
        self._begun_s = time.monotonic()
        self._offset = 0.0

    def stage(self, name: str, span: _Span) -> Progress:
        def forward(event: ProgressEvent) -> None:
            overall = span.begin + (span.end - span.begin) * event.fraction
            elapsed_s = time.monotonic() - self._begun_s
            gained = overall - self._offset
            left_s = elapsed_s * (1.0 - overall) / gained if gained > 0.01 else None
            self._sink(
                ProgressEvent(name, overall, event.message, event.figures, left_s, event.phase)
            )

        return Progress(name, forward, self._is_cancelled)

    def skip_to(self, fraction: float) -> None:
        """Exclude re-used stages up to ``fraction`` from the estimate of the time left."""
        self._begun_s = time.monotonic()
        self._offset = fraction


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
    names = region_names(job.settings.regions, job.region_bodies)

    train_begin = STAGE_SHARES["cameras"]
    begin = STAGE_SHARES["cameras"] + STAGE_SHARES["train"]
    if job.command == "bake":  # both are finished
        train_begin, begin = BAKE_BEGINS / 2, BAKE_BEGINS
    progress = overall.stage("cameras", _Span(0.0, train_begin))
    check_mask_model(job, folder, progress)  # refused before photos are read
    cameras = run_cameras(folder, job, progress, threads=threads)
    if cameras.reused:
        overall.skip_to(train_begin)
    if job.settings.masks_are_made:
        masks_begin, train_begin = train_begin, train_begin + (begin - train_begin) * MASKS_SHARE
        progress = overall.stage("masks", _Span(masks_begin, train_begin))
        cameras = run_masks(folder, job, cameras, progress, threads=threads, device=device)
        if cameras.reused:
            overall.skip_to(train_begin)
    reject_short_edges(job, cameras.folder)
    if job.command == "bake":
        require_training(folder, job, cameras)
    progress = overall.stage("train", _Span(train_begin, begin))
    trained = run_training(
        folder, job, cameras, progress, version=STAGE_VERSIONS["train"], threads=threads,
        device=device,
    )  # fmt: skip
    if trained.reused:
        overall.skip_to(begin)

    if job.command == "bake":
        overall.skip_to(begin)
        progress = overall.stage("bake", _Span(begin, 1.0))
        run_bake(folder, job, cameras, trained, progress, threads=threads)
        return
    share = (1.0 - STAGE_SHARES["export"] - begin) / len(names)
    regions: list[tuple[str, Stage, Stage]] = []
    for index, (request, name) in enumerate(zip(job.settings.regions, names, strict=True)):
        start = begin + index * share
        cut = start + share * STAGE_SHARES["mesh"] / (
            STAGE_SHARES["mesh"] + STAGE_SHARES["texture"]
        )
        progress = overall.stage("mesh", _Span(start, cut))
        meshed = run_mesh(
            folder, job, request, name, cameras, trained, progress, threads=threads, device=device
        )
        progress = overall.stage("texture", _Span(cut, start + share))
        textured = run_texture(
            folder, job, name, cameras, trained, meshed, progress, threads=threads
        )
        regions.append((name, meshed, textured))

    progress = overall.stage("export", _Span(1.0 - STAGE_SHARES["export"], 1.0))
    from .stages.export_stage import export_results

    summary = {
        "command": job.command,
        "source": Path(job.source).name,
        "settings": to_json(job.settings),
        "machine": describe_machine(threads),
        "device": device.device,
        "device_reason": device.reason,
        "started_unix_s": round(begun_s, 1),
        "wall_seconds": round(time.time() - begun_s, 1),
        "peak_memory_bytes": peak_memory_bytes(),
    }
    export_results(folder, job, cameras, trained, regions, summary, progress)
    progress.update(1.0, "finished")


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
