# SPDX-License-Identifier: GPL-3.0-or-later
"""The zip in the oldest and in the present bpy wheel: installed, registered twice, removed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.proofs import first_then_proofs

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
CACHE = REPOSITORY / ".cache"


def _oldest() -> str:
    python = CACHE / "bpy-4.2" / "bin" / "python"
    if python.exists():
        return str(python)
    reason = CACHE / "bpy-4.2.why-not"
    why = reason.read_text() if reason.is_file() else "run tools/test_blenders.sh"
    pytest.skip(f"no bpy 4.2: {why}")


@pytest.mark.parametrize("version", first_then_proofs(["present", "4.2"]))
def test_the_zip_registers_twice_and_leaves_cleanly(version: str, tmp_path: Path) -> None:
    python = _oldest() if version == "4.2" else sys.executable
    built = subprocess.run(
        [sys.executable, "build_addon.py", "--output", str(tmp_path)],
        cwd=REPOSITORY, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    (archive,) = tmp_path.glob("*.zip")
    done = subprocess.run(
        [python, str(HERE / "register_twice.py")],
        env={**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "profile"),
             "GW_ZIP": str(archive)},
        capture_output=True, text=True, timeout=90, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    registered = f"REGISTERED {version}" if version == "4.2" else "REGISTERED"
    assert registered in done.stdout, done.stdout
    assert "Traceback" not in done.stderr, done.stderr
