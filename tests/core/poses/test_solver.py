# SPDX-License-Identifier: GPL-3.0-or-later
"""Solving cameras and start points: pairs, EXIF, sets too large for all pairs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from benchmarks.camera_places import Tracks, hall_tracks, write_database
from gaussian_wrapping_addon.core.errors import Cancelled, DatasetError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.limits import SCENE_RADIUS
from gaussian_wrapping_addon.core.loading.load import (
    RANDOM_POINTS,
    count_observing_views,
    load_scene,
    random_points,
)
from gaussian_wrapping_addon.core.photos.exif import read_lens_exif
from gaussian_wrapping_addon.core.poses import matching, solver
from gaussian_wrapping_addon.core.poses.checks import SOLUTION_NAME, TURNTABLE_NAME, check_solution
from gaussian_wrapping_addon.core.poses.matching import match_chosen
from gaussian_wrapping_addon.core.poses.solver_helper import place_one_by_one
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from gaussian_wrapping_addon.core.scene.camera import Camera, quaternion_from_rotation
from gaussian_wrapping_addon.core.scene.frames import CENTER_STEP
from tests.core.poses.test_checks import RIGHT
from tests.core.readers.model_writers import ring_model, write_binary
from tests.synthetic import look_at

BANANAS = Path(__file__).parents[3] / "examples" / "bananas"
NAMES = ("DSC_0423", "DSC_0424", "DSC_0425", "DSC_0438")


def small_bananas(folder: Path, long_side: int = 400) -> Path:
    """Write four neighbouring photos, scaled down, with the EXIF that tells the focal length."""
    folder.mkdir()
    for name in NAMES:
        with Image.open(BANANAS / f"{name}.JPG") as image:
            exif = image.getexif()
            exif.get_ifd(0x8769)
            size = (long_side, round(long_side * image.height / image.width))
            small = image.resize(size, Image.Resampling.LANCZOS)
        small.save(folder / f"{name}.jpg", quality=95, exif=exif)
    return folder


def test_focal_length_from_exif(tmp_path: Path) -> None:
    read = read_lens_exif(BANANAS / "DSC_0423.JPG", 1000, 665)
    # 60 mm on 36 x 24 mm, by the diagonal; the solved focal length is 1733 px.
    assert read.focal_px == pytest.approx(60 * np.hypot(1000, 665) / np.hypot(36, 24))
    assert read.key[:2] == ("NIKON CORPORATION", "NIKON D3200")
    Image.new("RGB", (40, 30)).save(tmp_path / "plain.png")
    assert read_lens_exif(tmp_path / "plain.png", 40, 30).focal_px is None
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x920A] = 50.0  # 50 mm ...
    exif.get_ifd(0x8769)[0xA20E] = 2000.0  # ... on a sensor of 2000 pixels a centimetre
    exif.get_ifd(0x8769)[0xA210] = 3
    exif.get_ifd(0x8769)[0xA002] = 400
    Image.new("RGB", (40, 30)).save(tmp_path / "plane.jpg", exif=exif)
    assert read_lens_exif(tmp_path / "plane.jpg", 40, 30).focal_px == pytest.approx(1000.0)


def test_photos_alone_are_solved_with_progress(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    source = small_bananas(tmp_path / "photos")
    events: list[ProgressEvent] = []
    scene = load_scene(source, tmp_path / "work", Progress("cameras", events.append), seed=3)
    assert len(scene.views) == len(NAMES)
    assert scene.facts["photos_with_focal_length"] == len(NAMES)
    assert scene.facts["mean_reprojection_error_px"] < 0.6
    assert len(scene.points) > 300
    # Full-size photos give 1733 px at a width of 1000.
    assert scene.cameras[0].fx / scene.cameras[0].width == pytest.approx(1.733, rel=0.1)
    seen = count_observing_views(scene.cameras, scene.points)
    assert np.mean(seen >= 2) > 0.99
    fractions = [event.fraction for event in events]
    assert fractions == sorted(fractions)
    assert any("searching features" in event.message for event in events)
    assert any("placing photo" in event.message for event in events)
    assert not (tmp_path / "work" / "pose_solver").exists()
    assert (tmp_path / "work" / "cameras" / "images.bin").is_file()


def textured_plane(folder: Path, count: int = 4) -> list[Camera]:
    """Write photos of a noisy plane z = 0 and their poses, as a COLMAP model without points."""
    rng = np.random.default_rng(7)
    noise = rng.uniform(size=(700, 700, 3))
    texture = sum(ndimage.gaussian_filter(noise, (s, s, 0)) * s for s in (1, 2, 4, 8))
    texture = (texture - texture.min()) / np.ptp(texture) * 255
    width, height, focal_px = 240, 180, 225.0
    model = ring_model(count)
    model.cameras = [(1, "PINHOLE", width, height, [focal_px, focal_px, width / 2, height / 2])]
    model.points = []
    (folder / "images").mkdir(parents=True)
    cameras = []
    for i, image in enumerate(model.images):
        center = np.array([1.2 * np.cos(0.25 * i), 1.2 * np.sin(0.25 * i), 2.5])
        camera = look_at(center, np.zeros(3), str(image.name), width, height, focal_px)
        rays = camera.rays().reshape(-1, 3) @ camera.rotation
        hits = center + rays * (-center[2] / rays[:, 2:])
        where = (hits[:, :2] / 6.0 + 0.5) * 700
        pixels = [ndimage.map_coordinates(texture[..., c], where.T, order=1) for c in range(3)]
        photo = np.stack(pixels, 1).reshape(height, width, 3)
        Image.fromarray(np.rint(photo).astype(np.uint8)).save(folder / "images" / str(image.name))
        image.quaternion = quaternion_from_rotation(camera.rotation)
        image.translation = camera.cam_from_world[:, 3]
        image.points2d = []
        cameras.append(camera)
    write_binary(model, folder / "sparse")
    return cameras


def test_points_are_triangulated_from_posed_photos(tmp_path: Path) -> None:
    """A model without points: the poses stay, the points come from the photos, on the plane."""
    pytest.importorskip("pycolmap")
    cameras = textured_plane(tmp_path / "set")
    scene = load_scene(tmp_path / "set", tmp_path / "work", Progress(), seed=1, threads=1)
    for camera, moved in zip(cameras, scene.cameras, strict=True):
        center = scene.world_from_scene.points(moved.center[None])[0]
        step = CENTER_STEP * scene.world_from_scene.scale
        np.testing.assert_allclose(center, camera.center, rtol=0, atol=step)
    assert scene.facts["start_points"] == "triangulated from the photos"
    assert len(scene.points) >= 200
    world = scene.world_from_scene.points(scene.points)
    assert np.percentile(np.abs(world[:, 2]), 90) < 0.02  # cameras are 2.8 away
    assert scene.point_colors.std(0).min() > 5
    again = load_scene(tmp_path / "set", tmp_path / "work2", Progress(), seed=1, threads=1)
    np.testing.assert_array_equal(again.points, scene.points)


def test_posed_photos_without_texture_start_from_random_points(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    model = ring_model(6)
    model.points = []
    write_binary(model, tmp_path / "set" / "sparse")
    (tmp_path / "set" / "images").mkdir()
    ramp = np.repeat(np.linspace(60, 120, 64)[None], 48, 0)  # of more than one colour
    plain = np.rint(np.stack([ramp] * 3, 2)).astype(np.uint8)
    for image in model.images:
        Image.fromarray(plain).save(tmp_path / "set" / "images" / str(image.name))
    scene = load_scene(tmp_path / "set", tmp_path / "work", Progress())
    assert scene.facts["start_points"] == "random"
    assert len(scene.points) > 1000
    assert "random ones are used" in " ".join(w.text for w in scene.warnings)
    assert (count_observing_views(scene.cameras, scene.points) >= 2).all()


def test_random_points_lie_where_cameras_look() -> None:
    cameras = [
        look_at(np.array([4 * np.cos(a), 4 * np.sin(a), 1.0]), np.zeros(3), "x", 64, 48, 60.0)
        for a in np.linspace(0, 6, 9)
    ]
    points = random_points(cameras, seed=0)
    assert points.shape == (RANDOM_POINTS, 3)
    assert (count_observing_views(cameras, points) >= 2).all()
    assert np.linalg.norm(points, axis=1).max() < SCENE_RADIUS
    np.testing.assert_array_equal(points, random_points(cameras, seed=0))


def _texture_free(folder: Path) -> Path:
    folder.mkdir()
    for i in range(4):
        Image.new("RGB", (120, 90), (100 + i, 90, 80)).save(folder / f"{i}.png")
    return folder


def test_a_part_that_stays_apart_has_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(7):
        Image.new("RGB", (80, 60), (40 * number, 0, 0)).save(photos / f"shot{number}.png")

    def solve(_: str, folder: Path, *__: object, **___: object) -> None:
        model = ring_model(4)
        for number, image in enumerate(model.images):
            image.name = f"{number:06d}.jpg"
        write_binary(model, folder / "model")
        write_json(folder / TURNTABLE_NAME, {"photos": 0})
        apart = [["000004.jpg", "000005.jpg"]]
        write_json(folder / SOLUTION_NAME, {**RIGHT, "parts": [[]], "apart": apart})

    monkeypatch.setattr(solver, "run_helper", solve)
    solved = solver.solve_poses(
        photos, sorted(photos.iterdir()), [], tmp_path / "work", Progress(), threads=1
    )
    told = {warning.code: warning.text for warning in solved.warnings}
    assert sorted(told) == ["cameras-in-parts", "photos-not-placed"]
    assert "shot4.png, shot5.png" in told["cameras-in-parts"]
    assert (
        "1 of 7 photos could not be placed and are not used: shot6.png"
        in (told["photos-not-placed"])
    )


def test_photos_without_texture_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    source = _texture_free(tmp_path / "flat")
    with pytest.raises(DatasetError, match="could be placed") as caught:
        load_scene(source, tmp_path / "work", Progress())
    assert "overlap" in caught.value.hint


def test_cancelling_ends_the_helper(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    source = small_bananas(tmp_path / "photos")
    messages: list[str] = []
    progress = Progress(
        "cameras",
        lambda event: messages.append(event.message),
        lambda: any("searching" in message for message in messages),
    )
    with pytest.raises(Cancelled):
        load_scene(source, tmp_path / "work", progress)
    assert not any("placing" in message for message in messages)


pycolmap = pytest.importorskip("pycolmap")
PHOTOS = 36


def _features(folder: Path) -> tuple[Path, Tracks]:
    """Write features without matches; what looks the same has nearly the same descriptor."""
    tracks = hall_tracks(PHOTOS, 200, repeats=1, seed=0)
    database = folder / "database.db"
    write_database(database, tracks, seed=0)
    chance = np.random.default_rng(0)
    of_look = chance.gamma(0.4, 60.0, (5000, 128))
    with pycolmap.Database.open(database) as db:
        db.clear_two_view_geometries()
        db.clear_matches()
        for image in db.read_all_images():
            look = tracks.looks[[camera.name for camera in tracks.cameras].index(image.name)]
            noisy = of_look[look] + chance.normal(0.0, 8.0, (len(look), 128))
            found = pycolmap.FeatureDescriptors()
            found.type = pycolmap.FeatureExtractorType.SIFT
            found.data = noisy.clip(0, 255).astype(np.uint8)
            db.write_descriptors(image.image_id, found)
    (folder / "images").mkdir()
    return database, tracks


def test_chosen_pairs_give_right_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (matching, matching):
        monkeypatch.setattr(module, "EXHAUSTIVE_LIMIT", 10)
    monkeypatch.setattr(matching, "ALIKE_NEIGHBOURS", 6)
    monkeypatch.setattr(matching, "WELL_CONNECTED", 4)
    said: list[float] = []
    monkeypatch.setattr(matching, "emit", lambda **values: said.append(values["fraction"]))
    database, tracks = _features(tmp_path)
    names = sorted(camera.name for camera in tracks.cameras)
    task: dict[str, Any] = {
        "seed": 0, "threads": 1, "in_order": False, "positions": [None] * PHOTOS,
    }  # fmt: skip
    match_chosen(tmp_path, database, task, names)
    pairs = [(names.index(a), names.index(b)) for a, b in task["pairs"]]
    assert len(set(pairs)) == len(pairs) < PHOTOS * (PHOTOS - 1) / 4
    around = {(i, (i + 1) % PHOTOS) for i in range(PHOTOS)}
    assert {(min(p), max(p)) for p in around} <= set(pairs)  # the first and the last, too
    assert said == sorted(said)
    model = place_one_by_one(database, tmp_path, 0, PHOTOS)[0]
    assert model.num_reg_images() == PHOTOS
    verdict = check_solution(database, model)
    assert not verdict.contradicting
    assert len(verdict.parts(names)) == 1
