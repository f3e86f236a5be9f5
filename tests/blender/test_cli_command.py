# SPDX-License-Identifier: GPL-3.0-or-later
"""``blender --command gwrap``, and jobs that pass between the button and the command line."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import pytest

import gaussian_wrapping_addon
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.settings import preset
from gaussian_wrapping_addon.ops import cli_command, job_timer
from gaussian_wrapping_addon.ui import training_panel
from tests.blender.fake_layout import draw
from tests.blender.job_play import (
    meshes,
    play_to,
    running_job,
    status_of,
)

BATCH = Path(gaussian_wrapping_addon.__file__).with_name("batch.py")


def batch(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(BATCH), *arguments],
        env=dict(os.environ), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


def test_the_command_is_known_while_the_addon_is(monkeypatch: pytest.MonkeyPatch) -> None:
    known: list[str] = []
    real = bpy.utils.register_cli_command

    def note(name: str, run: object) -> object:
        known.append(name)
        return real(name, run)

    monkeypatch.setattr(bpy.utils, "register_cli_command", note)
    for _ in range(2):
        gaussian_wrapping_addon.register()
        assert cli_command._handle is not None
        gaussian_wrapping_addon.unregister()
        assert cli_command._handle is None
    assert known == ["gwrap", "gwrap"]


def test_the_command_has_the_exit_codes_of_batch(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    known: list[Any] = []
    monkeypatch.setattr(bpy.utils, "register_cli_command", lambda _, run: known.append(run))
    gaussian_wrapping_addon.register()
    gaussian_wrapping_addon.unregister()
    (run,) = known
    assert run(["no-such-command"]) == 2
    assert "Usage: blender --command gwrap" in capsys.readouterr().out
    assert run(["resume", str(tmp_path / "missing")]) in (1, 2)
    assert run(["check", str(tmp_path)]) == 3


@pytest.mark.usefixtures("ended_workers")
def test_a_job_of_the_button_goes_on_in_batch(photos: Path, worker: Callable[..., None]) -> None:
    folder = running_job(photos, worker)
    refused = batch("resume", str(folder))
    assert refused.returncode == 2
    assert "A job is running in" in refused.stdout
    bpy.ops.gwrap.cancel_job()
    play_to(folder, "CANCELLED")
    worker("quick")
    done = batch("resume", str(folder))
    assert done.returncode == 0, done.stdout + done.stderr
    assert (folder / "result" / "scene.blend").is_file()
    bpy.ops.gwrap.find_job(directory=str(folder))
    assert status_of(folder).state == "DONE"


@pytest.mark.usefixtures("ended_workers", "worker")
def test_a_job_of_batch_is_opened_by_the_button(photos: Path) -> None:
    folder = photos.with_name("job")
    target = JobFolder(folder)
    target.create()
    write_job(target.job_path, make_job("wrap", photos, preset("draft")))
    done = batch("resume", str(folder), "--no-blend")
    assert done.returncode == 0, done.stdout + done.stderr
    bpy.ops.gwrap.find_job(directory=str(folder))
    assert "Import Finished Result" in draw(training_panel.GWRAP_PT_train).texts
    bpy.ops.gwrap.import_result(directory=job_timer.result_to_import(bpy.context.scene))
    assert meshes() == 1
    bpy.ops.gwrap.resume_job()  # and goes on from the button
    play_to(folder, "DONE")
    assert meshes() == 1
