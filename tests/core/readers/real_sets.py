# SPDX-License-Identifier: GPL-3.0-or-later
"""Real photos with COLMAP models, which are not in the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

SETS = "GW_DATA_SETS"
"""Variable that names the folder of the data sets."""


def real_set(name: str) -> Path:
    """Return the folder of a data set, or skip the test."""
    folder = Path(os.environ.get(SETS, "")) / name
    if SETS not in os.environ or not folder.is_dir():
        pytest.skip(f"needs the photos of {name}: {SETS} names no folder that holds them")
    return folder
