# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of a job: made once, edited and rejected by people, part of the training's key."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.devices import choose_device
from gaussian_wrapping_addon.core.errors import Cancelled, DatasetError, ParseError, UsageError
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.jobs.stages import masks
from gaussian_wrapping_addon.core.jobs.stages.cameras import MASKED, run_cameras
from gaussian_wrapping_addon.core.jobs.stages.masks import check_mask_model, run_masks
from gaussian_wrapping_addon.core.jobs.store.job_file import (
    JobFile,
    make_job,
    read_job,
    training_keys,
)
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage
from gaussian_wrapping_addon.core.masks.mask_folder import read_list, write_list
from gaussian_wrapping_addon.core.masks.segmentation import encoded
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.scene import Scene, load_saved_scene, save_scene
from gaussian_wrapping_addon.core.settings import JobSettings
from tests.core.jobs.finished_sphere import write_cube, write_finished_sphere
from tests.core.masks import onnx_files
from tests.core.masks.test_silhouettes import overlap, sphere_seen
from tests.core.meshing.meshing_scenes import cube
from tests.core.training.small_scene import sphere_scene

PROCESSOR = choose_device("cpu")
COUNT = 12
"""Photos of the sphere."""
WALL = (60, 120, 200)
"""Colour of a plain background."""


@pytest.fixture
def folder(tmp_path: Path) -> JobFolder:
    return write_finished_sphere(tmp_path)


@pytest.fixture
def job(tmp_path: Path, folder: JobFolder) -> JobFile:
    return masking(folder, make_masks="region", regions=(str(write_cube(tmp_path / "box.json")),))


