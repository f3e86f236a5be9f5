# SPDX-License-Identifier: GPL-3.0-or-later
"""A result folder becomes Blender objects that project, measure and look as the data says."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError, ParseError, WrapError
from gaussian_wrapping_addon.ops import addon
from gaussian_wrapping_addon.ops.cameras import look_through
from gaussian_wrapping_addon.ops.scene_objects import (
    export_usd,
    import_result,
    set_shading,
    shading_of,
    texture_of,
    write_blend,
)
from tests.blender.placed_scene import region_from_object
from tests.blender.synthetic_result import (
    BOX_SCENE,
    CAMERAS,
    WORLD_FROM_SCENE,
    cube_mesh,
    png_bytes,
    write_region_result,
    write_result,
)


def edge_face_counts(mesh: bpy.types.Mesh) -> set[int]:
    counts: dict[tuple[int, int], int] = {}
    for polygon in mesh.polygons:
        for key in polygon.edge_keys:
            counts[key] = counts.get(key, 0) + 1
    return set(counts.values())


def test_a_result_has_mesh_texture_material_and_region(tmp_path: Path) -> None:
    imported = import_result(write_result(tmp_path / "job"), bpy.context.scene)
    (thing,) = imported.meshes
    assert [o for o in bpy.data.objects if o.type == "MESH"] == [thing]
    mesh = thing.data
    vertices, faces, corner_uvs = cube_mesh()
    assert np.array([v.co for v in mesh.vertices]) == pytest.approx(vertices, abs=1e-6)
    assert [list(p.vertices) for p in mesh.polygons] == faces.tolist()
    assert edge_face_counts(mesh) == {2}
    uvs = np.array([uv.vector for uv in mesh.uv_layers["UVMap"].uv]).reshape(12, 3, 2)
    assert uvs == pytest.approx(corner_uvs, abs=1e-7)
    assert all(p.use_smooth for p in mesh.polygons)
    (image,) = [i for i in bpy.data.images if i.source == "FILE"]
    assert Path(image.filepath) == tmp_path / "job" / "result" / "auto" / "albedo.png"
    assert image.colorspace_settings.name == "sRGB"
    assert image.packed_file is None
    # Blender's pixel row 0 is the bottom of the image.
    pixels = np.array(image.pixels).reshape(16, 16, 4)
    assert np.round(pixels[0, 0, :3] * 255).tolist() == [20, 120, 220]
    assert np.round(pixels[15, 0, :3] * 255).tolist() == [200, 30, 40]
    assert shading_of(mesh.materials[0]) == "LIT"
    assert thing.parent == imported.frame
    (region,) = imported.regions
    assert (region.type, region.empty_display_type) == ("EMPTY", "CUBE")
    assert min(region.scale) > 0
    world, expected = region_from_object(region), WORLD_FROM_SCENE.points(BOX_SCENE)
    distances = np.linalg.norm(world[:, None] - expected[None], axis=2)
    assert distances.min(0).max() < 1e-5 * np.linalg.norm(np.ptp(expected, 0))
    assert imported.frame.matrix_world == imported.frame.matrix_world.Identity(4)
    assert addon.world_from_scene(imported.frame).translation.tolist() == [500000.25, 4000000.5, 30]


@pytest.mark.parametrize("index", range(len(CAMERAS)))
def test_a_render_shows_the_cube_where_the_camera_says(tmp_path: Path, index: int) -> None:
    """Renders with Workbench: independent of how bpy_extras computes the view."""
    imported = import_result(write_result(tmp_path / "job"), bpy.context.scene)
    scene, camera = bpy.context.scene, CAMERAS[index]
    look_through(scene, imported.cameras[index])
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.render.film_transparent = True
    scene.display.render_aa = "OFF"
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.filepath = str(tmp_path / "view.png")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    alpha = np.array(image.pixels).reshape(camera.height, camera.width, 4)[::-1, :, 3] > 0.5
    rows, columns = np.nonzero(alpha)
    pixels, _ = camera.project(cube_mesh()[0])
    low = np.clip(pixels.min(0), 0, (camera.width, camera.height))
    high = np.clip(pixels.max(0), 0, (camera.width, camera.height))
    assert [columns.min(), rows.min()] == pytest.approx(low, abs=1.5)
    assert [columns.max() + 1, rows.max() + 1] == pytest.approx(high, abs=1.5)


def test_import_again_updates_and_keeps_what_the_user_did(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    scene = bpy.context.scene
    first = import_result(result, scene)
    first.frame.scale = (2, 2, 2)
    first.meshes[0].location = (1, 2, 3)
    first.meshes[0].name = "renamed"
    first.regions[0].location = (9, 9, 9)
    set_shading(first.meshes[0].data.materials[0], "UNLIT")
    count = len(bpy.data.objects)
    data = first.meshes[0].data
    again = import_result(result, scene)
    assert again.meshes[0].data == data, "an unchanged file must not replace edited geometry"

    time.sleep(0.01)
    write_region_result(result / "auto", half=0.75)
    write_region_result(result / "fine", half=0.25)
    again = import_result(result, scene)
    assert again.frame == first.frame
    assert {m.name for m in again.meshes} == {"renamed", "fine"}
    updated = bpy.data.objects["renamed"]
    assert list(updated.location) == [1, 2, 3]
    assert max(v.co.x for v in updated.data.vertices) == 0.75
    assert shading_of(updated.data.materials[0]) == "UNLIT"
    assert list(again.frame.scale) == [2, 2, 2]
    assert list(first.regions[0].location) == [9, 9, 9]
    assert len(bpy.data.objects) == count + 2, "one more mesh and its region"
    assert len(bpy.data.meshes) == 2, "the old geometry is gone"
    assert len(bpy.data.collections) == 2


def test_deleted_objects_come_back_and_a_moved_folder_is_found(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    first = import_result(result, bpy.context.scene)
    bpy.data.objects.remove(first.meshes[0])
    bpy.data.objects.remove(first.cameras[1])
    os.rename(tmp_path / "job", tmp_path / "moved")
    again = import_result(tmp_path / "moved" / "result", bpy.context.scene)
    assert again.frame == first.frame
    assert len(again.meshes) == 1
    assert len(again.cameras) == len(CAMERAS)
    assert addon.result_folder(again.frame) == tmp_path / "moved" / "result"


def break_npz(result: Path, **changes: np.ndarray) -> None:
    vertices, faces, corner_uvs = cube_mesh()
    arrays = {"vertices": vertices, "faces": faces, "corner_uvs": corner_uvs, **changes}
    np.savez(result / "auto" / "mesh.npz", **arrays)


def write_second_atlas(region: Path) -> np.ndarray:
    """Put half of the cube's faces into a second, green atlas; return the faces' atlases."""
    owner = (np.arange(12) // 6).astype(np.uint8)
    break_npz(region.parent, face_atlas=owner)
    green = np.full((8, 8, 3), (10, 200, 20), np.uint8)
    (region / "albedo-2.png").write_bytes(png_bytes(green))
    return owner


def lose_an_atlas(result: Path) -> None:
    write_second_atlas(result / "auto")
    (result / "auto" / "albedo-2.png").unlink()


def turn_a_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def set_scene(result: Path, **changes: object) -> None:
    values = json.loads((result / "scene.json").read_text())
    (result / "scene.json").write_text(json.dumps({**values, **changes}))


NAN_VERTICES = np.where(np.arange(24).reshape(8, 3) == 10, np.nan, cube_mesh()[0])
VAST_VERTICES = np.where(np.arange(24).reshape(8, 3) == 10, 1e39, cube_mesh()[0])
HUGE_UVS = np.full((12, 3, 2), np.inf, np.float32)


@pytest.mark.parametrize(
    ("damage", "place"),
    [
        (lambda r: break_npz(r, vertices=NAN_VERTICES), r"vertices\[3\]"),
        (lambda r: break_npz(r, vertices=VAST_VERTICES), r"vertices\[3\].*32 bits"),
        (lambda r: break_npz(r, corner_uvs=HUGE_UVS), r"corner_uvs\[0\]"),
        (lambda r: break_npz(r, corner_uvs=np.zeros((5, 3, 2), np.float32)), "corner_uvs"),
        (lambda r: break_npz(r, faces=np.full((12, 3), 8)), "out of range"),
        (lambda r: break_npz(r, faces=np.full((12, 3), -1)), "out of range"),
        (lambda r: break_npz(r, faces=np.zeros((0, 3), int)), "corner_uvs|none"),
        (lambda r: break_npz(r, faces=np.zeros((12, 3))), "integers"),
        (lambda r: break_npz(r, vertices=np.array([None] * 8)), r"mesh\.npz.*damaged"),
        (lambda r: (r / "auto" / "mesh.npz").write_bytes(b"PK\x03\x04junk"), r"mesh\.npz.*damaged"),
        (lambda r: turn_a_bit(r / "auto" / "mesh.npz"), r"mesh\.npz.*damaged"),
        (lambda r: (r / "auto" / "albedo.png").unlink(), "albedo.png"),
        (lambda r: (r / "auto" / "region.json").unlink(), "region.json"),
        (lambda r: (r / "auto" / "region.json").write_text("{}"), "class_name"),
        (lambda r: (r / "scene.json").unlink(), "scene.json"),
        (lambda r: (r / "scene.json").write_text("[1"), "line 1"),
        (lambda r: set_scene(r, radius="x"), "scene file"),
        (lambda r: set_scene(r, cameras=[{"photo": "a"}]), "scene file"),
        (lambda r: set_scene(r, world_from_scene={"scale": 0}), "scene file"),
        (lambda r: (r / "auto" / "mesh.npz").unlink(), "holds no mesh"),
        (lambda r: break_npz(r, face_atlas=np.zeros(11, np.uint8)), "atlas"),
        (lambda r: break_npz(r, face_atlas=np.zeros(12)), "atlas"),
        (lambda r: break_npz(r, face_atlas=np.full(12, 200)), "atlas"),
        (lose_an_atlas, r"albedo-2\.png"),
    ],
)
def test_damaged_results_are_refused_and_change_nothing(
    tmp_path: Path, damage: object, place: str
) -> None:
    result = write_result(tmp_path / "job")
    damage(result)  # type: ignore[operator]
    with pytest.raises((ParseError, DatasetError), match=place) as caught:
        import_result(result, bpy.context.scene)
    assert isinstance(caught.value, WrapError)
    assert caught.value.hint
    assert len(bpy.data.objects) == len(bpy.data.meshes) == len(bpy.data.collections) == 0


def test_write_blend_then_open_from_another_place(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job", regions=("auto", "leaf"))
    write_blend(result, result / "scene.blend")
    os.rename(tmp_path / "job", tmp_path / "elsewhere")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "elsewhere" / "result" / "scene.blend"))
    meshes = [o for o in bpy.data.objects if addon.kind_of(o) == "mesh"]
    assert {m[addon.REGION] for m in meshes} == {"auto", "leaf"}
    for mesh in meshes:
        assert len(mesh.data.polygons) == 12
        assert len(mesh.data.uv_layers) == 1
    for image in (i for i in bpy.data.images if i.source == "FILE"):
        assert image.filepath.startswith("//")
        assert tuple(image.size) == (16, 16), "the texture must be found beside the file"
    (frame,) = addon.objects_of_kind(bpy.context.scene, "frame")
    assert addon.result_folder(frame).resolve() == tmp_path / "elsewhere" / "result"
    assert bpy.context.scene.camera is not None
    assert bpy.context.scene.render.resolution_x == 640
    again = import_result(tmp_path / "elsewhere" / "result", bpy.context.scene)
    assert again.frame == frame
    assert len(again.meshes) == 2


def test_usd_of_each_region(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job", regions=("auto", "leaf"))
    paths = export_usd(result)
    assert paths == [result / "auto" / "mesh.usdc", result / "leaf" / "mesh.usdc"]
    for path in paths:
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        bpy.ops.wm.usd_import(filepath=str(path))
        (mesh,) = [o for o in bpy.data.objects if o.type == "MESH"]
        assert len(mesh.data.polygons) == 12
        assert len(mesh.data.uv_layers) == 1
        (image,) = [i for i in bpy.data.images if i.source == "FILE"]
        assert Path(bpy.path.abspath(image.filepath)).resolve() == path.with_name("albedo.png")


def test_each_atlas_is_a_material_and_more_or_less_change_them(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    (thing,) = import_result(result, bpy.context.scene).meshes
    first = thing.material_slots[0].material
    set_shading(first, "UNLIT")
    owner = write_second_atlas(result / "auto")
    import_result(result, bpy.context.scene)
    assert [p.material_index for p in thing.data.polygons] == owner.tolist()
    images = [texture_of(slot.material) for slot in thing.material_slots]
    assert [Path(i.filepath).name for i in images] == ["albedo.png", "albedo-2.png"]
    assert edge_face_counts(thing.data) == {2}
    assert [slot.material.name for slot in thing.material_slots] == ["auto", "auto 2"]
    assert thing.material_slots[0].material == first
    assert [shading_of(slot.material) for slot in thing.material_slots] == ["UNLIT", "UNLIT"]
    write_region_result(result / "auto", half=0.3)
    import_result(result, bpy.context.scene)
    assert [slot.material for slot in thing.material_slots] == [first]
    assert {p.material_index for p in thing.data.polygons} == {0}
