# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames stage: photos out of a video, kept in a stage folder of their own.

Another seed or other masks need new cameras, but the same frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import DatasetError
from ...progress import Progress
from ...report_warning import read_warnings
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import STAGE_VERSIONS, read_done, run_stage, stage_key

if TYPE_CHECKING:
    from ...dataset.scene import Scene


@dataclass(frozen=True)
class FramesRequest:
    """A video, and the key of the frames that a job takes from it."""

    video: Path
    key: str

    def folder(self, stages: Path) -> Path:
        """Return the folder of the stage."""
        return stages / f"frames-{self.key}"


def frames_request(job: JobFile) -> FramesRequest | None:
    """Return what a job takes from a video; ``None`` where its input is none."""
    from ...dataset.loading.source_kind import VIDEO, source_kind
    from ...dataset.video.video_file import is_video_path

    source = Path(job.source)
    if not is_video_path(source) or source.is_dir():
        try:
            kind = source_kind(source)
        except DatasetError:
            return None  # said again where the input is loaded
        if kind.kind != VIDEO or kind.video is None:
            return None
        source = kind.video
    try:
        state = source.stat()
        file = [state.st_size, state.st_mtime_ns]
    except OSError:
        file = []  # a finished training needs its frames only; loading says what is missing
    settings = job.settings
    key = stage_key(
        STAGE_VERSIONS["frames"], str(source), *file,
        settings.video_frames, 0.0 if settings.video_frames else settings.video_fps,
    )  # fmt: skip
    return FramesRequest(source, key)


def run_frames(
    folder: JobFolder, job: JobFile, request: FramesRequest, progress: Progress, *, threads: int
) -> tuple[Path, dict[str, Any]]:
    """Take the frames of a job's video; return their folder and the stage's ``done.json``.

    Raises
    ------
    DatasetError, ParseError
        The video cannot be used.
    """
    from ...dataset.video.extract import extract_frames
    from ...dataset.video.extract_helper import FRAMES_FOLDER

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        found = extract_frames(
            request.video, stage_folder, progress,
            frames=job.settings.video_frames, fps=job.settings.video_fps, threads=threads,
        )  # fmt: skip
        return {
            "names": list(found.names),
            "facts": found.facts,
            "warnings": [warning.to_json() for warning in found.warnings],
        }

    def whole(stage_folder: Path) -> bool:
        done = read_done(stage_folder) or {}
        names = done.get("names")
        return isinstance(names, list) and all(
            isinstance(name, str) and (stage_folder / FRAMES_FOLDER / name).is_file()
            for name in names
        )

    stage = run_stage(folder.stages, "frames", request.key, progress, work, whole=whole)
    return stage.folder / FRAMES_FOLDER, stage.done


def with_frame_facts(scene: Scene, done: dict[str, Any]) -> Scene:
    """Return a scene of frames with what is known of their video."""
    return replace(
        scene,
        warnings=(*read_warnings(done["warnings"]), *scene.warnings),
        facts={**scene.facts, **done["facts"]},
    )
