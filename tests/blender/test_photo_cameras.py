# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's cameras project as ours do, wherever the scene is placed, with photos behind them."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.ops import addon
from gaussian_wrapping_addon.ops.cameras import (
    CLIP_END,
    CLIP_START,
    cameras_under,
    create_camera,
    look_through,
)
from gaussian_wrapping_addon.ops.placement import place
from gaussian_wrapping_addon.ops.scene_objects import ImportedResult, import_result
from tests.blender.synthetic_result import CAMERAS, png_bytes, rotation_about, write_result

pytestmark = pytest.mark.usefixtures("addon")

POSE = np.concatenate([rotation_about((1, 2, 0.5), 0.6), np.array([[0.1], [-0.2], [6.0]])], 1)
SHAPES = [
    Camera("square", 1024, 1024, 900.0, 900.0, 512.0, 512.0, POSE),
    Camera("off centre", 4000, 3000, 3200.0, 3200.0, 2310.5, 1203.25, POSE),
    Camera("portrait off centre", 3000, 4000, 2900.0, 2900.0, 900.75, 2444.5, POSE),
    Camera("centre outside", 1600, 1200, 1500.0, 1500.0, -300.0, 1400.0, POSE),
    Camera("wide pixels", 4000, 3000, 3200.0, 2400.0, 1900.0, 1400.0, POSE),
    Camera("tall pixels", 3000, 3900, 2400.0, 3200.0, 1400.0, 1900.0, POSE),
    Camera("nearly square", 1000, 999, 800.0, 801.5, 480.0, 520.0, POSE),
    Camera("tele", 6000, 4000, 60000.0, 60000.0, 3000.0, 2000.0, POSE),
    Camera("fisheye-wide", 800, 600, 150.0, 150.0, 410.0, 290.0, POSE),
]
PLACEMENTS = [
    Similarity(),
    Similarity(0.37, rotation_about((1, 0.3, 2), 1.1), np.array([10.0, -4.0, 2.0])),
    Similarity(250.0, rotation_about((0, 1, 0.2), -2.5), np.zeros(3)),
]


def error_px(thing: bpy.types.Object, camera: Camera, placement: Similarity) -> float:
    """Largest distance between Blender's projection and ours over points in front."""
    scene = bpy.context.scene
    look_through(scene, thing)
    bpy.context.view_layer.update()
    near = np.random.default_rng(3).uniform(-0.5, 0.5, (40, 3)) * min(1, 3000 / camera.fx)
    points = near + np.array([0, 0, 6.0])  # camera frame
    points = (points - camera.cam_from_world[:, 3]) @ camera.rotation  # scene frame
    pixels, depth = camera.project(points)
    assert (depth > 0).all()
    worst = 0.0
    for point, pixel, z in zip(placement.points(points), pixels, depth, strict=True):
        x, y, blender_z = world_to_camera_view(scene, thing, Vector(point))
        found = (x * camera.width, (1.0 - y) * camera.height)
        worst = max(worst, float(np.linalg.norm(found - pixel)))
        assert blender_z == pytest.approx(placement.scale * z, rel=1e-4)
    return worst


@pytest.mark.parametrize("camera", SHAPES, ids=lambda c: c.name)
def test_projection_to_a_hundredth_of_a_pixel(camera: Camera) -> None:
    thing = create_camera(camera, "", 0.1, bpy.context.scene.collection)
    assert error_px(thing, camera, Similarity()) < 0.01
    assert bpy.context.scene.render.resolution_x == camera.width
    assert bpy.context.scene.render.resolution_y == camera.height


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_projection_stays_when_the_scene_is_placed(tmp_path: Path, placement: Similarity) -> None:
    imported = import_result(write_result(tmp_path / "job"), bpy.context.scene)
    place(imported.frame, placement)
    for thing, camera in zip(imported.cameras, CAMERAS, strict=True):
        assert error_px(thing, camera, placement) < 0.01
        data = thing.data
        assert data.clip_start == pytest.approx(CLIP_START * placement.scale, rel=1e-5)
        assert data.clip_end == pytest.approx(CLIP_END * placement.scale, rel=1e-5)


