# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene gets its metres from GPS, control points or markers when it is loaded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError, UsageError, WorkerError
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.jobs.commands.export_files import frames_of
from gaussian_wrapping_addon.core.jobs.stages.cameras import write_scene_summary
from gaussian_wrapping_addon.core.jobs.stages.texture import _place_in_metres
from gaussian_wrapping_addon.core.jobs.store.job_file import sidecar_path, write_sidecar
from gaussian_wrapping_addon.core.loading import load, real_world
from gaussian_wrapping_addon.core.loading.real_world import UnitsRequest
from gaussian_wrapping_addon.core.loading.source_kind import read_poses, source_kind
from gaussian_wrapping_addon.core.photos.exif import read_gps_exif
from gaussian_wrapping_addon.core.photos.photo_file import apply_orientation, stored_pixels
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.frames import FileFrame
from gaussian_wrapping_addon.core.scene.placement import FILE_NAME, write_placement
from gaussian_wrapping_addon.core.scene.scene import Scene
from gaussian_wrapping_addon.core.units.georeference import (
    GeoPoint,
    blender_start,
    enu_from_geographic,
    geographic_from_enu,
)
from gaussian_wrapping_addon.core.units.markers import MarkerScale
from gaussian_wrapping_addon.core.worker import environment
from tests.poses import look_at_pose

PLACE = GeoPoint(47.2, 8.6, 430.0)
UNIT_M = 7.0
"""Metres of a unit of the cameras' frame."""
WIDTH, HEIGHT = 64, 48
LOCAL_ORIGIN = np.array([1000.0, 2000.0, 50.0])


def turn() -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


WORLD_FROM_ENU = Similarity(1.0 / UNIT_M, turn(), np.array([3.0, -1.0, 2.0]))


def enu_centers(count: int) -> np.ndarray:
    i = np.arange(count)
    return np.stack([30 * np.cos(i), 30 * np.sin(i), 25.0 + 4 * (i % 4)], 1)


def cameras(count: int = 12) -> list[Camera]:
    """Return cameras in the input's frame, which is neither level nor metric."""
    return [
        Camera(
            f"p{i:02d}.jpg", WIDTH, HEIGHT, 60, 60, 32, 24, look_at_pose(place, [0, 0, 2.0])
        ).moved(WORLD_FROM_ENU)
        for i, place in enumerate(enu_centers(count))
    ]


def gps_exif(place: np.ndarray) -> Image.Exif:
    exif = Image.Exif()
    latitude, longitude, altitude = (float(v) for v in place)
    exif[0x8825] = {
        1: "N", 2: (latitude, 0.0, 0.0), 3: "E", 4: (longitude, 0.0, 0.0), 5: b"\0", 6: altitude,
    }  # fmt: skip
    return exif


def write_set(folder: Path, *, gps: bool = True, error_m: float = 0.5, count: int = 12) -> Path:
    """Write photos, with GPS off by some error, and their cameras as transforms.json."""
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    places = geographic_from_enu(enu_centers(count) + rng.normal(0, error_m, (count, 3)), PLACE)
    frames = []
    for camera, place in zip(cameras(count), places, strict=True):
        pixels = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
        more = {"exif": gps_exif(place)} if gps else {}
        Image.fromarray(pixels).save(folder / "images" / camera.name, **more)
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = camera.center
        frames.append({"file_path": f"images/{camera.name}", "transform_matrix": pose.tolist()})
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": 60, "fl_y": 60, "cx": 32, "cy": 24}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


@pytest.fixture(autouse=True)
def no_start_points(monkeypatch: pytest.MonkeyPatch) -> None:
    none = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "none")
    monkeypatch.setattr(load, "make_start_points", lambda *_args, **_more: none)


def loaded(folder: Path, **request: str) -> Scene:
    units = UnitsRequest(**request)
    return load.load_scene(folder, folder.parent / "work", Progress(), threads=1, units=units)


def solved(folder: Path, monkeypatch: pytest.MonkeyPatch, **request: str) -> Scene:
    """Load the photos alone, as if their cameras had just been solved."""
    model = read_poses(source_kind(folder))
    (folder / "transforms.json").unlink()
    monkeypatch.setattr(load, "solve_poses", lambda *_args, **_more: model)
    return loaded(folder, **request)


