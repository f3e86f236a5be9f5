# SPDX-License-Identifier: GPL-3.0-or-later
"""Real photos with COLMAP models, which are not in the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

FOLDER = Path(
    os.environ.get("GW_DATA_SETS", Path(__file__).resolve().parents[4] / "shared" / "data")
)


def real_set(name: str) -> Path:
    """Return the folder of a data set, or skip the test."""
    folder = FOLDER / name
    if not folder.is_dir():
        pytest.skip(f"needs the photos of {name}: there is no {folder} (set GW_DATA_SETS)")
    return folder
