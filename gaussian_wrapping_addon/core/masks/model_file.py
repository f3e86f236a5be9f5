# SPDX-License-Identifier: GPL-3.0-or-later
"""The file of a segmentation model, looked at before a job starts. Standard library only."""

from __future__ import annotations

from pathlib import Path

from ..errors import DatasetError, ResourceError
from ..limits import MAX_MODEL_BYTES


def check_model_file(path: Path) -> None:
    """Raise where a model's file is missing, no regular file, empty or too large; reads nothing.

    Raises
    ------
    DatasetError, ResourceError
    """
    try:
        size = path.stat().st_size if path.is_file() else None
    except OSError:
        size = None
    if not size:
        state = "is empty" if size == 0 else "is not there, or no file"
        raise DatasetError(f"The mask model {path} {state}.", "Check the path.")
    if size > MAX_MODEL_BYTES:
        raise ResourceError(
            f"The mask model {path.name} has {size / 2**30:.1f} GiB; "
            f"{MAX_MODEL_BYTES / 2**30:.0f} GiB are the limit.",
            "Choose a smaller model.",
        )
