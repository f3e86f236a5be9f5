# SPDX-License-Identifier: GPL-3.0-or-later
"""Keys of trainings: the hashes that name their folders."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

from ...errors import DatasetError
from ...settings import key_values
from .job_file import JobFile
from .stage_folder import stage_key


def start_fingerprint(path: str) -> list[Any]:
    """Return path, size and time of the start splat for the stage key; empty for none.

    Raises
    ------
    DatasetError
        The file does not exist, or is a pipe or a device.
    """
    if not path:
        return []
    hint = "Put the file back, or start the job without it."
    try:
        state = Path(path).stat()
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"The start splat {path} cannot be read: {getattr(error, 'strerror', error)}.", hint
        ) from None
    if not stat.S_ISREG(state.st_mode):
        raise DatasetError(f"The start splat {path} is not a regular file.", hint)
    return [path, state.st_size, state.st_mtime_ns]


def training_keys(version: int, cameras_key: str, job: JobFile) -> tuple[str, str]:
    """Return the stage's key, and the key without the extra iterations."""
    described = key_values(job.settings.training)
    start = start_fingerprint(job.settings.start_splat)
    parts = (version, cameras_key, job.settings.seed, *([start] if start else []))
    key = stage_key(*parts, described)
    described.pop("extra_iterations")
    return key, stage_key(*parts, described)


def blocks_key(version: int, cameras_key: str, job: JobFile) -> str:
    """Return the key of the blocks of a training: without what follows when they are joined."""
    described = key_values(job.settings.training)
    described.pop("extra_iterations")
    described.pop("polish", None)  # a key has no setting of its default
    return stage_key("blocks", version, cameras_key, job.settings.seed, described)
