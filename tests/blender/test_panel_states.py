# SPDX-License-Identifier: GPL-3.0-or-later
"""Every panel in every state: what it says, which buttons it offers, which one is the next step."""

from __future__ import annotations

import builtins
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path

import bpy
import pytest

from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from gaussian_wrapping_addon.core.loading import check
from gaussian_wrapping_addon.core.photos.video import ProbedVideo
from gaussian_wrapping_addon.ops import addon, dataset, job_timer, jobs, panel_settings
from gaussian_wrapping_addon.ops import training as training_estimate
from gaussian_wrapping_addon.ops.panel_settings import (
    PRIMARY,
    Stage,
    choices_key,
    job_settings,
    output_of,
)
from gaussian_wrapping_addon.ops.report_data import report_of
from tests.blender.fake_layout import FakeLayout, draw
from tests.blender.job_play import play_background, write_fake_python
from tests.blender.panel_states import (
    ERROR,
    HINT,
    OPERATORS,
    ORDER,
    PANELS,
    bad_data,
    buttons,
    can_run,
    cancelled,
    cancelling,
    checked,
    checking,
    choose_photos,
    done,
    done_two_regions,
    estimated,
    failed,
    gone,
    in_edit_mode,
    lost,
    mesh_failed,
    meshing,
    no_data,
    not_checked,
    not_open,
    tab,
    to_import,
    training,
    words,
)

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture(autouse=True)
def _nothing_left() -> None:
    job_timer.forget_all_jobs()
    dataset.stop_check()
    training_estimate.forget()


State = Callable[[Path], None]

STATES: dict[State, Stage] = {
    no_data: Stage.NO_DATA, not_checked: Stage.READY, checking: Stage.READY,
    checked: Stage.READY, bad_data: Stage.BAD_DATA, estimated: Stage.READY,
    training: Stage.RUNNING, cancelling: Stage.RUNNING, failed: Stage.STOPPED,
    lost: Stage.STOPPED, cancelled: Stage.STOPPED, not_open: Stage.NOT_OPEN, gone: Stage.GONE,
    to_import: Stage.IMPORTABLE, in_edit_mode: Stage.WAITING, done: Stage.FINISHED,
    done_two_regions: Stage.FINISHED, meshing: Stage.RUNNING, mesh_failed: Stage.FINISHED,
}  # fmt: skip

every_state = pytest.mark.parametrize("state", STATES, ids=lambda s: s.__name__)


HEADERS = {
    #                Dataset            Train          Mesh                  Result
    no_data: ("No photos", "Not trained", "Needs a training", "No result"),
    not_checked: ("Not checked", "Not trained", "Needs a training", "No result"),
    checking: ("Checking…", "Not trained", "Needs a training", "No result"),
    checked: ("3 photos", "Not trained", "Needs a training", "No result"),
    bad_data: ("Cannot be used", "Not trained", "Needs a training", "No result"),
    estimated: ("3 photos", "Not trained", "Needs a training", "No result"),
    training: ("3 photos", "25 %", "Needs a training", "No result"),
    cancelling: ("3 photos", "Cancelling", "Needs a training", "No result"),
    failed: ("3 photos", "Failed", "Needs a training", "No result"),
    lost: ("3 photos", "Failed", "Needs a training", "No result"),
    cancelled: ("3 photos", "Cancelled", "Needs a training", "No result"),
    not_open: ("3 photos", "Not open", "Needs a training", "No result"),
    gone: ("3 photos", "Job is gone", "Needs a training", "No result"),
    to_import: ("3 photos", "Not trained", "Needs a training", "No result"),
    in_edit_mode: ("3 photos", "Not trained", "Needs a training", "No result"),
    done: ("3 photos", "27.2 dB", "1 region", "1 mesh"),
    done_two_regions: ("3 photos", "27.2 dB", "No region selected", "1 mesh"),
    meshing: ("3 photos", "27.2 dB", "25 %", "1 mesh"),
    mesh_failed: ("3 photos", "27.2 dB", "1 region", "1 mesh"),
}


def check_headers(state: State, panels: dict[str, FakeLayout]) -> None:
    found = tuple(panels[name].header for name in ("Dataset", "Train", "Mesh", "Result"))
    assert found == HEADERS[state]
    assert panels["Texture"].header == "Automatic, photos"
    count = sum(1 for _ in addon.objects_of_kind(bpy.context.scene, "region"))
    words_of = {0: "No regions yet", 1: "1 region"}
    assert panels["Region"].header == words_of.get(count, f"{count} regions")


CHECKED = ["choose_input", "check_photos"]

RESULT = ["set_shading", "set_shading", "export_meshes", "pack_images", "import_result"]

RESULT += ["open_report"]

NO_RESULT = ["-export_meshes", "import_result"]

BUTTONS: dict[State, tuple[list[str], list[str], list[str], list[str]]] = {
    no_data: (["*choose_input"], ["-wrap_scene"], ["-mesh_region"], NO_RESULT),
    not_checked: (CHECKED, ["estimate", "*wrap_scene"], ["-mesh_region"], NO_RESULT),
    checking: (
        ["choose_input", "-check_photos"], ["estimate", "*wrap_scene"], ["-mesh_region"], NO_RESULT,
    ),
    checked: (CHECKED, ["estimate", "*wrap_scene"], ["-mesh_region"], NO_RESULT),
    bad_data: (["*choose_input", "check_photos"], ["-wrap_scene"], ["-mesh_region"], NO_RESULT),
    estimated: (CHECKED, ["*wrap_scene"], ["-mesh_region"], NO_RESULT),
    training: (["-choose_input", "check_photos"], ["*cancel_job"], ["-mesh_region"], NO_RESULT),
    cancelling: (["-choose_input", "check_photos"], ["*-cancel_job"], ["-mesh_region"], NO_RESULT),
    failed: (CHECKED, ["*resume_job", "wrap_scene"], ["-mesh_region"], NO_RESULT),
    lost: (CHECKED, ["*resume_job", "wrap_scene"], ["-mesh_region"], NO_RESULT),
    cancelled: (CHECKED, ["*resume_job", "wrap_scene"], ["-mesh_region"], NO_RESULT),
    not_open: (CHECKED, ["*resume_job", "find_job", "wrap_scene"], ["-mesh_region"], NO_RESULT),
    gone: (CHECKED, ["*find_job", "wrap_scene"], ["-mesh_region"], NO_RESULT),
    to_import: (CHECKED, ["*import_result", "wrap_scene"], ["-mesh_region"], NO_RESULT),
    in_edit_mode: (
        CHECKED, ["*object.mode_set", "wrap_scene"], ["-mesh_region"],
        ["-export_meshes", "-import_result"],
    ),
    done: (CHECKED, ["wrap_scene", "train_more"], ["*mesh_region"], RESULT),
    done_two_regions: (CHECKED, ["wrap_scene", "train_more"], ["*-mesh_region"], RESULT),
    meshing: (["-choose_input", "check_photos"], ["-wrap_scene"], ["*cancel_job"], RESULT),
    mesh_failed: (CHECKED, ["wrap_scene", "train_more"], ["*mesh_region"], RESULT),
}  # fmt: skip


def check_buttons(state: State, panels: dict[str, FakeLayout]) -> None:
    found = tuple(buttons(panels[name]) for name in ("Dataset", "Train", "Mesh", "Result"))
    assert found == BUTTONS[state]
    assert buttons(panels["Texture"]) == []
    assert ("Result / Report" in panels) == (BUTTONS[state][3] == RESULT)


SAID: dict[State, dict[str, str]] = {
    no_data: {"Dataset": "Photos of one object", "Mesh": "Needs a finished training."},
    not_checked: {"Dataset": "Check Photos", "Train": "Estimate Time and Memory"},
    checking: {"Dataset": "Checking…"},
    checked: {"Dataset": "3 photos, cameras to be solved", "Dataset / Details": "no camera poses"},
    bad_data: {"Dataset": "Add photos of the same thing from other places."},
    estimated: {
        "Train": "Training 4 to 12 min Memory 1.2 GB Not timed here: the first job compiles the "
        "renderer The disk is nearly full."
    },
    training: {"Train": "Train · 25 % · 1 min 30 s left Cancel Iteration 750 of 3,000"},
    cancelling: {"Train": "Cancelling…"},
    failed: {"Train": f"{ERROR} {HINT}"},
    lost: {"Train": f"{ERROR} {HINT}"},
    cancelled: {"Train": "Cancelled at 25 %. Resume continues from the last checkpoint."},
    not_open: {"Train": "This file has a job that is not open here."},
    gone: {"Train": "The folder of this file's job is gone. Find it,"},
    to_import: {"Train": "Import Finished Result"},
    in_edit_mode: {"Train": "Finished. Leave Edit Mode to see the result. Leave Edit Mode"},
    done: {
        "Region": "auto region",
        "Train": "Trained: 4,321 Gaussians, 27.2 dB",
        "Mesh": "Region: auto region",
    },
    done_two_regions: {"Mesh": "Select a region above, or add a region box. Mesh Region"},
    meshing: {"Mesh": "Train · 25 % · 1 min 30 s left Cancel Step"},
    mesh_failed: {"Mesh": f"{ERROR} {HINT}"},
}


