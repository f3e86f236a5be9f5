# SPDX-License-Identifier: GPL-3.0-or-later
"""Training in the panel: choices become settings, the estimate, the live view, train more."""

from __future__ import annotations

import io
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import UsageError, WorkerError
from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE, JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, read_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.regions.box import CUBE_CORNERS
from gaussian_wrapping_addon.core.regions.files import region_to_json
from gaussian_wrapping_addon.core.settings import (
    MASK_MODES,
    MODEL_SELECTION,
    SELECTION_MODES,
    preset,
    to_json,
)
from gaussian_wrapping_addon.ops import addon, background, job_timer, panel_settings
from gaussian_wrapping_addon.ops import training as training_estimate
from gaussian_wrapping_addon.ops.scene_objects import import_result
from gaussian_wrapping_addon.ui import training_panel
from gaussian_wrapping_addon.ui.job_view import live_rows
from tests.blender.fake_layout import draw
from tests.blender.fake_worker import LIVE, picture
from tests.blender.job_play import play_background, write_fake_python
from tests.blender.panel_states import Client, words
from tests.blender.synthetic_result import npy_bytes, write_result

pytestmark = pytest.mark.usefixtures("addon")

PANEL = training_panel.GWRAP_PT_train_advanced
TRAIN = training_panel.GWRAP_PT_train


@pytest.fixture(autouse=True)
def _nothing_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(addon, "_session", [])
    job_timer.forget_all_jobs()


def training() -> bpy.types.PropertyGroup:
    return bpy.context.scene.gwrap.training


SWITCHES = ("harmonics", "growth", "wrapping")
DECIDED = tuple(name for name in MODEL_SELECTION if name not in SWITCHES)


def choices_of(name: str) -> set[str]:
    return {item.identifier.lower() for item in training().bl_rna.properties[name].enum_items}


def test_untouched_choices_are_the_preset() -> None:
    for name in ("draft", "standard", "fine"):
        bpy.context.scene.gwrap.preset = name.upper()
        assert panel_settings.job_settings(bpy.context.scene, 3) == preset(name, threads=3)
        on_gpu = panel_settings.job_settings(bpy.context.scene, 3, "cuda")
        assert on_gpu == preset(name, threads=3, device="cuda")
    for name in DECIDED:
        assert choices_of(name) == set(SELECTION_MODES)
    assert choices_of("mask_mode") == set(MASK_MODES)


def test_each_choice_changes_its_setting_and_no_other(tmp_path: Path) -> None:
    splat, points = tmp_path / "splat.PLY", tmp_path / "gcp.txt"
    splat.write_bytes(b"ply")
    points.write_text("LOCAL\n")
    base = to_json(preset("standard"))
    of_training: dict[str, object] = {
        **dict.fromkeys(DECIDED, "OFF"),
        "mask_mode": "BACKGROUND",
        "iterations": 77,
        "max_gaussians": 7777,
        "max_image_px": 333,
    }
    of_job = {
        "start_splat": (str(splat), str(splat)),
        "georeference": ("OFF", "off"),
        "markers": ("DICT_4X4_50:0.05", "4x4_50:0.05"),
        "control_points": (str(points), str(points)),
    }
    for name, value in {**of_training, **{k: chosen for k, (chosen, _) in of_job.items()}}.items():
        setattr(training(), name, value)
        wanted = value.lower() if isinstance(value, str) else value
        change = {"training": {**base["training"], name: wanted}}
        if name in of_job:
            change = {name: of_job[name][1]}
        found = to_json(panel_settings.job_settings(bpy.context.scene, 0))
        assert found == {**base, **change}
        training().property_unset(name)
    training().iterations = 77
    assert bpy.ops.gwrap.reset_training() == {"FINISHED"}
    assert to_json(panel_settings.job_settings(bpy.context.scene, 0)) == base
    assert "80,000" in draw(PANEL).texts, "what the preset has"


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("markers", "4x4_50:0", "marker size '0' is not a length"),
        ("control_points", "/nowhere/gcp.txt", "does not exist"),
        ("control_points", r"\\server\share\gcp.txt", "another computer"),
        ("start_splat", "/nowhere/x.obj", "not a PLY"),
        ("start_splat", "/nowhere/missing.ply", "does not exist"),
        ("start_splat", r"\\server\share\x.ply", "another computer"),
    ],
)
def test_what_cannot_be_used_is_refused(name: str, value: str, words: str) -> None:
    setattr(training(), name, value)
    with pytest.raises(UsageError, match=words):
        panel_settings.job_settings(bpy.context.scene, 0)


def test_every_choice_has_a_tooltip_in_words() -> None:
    for owner in training().bl_rna.properties:
        if owner.identifier in ("rna_type", "name"):
            continue
        assert len(owner.description.split()) >= 5
        assert len(owner.name) <= 16, "longer labels are cut off in the panel"
        for item in owner.enum_items if owner.type == "ENUM" else ():
            assert len(item.description.split()) >= 3, item.identifier


