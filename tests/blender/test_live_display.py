# SPDX-License-Identifier: GPL-3.0-or-later
"""A running job outside of the panel: points in the 3D view, progress in the status bar."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.gaussians.preview_points import POINT, POINTS_FILE, points_file
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobStatus
from gaussian_wrapping_addon.ops import job_timer, jobs
from gaussian_wrapping_addon.ops.scene_objects import import_result
from gaussian_wrapping_addon.ui import job_view
from tests.blender.fake_layout import FakeLayout
from tests.blender.panel_states import Client
from tests.blender.synthetic_result import write_result

pytestmark = pytest.mark.usefixtures("addon")

RUNNING = JobStatus("RUNNING", "train", 0.3, "iteration 750/3000", 90.0)


def watch(folder: Path, status: JobStatus = RUNNING, scene: Any = None) -> Client:
    client = Client(status)
    scene = scene or bpy.context.scene
    job_timer.watch(scene, folder, client, imports=False)  # type: ignore[arg-type]
    return client


def write_points(folder: Path, count: int = 5, data: bytes | None = None) -> Path:
    points = np.zeros(count, POINT)
    points["position"][:, 0] = np.arange(count)
    points["color"] = (255, 0, 51, 255)
    path = folder / "stages" / "train-now" / POINTS_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(points_file(points) if data is None else data)
    return path


def look(folder: Path) -> None:
    """Let the timer search, wait for the reading, and let it take what was read."""
    job_timer._shown_points.setdefault(str(folder), job_timer._ShownPoints()).searched_s = float(
        "-inf"
    )
    job_timer.poll_jobs()
    reading = job_timer._shown_points[str(folder)].reading
    assert reading is not None
    assert reading.finished(20.0)
    job_timer.poll_jobs()


def count() -> int | None:
    points = job_timer.points_of(bpy.context.scene)
    return None if points is None else len(points.positions)


def test_points_follow_the_file_the_job_and_the_checkbox(tmp_path: Path) -> None:
    client = watch(tmp_path)
    assert count() is None
    path = write_points(tmp_path, 5)
    look(tmp_path)
    points = job_timer.points_of(bpy.context.scene)
    assert points is not None
    assert points.positions[:, 0].tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(points.colors, np.tile((1, 0, 0.2, 1), (5, 1)), atol=1e-6)
    write_points(tmp_path, 7)
    look(tmp_path)
    assert count() == 7
    for bad in (b"", b"PK", points_file(np.zeros(3, POINT))[:-1], b"\x93NUMPY" * 400_000):
        write_points(tmp_path, data=bad)
        look(tmp_path)
        assert count() == 7, "a broken file changes nothing"
    bpy.context.scene.gwrap.show_points = False
    assert count() is None
    bpy.context.scene.gwrap.show_points = True
    assert count() == 7
    other = bpy.data.scenes.new("other")
    assert job_timer.points_of(other) is None, "only where the job is"
    client.status = replace(RUNNING, stage="mesh")
    job_timer.poll_jobs()
    assert count() is None, "the training is over"
    client.status = replace(RUNNING, state="CANCELLED")
    job_timer.poll_jobs()
    assert job_timer._shown_points == {}
    assert path.exists()


@pytest.mark.parametrize("where", ["link", "done", "elsewhere"])
def test_points_of_nothing_that_runs_are_not_read(tmp_path: Path, where: str) -> None:
    path = write_points(tmp_path)
    if where == "link":
        path.rename(tmp_path / "there.npy")
        path.symlink_to(tmp_path / "there.npy")
    elif where == "done":
        (path.parent / "done.json").write_text("{}")
    else:
        path.rename(path.parent.with_name("mesh-now.npy"))
    watch(tmp_path)
    look(tmp_path)
    assert count() is None


def test_another_file_shows_neither_points_nor_progress(tmp_path: Path) -> None:
    write_points(tmp_path)
    watch(tmp_path)
    look(tmp_path)
    assert count() == 5
    assert len(job_view.running_jobs()) == 1
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    jobs.attach_open_file()
    assert count() is None
    assert job_view.running_jobs() == []


class Gpu:
    """Stands for Blender's modules ``gpu`` and ``gpu_extras.batch``, and notes what is drawn."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, known: str = "FLAT_COLOR") -> None:
        self.drawn: list[tuple[np.ndarray, np.ndarray | None]] = []
        self.matrix_now: np.ndarray | None = None
        self.made = 0
        batch = SimpleNamespace(draw=lambda _shader: self.drawn.append((self.pos, self.matrix_now)))

        def from_builtin(name: str) -> str:
            if name != known:
                raise ValueError(name)
            return name

        def for_shader(_shader: object, kind: str, values: dict[str, np.ndarray]) -> object:
            assert kind == "POINTS"
            assert values["color"].shape[1] == 4
            self.pos = values["pos"]
            self.made += 1
            return batch

        state = SimpleNamespace(
            depth_test_set=lambda _v: None, point_size_set=lambda _v: None,
        )  # fmt: skip
        gpu = SimpleNamespace(
            shader=SimpleNamespace(from_builtin=from_builtin), state=state, matrix=self,
        )  # fmt: skip
        monkeypatch.setitem(__import__("sys").modules, "gpu", gpu)
        extras = SimpleNamespace(batch_for_shader=for_shader)
        monkeypatch.setitem(__import__("sys").modules, "gpu_extras.batch", extras)

    def push_pop(self) -> Gpu:
        return self

    def __enter__(self) -> None:
        self.matrix_now = None

    def __exit__(self, *_error: object) -> None:
        self.matrix_now = None

    def multiply_matrix(self, matrix: object) -> None:
        self.matrix_now = np.array(matrix)