def check_words(state: State, panels: dict[str, FakeLayout]) -> None:
    for name, text in SAID[state].items():
        assert text in words(panels[name])
    for other in (ERROR, "Import Finished Result", "Cancelled at"):
        told = [text for text in SAID[state].values() if other in text]
        drawn = [layout for layout in panels.values() if other in words(layout)]
        assert len(drawn) == len(told), "told once, and only where it belongs"


def check_locks(state: State, panels: dict[str, FakeLayout]) -> None:
    """Settings cannot be changed while a job runs."""
    running = STATES[state] is Stage.RUNNING
    names = ("Train", "Train / Advanced", "Mesh", "Mesh / Advanced", "Texture")
    for name in names:
        fields = panels[name].fields
        assert fields
        others = ("more_iterations", "show_points")  # shown only when they can be changed
        assert all(field.enabled != running for field in fields if field.name not in others)


@every_state
def test_what_every_panel_shows(state: State, tmp_path: Path) -> None:
    state(tmp_path)
    assert panel_settings.stage_of(bpy.context) is STATES[state]
    panels = tab()
    assert [name for name in panels if "/" not in name] == ORDER
    large = [b for layout in panels.values() for b in layout.buttons if b.large]
    assert [b.operator for b in large] == [PRIMARY[STATES[state]]], "the next step"
    for name, layout in panels.items():
        assert layout.log, f"{name} is empty"
        assert max(map(len, layout.texts.splitlines()), default=0) <= 60
        assert len(layout.header) <= 20, "a header has no room for more"
        shouted = [word for word in layout.texts.split() if word.isupper() and len(word) > 4]
        assert set(shouted) <= {"COLMAP", "PSNR,"}, name
    check_headers(state, panels)
    check_buttons(state, panels)
    check_words(state, panels)
    check_locks(state, panels)


@every_state
def test_every_greyed_button_says_why(state: State, tmp_path: Path) -> None:
    state(tmp_path)
    for cls in OPERATORS:
        operator = getattr(bpy.ops.gwrap, cls.bl_idname.removeprefix("gwrap."))
        if operator.poll():
            continue
        with pytest.raises(RuntimeError, match="poll") as refused:
            operator()
        reason = str(refused.value).partition("poll()")[2].strip()
        assert "context is incorrect" not in reason, cls.bl_idname
        assert len(reason.split()) >= 4, (cls.bl_idname, reason)
        assert not reason.endswith(".")


@every_state
def test_drawing_and_polling_read_no_file(
    state: State, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state(tmp_path)
    bpy.context.scene.gwrap.training.start_splat = "/nowhere/missing.ply"

    def refuse(*_arguments: object, **_keywords: object) -> None:
        raise AssertionError("the disk was read")

    draw(PANELS[0])  # whatever is imported at the first drawing
    with monkeypatch.context() as patch:
        for name in ("stat", "lstat", "scandir", "listdir", "open"):
            patch.setattr(os, name, refuse)
        patch.setattr(builtins, "open", refuse)
        tab()
        for cls in OPERATORS:
            can_run(cls.bl_idname)


def test_choosing_photos_checks_them_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(training_estimate, "start", lambda *arguments: asked.append(arguments))
    choose_photos(tmp_path)
    properties = bpy.context.scene.gwrap
    folder, properties.source = properties.source, ""
    assert bpy.ops.gwrap.choose_input(filepath=f"{folder}/") == {"FINISHED"}
    assert properties.source == folder
    assert tab()["Dataset"].header == "Checking…"
    play_background()
    assert tab()["Dataset"].header == "3 photos"
    assert len(asked) == 1, "the estimate follows by itself"
    (tmp_path / "photos" / "0.png").unlink()
    (tmp_path / "photos" / "1.png").unlink()
    assert bpy.ops.gwrap.check_photos("INVOKE_DEFAULT") == {"FINISHED"}
    play_background()
    assert tab()["Dataset"].header == "Cannot be used"
    assert len(asked) == 1
    properties.source = str(tmp_path)
    assert tab()["Dataset"].header == "Not checked"


def test_the_estimate_that_follows_a_check_starts_no_thread_in_the_timer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PYTHON_VARIABLE, str(write_fake_python(tmp_path)))
    monkeypatch.setenv("GW_ASKED", str(tmp_path / "asked.json"))
    monkeypatch.setenv("GW_ANSWER", json.dumps({"line": "training: 4 to 6 min"}))
    choose_photos(tmp_path)
    assert bpy.ops.gwrap.choose_input(filepath=bpy.context.scene.gwrap.source) == {"FINISHED"}

    def refuse(_thread: threading.Thread) -> None:
        raise AssertionError("a thread is started")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        play_background()
    assert "Training 4 to 6 min" in words(tab()["Train"])


