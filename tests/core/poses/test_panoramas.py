# SPDX-License-Identifier: GPL-3.0-or-later
"""Panoramas cut into views: directions, pixels, masks, poses given and solved."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gaussian_wrapping_addon.core.errors import DatasetError, UsageError
from gaussian_wrapping_addon.core.jobs.commands.estimate_command import input_facts
from gaussian_wrapping_addon.core.loading import load as load_module
from gaussian_wrapping_addon.core.loading.check import check_input
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.loading.other_inputs import with_views_of_panoramas
from gaussian_wrapping_addon.core.loading.real_world import UnitsRequest
from gaussian_wrapping_addon.core.loading.source_kind import read_poses, source_kind
from gaussian_wrapping_addon.core.photos.photo_file import AS_WRITTEN
from gaussian_wrapping_addon.core.poses.matching import pairs_by_pose
from gaussian_wrapping_addon.core.poses.panoramas import (
    BY_SHAPE,
    FIELD_OF_VIEW_DEG,
    STATED,
    VIEWS,
    panorama_evidence,
    panorama_pairs,
    panorama_pixels,
    view_lens,
    view_name,
)
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.scene import Scene
from gaussian_wrapping_addon.core.settings import JobSettings
from tests.core.poses.room import HALF, color_of, poses, write_panoramas
from tests.core.readers import writers
from tests.core.readers.writers import Shots

WIDTH = 400


def load(source: Path, work: Path, **more: Any) -> Scene:
    return load_scene(source, work, Progress(), seed=1, threads=1, **more)


def room_points(count: int = 400) -> np.ndarray:
    """Return (n, 3) points on the walls."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1.0, 1.0], count)
    return points * HALF


