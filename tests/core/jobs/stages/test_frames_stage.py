# SPDX-License-Identifier: GPL-3.0-or-later
"""A job's video: frames in a stage of their own, used again, and what the report says of them."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError, UsageError
from gaussian_wrapping_addon.core.evaluation.report.report import report_markdown
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.stages.cameras import frames_request, run_cameras
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, training_keys
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.loading import load
from gaussian_wrapping_addon.core.photos import video_frames
from gaussian_wrapping_addon.core.photos.finder import list_photos
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View, load_saved_scene
from gaussian_wrapping_addon.core.settings import JobSettings
from tests.core.photos.small_videos import HEIGHT, WIDTH, pan, write

FRAMES = 8


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write(tmp_path / "clip.mp4", pan(range(0, 600, 20)))


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Replace the solving of cameras, and note what was given to it."""
    given: list[Path] = []

    def fake(source: Path, *_: Any, **__: Any) -> Scene:
        given.append(source)
        pose = np.eye(3, 4)
        views = tuple(
            View(Camera(p.name, WIDTH, HEIGHT, 300.0, 300.0, 160.0, 120.0, pose), p, None)
            for p in list_photos(source)
        )
        nothing = np.zeros((0, 3))
        facts = {"kind": "photos", "photos": len(views)}
        return Scene(views, nothing, nothing.astype(np.uint8), Similarity(), (), facts)

    monkeypatch.setattr(load, "load_scene", fake)
    return given


