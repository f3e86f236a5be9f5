# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders of a scene: its photos, the output of its next job, the job of a result."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...core.dataset.video.video_file import is_video_path
from ...core.errors import UsageError, WrapError
from ...core.files import real_path
from ...core.jobs.store.job_file import read_job
from ...core.jobs.store.job_folder import JobFolder
from ..common import tags
from ..common.addon import properties_of


def source_of(scene: bpy.types.Scene) -> Path:
    """Return the photo folder of a scene.

    Raises
    ------
    UsageError
        None is chosen.
    """
    if not properties_of(scene).source:
        raise UsageError("No photo folder is chosen.", "Choose one in Dataset.")
    return real_path(bpy.path.abspath(properties_of(scene).source))


def output_of(scene: bpy.types.Scene, source: Path) -> Path:
    """Return the job folder for a source: the one chosen, or a sibling of the source.

    Raises
    ------
    UsageError
        It lies inside the photo folder, which is never written to.
    """
    text = "" if _is_of_other_photos(scene, source) else properties_of(scene).output
    if source.suffix.lower() == ".ply" or (is_video_path(source) and not source.is_dir()):
        base = source.with_suffix("")  # other files in its folder are not its input
    else:
        base = source.parent if source.is_file() else source
    if not text and not base.name:  # a memory card, or the root of a disk
        raise UsageError(
            f"{base} is a whole disk, which has no folder beside it.",
            "Copy the photos into a folder of their own.",
        )
    folder = real_path(bpy.path.abspath(text)) if text else base.with_name(f"{base.name}_wrap")
    if folder.is_relative_to(base):
        raise UsageError(
            f"{folder} lies inside the photo folder.", "Choose an output folder outside of it."
        )
    return folder


def _is_of_other_photos(scene: bpy.types.Scene, source: Path) -> bool:
    """Return whether the output is that of this scene's last job with another source.

    Changing the path of the photos must not overwrite a finished job of other photos.
    """
    properties = properties_of(scene)
    if not properties.output or properties.output != properties.job_folder:
        return False
    job = JobFolder(Path(bpy.path.abspath(properties.job_folder)))
    if not job.is_job():
        return False
    try:
        return real_path(read_job(job.job_path).source) != source
    except WrapError:
        return False


def job_folder_of(frame: bpy.types.Object) -> Path:
    """Return the job folder of a result's frame.

    Raises
    ------
    UsageError
        It has been moved or deleted.
    """
    folder = real_path(tags.result_folder(frame)).parent
    if not JobFolder(folder).is_job():
        raise UsageError(
            f"{folder} holds no job.", "Import the result again from where its folder is now."
        )
    return folder