def context(*, overlays: bool = True) -> Any:
    space = SimpleNamespace(overlay=SimpleNamespace(show_overlays=overlays))
    return SimpleNamespace(
        space_data=space, scene=bpy.context.scene, preferences=bpy.context.preferences
    )


@pytest.mark.parametrize("known", ["POINT_FLAT_COLOR", "FLAT_COLOR"])
def test_what_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known: str) -> None:
    gpu = Gpu(monkeypatch, known)
    job_view._draw_points(context())
    assert gpu.drawn == []
    write_points(tmp_path / "job")
    watch(tmp_path / "job")
    look(tmp_path / "job")
    job_view.VIEW.draw(context(overlays=False))
    assert gpu.drawn == []
    job_view._draw_points(context())
    import_result(write_result(tmp_path / "elsewhere"), bpy.context.scene).frame.location.x = 9
    bpy.context.view_layer.update()
    job_view._draw_points(context())
    assert gpu.made == 1, "one batch for as long as the points are the same"
    assert all(matrix is None for _, matrix in gpu.drawn)
    imported = import_result(write_result(tmp_path / "job"), bpy.context.scene)
    imported.frame.location = (1, 2, 3)
    bpy.context.view_layer.update()
    job_view._draw_points(context())
    matrix = gpu.drawn[-1][1]
    assert matrix is not None
    assert matrix[:3, 3].tolist() == [1, 2, 3]
    bpy.context.scene.gwrap.show_points = False
    job_view._draw_points(context())
    assert len(gpu.drawn) == 3
    assert job_view._drawing.batch is None, "the GPU's memory is given back"


def test_an_error_while_drawing_is_logged_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_arguments: object) -> None:
        raise RuntimeError("no context")

    monkeypatch.setattr(job_view, "_draw_points", broken)
    monkeypatch.setattr(job_view, "_draw_status", broken)
    with caplog.at_level(logging.ERROR):
        for _ in range(3):
            job_view.VIEW.draw(context())
            job_view.draw(SimpleNamespace(layout=None), bpy.context)
    assert [r.message for r in caplog.records] == [
        "points cannot be drawn", "progress cannot be drawn",
    ]  # fmt: skip


def bar() -> FakeLayout:
    layout = FakeLayout()
    job_view.draw(SimpleNamespace(layout=layout), bpy.context)
    return layout


def test_running_jobs_are_in_the_status_bar(tmp_path: Path) -> None:
    assert bar().log == []
    for state in ("NEW", "RUNNING", "CANCELLING"):
        watch(tmp_path / "a", replace(RUNNING, state=state, fraction=0.256))
        (name, _, keywords) = bar().log[-1]
        assert name == "progress"
        assert keywords["text"] == "Train · 26 % · 1 min 30 s left"
        assert keywords["factor"] == 0.256
    watch(tmp_path / "b", replace(RUNNING, fraction=1.7), bpy.data.scenes.new("other"))
    (_, _, keywords) = bar().log[-1]
    assert keywords["text"] == "Train · 100 % · 1 min 30 s left (+1)", "the newest"
    assert keywords["factor"] == 1.0
    for ended in ("DONE", "CANCELLED", "FAILED", "LOST"):
        for job in job_timer.jobs.values():
            job.status = replace(RUNNING, state=ended)
        assert bar().log == []
