# SPDX-License-Identifier: GPL-3.0-or-later
"""Take photos out of a video, in a helper process: FFmpeg may crash or hang on damaged files."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import DatasetError
from ...files import read_json, write_json
from ...kernels.parallel import default_threads
from ...limits import MIN_IMAGES
from ...machine import helper_memory_limit_bytes
from ...processes.helper_process import run_helper
from ...progress import Progress
from ...report_warning import ReportWarning
from .extract_helper import CHOSEN_NAME, FRAMES_FOLDER
from .video_warnings import hdr_warning, interlaced_warning

_HELPER = "dataset.video.extract_helper"
_DEADLINE_S = 4 * 3600.0
"""For an hour of 4K on a slow machine."""
_LISTED_GAPS = 3
_MOST_DAMAGED_SHARE = 0.02
"""Share of frames that may be missing without a warning: players skip them, too."""


@dataclass(frozen=True)
class VideoFrames:
    """Photos taken out of a video."""

    folder: Path
    names: tuple[str, ...]
    """In order of time, which is the order of the names."""
    facts: dict[str, Any]
    """For the report."""
    warnings: tuple[ReportWarning, ...]


def extract_frames(
    video: Path,
    work_folder: Path,
    progress: Progress,
    *,
    frames: int = 0,
    fps: float = 0.0,
    threads: int = 0,
) -> VideoFrames:
    """Choose sharp frames of a video and write them as JPEG into ``work_folder/frames``.

    Parameters
    ----------
    video : Path
        Nothing is written beside it.
    work_folder : Path
        What an interrupted run has left there is removed.
    frames, fps : int, float
        As of :func:`~.choose_frames.choose_frames`; 0 chooses by the motion.
    threads : int
        Of the decoder; 0 uses every core.

    Raises
    ------
    DatasetError, ParseError
        It is no video that can be read, or fewer than ``MIN_IMAGES`` frames can be used.
    Cancelled
    """
    target = work_folder / FRAMES_FOLDER
    task_folder = work_folder / "video"
    for earlier in (target, task_folder):
        if earlier.exists():
            shutil.rmtree(earlier)
    task_folder.mkdir(parents=True)
    task = {
        "video": str(video), "frames": frames, "fps": fps,
        "threads": threads or default_threads(),
    }  # fmt: skip
    write_json(task_folder / "task.json", task)
    run_helper(
        _HELPER, task_folder, progress, deadline_s=_DEADLINE_S,
        memory_bytes=helper_memory_limit_bytes(),
    )  # fmt: skip
    chosen = read_json(task_folder / CHOSEN_NAME)
    os.replace(task_folder / FRAMES_FOLDER, target)
    shutil.rmtree(task_folder)
    names = tuple(entry["name"] for entry in chosen["frames"])
    left_out = (
        f"{chosen['read']} frames were read: {chosen['blurred']} are blurred, {chosen['still']} "
        "show the same as the one before."
    )
    if len(names) < MIN_IMAGES:
        raise DatasetError(
            f"Only {len(names)} frames of {video.name} can be used; {MIN_IMAGES} are needed. "
            f"{left_out}",
            "Film again: walk around the object, slowly and in enough light.",
        )
    facts = {
        "kind": "video",
        "photos_in_order": "frames of a video",
        "video_frames_read": chosen["read"],
        "video_frames_blurred": chosen["blurred"],
        "video_frames_still": chosen["still"],
        "video_frames_damaged": chosen["damaged"],
        "video_frames_kept": len(names),
    }
    return VideoFrames(target, names, facts, tuple(_warnings(video, chosen)))


def _warnings(video: Path, chosen: dict[str, Any]) -> list[ReportWarning]:
    found = []
    if chosen["is_cut"] or chosen["damaged"] > _MOST_DAMAGED_SHARE * chosen["read"]:
        found.append(
            ReportWarning(
                "video-damaged",
                f"{chosen['damaged']} frames of {video.name} cannot be decoded and are not used; "
                f"{chosen['read']} can.",
                "Copy it from the camera again.",
            )
        )
    if chosen["gaps_s"]:
        gaps = [f"{begin:.1f} to {end:.1f} s" for begin, end in chosen["gaps_s"]]
        listed = ", ".join(gaps[:_LISTED_GAPS]) + (", ..." if len(gaps) > _LISTED_GAPS else "")
        found.append(
            ReportWarning(
                "video-blurred",
                f"All frames of {video.name} are blurred at {listed}; nothing is used of it.",
                "Where cameras or surface are missing, film that part again, more slowly.",
            )
        )
    if chosen["is_hdr"]:
        found.append(hdr_warning(video))
    if chosen["is_interlaced"]:
        found.append(interlaced_warning(video))
    return found