@pytest.fixture
def result(tmp_path: Path) -> ImportedResult:
    folder = write_result(tmp_path / "job")
    photos = tmp_path / "job" / "photos"
    photos.mkdir()
    for camera in CAMERAS[:-1]:  # one photo is missing
        pixels = np.full((camera.height, camera.width, 3), 80, np.uint8)
        (photos / camera.name).write_bytes(png_bytes(pixels))
    imported = import_result(folder, bpy.context.scene)
    bpy.context.view_layer.update()
    return imported


def test_the_photo_is_behind_and_only_when_it_is_looked_at(result: ImportedResult) -> None:
    photo = next(c for c in result.cameras if c.name == "tall.jpg")
    assert not any(c.data.background_images for c in result.cameras)
    bpy.context.view_layer.objects.active = photo
    assert bpy.ops.gwrap.view_photo() == {"FINISHED"}
    assert bpy.ops.gwrap.view_photo() == {"FINISHED"}, "again"
    scene = bpy.context.scene
    assert scene.camera == photo
    assert (scene.render.resolution_x, scene.render.resolution_y) == (300, 500)
    (background,) = photo.data.background_images
    assert photo.data.show_background_images
    assert background.frame_method == "STRETCH"
    assert background.image.filepath.endswith("tall.jpg")
    assert background.image.packed_file is None
    assert not background.image.has_data, "read when it is drawn"
    assert [c for c in result.cameras if c.data.background_images] == [photo]
    assert tuple(background.image.size) == (300, 500), "it can be read"


def test_photos_one_after_another(result: ImportedResult) -> None:
    order = cameras_under(result.frame)
    bpy.context.view_layer.objects.active = result.meshes[0]
    seen = []
    for _ in range(len(order) + 1):
        assert bpy.ops.gwrap.view_photo(step=1) == {"FINISHED"}
        seen.append(bpy.context.scene.camera)
    assert seen == [*order, order[0]]
    bpy.ops.gwrap.view_photo(step=-1)
    assert bpy.context.scene.camera == order[-1]
    bpy.context.view_layer.update()
    assert [c for c in order if c.visible_get()] == [order[-1]], "a hidden one shows no photo"
    assert all(len(c.users_collection) >= 1 for c in order)
    import_result(addon.result_folder(result.frame), bpy.context.scene)
    assert cameras_under(result.frame) == order
    bpy.ops.gwrap.view_photo()
    assert bpy.context.scene.camera == order[-1], "without a selected camera it stays"


def test_a_missing_photo_is_told_and_the_view_is_right(
    result: ImportedResult, capfd: pytest.CaptureFixture[str]
) -> None:
    lost = next(c for c in result.cameras if c.name == CAMERAS[-1].name)
    bpy.context.view_layer.objects.active = lost
    assert bpy.ops.gwrap.view_photo() == {"FINISHED"}
    assert bpy.context.scene.camera == lost
    assert bpy.context.scene.render.resolution_x == CAMERAS[-1].width
    assert not lost.data.background_images
    text = capfd.readouterr()
    assert "does not exist" in text.out + text.err


@pytest.mark.parametrize("moved", [False, True])
def test_a_straightened_photo_is_found_in_a_job_that_was_moved(tmp_path: Path, moved: bool) -> None:
    job = tmp_path / "stages" / "job"  # the name of a folder above must not mislead
    folder = write_result(job)
    imported = import_result(folder, bpy.context.scene)
    thing = imported.cameras[0]
    images = job / "stages" / "cameras-1" / "images"
    images.mkdir(parents=True)
    (images / "0.png").write_bytes(png_bytes(np.full((480, 640, 3), 9, np.uint8)))
    thing[addon.PHOTO] = str(images / "0.png")
    if moved:
        job.rename(tmp_path / "elsewhere")
        import_result(tmp_path / "elsewhere" / "result", bpy.context.scene)
    bpy.context.view_layer.objects.active = thing
    bpy.ops.gwrap.view_photo()
    path = Path(thing.data.background_images[0].image.filepath)
    home = tmp_path / "elsewhere" if moved else job
    assert path == home / "stages" / "cameras-1" / "images" / "0.png"


def test_without_cameras_the_next_step_is_named(result: ImportedResult) -> None:
    for camera in list(cameras_under(result.frame)):
        bpy.data.objects.remove(camera)
    with pytest.raises(RuntimeError, match="Import the result again"):
        bpy.ops.gwrap.view_photo()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert not bpy.ops.gwrap.view_photo.poll(), "without a result"
