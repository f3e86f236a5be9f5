# SPDX-License-Identifier: GPL-3.0-or-later
"""Region objects mean the right volume in the world, whatever was done to them in Blender."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from gaussian_wrapping_addon.core.errors import UsageError, WrapError
from gaussian_wrapping_addon.core.regions.box import CUBE_CORNERS, CUBE_TRIANGLES
from gaussian_wrapping_addon.core.regions.files import region_to_json
from gaussian_wrapping_addon.core.regions.scene_regions import read_region
from gaussian_wrapping_addon.ops import addon
from gaussian_wrapping_addon.ops.region_objects import create_region
from gaussian_wrapping_addon.ops.region_operators import GWRAP_OT_export_region
from gaussian_wrapping_addon.ops.scene_objects import ImportedResult, import_result
from tests.blender.placed_scene import region_from_object
from tests.blender.synthetic_result import WORLD_FROM_SCENE, write_result

pytestmark = pytest.mark.usefixtures("addon")


def same_set(found: np.ndarray, expected: np.ndarray, share: float = 1e-5) -> bool:
    distances = np.linalg.norm(found[:, None] - expected[None], axis=2)
    limit = share * np.linalg.norm(np.ptp(expected, 0))
    return bool(
        len(found) == len(expected)
        and distances.min(0).max() <= limit
        and distances.min(1).max() <= limit
    )


@pytest.fixture
def result(tmp_path: Path) -> ImportedResult:
    imported = import_result(write_result(tmp_path / "job"), bpy.context.scene)
    bpy.context.view_layer.update()
    return imported


def affine(location: tuple, rotation: tuple, scale: tuple) -> np.ndarray:
    return np.array(Matrix.LocRotScale(location, Euler(rotation), scale), np.float64)


def apply(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.parametrize(
    ("frame_scale", "scale", "with_parent"),
    [(1.0, (1, 1, 1), False), (0.37, (0.5, 2, 0.1), True), (0.37, (-1, 1, 2), False)],
)
def test_box_in_world_coordinates(
    result: ImportedResult, frame_scale: float, scale: tuple, with_parent: bool
) -> None:
    bpy.context.scene.cursor.location = (0.3, 0.2, -0.1)
    assert bpy.ops.gwrap.add_region_box(around="CURSOR") == {"FINISHED"}
    box = bpy.context.view_layer.objects.active
    assert (box.type, box.empty_display_type, box.show_in_front) == ("EMPTY", "CUBE", True)
    assert box.parent == result.frame
    box.empty_display_size = 0.7
    local = affine((0.4, -0.3, 0.9), (0.2, 0.5, -1.1), scale)
    box.location, box.rotation_euler, box.scale = (0.4, -0.3, 0.9), (0.2, 0.5, -1.1), scale
    result.frame.location = (10, -4, 2)
    result.frame.rotation_euler = (0.1, 0.7, 0.3)
    result.frame.scale = (frame_scale,) * 3
    scene_corners = apply(local, 0.7 * CUBE_CORNERS)
    if with_parent:
        arm = bpy.data.objects.new("arm", None)
        result.collection.objects.link(arm)
        arm.parent, arm.location, arm.rotation_euler = result.frame, (1, 2, 3), (0, 0, 0.5)
        box.parent = arm
        scene_corners = apply(affine((1, 2, 3), (0, 0, 0.5), (1, 1, 1)), scene_corners)
    expected = WORLD_FROM_SCENE.points(scene_corners)
    assert same_set(region_from_object(box), expected)


def test_a_hidden_box_moves_with_its_frame(result: ImportedResult) -> None:
    """Blender leaves the matrix_world of disabled objects as it was."""
    box = result.regions[0]
    expected = region_from_object(box)
    for hide in (lambda: setattr(box, "hide_viewport", True),
                 lambda: setattr(result.collection, "hide_viewport", True)):  # fmt: skip
        hide()
        bpy.context.view_layer.update()
        result.frame.location = (10, -4, 2)
        result.frame.rotation_euler = (0.1, 0.7, 0.3)
        result.frame.scale = (0.37,) * 3
        bpy.context.view_layer.update()
        assert same_set(region_from_object(box), expected)


def test_boxes_without_a_result_are_in_blenders_world() -> None:
    bpy.ops.gwrap.add_region_box(around="CURSOR")
    box = bpy.context.view_layer.objects.active
    assert box.parent is None
    assert same_set(region_from_object(box), 0.5 * CUBE_CORNERS)
    thing = create_region("r", CUBE_CORNERS * (3, 2, 1), None, bpy.context.scene.collection)
    assert list(thing.scale) == pytest.approx([3, 2, 1]), "a flat cube gets no negative scale"
    assert list(thing.rotation_euler) == pytest.approx([0, 0, 0], abs=1e-6)


def test_boxes_around_selected_result_and_cursor(result: ImportedResult) -> None:
    mesh = result.meshes[0]
    mesh.location = (2, 0, 0)
    bpy.context.view_layer.update()
    for thing in bpy.context.view_layer.objects:
        thing.select_set(thing == mesh)
    bpy.ops.gwrap.add_region_box(around="SELECTED")
    around = bpy.context.view_layer.objects.active
    corners = 0.5 * CUBE_CORNERS + (2, 0, 0)
    assert same_set(region_from_object(around), WORLD_FROM_SCENE.points(corners))
    bpy.ops.gwrap.add_region_box(around="RESULT")
    copy = bpy.context.view_layer.objects.active
    assert copy != result.regions[0]
    assert same_set(region_from_object(copy), region_from_object(result.regions[0]))
    for thing in bpy.context.view_layer.objects:
        thing.select_set(False)
    with pytest.raises(RuntimeError, match="no extent"):
        bpy.ops.gwrap.add_region_box(around="SELECTED")
    result.frame.location, result.frame.scale = (5, 0, 0), (3, 3, 3)
    bpy.context.scene.cursor.location = (5.6, 0, 0)
    bpy.ops.gwrap.add_region_box(around="CURSOR")
    box = bpy.context.view_layer.objects.active
    assert list(box.matrix_world.translation) == pytest.approx([5.6, 0, 0], abs=1e-5)
    bpy.context.view_layer.objects.active = mesh
    assert not bpy.ops.gwrap.use_as_region.poll(), "a result is not used as a region"


def test_a_mesh_region_is_its_hull_with_modifiers(result: ImportedResult) -> None:
    bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=6, location=(0.5, 0, 0))
    thing = bpy.context.view_layer.objects.active
    thing.data.vertices[0].co *= 0.1  # a dent, which a hull does not have
    array = thing.modifiers.new("array", "ARRAY")
    array.count = 2
    array.relative_offset_displace = (2, 0, 0)
    assert bpy.ops.gwrap.use_as_region() == {"FINISHED"}
    assert addon.kind_of(thing) == "region"
    assert thing.parent == result.frame
    world = region_from_object(thing)
    scene = WORLD_FROM_SCENE.inverse().points(world)
    assert scene[:, 0].min() == pytest.approx(-0.5, abs=1e-4)
    assert scene[:, 0].max() == pytest.approx(5.5, abs=1e-4)
    assert len(world) < 2 * len(thing.data.vertices) - 1


def plane() -> bpy.types.Object:
    bpy.ops.mesh.primitive_plane_add()
    return bpy.context.view_layer.objects.active


def curve() -> bpy.types.Object:
    bpy.ops.curve.primitive_bezier_circle_add()
    return bpy.context.view_layer.objects.active


def flat_box() -> bpy.types.Object:
    bpy.ops.object.empty_add(type="CUBE")
    thing = bpy.context.view_layer.objects.active
    thing.scale = (1, 0, 1)
    return thing


def hidden_by_a_nan() -> bpy.types.Object:
    bpy.ops.object.empty_add(type="CUBE")
    thing = bpy.context.view_layer.objects.active
    thing.empty_display_size = 1
    thing.location = (float("nan"), 0, 0)
    return thing


@pytest.mark.parametrize("make", [plane, curve, flat_box, hidden_by_a_nan])
def test_what_encloses_no_volume_is_refused(make: Callable[[], bpy.types.Object]) -> None:
    with pytest.raises(WrapError) as caught:
        region_from_object(make())
    assert caught.value.hint


def test_a_frame_that_lost_its_coordinates_is_refused(result: ImportedResult) -> None:
    result.frame[addon.WORLD_FROM_SCENE] = '{"scale": 1}'
    with pytest.raises(UsageError, match="lost its world coordinates"):
        region_from_object(result.regions[0])
    result.frame.scale = (0, 0, 0)
    with pytest.raises(WrapError):
        region_from_object(result.regions[0])


@pytest.mark.parametrize("name", ["région 1.json", "box.rsbox"])
def test_export_then_import_is_the_same_region(
    result: ImportedResult, tmp_path: Path, name: str
) -> None:
    box = result.regions[0]
    assert bpy.ops.gwrap.select_region(name=box.name) == {"FINISHED"}
    assert bpy.context.view_layer.objects.active == box
    box.location, box.rotation_euler, box.scale = (0.1, 0.2, 0.3), (0.2, -0.4, 1.9), (1, 2, 0.5)
    bpy.context.view_layer.update()
    path = tmp_path / name
    bpy.ops.gwrap.export_region(filepath=str(path))
    expected = region_from_object(box)
    if name.endswith("json"):
        values = json.loads(path.read_text())
        assert values["class_name"] == "GaussianWrappingBoundingVolume"
        assert values["blender_object_name"] == box.name
        assert len(values["hull_simplices"]) == 12
        assert same_set(np.asarray(read_region(path).vertices), expected), "as the worker reads it"
    else:
        assert path.read_text().startswith("<ReconstructionRegion ")
    bpy.ops.gwrap.import_region(filepath=str(path))
    again = bpy.context.view_layer.objects.active
    assert again != box
    assert again.type == "EMPTY"
    assert again.parent == result.frame
    assert same_set(region_from_object(again), expected)
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=1)
    with pytest.raises(RuntimeError, match=r"no box.*Export it as \.json"):
        bpy.ops.gwrap.export_region(filepath=str(tmp_path / "ball.rsbox"))
    assert list(tmp_path.glob("ball*")) == []


def test_a_solid_that_is_no_box_comes_back_as_a_mesh(
    result: ImportedResult, tmp_path: Path
) -> None:
    points = np.random.default_rng(1).normal(size=(30, 3))
    path = tmp_path / "blob.json"
    world = WORLD_FROM_SCENE.points(points)
    path.write_text(json.dumps(region_to_json("blob", world, None)))
    bpy.ops.gwrap.import_region(filepath=str(path))
    thing = bpy.context.view_layer.objects.active
    assert thing.type == "MESH"
    assert thing.display_type == "WIRE"
    found = region_from_object(thing)
    # Hull corners are extreme in some direction: compare the support in many directions.
    directions = np.random.default_rng(2).normal(size=(500, 3))
    support = (directions @ (found - world.mean(0)).T).max(1)
    expected = (directions @ (world - world.mean(0)).T).max(1)
    assert support == pytest.approx(expected, rel=1e-4)
    edges = {}
    for polygon in thing.data.polygons:
        for key in polygon.edge_keys:
            edges[key] = edges.get(key, 0) + 1
    assert set(edges.values()) == {2}, "the hull is closed"


@pytest.mark.parametrize(
    ("file_format", "before", "after"),
    [
        ("RSBOX", "a.json", "a.rsbox"),
        ("JSON", "a.rsbox", "a.json"),
        ("RSBOX", "a.b", "a.b.rsbox"),
    ],
)
def test_the_name_follows_the_format(file_format: str, before: str, after: str) -> None:
    dialog = SimpleNamespace(file_format=file_format, filepath=f"/tmp/{before}")
    GWRAP_OT_export_region.check(dialog, bpy.context)  # type: ignore[arg-type]
    assert Path(dialog.filepath) == Path("/tmp") / after


@pytest.mark.parametrize("vertices", [None, [[0, 0, 0]] * 3, [[0, 0, True]] * 8])
def test_broken_region_files_are_refused(tmp_path: Path, vertices: object) -> None:
    path = tmp_path / "bad.json"
    good = region_to_json("x", CUBE_CORNERS, CUBE_TRIANGLES)
    path.write_text(json.dumps({**good, "vertices": vertices}))
    with pytest.raises(RuntimeError, match=r"bad\.json"):
        bpy.ops.gwrap.import_region(filepath=str(path))
    assert len(bpy.data.objects) == 0