def test_live_rows() -> None:
    for figures, rows in (
        ({}, {}),
        (5, {}),
        ({"iteration": "x"}, {}),
        ({"iteration": 3.0, "psnr": 20.0}, {"Iteration": "3", "PSNR, Trained": "20.0 dB"}),
        (
            LIVE,
            {
                "Iteration": "750 of 3,000",
                "Gaussians": "12,345",
                "PSNR, Held Out": "24.3 dB",
                "Iterations per Second": "16.2",
                "Training Left": "2 min 18 s",
            },
        ),
    ):
        status = JobStatus("RUNNING", "train", figures=figures)  # type: ignore[arg-type]
        assert dict(live_rows(status)) == rows
    still = JobStatus("RUNNING", "train", figures={**LIVE, "iterations_per_s": 0.0})
    assert "Training Left" not in dict(live_rows(still))
    assert live_rows(JobStatus("DONE", "train", figures=LIVE)) == ()


def write_picture(folder: Path, name: str = "train-now", data: bytes | None = None) -> Path:
    path = folder / "stages" / name / job_timer.PICTURE
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(npy_bytes(picture()) if data is None else data)
    return path


def refreshed(key: str, now_s: float) -> bool:
    """Look for a picture, wait until it is read, and show it."""
    assert not job_timer.refresh(key, now_s), "it is read in a thread"
    reading = job_timer._shown_previews[key].reading
    if reading is not None:
        assert reading.finished(20.0)
    return job_timer.refresh(key, now_s)


def test_the_picture_follows_the_file_and_survives_bad_ones(tmp_path: Path) -> None:
    key = str(tmp_path)
    assert not refreshed(key, 0.0), "no picture yet"
    path = write_picture(tmp_path)
    assert not refreshed(key, job_timer.EVERY_S - 0.1), "not yet time"
    assert refreshed(key, 10.0)
    stamp = job_timer._shown_previews[key].stamp
    assert stamp is not None
    assert stamp[0] == str(path)
    assert len(job_timer.icons_of(key)) == 2, "photo and rendering"
    names = job_timer._shown_previews[key].names
    left, right = (job_timer._pictures[name] for name in names)
    assert left.image_size[:] == right.image_size[:]
    colours = [np.array(p.image_pixels_float[:]).reshape(-1, 4).mean(0) for p in (left, right)]
    assert colours[1][:3] == pytest.approx(0.875 * colours[0][:3], abs=0.03)
    assert not refreshed(key, 20.0), "nothing new"
    flat = npy_bytes(picture()[..., 0])
    several = io.BytesIO()
    np.savez(several, picture=picture())
    huge = npy_bytes(picture()).replace(b"(120, 324, 3)", b"(9999999999, 9999, 3)")
    assert len(huge) != len(npy_bytes(picture()))
    bad_ones = (b"", b"no picture", b"PK\x03\x04 no zip", several.getvalue(), huge, flat)
    for bad in (*bad_ones, npy_bytes(picture())[:200], npy_bytes(np.zeros(0))):
        write_picture(tmp_path, data=bad)
        assert not refreshed(key, job_timer._shown_previews[key].searched_s + 10.0)
        assert job_timer.icons_of(key)
    (path.parent / "done.json").write_text("{}")
    assert job_timer.newest_picture(tmp_path) is None, "a finished training is not under way"
    job_timer.forget(key)
    assert job_timer.icons_of(key) == ()
    assert len(job_timer._pictures) == 0
    job_timer.stop()
    job_timer.stop()


def test_a_running_training_is_drawn_and_let_go(tmp_path: Path) -> None:
    write_picture(tmp_path)
    running = JobStatus("RUNNING", "train", 0.3, "iteration 750/3000", 90.0, figures=LIVE)
    client = Client(running)
    job_timer.watch(bpy.context.scene, tmp_path, client, imports=False)  # type: ignore[arg-type]
    job_timer.poll_jobs()
    assert job_timer._shown_previews[str(tmp_path)].reading.finished(20.0)
    job_timer.poll_jobs()
    layout = draw(training_panel.GWRAP_PT_train)
    assert "750 of 3,000" in layout.texts
    assert "iteration 750" not in layout.texts.lower().replace("750 of", ""), "not told twice"
    assert [name for name, *_ in layout.log].count("template_icon") == 2
    assert "gwrap.estimate" not in draw(TRAIN).operators
    client.status = replace(running, state="CANCELLED")
    job_timer.poll_jobs()
    assert job_timer.icons_of(str(tmp_path)) == ()
    assert "template_icon" not in [name for name, *_ in draw(training_panel.GWRAP_PT_train).log]