def test_photos_alone_get_metres_up_and_a_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = solved(write_set(tmp_path / "set"), monkeypatch)
    record = scene.facts["georeference"]
    assert (record["applied"], record["sources"], record["z_up"]) == (True, ["gps"], True)
    assert record["utm"]["zone"] == "32N"
    assert scene.facts["up_from"] == "metric frame"
    assert record["world_from_input"]["scale"] == pytest.approx(UNIT_M, rel=0.02)
    # World: metres east, north, up of the origin; scene: level.
    origin = GeoPoint(**record["origin"])
    found = scene.world_from_scene.points(np.array([c.center for c in scene.cameras]))
    wanted = enu_from_geographic(geographic_from_enu(enu_centers(12), PLACE), origin)
    assert np.linalg.norm(found - wanted, axis=1).max() < 1.0
    np.testing.assert_allclose(scene.world_from_scene.rotation[2], [0, 0, 1], atol=1e-5)


def test_what_is_off_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = solved(write_set(tmp_path / "a" / "set", gps=False), monkeypatch)
    off = solved(write_set(tmp_path / "b" / "set"), monkeypatch, georeference="off")
    for scene in (plain, off):
        assert not {"georeference", "georeference_note"} & set(scene.facts)
        assert scene.warnings == plain.warnings
        assert scene.world_from_scene.to_json() == plain.world_from_scene.to_json()
        for camera, same in zip(scene.cameras, plain.cameras, strict=True):
            np.testing.assert_array_equal(camera.cam_from_world, same.cam_from_world)


def test_given_cameras_keep_their_world_but_the_place_is_recorded(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "set")
    auto = loaded(folder)
    off = loaded(folder, georeference="off")
    assert auto.world_from_scene.to_json() == off.world_from_scene.to_json()
    record = auto.facts["georeference"]
    assert record["applied"] is False
    assert record["metric_from_world"]["scale"] == pytest.approx(UNIT_M, rel=0.02)
    assert record["world_from_input"] == Similarity().to_json()
    assert blender_start(record, auto.world_from_scene) is None
    on = loaded(folder, georeference="on")
    assert on.facts["georeference"]["applied"] is True
    assert on.facts["georeference"]["world_from_input"] == record["metric_from_world"]


def test_bad_gps_is_refused_or_noted(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "set", error_m=25.0)
    scene = loaded(folder)
    assert "georeference" not in scene.facts
    assert "GPS" in scene.facts["georeference_note"] or "agree" in scene.facts["georeference_note"]
    with pytest.raises(DatasetError, match=r"GPS does not place the scene: .*--set georeference"):
        loaded(folder, georeference="on")
    bare = write_set(tmp_path / "bare", gps=False)
    with pytest.raises(DatasetError, match="0 of 12 photos have a GPS position"):
        loaded(bare, georeference="on")


@pytest.mark.parametrize("format", ["ply", "glb", "obj"])
def test_the_sidecar_leads_from_the_mesh_to_the_gps_positions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str
) -> None:
    folder = write_set(tmp_path / "set")
    scene = solved(folder, monkeypatch)
    result = tmp_path / "job" / "result"
    result.mkdir(parents=True)
    write_scene_summary(result / "scene.json", scene)
    _place_in_metres(result, result, scene)
    world_from_scene, blender_from_scene = frames_of(result)
    centers = np.array([c.center for c in scene.cameras])
    exif = [read_gps_exif(folder / c.name) for c in scene.cameras]
    for placed in (False, True):
        target = blender_from_scene if placed else world_from_scene
        frame = FileFrame(format, target, np.zeros(3) if placed else np.array([3.0, 5.0, 8.0]))
        file = tmp_path / f"mesh.{format}"
        write_sidecar(
            file, frame, world_from_scene, blender_from_scene,
            placed=placed, result=result, contents={},
        )  # fmt: skip
        in_file = frame.file_from_scene().points(centers)
        # From here on, the sidecar alone.
        sidecar = read_json(sidecar_path(file))
        record = sidecar["georeference"]
        metric = Similarity.from_json(record["metric_from_file"]).points(in_file)
        places = geographic_from_enu(metric, GeoPoint(**record["origin"]))
        again = enu_from_geographic(places, PLACE)
        gps = np.array([(p.latitude_deg, p.longitude_deg, p.altitude_m) for p in exif if p])
        distances = np.linalg.norm(again - enu_from_geographic(gps, PLACE), axis=1)
        assert len(gps) == 12
        # The scene rounds camera centres to a grid of 7e-6 units of 7 m or more.
        assert np.median(distances) == pytest.approx(record["gps"]["median_m"], abs=2e-3)
        assert distances.max() == pytest.approx(record["gps"]["max_m"], abs=2e-3)
        assert sidecar["unit"].startswith("metre")