def test_a_clicked_photo_stands_for_its_folder_and_files_for_themselves(tmp_path: Path) -> None:
    choose_photos(tmp_path)
    properties = bpy.context.scene.gwrap
    folder = Path(properties.source)
    bpy.ops.gwrap.choose_input(filepath=str(folder / "1.png"))
    assert properties.source == str(folder)
    files = ("cameras.xml", "cameras.csv", "cameras.sfm", "0.xmp", "shots.geojson")
    for name in (*files, "transforms.json", "clip.MP4", "splat.PLY"):
        (folder / name).write_text("x")
        bpy.ops.gwrap.choose_input(filepath=str(folder / name))
        assert properties.source == str(folder / name)
    for wrong in ("", str(tmp_path / "nowhere" / "x")):
        with pytest.raises(RuntimeError, match=r"chosen|does not exist"):
            bpy.ops.gwrap.choose_input(filepath=wrong)
    assert properties.source == str(folder / "splat.PLY")


def test_a_video_shows_how_its_frames_are_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_estimate, "start", lambda *_: None)
    probed = ProbedVideo(320, 240, 30, 1.0, "h264", False, False)
    monkeypatch.setattr(check, "probe_video", lambda *_: probed)
    choose_photos(tmp_path)
    properties = bpy.context.scene.gwrap

    def fields() -> set[str]:
        return {field.name for field in tab()["Dataset"].fields}

    assert not fields() & {"video_frames", "video_fps"}
    video = tmp_path / "clip.mp4"
    video.write_bytes(b"\0\0\0\x18ftypisom")
    assert bpy.ops.gwrap.choose_input(filepath=str(video)) == {"FINISHED"}
    play_background()
    assert properties.source == str(video)
    assert output_of(bpy.context.scene, video) == tmp_path / "clip_wrap"
    assert properties.checked_kind == "video"
    assert tab()["Dataset"].header == "1 s of video"
    assert fields() >= {"video_frames", "video_fps"}
    key = choices_key(bpy.context.scene)
    properties.video_fps = 2.0
    assert choices_key(bpy.context.scene) != key, "the estimate is another one"
    assert job_settings(bpy.context.scene, 1).video_fps == 2.0
    properties.video_frames = 50
    assert "video_fps" not in fields()
    chosen = job_settings(bpy.context.scene, 1)
    assert (chosen.video_frames, chosen.video_fps) == (50, 0.0)


def test_other_photos_begin_anew_beside_the_earlier_result(tmp_path: Path) -> None:
    done(tmp_path)
    properties = bpy.context.scene.gwrap
    properties.output = properties.job_folder
    other = tmp_path / "other"
    other.mkdir()
    bpy.ops.gwrap.choose_input(filepath=str(other))
    assert (properties.job_folder, properties.output) == ("", "")
    jobs.after_undo(bpy.context.scene)
    assert properties.job_folder == "", "undo does not bring the job of other photos back"
    assert panel_settings.stage_of(bpy.context) is Stage.READY
    assert tab()["Result"].header == "1 mesh"


def test_a_check_of_photos_that_are_no_longer_chosen_is_dropped(tmp_path: Path) -> None:
    choose_photos(tmp_path)
    dataset.start_check(bpy.context.scene)
    bpy.context.scene.gwrap.source = str(tmp_path)
    play_background()
    assert tab()["Dataset"].header == "Not checked"
    assert len(bpy.context.scene.gwrap.findings) == 0


def test_copying_the_report(tmp_path: Path) -> None:
    assert not bpy.ops.gwrap.copy_report.poll()
    done(tmp_path)
    assert bpy.ops.gwrap.copy_report() == {"FINISHED"}
    frame = addon.current_frame(bpy.context)
    report = report_of(addon.figures_of(frame))
    text = report.as_text()
    for name, value in (*report.rows, *report.stages, *report.regions[0].rows):
        assert f"{name}: {value}" in text
    assert all(warning in text for warning in report.warnings)