def masking(folder: JobFolder, **settings: Any) -> JobFile:
    """Return a job that wraps the photos of the sphere."""
    return make_job("wrap", Path(read_job(folder.job_path).source), JobSettings(**settings))


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Make left halves instead of silhouettes; return the folders in which they were made."""
    calls: list[Path] = []

    def make(scene: Scene, _job: JobFile, target: Path, *_: object, **__: object) -> None:
        calls.append(target)
        for index, view in enumerate(scene.views):
            left = np.zeros((view.camera.height, view.camera.width), bool)
            left[:, : view.camera.width // 2] = True
            (target / f"{index:06d}.png").write_bytes(encoded(left))

    monkeypatch.setattr(masks, "make_region_masks", make)
    return calls


def run(folder: JobFolder, job: JobFile) -> Stage:
    cameras = run_cameras(folder, job, Progress(), threads=1)
    return run_masks(folder, job, cameras, Progress(), threads=1, device=PROCESSOR)


def names_of(stage: Stage) -> list[str]:
    return [view.camera.name for view in load_saved_scene(stage.folder).views]


def finish_training(folder: JobFolder, job: JobFile, scene: Stage) -> None:
    key, _ = training_keys(scene.key, job)
    (folder.stages / f"train-{key}").mkdir()
    write_json(folder.stages / f"train-{key}" / "done.json", {"finished_unix_s": 9.0})


def test_all_photos_get_their_mask_and_masks_mean_background(
    folder: JobFolder, job: JobFile, made: list[Path], tmp_path: Path
) -> None:
    stage = run(folder, job)
    assert stage.name == MASKED
    assert [earlier.name for earlier in stage.before] == ["cameras", "masks"]
    again = run(folder, job)
    assert (again.reused, again.key, len(made)) == (True, stage.key, 1)
    listed = read_json(folder.root / "masks" / "masks.json")
    assert (listed["version"], listed["rejected"]) == (1, [])
    for entry in listed["masks"]:
        assert entry["file"] == f"{entry['photo']}.png"
        assert (folder.root / entry["image"]).is_file()
        assert (folder.root / "masks" / entry["file"]).is_file()
    moved = tmp_path / "elsewhere"
    shutil.move(folder.root, moved)
    scene = load_saved_scene(moved / "stages" / stage.folder.name)
    assert len(scene.views) == len(listed["masks"]) == COUNT
    assert scene.mask_mode("auto") == "background"
    assert scene.facts["photos_masked_to_object"] == COUNT
    for view in scene.views:
        assert view.photo_path.is_file()
        assert view.mask_path is not None
        mask = np.asarray(Image.open(view.mask_path)) == 255
        assert mask[:, : mask.shape[1] // 2].all()
        assert not mask[:, mask.shape[1] // 2 :].any()


def test_edits_rejections_and_deleted_files_change_the_key(
    folder: JobFolder, job: JobFile, made: list[Path]
) -> None:
    first = run(folder, job)
    masks = folder.root / "masks"
    names = names_of(first)
    listed = read_list(masks)
    assert listed is not None
    write_list(masks, listed.with_decision(names[0], accepted=False))
    (masks / f"{names[1]}.png").unlink()
    size = Image.open(masks / f"{names[2]}.png").size
    Image.new("L", size, 255).save(masks / f"{names[2]}.png")
    Image.new("L", size, 0).save(masks / f"{names[3]}.png")
    second = run(folder, job)
    assert second.key != first.key
    assert names_of(second) == [names[2], *names[4:]]
    scene = load_saved_scene(second.folder)
    assert scene.views[0].mask_path is not None
    assert (np.asarray(Image.open(scene.views[0].mask_path)) == 255).all()
    assert scene.facts["photos_rejected"] == 2
    assert [w.code for w in scene.warnings] == ["photos-without-object"]
    assert names_of(first) == names  # what was trained on does not change
    assert len(made) == 1


def test_a_finished_training_is_meshed_with_the_masks_that_it_had(
    folder: JobFolder, job: JobFile, made: list[Path], caplog: pytest.LogCaptureFixture
) -> None:
    first = run(folder, job)
    finish_training(folder, job, first)
    mesh = dataclasses.replace(job, command="mesh")
    assert run(folder, mesh).key == first.key
    assert "masks have changed" not in caplog.text
    (folder.root / "masks" / f"{names_of(first)[0]}.png").unlink()
    assert run(folder, mesh).key == first.key
    assert "masks have changed" in caplog.text
    assert run(folder, job).key != first.key
    # Photos that have changed as well: the scene of the training is found.
    next(Path(job.source).glob("*.png")).touch()
    stage = run(folder, mesh)
    assert (stage.name, stage.key) == (MASKED, first.key)
    assert len(made) == 1


def test_no_masks_are_made_unless_asked_for(folder: JobFolder, made: list[Path]) -> None:
    job = read_job(folder.job_path)
    assert run(folder, job).name == "cameras"
    assert not made
    assert not (folder.root / "masks").exists()


def test_a_mask_of_another_size_or_that_is_no_image_is_refused(
    folder: JobFolder, job: JobFile, made: list[Path]
) -> None:
    name = names_of(run(folder, job))[0]
    path = folder.root / "masks" / f"{name}.png"
    Image.new("L", (5, 5), 255).save(path)
    with pytest.raises(DatasetError, match=f"{name}.png is 5 x 5 pixels, its photo"):
        run(folder, job)
    path.write_bytes(b"no image")
    with pytest.raises(DatasetError):
        run(folder, job)
    (folder.root / "masks" / "masks.json").write_text("[]")
    with pytest.raises(ParseError, match="version 1 was expected"):
        run(folder, job)


def test_too_few_photos_are_refused(folder: JobFolder, job: JobFile, made: list[Path]) -> None:
    for name in names_of(run(folder, job))[2:]:
        (folder.root / "masks" / f"{name}.png").unlink()
    with pytest.raises(DatasetError, match=f"Masks leave 2 of {COUNT} photos; at least 3"):
        run(folder, job)


def test_masks_of_ones_own_are_refused_unless_they_mean_background(
    folder: JobFolder, job: JobFile, made: list[Path]
) -> None:
    cameras = run_cameras(folder, job, Progress(), threads=1)
    scene = load_saved_scene(cameras.folder)
    view = scene.views[0]
    top = np.zeros((view.camera.height, view.camera.width), bool)
    top[: view.camera.height // 2] = True
    own = cameras.folder / "own.png"
    own.write_bytes(encoded(top))
    views = (dataclasses.replace(view, mask_path=own), *scene.views[1:])
    save_scene(dataclasses.replace(scene, views=views), cameras.folder)
    with pytest.raises(UsageError, match=f"1 of {COUNT} photos have masks of their own"):
        run(folder, job)
    assert not made
    training = dataclasses.replace(job.settings.training, mask_mode="background")
    settings = dataclasses.replace(job.settings, training=training)
    stage = run(folder, dataclasses.replace(job, settings=settings))
    path = load_saved_scene(stage.folder).views[0].mask_path
    assert path is not None
    mask = np.asarray(Image.open(path)) == 255
    half = mask.shape[1] // 2
    assert (mask[:, :half] == top[:, :half]).all()  # what both keep
    assert not mask[:, half:].any()


def test_a_region_makes_masks_of_the_sphere(tmp_path: Path) -> None:
    """Before a plain background without points, where fog around the object would be as good."""
    scene, photos = sphere_scene(COUNT, 96)
    (tmp_path / "photos").mkdir()
    views = []
    for view, pixels in zip(scene.views, photos.photos, strict=True):
        sphere = sphere_seen(view.camera, np.zeros(3), 1.0)
        path = tmp_path / "photos" / view.camera.name
        Image.fromarray(np.where(sphere[..., None], pixels, WALL).astype(np.uint8)).save(path)
        views.append(dataclasses.replace(view, photo_path=path))
    box = write_cube(tmp_path / "box.json")
    settings = JobSettings(make_masks="region", regions=(str(box),))
    job = make_job("wrap", tmp_path / "photos", settings)
    target = tmp_path / "made"
    target.mkdir()
    scene = dataclasses.replace(scene, views=tuple(views))
    masks.make_region_masks(scene, job, target, Progress(), threads=1, device=PROCESSOR)
    for index, view in enumerate(views):
        mask = np.asarray(Image.open(target / f"{index:06d}.png")) == 255
        truth = sphere_seen(view.camera, np.zeros(3), 1.0)
        assert mask[truth].mean() >= 0.97  # nothing of the object is cut
        assert overlap(mask, truth) >= 0.75
        assert mask[~sphere_seen(view.camera, np.zeros(3), 1.3)].mean() < 0.02


def test_a_stopped_making_is_resumed(
    folder: JobFolder, job: JobFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(masks.COARSE, "iterations", 60)
    cameras = run_cameras(folder, job, Progress(), threads=1)
    iterations: list[float] = []

    def note(event: ProgressEvent) -> None:
        iterations.append(event.figures.get("iteration", 0.0))

    progress = Progress("masks", note, lambda: max(iterations, default=0.0) >= 30)
    with pytest.raises(Cancelled):
        run_masks(folder, job, cameras, progress, threads=1, device=PROCESSOR)
    assert not (folder.root / "masks").exists()
    (coarse,) = folder.stages.glob("masks-*/coarse")
    assert list(coarse.glob("checkpoint-*"))
    assert len(names_of(run(folder, job))) == COUNT


def test_a_region_with_nothing_in_it_is_refused(
    folder: JobFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(masks.COARSE, "iterations", 5)
    write_region(tmp_path / "far.json", Region("far", cube(1.4).vertices + np.array([50, 0, 0])))
    with pytest.raises(DatasetError, match="found nothing in the regions"):
        run(folder, masking(folder, make_masks="region", regions=(str(tmp_path / "far.json"),)))


def test_a_model_masks_the_bright_part_and_a_finished_training_needs_it_no_more(
    folder: JobFolder, tmp_path: Path
) -> None:
    pytest.importorskip("onnxruntime")
    path = onnx_files.written(tmp_path / "model.onnx", onnx_files.brightness(32))
    job = masking(folder, mask_model=str(path), mask_model_range="unit")
    check_mask_model(job, folder, Progress())
    stage = run(folder, job)
    for view in load_saved_scene(stage.folder).views:
        assert view.mask_path is not None
        mask = np.asarray(Image.open(view.mask_path)) == 255
        bright = np.asarray(Image.open(view.photo_path).convert("RGB")).mean(2) >= 127.5
        assert overlap(mask, bright) >= 0.97
    finish_training(folder, job, stage)
    path.unlink()
    assert run(folder, dataclasses.replace(job, command="mesh")).key == stage.key
    with pytest.raises(DatasetError, match="is not there"):
        run(folder, job)


@pytest.mark.parametrize("data", [b"no model", onnx_files.same_shape((1, 3))])
def test_a_model_that_is_none_is_refused_before_photos_are_read(
    folder: JobFolder, tmp_path: Path, data: bytes
) -> None:
    pytest.importorskip("onnxruntime")
    path = onnx_files.written(tmp_path / "model.onnx", data)
    with pytest.raises(DatasetError, match=r"mask model|ONNX model"):
        check_mask_model(masking(folder, mask_model=str(path)), folder, Progress())