def test_views_see_what_the_panorama_shows_in_their_direction() -> None:
    """Pixel centres of each view, sent through the equirectangular formula of OpenSfM."""
    lens = view_lens(WIDTH)
    (fx, fy), (cx, cy) = lens.focal, lens.principal_point
    rng = np.random.default_rng(1)
    for view in VIEWS:
        rotation = view.cam_from_panorama
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        rows, columns = rng.integers(0, lens.width, (2, 50))
        local = np.stack([(columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones(50)], 1)
        x, y, z = (local @ rotation).T
        normalised = np.stack(
            [np.arctan2(x, z) / (2 * np.pi), np.arctan2(y, np.hypot(x, z)) / (2 * np.pi)], 1
        )
        expected = normalised * WIDTH + [WIDTH / 2, WIDTH / 4]
        np.testing.assert_allclose(
            panorama_pixels(view, WIDTH, WIDTH // 2)[rows, columns], expected, rtol=0, atol=1e-9
        )


def test_directions_of_views_are_those_said() -> None:
    forward = np.array([view.cam_from_panorama[2] for view in VIEWS])
    np.testing.assert_allclose(forward[0], [0, 0, 1], atol=1e-15)  # the photo's middle
    np.testing.assert_allclose(forward[2], [1, 0, 0], atol=1e-15)  # a quarter turn to the right
    assert (forward[8:11, 1] < -0.7).all()  # upwards: y is down
    assert (forward[11:, 1] > 0.7).all()
    # Every direction up to 10 degrees from the poles is in some view.
    lat, lon = np.meshgrid(np.radians(np.arange(-80, 81, 4)), np.radians(np.arange(0, 360, 4)))
    all_ways = np.stack(
        [np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], -1
    ).reshape(-1, 3)
    seen = np.zeros(len(all_ways), bool)
    half = np.tan(np.radians(0.5 * FIELD_OF_VIEW_DEG))
    for view in VIEWS:
        local = all_ways @ view.cam_from_panorama.T
        seen |= (local[:, 2] > 0) & (np.abs(local[:, :2]) <= half * local[:, 2:]).all(1)
    assert seen.all()


def posed_set(folder: Path, program: str, count: int = 3) -> Path:
    """Write panoramas with their poses in the file of a program, and 400 points."""
    names = write_panoramas(folder / "images", count, WIDTH)
    points = room_points()
    shots = Shots(names, poses(count), WIDTH, WIDTH // 2, {}, points=points)
    if program == "opensfm":
        return writers.write_opensfm(folder, shots, kind="spherical")
    if program == "metashape":
        return writers.write_metashape(folder, shots, kind="spherical")
    stored = dataclasses.replace(
        shots, stored_in="images/", lens={"camera_model": "EQUIRECTANGULAR"}
    )
    return writers.write_transforms(folder, stored)


@pytest.mark.parametrize("program", ["opensfm", "metashape", "transforms"])
def test_cameras_that_say_equirectangular(tmp_path: Path, program: str) -> None:
    model = read_poses(source_kind(posed_set(tmp_path, program)))
    assert [photo.is_panorama for photo in model.photos] == [True] * 3
    for photo, pose in zip(model.photos, poses(3), strict=True):
        np.testing.assert_allclose(photo.cam_from_world, pose, atol=1e-12)
    assert model.facts["camera_models"] == ["EQUIRECTANGULAR"]


def test_posed_panoramas_become_pinhole_photos_of_the_room(tmp_path: Path) -> None:
    source = posed_set(tmp_path / "set", "opensfm")
    scene = load(source, tmp_path / "work")
    assert len(scene.views) == 3 * len(VIEWS)
    assert scene.facts["panoramas"] == 3
    right, mirrored = [], []
    for view in scene.views:
        camera = view.camera.moved(scene.world_from_scene)
        photo = np.asarray(Image.open(view.photo_path).convert("RGB"), np.float64)
        assert photo.shape[:2] == (camera.height, camera.width)
        rays = camera.rays().reshape(-1, 3) @ camera.rotation
        truth = color_of(camera.center, rays).reshape(photo.shape)
        right.append(np.abs(truth - photo).mean())
        mirrored.append(np.abs(truth[:, ::-1] - photo).mean())
    # A panorama of 400 pixels cannot show the walls sharply; what is elsewhere differs much more.
    assert max(right) < 9.0
    assert (np.array(right) < 0.6 * np.array(mirrored)).all()
    world = scene.world_from_scene.points(scene.points)
    assert np.abs(np.abs(world) / HALF).max() == pytest.approx(1.0, abs=1e-4)


def test_masks_are_cut_as_well(tmp_path: Path) -> None:
    source = posed_set(tmp_path / "set", "opensfm")
    (tmp_path / "set" / "masks").mkdir()
    mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0  # all to the left of the middle
    Image.fromarray(mask).save(tmp_path / "set" / "masks" / "hall1.png")
    scene = load(source, tmp_path / "work")
    masks = {view.camera.name: view.mask_path for view in scene.views if view.mask_path}
    # Views that look to the right are kept altogether, those to the left are left out.
    assert view_name("hall1.png", 2) not in masks
    assert view_name("hall1.png", 6) not in {view.camera.name for view in scene.views}
    middle = masks[view_name("hall1.png", 0)]
    assert middle is not None
    kept = np.asarray(Image.open(middle)) > 127
    assert not kept[:, : kept.shape[1] // 2 - 1].any()
    assert kept[:, kept.shape[1] // 2 + 1 :].all()
    assert not any(name.startswith(("hall0", "hall2")) for name in masks)


def test_photos_of_another_shape_are_refused(tmp_path: Path) -> None:
    source = posed_set(tmp_path, "opensfm")
    Image.new("RGB", (300, 200), "white").save(tmp_path / "images" / "hall1.png")
    errors = [f.message for f in check_input(source) if f.severity == "error"]
    assert errors == ["hall1.png is 300 x 200 pixels; a panorama is twice as wide as high."]
    with pytest.raises(DatasetError, match="is 300 x 200 pixels; a panorama"):
        load(source, tmp_path / "work")


def test_only_sets_of_panoramas_are_taken_for_them(tmp_path: Path) -> None:
    names = write_panoramas(tmp_path, 3, 64)
    files = [tmp_path / name for name in names]
    assert panorama_evidence(files) == BY_SHAPE
    (warning,) = [f for f in check_input(tmp_path) if f.severity == "warning" and f.hint]
    assert "taken for 360 degree panoramas, as all are exactly twice as wide" in warning.message
    assert "--set equirectangular=off" in warning.hint
    for mode, count in (("off", 0), ("on", 1)):
        found = check_input(tmp_path, panoramas=mode)
        assert sum("360" in finding.message for finding in found) == count
        assert all("exactly twice" not in finding.message for finding in found)
    assert input_facts(tmp_path).photos == 3 * len(VIEWS)
    ordinary = dataclasses.replace(JobSettings(), equirectangular="off")
    assert input_facts(tmp_path, ordinary).photos == 3
    Image.new("RGB", (66, 32), "white").save(tmp_path / "other.png")
    assert not panorama_evidence([*files, tmp_path / "other.png"])
    assert input_facts(tmp_path).photos == 4
    assert not panorama_evidence([])


XMP = (
    b"<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:Description "
    b'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"%s</rdf:Description></x:xmpmeta>'
)


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize(
    ("said", "evidence"),
    [
        (b' GPano:ProjectionType="equirectangular">', STATED),
        (b"><GPano:ProjectionType> Equirectangular </GPano:ProjectionType>", STATED),
        (b" GPano:ProjectionType = 'cylindrical'>", ""),
        (b' GPano:StitchingSoftware="x">', BY_SHAPE),
    ],
)
def test_what_photos_say_of_their_projection_counts(
    tmp_path: Path, said: bytes, evidence: str, suffix: str
) -> None:
    files = [tmp_path / f"hall{i}.{suffix}" for i in range(3)]
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", (XMP % said).decode())
    for file in files[:2]:
        more = {"xmp": XMP % said} if suffix == "jpg" else {"pnginfo": text}
        Image.new("RGB", (128, 64), "white").save(file, **more)
    Image.new("RGB", (128, 64), "white").save(files[2])
    assert panorama_evidence(files) == evidence
    found = check_input(tmp_path)
    warned = any("exactly twice" in finding.message for finding in found)
    stated = any("The photos are 360 degree panoramas" in finding.message for finding in found)
    assert (warned, stated) == (evidence == BY_SHAPE, evidence == STATED)
    Image.new("RGB", (130, 64), "white").save(files[2])
    assert not panorama_evidence(files)  # cut, or not all are panoramas


def test_places_that_views_do_not_have_are_refused_at_once(tmp_path: Path) -> None:
    source = posed_set(tmp_path / "set", "transforms")
    with pytest.raises(UsageError, match="not read for 360 degree photos"):
        load(source, tmp_path / "work", units=UnitsRequest(georeference="on"))


def test_wide_frames_of_a_video_are_no_panoramas(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index in range(3):
        Image.new("RGB", (64, 32), (40 * index, 0, 0)).save(tmp_path / f"frame-{index}.png")
    solved: list[str] = []

    def solve(_root: Path, photos: list[Path], *_: object, **more: object) -> NoReturn:
        solved.extend(path.name for path in photos)
        raise DatasetError("enough", "")

    monkeypatch.setattr(load_module, "solve_poses", solve)
    with pytest.raises(DatasetError, match="enough"):
        load(tmp_path, tmp_path / "work", in_order=True)
    assert solved == ["frame-0.png", "frame-1.png", "frame-2.png"]


def test_cameras_that_are_no_panoramas_are_said(tmp_path: Path) -> None:
    names = write_panoramas(tmp_path / "images", 3, 64)
    shots = Shots(names, poses(3), 64, 32, {"focal": 0.9}, points=room_points())
    writers.write_opensfm(tmp_path, shots, kind="perspective")
    scene = load(tmp_path, tmp_path / "work", equirectangular="on")
    assert [w.code for w in scene.warnings if "panorama" in w.code] == ["no-panoramas"]
    assert len(scene.views) == 3


def test_masks_that_a_transforms_file_names(tmp_path: Path) -> None:
    path = posed_set(tmp_path / "set", "transforms")
    values = json.loads(path.read_text())
    values["frames"][0]["mask_path"] = "sky.png"
    values["frames"][1]["mask_path"] = "gone.png"
    path.write_text(json.dumps(values))
    mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    mask[: WIDTH // 4] = 0  # all above the horizon
    Image.fromarray(mask).save(tmp_path / "set" / "sky.png")
    model, kind = read_poses(source_kind(path)), source_kind(path)
    model, _ = with_views_of_panoramas(
        model, kind, tmp_path / "work", Progress(), AS_WRITTEN, threads=1
    )
    masks = {photo.name: photo.mask_path for photo in model.photos if photo.mask_path}
    assert sorted(masks) == [view_name("images/hall0.png", view) for view in range(len(VIEWS))]
    up = masks[view_name("images/hall0.png", 8)]
    assert up is not None
    assert not np.asarray(Image.open(up)).any()
    assert "1 masks were not used: gone.png is missing." in [w.text for w in model.warnings]


def test_views_of_one_place_are_not_matched() -> None:
    centers = np.repeat([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 3, axis=0)
    forwards = np.tile([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]], (2, 1))
    pairs = pairs_by_pose(centers, forwards)
    assert pairs
    assert all(i < 3 <= j for i, j in pairs)
    assert len(panorama_pairs(12)) == 66
    pairs = panorama_pairs(100)
    assert {(i, i + 1) for i in range(99)} <= set(pairs)
    assert len(pairs) == len(set(pairs)) < 900


@pytest.mark.proof
def test_panoramas_without_cameras_are_solved_as_a_rig(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    write_panoramas(tmp_path / "set", 3, 800)
    scene = load(tmp_path / "set", tmp_path / "work")
    assert scene.facts["panoramas_placed"] == 3
    assert len(scene.views) == 3 * len(VIEWS)
    by_name = {view.camera.name: view.camera for view in scene.views}
    centers = np.array([by_name[view_name(f"hall{i}.png", 0)].center for i in range(3)])
    for i in range(3):
        first = by_name[view_name(f"hall{i}.png", 0)]
        for number, view in enumerate(VIEWS):
            camera = by_name[view_name(f"hall{i}.png", number)]
            turn = camera.rotation @ first.rotation.T
            np.testing.assert_allclose(turn, view.cam_from_panorama, atol=1e-6)
            np.testing.assert_allclose(camera.center, first.center, atol=1e-6)
            assert camera.fx == pytest.approx(800 / (2 * np.pi))
    truth = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses(3)])
    for a, b, c in ((0, 1, 2), (1, 2, 0)):
        ours = np.linalg.norm(centers[a] - centers[b]) / np.linalg.norm(centers[b] - centers[c])
        theirs = np.linalg.norm(truth[a] - truth[b]) / np.linalg.norm(truth[b] - truth[c])
        assert ours == pytest.approx(theirs, rel=2e-3)
