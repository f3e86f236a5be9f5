# SPDX-License-Identifier: GPL-3.0-or-later
"""A real Blender for the tests of this folder: which one, with a window, the add-on installed.

``BLENDER`` names the program; without it ``.cache/blender/blender-real`` is taken (made by
``tools/real_blender.sh``), which brings its own display, or ``blender`` on the path. Where none can
be had, the tests skip with the reason that ``tools/test_blenders.sh`` has kept. ``GW_GUI_KEEP=DIR``
keeps screenshots and outcomes.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
ADDON = "gaussian_wrapping_addon"
OWN = REPOSITORY / ".cache" / "blender" / "blender-real"


@pytest.fixture(scope="session")
def blender() -> str:
    """The program of a real Blender."""
    named = os.environ.get("BLENDER")
    if named and not shutil.which(named):
        pytest.fail(f"BLENDER={named} does not exist")
    reason = REPOSITORY / ".cache" / "blender.why-not"
    found = named or (str(OWN) if OWN.exists() else shutil.which("blender"))
    if not found and reason.is_file():
        pytest.skip(f"no real Blender: {reason.read_text()}")
    if not found:
        pytest.skip("no real Blender: run tools/test_blenders.sh, or set BLENDER=/path/to/blender")
    return str(found)


@pytest.fixture(scope="session")
def extension(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The zip, built from this tree."""
    folder = tmp_path_factory.mktemp("zip")
    built = subprocess.run(
        [sys.executable, "build_addon.py", "--output", str(folder)],
        cwd=REPOSITORY, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    (archive,) = folder.glob("*.zip")
    return archive


@dataclass
class Visit:
    """One Blender with a clean profile that has the add-on."""

    blender: str
    folder: Path
    """Takes screenshots and ``outcome.json``; the profile lies in it."""
    environment: dict[str, str]

    def run(
        self, script: str, *options: str, deadline_s: float, **variables: str
    ) -> dict[str, Any]:
        """Open a window, run a script of this folder, return its outcome.

        ``options`` are for Blender, ``variables`` of the environment.

        Fails where the script or one of its checks failed, where a traceback was printed, or where
        Blender left a process behind.
        """
        command = [*with_window(self.blender), *options, "-P", str(HERE / script)]
        done = subprocess.run(
            command, env={**self.environment, **variables}, capture_output=True, text=True,
            timeout=deadline_s, check=False, cwd=REPOSITORY,
        )  # fmt: skip
        words = done.stdout[-3000:] + done.stderr[-3000:]
        keep(self.folder)
        assert (self.folder / "outcome.json").is_file(), words
        outcome = json.loads((self.folder / "outcome.json").read_text())
        assert outcome["error"] == "", outcome["error"] + words
        assert "Traceback" not in done.stdout + done.stderr, words
        assert left_behind(self.folder) == []
        return outcome


@pytest.fixture
def visit(blender: str, extension: Path, tmp_path: Path) -> Visit:
    """A Blender whose clean profile has got the zip."""
    environment = {
        **os.environ,
        "BLENDER_USER_RESOURCES": str(tmp_path / "profile"),
        "GW_GUI_FOLDER": str(tmp_path),
        "GW_BIND": f"{os.path.realpath(sys.prefix)}:{REPOSITORY}",
    }
    environment.pop("GAUSSIAN_WRAPPING_PYTHON", None)
    installed = subprocess.run(
        [blender, "--command", "extension", "install-file", "-r", "user_default", "-e",
         str(extension)],
        env=environment, capture_output=True, text=True, timeout=100, check=False, cwd=REPOSITORY,
    )  # fmt: skip
    folder = tmp_path / "profile" / "extensions" / "user_default" / ADDON
    assert folder.is_dir(), installed.stdout + installed.stderr
    return Visit(blender, tmp_path, environment)


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


def keep(folder: Path) -> None:
    """Copy screenshots and outcome where the person asked for them."""
    kept = os.environ.get("GW_GUI_KEEP")
    if kept:
        Path(kept).mkdir(parents=True, exist_ok=True)
        for path in [*folder.glob("*.png"), *folder.glob("outcome.json")]:
            shutil.copy(path, kept)


def left_behind(folder: Path) -> list[str]:
    """Return the command lines of processes that speak of this folder, on Linux."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it has just ended
            continue
        if str(folder) in command and int(entry.name) != os.getpid():
            found.append(command)
    return found


def colours_of(path: Path) -> int:
    """Count the different colours of a screenshot."""
    image = pytest.importorskip("PIL.Image").open(path).convert("RGB")
    return len(np.unique(np.asarray(image).reshape(-1, 3), axis=0))
