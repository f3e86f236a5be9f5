# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on in a real Blender with a window: installed from the zip, used through its panel.

``BLENDER`` names the program (``/opt/gw-blender/blender-real`` brings its own display), or
``blender`` is found on the path. ``GW_GUI_KEEP=DIR`` keeps the screenshots.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = [pytest.mark.gui, pytest.mark.slow]

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
SCREENSHOTS = ("1-start", "2-running", "3-cancelled", "4-failed", "5-result", "6-camera")


@pytest.fixture
def blender() -> str:
    found = os.environ.get("BLENDER") or shutil.which("blender")
    if not found:
        pytest.skip("no real Blender: set BLENDER=/path/to/blender or put blender on the path")
    if not Path(found).exists():
        pytest.fail(f"BLENDER={found} does not exist")
    return found


def with_window(blender: str) -> list[str]:
    """Return the command that opens a window, or skip where there is no display."""
    if Path(blender).name == "blender-real":
        return [blender, "--gui"]
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform != "linux":
        return [blender]
    if shutil.which("xvfb-run"):
        return ["xvfb-run", "-a", "-s", "-screen 0 1400x900x24", blender]
    pytest.skip("no display and no xvfb-run")
    return []


def colours_of(path: Path) -> int:
    """Count the different colours of a screenshot."""
    image = pytest.importorskip("PIL.Image").open(path).convert("RGB")
    return len(np.unique(np.asarray(image).reshape(-1, 3), axis=0))


def test_the_panel_in_a_real_blender(blender: str, tmp_path: Path) -> None:
    built = subprocess.run(
        [sys.executable, "build_addon.py", "--output", str(tmp_path)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    (archive,) = tmp_path.glob("*.zip")
    (tmp_path / "photos").mkdir()
    worker = tmp_path / "fake-python"
    fake = REPOSITORY / "tests" / "blender" / "fake_worker.py"
    worker.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{fake}" "$@"\n')
    worker.chmod(0o755)
    environment = {
        **os.environ,
        "BLENDER_USER_RESOURCES": str(tmp_path / "profile"),
        "GAUSSIAN_WRAPPING_PYTHON": str(worker),
        "GW_GUI_FOLDER": str(tmp_path),
        "GW_BIND": sys.prefix,
    }
    installed = subprocess.run(
        [blender, "--command", "extension", "install-file", "-r", "user_default", "-e",
         str(archive)],
        env=environment, capture_output=True, text=True, timeout=100, check=False, cwd=REPOSITORY,
    )  # fmt: skip
    folder = tmp_path / "profile" / "extensions" / "user_default" / "gaussian_wrapping_addon"
    assert folder.is_dir(), installed.stdout + installed.stderr
    done = subprocess.run(
        [*with_window(blender), "--factory-startup",
         "--addons", "bl_ext.user_default.gaussian_wrapping_addon",
         "--python-exit-code", "3", "-P", str(HERE / "drive_blender.py")],
        env=environment, capture_output=True, text=True, timeout=240, check=False, cwd=REPOSITORY,
    )  # fmt: skip
    words = done.stdout[-3000:] + done.stderr[-3000:]
    keep = os.environ.get("GW_GUI_KEEP")
    if keep:
        Path(keep).mkdir(parents=True, exist_ok=True)
        for path in tmp_path.glob("*.png"):
            shutil.copy(path, keep)
    assert (tmp_path / "outcome.json").is_file(), words
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert outcome["error"] == "", outcome["error"] + words
    assert len(outcome["checks"]) >= 12
    assert "Traceback" not in done.stdout + done.stderr, words
    for name in SCREENSHOTS:
        assert colours_of(tmp_path / f"{name}.png") > 100, f"{name} is (nearly) empty"
