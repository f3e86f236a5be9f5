# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on in a real Blender with a window: installed from the zip, used through its panel."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.blender import synthetic_result
from tests.blender.ball_job import write_ball_job
from tests.gui.conftest import REPOSITORY, Visit, colours_of

pytestmark = [pytest.mark.gui, pytest.mark.proof]

SCREENSHOTS = ("1-start", "2-running", "3-cancelled", "4-failed", "5-result", "6-camera")


def fake_worker(folder: Path) -> str:
    """Write a program that stands for the worker's Python, and an empty folder of photos."""
    (folder / "photos").mkdir()
    worker = folder / "fake-python"
    fake = REPOSITORY / "tests" / "blender" / "fake_worker.py"
    worker.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{fake}" "$@"\n')
    worker.chmod(0o755)
    return str(worker)


def not_empty(visit: Visit, *names: str, colours: int = 100) -> None:
    for name in names:
        assert colours_of(visit.folder / f"{name}.png") > colours, f"{name} is (nearly) empty"


def test_every_button_with_a_fake_worker(visit: Visit) -> None:
    worker = fake_worker(visit.folder)
    outcome = visit.run("drive_blender.py", deadline_s=240, GAUSSIAN_WRAPPING_PYTHON=worker)
    assert len(outcome["checks"]) >= 12
    not_empty(visit, *SCREENSHOTS)


def test_the_panel_in_other_languages(visit: Visit) -> None:
    worker = fake_worker(visit.folder)
    visit.run("drive_languages.py", deadline_s=240, GAUSSIAN_WRAPPING_PYTHON=worker)
    not_empty(visit, "1-de_DE", "2-de_DE", "1-ja_JP", "2-ja_JP")


def test_regions_are_drawn_and_dragged(visit: Visit) -> None:
    synthetic_result.write_result(visit.folder)
    visit.run("drive_regions.py", "--enable-event-simulate", deadline_s=240)
    not_empty(visit, "8-regions", "9-dragged")


@pytest.mark.timeout(900)
def test_photos_are_baked_onto_meshes_of_the_scene(visit: Visit) -> None:
    """A monkey without UVs, and a ball made lighter and made of quads, with the real worker."""
    write_ball_job(visit.folder).root.rename(visit.folder / "ball")
    visit.run("drive_bake.py", deadline_s=800, GW_GUI_WORKER=sys.executable)
    not_empty(visit, "1-bake", "2-baking", "3-baked", "4-lighter", "5-quads")


@pytest.mark.timeout(2000)
def test_photos_to_a_textured_region_with_the_real_worker(visit: Visit) -> None:
    """The whole session of a person: example photos, draft, a region box, a finer mesh of it."""
    shutil.copytree(REPOSITORY / "examples" / "bananas", visit.folder / "photos")
    outcome = visit.run("drive_session.py", deadline_s=1900, GW_GUI_WORKER=sys.executable)
    stalls = outcome["stalls"]
    assert stalls["looks"] > 20
    assert stalls["longest_look_s"] < 0.05, stalls
    assert max(stalls["imports_s"]) < 1.0, stalls
    not_empty(
        visit, "1-checked", "2-training", "3-wrapped", "4-region", "5-region-meshed", colours=1000
    )
    assert (visit.folder / "session.blend").is_file()


def test_registers_twice_and_leaves_cleanly(blender: str, extension: Path, tmp_path: Path) -> None:
    script = REPOSITORY / "tests" / "blender" / "register_twice.py"
    done = subprocess.run(
        [blender, "--background", "--factory-startup", "--python-exit-code", "3",
         "-P", str(script)],
        env={**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path), "GW_ZIP": str(extension)},
        capture_output=True, text=True, timeout=120, check=False, cwd=REPOSITORY,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "REGISTERED" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr
