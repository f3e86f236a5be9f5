# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole inputs of HEIC and RAW photos: loaded, converted beside the job, masked, undistorted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import MissingExtraError
from gaussian_wrapping_addon.core.jobs.store.stage_folder import source_fingerprint
from gaussian_wrapping_addon.core.loading import load as load_module
from gaussian_wrapping_addon.core.loading.check import check_input
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.photos.photo_file import read_photo
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.poses import solver as pose_solver
from gaussian_wrapping_addon.core.poses.solver import MAX_SIFT_PX, solve_poses
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.scene import Scene
from gaussian_wrapping_addon.core.worker import environment
from tests.core.photos.camera_files import write_dng
from tests.core.readers.model_writers import write_project

pillow_heif = pytest.importorskip("pillow_heif")


pytest.importorskip("rawpy")


def camera_project(folder: Path, **arguments: object) -> Path:
    """A COLMAP project whose photos are two HEIC, two DNG and a PNG."""
    pillow_heif.register_heif_opener()
    source = folder / "set"
    write_project(source, **arguments)  # type: ignore[arg-type]
    for k in range(4):
        path = source / "images" / f"p{k:02d}.png"
        pixels = np.asarray(Image.open(path).convert("RGB"))
        if k < 2:
            Image.fromarray(pixels).save(path.with_suffix(".heic"), quality=95, chroma=444)
        else:
            write_dng(path.with_suffix(".dng"), (pixels / 255.0) ** 2.2)
        path.unlink()
    return source


def load(source: Path) -> Scene:
    return load_scene(source, source.parent / "work", Progress(), threads=2)


def test_converted_copies_lie_with_the_job(tmp_path: Path) -> None:
    source = camera_project(tmp_path)
    before = {p: p.stat().st_mtime_ns for p in source.rglob("*")}
    scene = load(source)
    assert {p: p.stat().st_mtime_ns for p in source.rglob("*")} == before
    work = tmp_path / "work" / "images"
    places = [view.photo_path.parent for view in scene.views]
    assert places == [work] * 4 + [source / "images"]
    assert all(view.photo_path.suffix in (".jpg", ".png") for view in scene.views)
    store = PhotoStore(scene, 4000)
    for k, name in enumerate(("p00.heic", "p01.heic", "p02.dng", "p03.dng")):
        own = read_photo(source / "images" / name).color.astype(int)
        assert np.abs(store.photo(k) - own).mean() < 2, "a JPEG of high quality"
    assert [w.code for w in scene.warnings] == ["photos-renamed"]
    names = {name for name, _, _ in source_fingerprint(source)}
    assert {"images/p00.heic", "images/p03.dng"} <= names


def test_masks_and_lenses_apply_to_them(tmp_path: Path) -> None:
    source = camera_project(tmp_path, model="SIMPLE_RADIAL", params=[60.0, 32.0, 24.0, -0.1])
    mask = np.zeros((48, 64), np.uint8)
    mask[:, 32:] = 255
    (source / "masks").mkdir()
    Image.fromarray(mask).save(source / "masks" / "p00.heic.png")
    Image.fromarray(mask).save(source / "images" / "p02_mask.png")
    scene = load(source)
    assert scene.facts["photos_undistorted"] == 5
    assert scene.facts["photos_masked"] == 2
    store = PhotoStore(scene, 4000)
    for k in (0, 2):
        found = store.mask(k)
        assert not found[:, : found.shape[1] // 2 - 1].any()
        assert found[:, found.shape[1] // 2 + 1 :].all()
    assert store.mask(1) is None


def test_copies_of_the_same_photo_are_said(tmp_path: Path) -> None:
    assert load_module.second_copies_warning(tmp_path) == []
    for k in range(4):
        Image.fromarray(np.full((40, 60, 3), 40 * k, np.uint8)).save(tmp_path / f"{k}.jpg")
        (tmp_path / f"{k}.NEF").write_bytes(b"II*\0")
    (warning,) = load_module.second_copies_warning(tmp_path)
    assert warning.text.startswith("4 HEIC or RAW files are left out")
    assert "0.NEF, 1.NEF, 2.NEF ..." in warning.text
    assert "move the images away" in warning.hint
    told = [f.message for f in check_input(tmp_path) if f.severity == "warning"]
    assert warning.text in told


def test_a_missing_package_ends_the_job_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = camera_project(tmp_path)
    monkeypatch.setattr(
        environment, "EXTRAS",
        [environment.Extra(e.name, e.packages, "gw_none", e.title, e.purpose)
         for e in environment.EXTRAS],
    )  # fmt: skip
    with pytest.raises(MissingExtraError) as caught:
        load(source)
    assert caught.value.extras == ("heif", "raw")
    assert "p00.heic, p01.heic" in caught.value.message
    assert not list((tmp_path / "work").iterdir())
    photos = tmp_path / "photos"
    (source / "images").rename(photos)
    with pytest.raises(MissingExtraError, match=r"p02\.dng, p03\.dng"):
        load_scene(photos, tmp_path / "work2", Progress())


def test_the_solver_gets_half_developed_photos_of_the_same_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of large RAW photos; cameras are those of the full size."""
    size = (2 * MAX_SIFT_PX * 3 // 4, 2 * MAX_SIFT_PX)
    ramp = np.linspace(0.1, 0.9, size[1])[None, :, None] * np.ones((size[0], 1, 3))
    photos = [write_dng(tmp_path / f"{k}.dng", ramp) for k in range(3)]
    seen: dict[str, object] = {}

    def stop(_module: str, folder: Path, *_: object, **__: object) -> None:
        seen["task"] = json.loads((folder / "task.json").read_text())
        seen["sizes"] = {Image.open(p).size for p in (folder / "images").iterdir()}
        raise KeyboardInterrupt

    monkeypatch.setattr(pose_solver, "run_helper", stop)
    with pytest.raises(KeyboardInterrupt):
        solve_poses(tmp_path, photos, [], tmp_path / "work", Progress(), threads=1)
    assert seen["sizes"] == {(MAX_SIFT_PX, MAX_SIFT_PX * 3 // 4)}
    (group,) = seen["task"]["groups"]  # type: ignore[index]
    diagonal = np.hypot(MAX_SIFT_PX, MAX_SIFT_PX * 3 // 4) / np.hypot(36, 24)
    assert group["focal_px"] == pytest.approx(36 * diagonal)
