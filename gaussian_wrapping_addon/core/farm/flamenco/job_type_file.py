# SPDX-License-Identifier: GPL-3.0-or-later
"""Copy the job type's script to where a Manager finds it."""

from __future__ import annotations

from pathlib import Path

from ...errors import UsageError, unwritable_error
from ...files import write_bytes

SCRIPT = Path(__file__).with_name("gaussian-wrapping.js")


def write_job_type(folder: Path) -> Path:
    """Write the script into a folder and return its path; an older one is replaced.

    Raises
    ------
    UsageError
        There is no such folder.
    ResourceError
        It cannot be written.
    """
    if not folder.is_dir():
        raise UsageError(
            f"{folder} is no folder.", "Make the folder scripts beside flamenco-manager."
        )
    target = folder / SCRIPT.name
    try:
        write_bytes(target, SCRIPT.read_bytes())
    except OSError as error:
        raise unwritable_error(target, error) from None
    return target