def finished_job(folder: Path) -> Path:
    """Write a finished job with a region of its own, and import its result."""
    job = JobFolder(folder)
    job.create()
    photos = folder.with_name("photos")
    photos.mkdir()
    made = make_job("wrap", photos, preset("draft"))
    region = str(folder / "gone.json")
    settings = replace(made.settings, regions=(region,))
    body = region_to_json("gone", np.array(CUBE_CORNERS, np.float64))
    write_job(job.job_path, JobFile("mesh", made.source, settings, {region: body}))
    (job.stages / "train-abc").mkdir()
    (job.stages / "train-abc" / "done.json").write_text('{"seconds": 1.0}')
    (job.stages / "train-abc" / "checkpoint-000300.json").write_text("{}")
    import_result(write_result(folder), bpy.context.scene)
    bpy.context.view_layer.update()
    return folder


def test_train_more_adds_iterations_and_changes_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not bpy.ops.gwrap.train_more.poll()
    folder = finished_job(tmp_path / "job")
    earlier = read_job(folder / "job.json")
    monkeypatch.setenv(PYTHON_VARIABLE, sys.executable)
    done = Client(JobStatus("DONE", "train", 1.0))
    monkeypatch.setattr(JobClient, "_launch", lambda *_: done)
    training().more_iterations = 1500
    assert "gwrap.train_more" in draw(TRAIN).operators
    for extra in (1500, 3000):
        assert bpy.ops.gwrap.train_more() == {"FINISHED"}
        job = read_job(folder / "job.json")
        assert job.command == "more"
        assert job.settings.training.extra_iterations == extra
        back = replace(job.settings.training, extra_iterations=0)
        assert replace(job.settings, training=back) == earlier.settings
        assert (job.source, job.region_bodies) == (earlier.source, earlier.region_bodies)
    assert bpy.context.scene.gwrap.job_command == "WRAP"
    training().more_iterations = 1_000_000
    with pytest.raises(RuntimeError, match="extra_iterations is out of range"):
        bpy.ops.gwrap.train_more()
    (folder / "stages" / "train-abc" / "done.json").unlink()
    with pytest.raises(RuntimeError, match="no finished training"):
        bpy.ops.gwrap.train_more()


@pytest.fixture
def worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put the fake in the place of the worker's Python; return what it was asked."""
    monkeypatch.setenv(PYTHON_VARIABLE, str(write_fake_python(tmp_path)))
    monkeypatch.setenv("GW_ASKED", str(tmp_path / "asked.json"))
    bpy.context.scene.gwrap.source = str(tmp_path)
    return tmp_path / "asked.json"


def test_estimate_asks_the_worker_and_shows_its_words(
    worker: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = [
        {"line": "training: 4 to 6 min"},
        {"line": "memory: 1.2 GB"},
        {"warning": "full", "code": "disk"},
    ]
    monkeypatch.setenv("GW_ANSWER", "\n".join(["noise", *map(json.dumps, said)]))
    training().iterations = 432
    assert bpy.ops.gwrap.estimate() == {"FINISHED"}
    assert "Estimating…" in draw(TRAIN).texts
    assert not bpy.ops.gwrap.estimate.poll(), "one at a time"
    play_background()
    texts = words(draw(TRAIN))
    for text in ("Training 4 to 6 min", "Memory 1.2 GB", "Full"):
        assert text in texts
    asked = JobFile.from_json(json.loads(worker.read_text()))
    assert asked.source == str(worker.parent)
    wanted = make_job("wrap", worker.parent, panel_settings.job_settings(bpy.context.scene, 0))
    assert asked.settings == wanted.settings
    training().iterations = 433
    assert "4 to 6 min" not in draw(TRAIN).texts, "it was about other choices"
    training().iterations = 432
    assert "4 to 6 min" in draw(TRAIN).texts, "going back shows it again"
    monkeypatch.setenv("GW_ANSWER", json.dumps({"error": "No photos.", "hint": "Add some."}))
    assert bpy.ops.gwrap.estimate() == {"FINISHED"}
    play_background()
    assert "No photos. Add some." in words(draw(TRAIN))


def test_an_estimate_without_words_says_so() -> None:
    with pytest.raises(WorkerError, match="Segmentation fault"):
        training_estimate.estimate_of([{"message": "reading"}], "Segmentation fault")


def test_stopping_forgets_the_question(worker: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GW_ANSWER", json.dumps({"line": "training: 4 to 6 min"}))
    bpy.ops.gwrap.estimate()
    training_estimate.stop()
    assert not training_estimate.is_busy()
    time.sleep(0.1)
    background.poll()
    assert "4 to 6 min" not in draw(TRAIN).texts


def test_pictures_of_blocks_are_shown_but_their_points_are_only_a_part(tmp_path: Path) -> None:
    whole = job_timer.WHOLE_TRAININGS
    for number, name in enumerate(("blocks-ab/coarse-all", "blocks-ab/block-0001")):
        path = tmp_path / "stages" / name / job_timer.PICTURE
        path.parent.mkdir(parents=True)
        path.write_bytes(b"picture")
        os.utime(path, ns=(number, 10**9 + number))
    newest = job_timer.newest_picture(tmp_path)
    assert newest is not None
    assert "block-0001" in newest[0]
    points = job_timer.newest_picture(tmp_path, job_timer.PICTURE, whole)
    assert points is not None
    assert "coarse-all" in points[0]