@pytest.fixture
def extracted(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Note how often a video is decoded."""
    calls: list[Path] = []
    real = video_frames.extract_frames

    def noted(video: Path, *arguments: Any, **options: Any) -> video_frames.VideoFrames:
        calls.append(video)
        return real(video, *arguments, **options)

    monkeypatch.setattr(video_frames, "extract_frames", noted)
    return calls


def job_of(source: Path, **changes: Any) -> JobFile:
    return make_job("wrap", source, JobSettings(**{"video_frames": FRAMES, **changes}))


def folder_in(root: Path) -> JobFolder:
    folder = JobFolder(root / "out")
    folder.create()
    return folder


def test_frames_are_taken_once_and_used_again_also_where_the_folder_is_moved(
    tmp_path: Path, video: Path, loaded: list[Path], extracted: list[Path]
) -> None:
    folder = folder_in(tmp_path)
    stage = run_cameras(folder, job_of(video), Progress(), threads=1)
    assert stage.done["facts"]["kind"] == "video"
    assert stage.done["facts"]["photos_in_order"] == "frames of a video"
    assert stage.done["facts"]["video_frames_read"] == 30
    assert stage.done["facts"]["video_frames_kept"] == stage.done["views"] == FRAMES
    text = report_markdown({"cameras": stage.done}, tmp_path)
    for row in (
        "| Frames of the video | 30 frames |", "| Frames used as photos | 8 frames |",
        "| Frames left out as blurred | 0 frames |",
        "| Frames left out because nothing moved | 0 frames |",
    ):  # fmt: skip
        assert row in text
    assert "solved from the photos alone" in text
    assert run_cameras(folder, job_of(video), Progress(), threads=1).reused
    other = run_cameras(folder, job_of(video, seed=3), Progress(), threads=1)
    assert other.key != stage.key
    assert (len(loaded), len(extracted)) == (2, 1)
    assert [path.parent for path in loaded] == [next(folder.stages.glob("frames-*"))] * 2
    moved = tmp_path / "elsewhere"
    folder.root.rename(moved)
    scene = load_saved_scene(moved / "stages" / stage.folder.name)
    assert len(scene.views) == FRAMES
    assert all(view.photo_path.resolve().is_relative_to(moved) for view in scene.views)


def test_other_frames_and_another_file_are_other_stages(tmp_path: Path, video: Path) -> None:
    def key(**changes: Any) -> str:
        request = frames_request(job_of(video, **changes))
        assert request is not None
        return request.key

    keys = {key(), key(video_frames=9), key(video_frames=0), key(video_frames=0, video_fps=2.0)}
    assert len(keys) == 4
    assert key(video_fps=2.0) == key()  # where a number is given, it alone counts
    first = key()
    os.utime(video, ns=(1, 1))
    assert key() != first
    # Settings of videos that are not given are in no key of trainings made before them.
    job = job_of(video, video_frames=0)
    assert frames_request(job) == frames_request(replace(job, command="mesh"))


def test_lost_frames_are_taken_again(
    tmp_path: Path, video: Path, loaded: list[Path], extracted: list[Path]
) -> None:
    folder = folder_in(tmp_path)
    run_cameras(folder, job_of(video), Progress(), threads=1)
    (frames,) = folder.stages.glob("frames-*/frames")
    next(frames.iterdir()).unlink()
    run_cameras(folder, job_of(video, seed=1), Progress(), threads=1)
    assert (len(extracted), len(list(frames.iterdir()))) == (2, FRAMES)
    shutil.rmtree(frames.parent)
    assert not run_cameras(folder, job_of(video), Progress(), threads=1).reused
    assert len(extracted) == 3


def test_a_folder_that_holds_a_video_is_the_video_one_named_like_it_is_a_folder(
    tmp_path: Path, loaded: list[Path]
) -> None:
    folder = tmp_path / "photos.mov"
    folder.mkdir()
    (folder / "a.jpg").write_bytes(b"picture")
    assert frames_request(job_of(folder)) is None
    video = write(folder / "clip.MOV", pan(range(0, 600, 20)), codec="mpeg4")
    (folder / "a.jpg").unlink()
    request = frames_request(job_of(folder))
    assert request is not None
    assert request.video == video
    stage = run_cameras(folder_in(tmp_path), job_of(folder), Progress(), threads=1)
    assert stage.done["views"] == FRAMES


@pytest.mark.parametrize("gone", ["the video", "its folder"])
def test_a_video_that_is_gone_stops_no_mesh_of_its_training(
    tmp_path: Path, gone: str, loaded: list[Path], extracted: list[Path]
) -> None:
    (tmp_path / "filmed").mkdir()
    video = write(tmp_path / "filmed" / "clip.mp4", pan(range(0, 600, 20)))
    source = video if gone == "the video" else video.parent
    folder, job = folder_in(tmp_path), job_of(source)
    stage = run_cameras(folder, job, Progress(), threads=1)
    key, _ = training_keys(stage.key, job)
    (folder.stages / f"train-{key}").mkdir()
    write_json(folder.stages / f"train-{key}" / "done.json", {"finished_unix_s": 1.0})
    shutil.rmtree(video.parent)
    mesh = make_job("mesh", source, job.settings)
    again = run_cameras(folder, mesh, Progress(), threads=1)
    assert (again.folder, len(loaded), len(extracted)) == (stage.folder, 1, 1)
    assert all(view.photo_path.is_file() for view in load_saved_scene(again.folder).views)
    with pytest.raises(DatasetError, match="does not exist"):
        make_job("wrap", source, job.settings)
    shutil.rmtree(next(folder.stages.glob("frames-*")))
    with pytest.raises(DatasetError, match=r"frame-\d+\.jpg no longer exists"):
        load_saved_scene(again.folder)


def test_frames_have_no_gps(tmp_path: Path, video: Path, extracted: list[Path]) -> None:
    with pytest.raises(UsageError, match="Frames of a video have no GPS position"):
        run_cameras(folder_in(tmp_path), job_of(video, georeference="on"), Progress(), threads=1)
    assert extracted == []


def test_a_resumed_job_whose_control_points_are_gone_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("cameras are solved")

    monkeypatch.setattr(load, "solve_poses", never)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"picture")
    points = tmp_path / "points.txt"
    points.write_text("LOCAL\n")
    job = job_of(tmp_path / "photos", control_points=str(points), video_frames=0)
    points.unlink()
    with pytest.raises(DatasetError, match=r"points\.txt cannot be read: No such file") as refused:
        run_cameras(folder_in(tmp_path), job, Progress(), threads=1)
    assert refused.value.hint.startswith("Put the file back and resume the job")
