# SPDX-License-Identifier: GPL-3.0-or-later
"""Play the job timer, which never fires in background Blender, against the fake worker."""

from __future__ import annotations

import os
import stat
import sys
import time
from collections.abc import Callable
from pathlib import Path

import bpy

from gaussian_wrapping_addon.core.jobs.store.job_folder import JobStatus
from gaussian_wrapping_addon.ops import addon, background, job_timer

WAIT_S = float(os.environ.get("GW_WAIT_S", "40"))
"""Longest wait for a state; more where the real worker is at work."""


def write_fake_python(folder: Path) -> Path:
    """Write a program that is the fake worker in the place of the worker's Python."""
    script = folder / "fake-python"
    fake = Path(__file__).with_name("fake_worker.py")
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{fake}" "$@"\n')
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    return script


def start_wrap(photos: Path, scene: bpy.types.Scene | None = None) -> Path:
    """Press Wrap Scene; return the job folder."""
    scene = scene or bpy.context.scene
    scene.gwrap.source = str(photos)
    assert bpy.ops.gwrap.wrap_scene() == {"FINISHED"}
    return Path(scene.gwrap.job_folder)


def running_job(photos: Path, worker: Callable[..., None], mode: str = "slow") -> Path:
    """Press Wrap Scene, and tick until the worker has reported; return the job folder."""
    worker(mode)
    folder = start_wrap(photos)
    play_until(lambda: status_of(folder).fraction == 0.25, "never at work")
    return folder


def select(*things: bpy.types.Object) -> None:
    """Select these objects alone; the first is the active one."""
    bpy.context.view_layer.update()
    for thing in bpy.context.view_layer.objects:
        thing.select_set(thing in things)
    bpy.context.view_layer.objects.active = things[0] if things else None


def status_of(folder: Path) -> JobStatus:
    """Return what the panel would show of a job."""
    found = job_timer.status_of(str(folder))
    assert found is not None, f"no job is watched in {folder}"
    return found


def play_until(
    holds: Callable[[], bool], what: str, clock: Callable[[], float] = time.monotonic
) -> None:
    """Tick until something holds."""
    end_s = time.monotonic() + WAIT_S
    while time.monotonic() < end_s:
        job_timer.poll_jobs(clock)
        if holds():
            return
        time.sleep(0.02)
    raise AssertionError(f"{what}: {[(f, j.status) for f, j in job_timer.jobs.items()]}")


def play_background(holds: Callable[[], bool] | None = None, wait_s: float = WAIT_S) -> None:
    """Play the timer of background work until something holds, or until it goes out."""
    end_s = time.monotonic() + wait_s
    while True:
        left = background.poll()
        if left is None if holds is None else holds():
            return
        assert time.monotonic() < end_s
        time.sleep(0.01)


def play_to(folder: Path, *states: str) -> JobStatus:
    """Tick until a job is in one of these states."""
    play_until(lambda: status_of(folder).state in states, f"never {states}")
    return status_of(folder)


def play_to_stage(folder: Path, stage: str) -> None:
    """Tick until a job says that it is in a stage."""
    play_until(lambda: status_of(folder).stage == stage, f"never in {stage}")


def meshes() -> int:
    """Count the meshes that were imported into the open scene."""
    return len(list(addon.objects_of_kind(bpy.context.scene, "mesh")))


def status() -> JobStatus:
    """Return what the panel would show of the open scene's job."""
    return status_of(Path(bpy.context.scene.gwrap.job_folder))


def wait_for(*states: str, clock: Callable[[], float] = time.monotonic) -> None:
    """Tick until the open scene's job is in one of these states."""
    play_until(lambda: status().state in states, f"never {states}", clock)
