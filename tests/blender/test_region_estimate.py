# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimates of regions by the real worker: the answer, when it is stale, and ending early."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import pytest

from gaussian_wrapping_addon.core.regions.box import CUBE_CORNERS
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.worker.helper_process import child_command
from gaussian_wrapping_addon.ops import addon, background, meshing
from gaussian_wrapping_addon.ops.region_objects import create_region
from tests.blender.job_play import play_background

pytestmark = pytest.mark.usefixtures("addon")

WAIT_S = 120.0


@pytest.fixture(autouse=True)
def _no_questions() -> Iterator[None]:
    yield
    meshing.stop()


def region_of(folder: Path) -> bpy.types.Object:
    """Make a frame as an import does, and a box of half side 1.4 in it."""
    collection = bpy.context.scene.collection
    frame = bpy.data.objects.new("frame", None)
    collection.objects.link(frame)
    frame[addon.KIND], frame[addon.RESULT] = "frame", str(folder / "result")
    frame[addon.WORLD_FROM_SCENE] = json.dumps(Similarity().to_json())
    region = create_region("box", 1.4 * CUBE_CORNERS, frame, collection)
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = region
    region.select_set(True)
    return region


@pytest.mark.proof
def test_the_workers_answer_is_shown_until_something_changes(tmp_path: Path) -> None:
    if importlib.util.find_spec("torch") is None:
        pytest.skip("the worker of this test is this Python, which has no torch")
    # In a process of its own: this one must not load torch.
    code = (
        "import sys; from pathlib import Path; sys.path.insert(0, sys.argv[1]);"
        "from tests.core.jobs.finished_sphere import write_finished_sphere as write;"
        "write(Path(sys.argv[2]))"
    )
    root = Path(__file__).resolve().parents[2]
    subprocess.run([sys.executable, "-c", code, str(root), str(tmp_path / "job")], check=True)
    region = region_of(tmp_path / "job" / "out")
    scene = bpy.context.scene
    assert bpy.ops.gwrap.estimate_regions() == {"FINISHED"}
    assert meshing.is_waiting(region)
    assert not bpy.ops.gwrap.estimate_regions.poll()
    play_background(lambda: not meshing.is_busy(), WAIT_S)
    estimate, holds = meshing.estimate_for(scene, region)
    assert estimate is not None
    assert holds
    assert not estimate.warnings, estimate.warnings
    assert estimate.lines[0].startswith("Triangles: ")
    assert any(line.startswith("Time: ") for line in estimate.lines)

    def still() -> bool:
        bpy.context.view_layer.update()
        return meshing.estimate_for(scene, region)[1]

    region.location.x += 0.5
    assert not still()
    region.location.x -= 0.5
    assert still(), "back where it was"
    region.parent.location.x += 3.0
    assert still(), "the scene as a whole has moved"
    scene.gwrap.resolution, scene.gwrap.points = "POINTS", 4321
    assert not still()
    scene.gwrap.resolution = "AUTOMATIC"
    assert still()
    method = scene.gwrap.method
    scene.gwrap.method = "PIVOTS"
    assert not still()
    scene.gwrap.method = method
    assert still()
    region.gwrap.own_edge_length, region.gwrap.edge_length = True, 0.6  # of a diagonal of 4.85
    assert bpy.ops.gwrap.estimate_regions() == {"FINISHED"}
    play_background(lambda: not meshing.is_busy(), WAIT_S)
    estimate, _ = meshing.estimate_for(scene, region)
    assert estimate is not None
    assert not estimate.warnings
    region.gwrap.edge_length = 1.0
    assert bpy.ops.gwrap.estimate_regions() == {"FINISHED"}
    play_background(lambda: not meshing.is_busy(), WAIT_S)
    estimate, _ = meshing.estimate_for(scene, region)
    assert estimate is not None
    assert "reduced" in " ".join(estimate.warnings)


def test_disabling_the_addon_ends_the_process(
    tmp_path: Path, addon: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    region = region_of(folder)
    slow = [sys.executable, "-c", "import time; time.sleep(100)"]
    monkeypatch.setattr(meshing, "child_command", lambda *_, **__: slow)
    child = background.Child()
    monkeypatch.setattr(meshing, "Child", lambda: child)
    meshing.start(bpy.context.scene, [region], folder, sys.executable)
    play_background(lambda: child.process is not None, WAIT_S)
    process = child.process
    assert process is not None
    os.kill(process.pid, 0)
    addon.unregister()
    assert process.wait(10) != 0
    assert not meshing.is_busy()
    assert not bpy.app.timers.is_registered(background.poll)
    addon.register()
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)


def test_a_worker_that_says_nothing_is_an_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    region = region_of(tmp_path)
    for command, words in (
        ([sys.executable, "-c", "raise SystemExit('no torch here')"], "no torch here"),
        (child_command(meshing.MODULE, "{", python=sys.executable), ""),
        ([str(tmp_path / "nowhere")], "does not run"),
    ):
        monkeypatch.setattr(meshing, "child_command", lambda *_, c=command, **__: c)
        meshing.start(bpy.context.scene, [region], tmp_path, sys.executable)
        play_background(lambda: not meshing.is_busy(), WAIT_S)
        estimate, _ = meshing.estimate_for(bpy.context.scene, region)
        assert estimate is not None
        assert estimate.warnings
        assert words in " ".join(estimate.warnings)
    assert background.Child().run([sys.executable, "-c", "print(1)"], 20)[0] == []
