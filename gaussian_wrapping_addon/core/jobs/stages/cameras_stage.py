# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras stage: load the input as a scene, or re-use the cameras of a finished training."""

from __future__ import annotations

import contextlib
import hashlib
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import ParseError, UsageError
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
from ..store.training_keys import training_keys
from ..video.frames_stage import frames_request, run_frames, with_frame_facts

if TYPE_CHECKING:
    from ...dataset.loading.real_world import UnitsRequest
FRAMES_SHARE = 0.4
"""Rough share of the stage's time, where the photos are frames of a video."""

_logger = logging.getLogger(__name__)

MASKED = "masked"
"""Name of the stage that takes the place of ``cameras`` where masks are made."""


def run_cameras(folder: JobFolder, job: JobFile, progress: Progress, *, threads: int) -> Stage:
    """Load the scene, or re-use a finished cameras stage.

    ``mesh``, ``bake`` and ``more`` use the cameras of the finished training even if the photos
    have changed since, or an earlier version has loaded them.

    Raises
    ------
    DatasetError, ParseError
        The input cannot be used.
    UsageError
        A splat is to get metres by photos, or a video by GPS, which they have none of.
    """
    from ...array_file import is_whole
    from ...dataset.loading.load import load_scene
    from ...dataset.loading.real_world import UnitsRequest
    from ...dataset.photos.mask_reading import AS_WRITTEN, MaskReading
    from ...dataset.scene_file import MOST_POINTS_BYTES, POINTS_NAME, SCENE_NAME, save_scene
    from .splat_scene import is_splat, make_splat_scene

    source = Path(job.source)
    turntable = job.settings.turntable
    equirectangular = job.settings.equirectangular
    reading = MaskReading(job.settings.mask_invert == "on", job.settings.mask_grow_px)
    settings = job.settings
    units = UnitsRequest(settings.georeference, settings.markers, settings.control_points)
    wanted = frames_request(job)
    photos = source_fingerprint(source) if wanted is None else wanted.key
    key = stage_key(
        STAGE_VERSIONS["cameras"], job.source, photos, job.settings.seed,
        *([] if turntable == "auto" else [turntable]),
        *([] if equirectangular == "auto" else ["equirectangular", equirectangular]),
        *([] if reading == AS_WRITTEN else [reading.invert, reading.grow_px]),
        *_units_key(units),
    )  # fmt: skip
    if (
        job.command in ("mesh", "more", "bake")
        and read_done(folder.stages / f"cameras-{key}") is None
    ):
        earlier = scene_of_finished_training(folder, job)
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
            if units.markers or units.control_points or units.georeference == "on":
                raise UsageError(
                    "A splat has no photos to tell its size by.",
                    "Leave out markers, control points and georeference.",
                )
            scene = make_splat_scene(source, stage_folder, progress, threads=threads)
        else:
            root, taken = source, None
            if wanted is not None:
                if units.georeference == "on" and not units.control_points:
                    raise UsageError(
                        "Frames of a video have no GPS position.",
                        "Leave georeference out; give markers, control points or a measured "
                        "length.",
                    )
                span = progress.span(0.0, FRAMES_SHARE)
                root, taken = run_frames(folder, job, wanted, span, threads=threads)
                progress = progress.span(FRAMES_SHARE, 1.0)
            scene = load_scene(
                root, stage_folder, progress,
                seed=job.settings.seed, threads=threads, turntable=turntable, reading=reading,
                equirectangular=equirectangular, units=units, in_order=taken is not None,
            )  # fmt: skip
            if taken is not None:
                scene = with_frame_facts(scene, taken)
        save_scene(scene, stage_folder)
        return {
            "views": len(scene.views),
            "points": len(scene.points),
            "warnings": [warning.to_json() for warning in scene.warnings],
            "facts": scene.facts,
        }

    def whole(stage_folder: Path) -> bool:
        if wanted is not None and read_done(wanted.folder(folder.stages)) is None:
            return False  # its photos may lie there
        try:
            read_json(stage_folder / SCENE_NAME)
        except (FileNotFoundError, ParseError):
            return False
        return is_whole(stage_folder / POINTS_NAME, MOST_POINTS_BYTES)

    return run_stage(folder.stages, "cameras", key, progress, work, whole=whole)


def _units_key(units: UnitsRequest) -> list[str]:
    """Return what the stage's key has of the request for metres; nothing of the default."""
    from ...dataset.loading.real_world import BY_GPS_IF_GOOD
    from ...dataset.units.control_file import MAX_FILE_BYTES

    if units == BY_GPS_IF_GOOD:
        return []
    content = ""
    if units.control_points:
        # A file that cannot be read is refused where it is needed, not for a finished stage.
        with contextlib.suppress(OSError), Path(units.control_points).open("rb") as stream:
            content = hashlib.sha256(stream.read(MAX_FILE_BYTES + 1)).hexdigest()
    return ["units", units.georeference, units.markers, content]


def scene_stage_name(job: JobFile) -> str:
    """Return the name of the stages whose scene a job trains on."""
    return MASKED if job.settings.masks_are_made else "cameras"


def scene_of_finished_training(folder: JobFolder, job: JobFile) -> Stage | None:
    """Return the newest finished scene with a finished training of this job.

    It is that of the cameras, or the masked one where the job makes masks. For ``more``, a shorter
    training that it can continue is one as well.
    """
    extra = job.settings.training.extra_iterations
    name = scene_stage_name(job)
    found: list[tuple[float, int, Stage]] = []
    for path in sorted(folder.stages.glob(f"{name}-*")):
        done, key = read_done(path), path.name.removeprefix(f"{name}-")
        train_key, base_key = training_keys(STAGE_VERSIONS["train"], key, job)
        trained = read_done(folder.stages / f"train-{train_key}")
        if trained is None and job.command == "more":
            shorter = shorter_training(folder.stages, base_key, extra)
            trained = None if shorter is None else read_done(shorter)
        if done is not None and trained is not None:
            stage = Stage(name, key, path, done, True)
            found.append((trained["finished_unix_s"], len(found), stage))
    return max(found)[2] if found else None
