# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras stage: load the input as a scene, or re-use the cameras of a finished training."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from ...errors import ParseError
from ...files import read_json
from ...progress import Progress
from ..store.continue_training import shorter_training
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import (
    STAGE_VERSIONS,
    Stage,
    read_done,
    run_stage,
    source_fingerprint,
    stage_key,
)
from .training_stage import training_keys

_logger = logging.getLogger(__name__)


def run_cameras(folder: JobFolder, job: JobFile, progress: Progress, *, threads: int) -> Stage:
    """Load the scene, or re-use a finished cameras stage.

    ``mesh``, ``bake`` and ``more`` use the cameras of the finished training even if the photos
    have changed since, or an earlier version has loaded them.

    Raises
    ------
    DatasetError, ParseError
        The input cannot be used.
    """
    from ...array_file import is_whole
    from ...dataset.loading.load import load_scene
    from ...dataset.photos.mask_reading import AS_WRITTEN, MaskReading
    from ...dataset.scene_file import MOST_POINTS_BYTES, POINTS_NAME, SCENE_NAME, save_scene
    from .splat_scene import is_splat, make_splat_scene

    source = Path(job.source)
    turntable = job.settings.turntable
    reading = MaskReading(job.settings.mask_invert == "on", job.settings.mask_grow_px)
    key = stage_key(
        STAGE_VERSIONS["cameras"], job.source, source_fingerprint(source), job.settings.seed,
        *([] if turntable == "auto" else [turntable]),
        *([] if reading == AS_WRITTEN else [reading.invert, reading.grow_px]),
    )  # fmt: skip
    if (
        job.command in ("mesh", "more", "bake")
        and read_done(folder.stages / f"cameras-{key}") is None
    ):
        earlier = _cameras_of_finished_training(folder, job)
        if earlier is not None:
            _logger.warning(
                "%s has changed since the training, its files have new dates, or it was loaded by "
                "an earlier version or with other masks: the mesh is of the training as it is. To "
                "train anew, run wrap.",
                source,
            )  # fmt: skip
            return earlier

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        if is_splat(source):
            scene = make_splat_scene(source, stage_folder, progress, threads=threads)
        else:
            scene = load_scene(
                source, stage_folder, progress,
                seed=job.settings.seed, threads=threads, turntable=turntable, reading=reading,
            )  # fmt: skip
        save_scene(scene, stage_folder)
        return {
            "views": len(scene.views),
            "points": len(scene.points),
            "warnings": [warning.to_json() for warning in scene.warnings],
            "facts": scene.facts,
        }

    def whole(stage_folder: Path) -> bool:
        try:
            read_json(stage_folder / SCENE_NAME)
        except (FileNotFoundError, ParseError):
            return False
        return is_whole(stage_folder / POINTS_NAME, MOST_POINTS_BYTES)

    return run_stage(folder.stages, "cameras", key, progress, work, whole=whole)


def _cameras_of_finished_training(folder: JobFolder, job: JobFile) -> Stage | None:
    """Return the newest finished cameras stage with a finished training of this job.

    For ``more``, a shorter training that it can continue is one as well.
    """
    extra = job.settings.training.extra_iterations
    found: list[tuple[float, int, Stage]] = []
    for path in sorted(folder.stages.glob("cameras-*")):
        done, key = read_done(path), path.name.removeprefix("cameras-")
        train_key, base_key = training_keys(STAGE_VERSIONS["train"], key, job)
        trained = read_done(folder.stages / f"train-{train_key}")
        if trained is None and job.command == "more":
            shorter = shorter_training(folder.stages, base_key, extra)
            trained = None if shorter is None else read_done(shorter)
        if done is not None and trained is not None:
            stage = Stage("cameras", key, path, done, True)
            found.append((trained["finished_unix_s"], len(found), stage))
    return max(found)[2] if found else None