def test_the_first_placement_is_metric_and_one_made_in_blender_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = solved(write_set(tmp_path / "set"), monkeypatch)
    result, new = tmp_path / "result", tmp_path / "new"
    result.mkdir()
    new.mkdir()
    write_scene_summary(result / "scene.json", scene)
    _place_in_metres(result, new, scene)
    (new / FILE_NAME).rename(result / FILE_NAME)
    world_from_scene, placed = frames_of(result)
    np.testing.assert_allclose(placed.matrix(), world_from_scene.matrix(), atol=1e-12)
    mine = Similarity(2.0)
    write_placement(result / FILE_NAME, mine, scene.world_from_scene)
    _place_in_metres(result, new, scene)
    assert not (new / FILE_NAME).exists()
    write_placement(result / FILE_NAME, mine, Similarity(3.0))  # of other cameras
    _place_in_metres(result, new, scene)
    assert (new / FILE_NAME).is_file()


def test_far_coordinates_are_placed_near_the_origin() -> None:
    record = {"metric_from_world": Similarity().to_json(), "applied": True, "z_up": True}
    far = Similarity(2.0, np.eye(3), np.array([512345.6, 5200000.4, 300.2]))
    start = blender_start(record, far)
    np.testing.assert_allclose(start.translation, [-0.4, 0.4, 0.2], atol=1e-6)
    level = blender_start({**record, "z_up": False}, far)
    assert (level.scale, *level.translation) == (2.0, 0.0, 0.0, 0.0)
    skewed = {**Similarity().to_json(), "rotation": [[1, 0, 0], [0, 1, 0], [0, 0.1, 1]]}
    mirrored = {**Similarity().to_json(), "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}
    negative = {**Similarity().to_json(), "scale": -1.0}
    wrong = [{**record, "metric_from_world": w} for w in (skewed, mirrored, negative, {}, 3)]
    for broken in (None, [], {"applied": True}, *wrong):
        assert blender_start(broken, far) is None


def control_text(count: int, *, wrong: int = -1) -> str:
    """Return a file of local control points with exact pixels."""
    marks = np.random.default_rng(2).uniform(-6, 6, (count, 3)) + np.array([0, 0, 2.0])  # ENU
    local = marks + LOCAL_ORIGIN
    lines = ["LOCAL"]
    for i, mark in enumerate(marks):
        place = local[i] + (i == wrong) * np.array([0.0, 3.0, 0.0])
        for camera in cameras()[:6]:
            pixel, _ = camera.project(WORLD_FROM_ENU.points(mark[None]))
            x, y = pixel[0]
            if 0 < x < WIDTH and 0 < y < HEIGHT:
                lines.append(f"{place[0]} {place[1]} {place[2]} {x} {y} {camera.name} mark{i}")
    return "\n".join(lines) + "\n"


def test_control_points_give_their_frame(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "set", gps=False)
    path = tmp_path / "gcp.txt"
    path.write_text(control_text(6, wrong=2))
    scene = loaded(folder, control_points=str(path))
    record = scene.facts["georeference"]
    assert record["frame"] == "local coordinates of the control points"
    assert (record["applied"], record["origin"], record["crs"]) == (True, None, None)
    found = scene.world_from_scene.points(np.array([c.center for c in scene.cameras]))
    wanted = enu_centers(12) + LOCAL_ORIGIN
    np.testing.assert_allclose(found, wanted, atol=1e-3)
    (warning,) = [w for w in scene.warnings if w.code == "control-points-wrong"]
    assert "mark2 by 3 m" in warning.text


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("5 5 p00.jpg a\n0 0 0 5 5 other.jpg", "gcp.txt, line 3: there is no photo other.jpg"),
        ("5 500 p00.jpg", "gcp.txt, line 2: the pixel lies outside of p00.jpg"),
        ("5 5 p00.jpg", "0 control points are seen in two placed photos"),
    ],
)
def test_control_points_that_fit_no_photo(tmp_path: Path, lines: str, words: str) -> None:
    folder, path = write_set(tmp_path / "set", gps=False), tmp_path / "gcp.txt"
    path.write_text(f"LOCAL\n0 0 0 {lines} a\n")
    with pytest.raises(DatasetError, match=words):
        loaded(folder, control_points=str(path))


