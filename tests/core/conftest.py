# SPDX-License-Identifier: GPL-3.0-or-later
"""The emulator of the CUDA text is compiled once for all tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def emulator_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the CUDA text compiled for the host."""
    from tests.core.render.cuda.emulation import build_emulator  # torch, which not every test needs

    return build_emulator(tmp_path_factory.mktemp("emulator"))