@pytest.mark.parametrize("scale", [1.004, 1.3])
def test_markers_decide_the_scale_and_gps_the_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scale: float
) -> None:
    found = MarkerScale(scale * UNIT_M, 5e-4, {"markers": {"used": 3}})
    monkeypatch.setattr(real_world, "find_markers", lambda *_args, **_more: {})
    monkeypatch.setattr(real_world, "scale_from_markers", lambda *_args: found)
    monkeypatch.setattr(real_world, "load_extra", lambda *_args: None)
    scene = solved(write_set(tmp_path / "set"), monkeypatch, markers="4x4_50:0.1")
    told = [w.text for w in scene.warnings if w.code == "scales-contradict"]
    assert len(told) == (scale == 1.3)
    assert all("The scale by markers is +29 % off that by gps" in text for text in told)
    given = loaded(write_set(tmp_path / "given"), markers="4x4_50:0.1").facts["georeference"]
    # Given cameras keep their axes: GPS only checks.
    assert (given["sources"], given["z_up"]) == (["markers", "gps"], False)
    assert given["world_from_input"]["rotation"] == np.eye(3).tolist()
    if scale < 1.3:
        record = scene.facts["georeference"]
        assert record["sources"] == ["gps", "markers"]
        assert record["world_from_input"]["scale"] == pytest.approx(scale * UNIT_M)
        assert (record["scale_error"], record["z_up"]) == (5e-4, True)


def test_what_is_wrong_is_told_before_cameras_are_solved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_set(tmp_path / "set", gps=False)

    def solve(*_arguments: Any, **_more: Any) -> Any:
        raise AssertionError("cameras are solved")

    monkeypatch.setattr(load, "solve_poses", solve)
    (folder / "transforms.json").unlink()
    words = "GPS does not place the scene: 0 of 12 photos have a GPS position; 5 are needed"
    with pytest.raises(DatasetError, match=words) as refused:
        loaded(folder, georeference="on")
    assert "leave --set georeference out" in refused.value.hint
    UnitsRequest("on", control_points="x").check_gps([])  # control points place it
    with pytest.raises(AssertionError, match="cameras are solved"):
        loaded(folder)
    with pytest.raises(DatasetError, match="cannot be read"):
        loaded(folder, control_points=str(tmp_path / "none.txt"))
    with pytest.raises(UsageError, match="no marker dictionary '9x9'"):
        loaded(folder, markers="9x9:0.1")

    def missing(_name: str) -> Any:
        raise ModuleNotFoundError("No module named 'cv2'", name="cv2")

    monkeypatch.setattr(environment.importlib, "import_module", missing)
    with pytest.raises(WorkerError, match=r"printed markers.*--add markers"):
        loaded(folder, markers="4x4_50:0.1")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright_pixels_are_found_in_the_stored_photo(orientation: int) -> None:
    stored = np.arange(5 * 7).reshape(5, 7)
    upright = apply_orientation(stored, orientation)
    height, width = upright.shape
    for y, x in np.ndindex(height, width):
        at = stored_pixels(np.array([[x + 0.5, y + 0.5]]), orientation, width, height)[0]
        assert stored[int(at[1]), int(at[0])] == upright[y, x]
