# SPDX-License-Identifier: GPL-3.0-or-later
"""Scale, ground and origin move the parent empty alone; undo, re-import and regions follow."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import bmesh
import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.placement import FILE_NAME, read_placement
from gaussian_wrapping_addon.ops import addon, placement
from gaussian_wrapping_addon.ops.region_objects import matrix_of, transformed
from gaussian_wrapping_addon.ops.scene_objects import (
    ImportedResult,
    export_usd,
    import_result,
    write_blend,
)
from tests.blender.placed_scene import (
    in_blender,
    pick_vertices,
    put_points,
    region_from_object,
    same_matrix,
    state,
    stored,
    tilt,
    upright_cameras,
)
from tests.blender.synthetic_result import (
    WORLD_FROM_SCENE,
    rotation_about,
    write_region_result,
    write_result,
)

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """A result whose cameras are upright, in a folder that may be written to."""
    result = write_result(tmp_path / "job")
    values = json.loads((result / "scene.json").read_text())
    (result / "scene.json").write_text(json.dumps({**values, "cameras": upright_cameras()}))
    addon.remember(tmp_path / "job")
    return tmp_path / "job"


@pytest.fixture
def result(job: Path) -> ImportedResult:
    placement.after_load()
    imported = import_result(job / "result", bpy.context.scene)
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = imported.meshes[0]
    return imported


@pytest.mark.parametrize(
    ("way", "by_hand"), [("vertices", True), ("points", False), ("own empties", True)]
)
def test_two_points_get_their_true_distance(
    result: ImportedResult, way: str, by_hand: bool
) -> None:
    if by_hand:
        tilt(result)
    before = state(result)
    ends = np.array([in_blender(result, 0), in_blender(result, 7)])
    if way == "vertices":
        pick_vertices(result.meshes[0], [0, 7])
    elif way == "points":
        put_points(ends)
    else:
        bpy.ops.object.select_all(action="DESELECT")
        for end in ends:
            thing = bpy.data.objects.new("mine", None)
            bpy.context.scene.collection.objects.link(thing)
            thing.location = end
            bpy.context.view_layer.update()
            thing.select_set(True)
    origin = matrix_of(result.frame)[:3, 3] * 0.35 / np.linalg.norm(ends[1] - ends[0])
    assert bpy.ops.gwrap.set_scale(distance=0.35) == {"FINISHED"}
    assert bpy.context.mode == "OBJECT"
    length = np.linalg.norm(in_blender(result, 7) - in_blender(result, 0))
    assert length == pytest.approx(0.35, rel=1e-6)
    assert matrix_of(result.frame)[:3, 3] == pytest.approx(origin, rel=1e-5, abs=1e-6)
    assert state(result) == before, "only the parent moves"
    if way == "own empties":
        for thing, vertex in zip(
            sorted((o for o in bpy.data.objects if o.name.startswith("mine")),
                   key=lambda o: o.name), (0, 7), strict=True,
        ):  # fmt: skip
            found = matrix_of(thing)[:3, 3]
            assert found == pytest.approx(in_blender(result, vertex), abs=1e-5), "it goes along"
    scale = np.linalg.norm(matrix_of(result.frame)[:3, :3], axis=0)
    assert scale == pytest.approx(scale.mean(), rel=1e-6)
    kept = stored(result)
    assert kept is not None
    assert same_matrix(result.frame, kept)


def test_scaling_again_replaces_the_first_distance(result: ImportedResult) -> None:
    for distance in (5.0, 0.2, 1.0):
        pick_vertices(result.meshes[0], [0, 7])
        bpy.ops.gwrap.set_scale(distance=distance)
        length = np.linalg.norm(in_blender(result, 7) - in_blender(result, 0))
        assert length == pytest.approx(distance, rel=1e-6)
    expected = 1.0 / np.sqrt(3.0)  # the diagonal of a cube of side 1
    assert placement.placement_of(result.frame).scale == pytest.approx(expected, rel=1e-7)


def test_three_points_become_the_floor(result: ImportedResult) -> None:
    tilt(result)
    pick_vertices(result.meshes[0], [0, 2, 4])  # the face at the cube's lowest z
    before = placement.placement_of(result.frame).scale
    assert bpy.ops.gwrap.set_ground() == {"FINISHED"}
    heights = np.array([in_blender(result, v)[2] for v in range(8)])
    assert heights[[0, 2, 4, 6]] == pytest.approx(0.0, abs=1e-5)
    assert heights[[1, 3, 5, 7]] == pytest.approx(before, abs=1e-5), "cameras are above"
    assert placement.placement_of(result.frame).scale == pytest.approx(before, rel=1e-6)
    pick_vertices(result.meshes[0], [0, 2, 4])
    assert bpy.ops.gwrap.set_ground(flip=True) == {"FINISHED"}
    heights = np.array([in_blender(result, v)[2] for v in range(8)])
    assert heights[[1, 3, 5, 7]] == pytest.approx(-before, abs=1e-5)


def test_scale_keeps_ground_and_origin(result: ImportedResult) -> None:
    tilt(result)
    pick_vertices(result.meshes[0], [0, 2, 4])
    bpy.ops.gwrap.set_ground()
    pick_vertices(result.meshes[0], [0])
    bpy.ops.gwrap.set_origin()
    assert in_blender(result, 0) == pytest.approx(0.0, abs=1e-5)
    pick_vertices(result.meshes[0], [0, 4])
    bpy.ops.gwrap.set_scale(distance=10.0)
    assert in_blender(result, 0) == pytest.approx(0.0, abs=1e-5)
    assert in_blender(result, 2)[2] == pytest.approx(0.0, abs=1e-5)
    assert np.linalg.norm(in_blender(result, 4)) == pytest.approx(10.0, rel=1e-6)
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.scene.cursor.location = in_blender(result, 3)
    assert bpy.ops.gwrap.set_origin(target="CURSOR") == {"FINISHED"}
    assert in_blender(result, 3) == pytest.approx(0.0, abs=1e-5)


def test_auto_ground_without_meshes_takes_the_region(result: ImportedResult) -> None:
    bpy.data.objects.remove(result.meshes[0])
    bpy.context.view_layer.objects.active = result.frame
    tilt(result)
    assert bpy.ops.gwrap.auto_ground() == {"FINISHED"}
    box = transformed(matrix_of(result.regions[0]), np.array([[0.0, 0.0, -1.0]]))
    assert box[0, 2] == pytest.approx(0.0, abs=1e-5)
    bpy.data.objects.remove(result.regions[0])
    with pytest.raises(RuntimeError, match="neither mesh nor region"):
        bpy.ops.gwrap.auto_ground()


def test_auto_ground_finds_the_floor_of_a_mesh(result: ImportedResult) -> None:
    tilt(result)
    assert bpy.ops.gwrap.auto_ground() == {"FINISHED"}, "a cube has no clear floor, and stands"
    up = matrix_of(result.frame)[:3, 2]
    assert up / np.linalg.norm(up) == pytest.approx([0, 0, 1], abs=1e-5)
    assert min(in_blender(result, v)[2] for v in range(8)) == pytest.approx(0.0, abs=1e-5)
    work = bmesh.new()
    bmesh.ops.create_grid(work, x_segments=20, y_segments=20, size=2.0)
    bmesh.ops.create_uvsphere(work, u_segments=24, v_segments=12, radius=0.5)
    bmesh.ops.translate(work, verts=work.verts[441:], vec=(0, 0, 0.8))
    work.to_mesh(result.meshes[0].data)
    work.free()
    tilt(result)
    assert bpy.ops.gwrap.auto_ground() == {"FINISHED"}
    heights = np.array([in_blender(result, v)[2] for v in range(441)])
    assert heights == pytest.approx(0.0, abs=1e-4)
    assert in_blender(result, 450)[2] > 0.1


@pytest.mark.parametrize(
    ("tool", "places", "text"),
    [
        ("set_scale", [[0, 0, 0]], "One point is picked"),
        ("set_scale", [[1, 0, 0], [1, 0, 0]], "coincide"),
        ("set_scale", [[0, 0, 0], [1, 0, 0], [2, 0, 0]], "3 are picked"),
        ("set_ground", [[0, 0, 0], [1, 0, 0]], "2 are picked"),
        ("set_ground", [[0, 0, 0], [1, 0, 0], [2, 0, 0]], "one line"),
        ("set_origin", [], "No point is picked"),
    ],
)
def test_wrong_picks_change_nothing(
    result: ImportedResult, tool: str, places: list, text: str
) -> None:
    bpy.ops.object.select_all(action="DESELECT")
    put_points(np.array(places, float).reshape(-1, 3))
    before = matrix_of(result.frame)
    with pytest.raises(RuntimeError, match=text):
        getattr(bpy.ops.gwrap, tool)()
    assert (matrix_of(result.frame) == before).all()
    assert stored(result) is None


def uneven(result: ImportedResult) -> None:
    result.frame.scale = (1, 2, 1)


def held(result: ImportedResult) -> None:
    result.frame.constraints.new("LIMIT_SCALE").use_max_x = True
    result.frame.constraints[0].max_x = 0.5


def nothing(_result: ImportedResult) -> None:
    pass


@pytest.mark.parametrize(
    ("spoil", "distance", "words"),
    [
        (nothing, 0.0, "not a distance"),
        (nothing, 1e30, "would be scaled"),
        (uneven, 1.0, "scaled differently"),
        (held, 50.0, "scaled differently|held in place"),
    ],
)
def test_scales_that_cannot_be_are_refused_and_reset_helps(
    result: ImportedResult,
    spoil: Callable[[ImportedResult], None],
    distance: float,
    words: str,
) -> None:
    spoil(result)
    bpy.context.view_layer.update()
    pick_vertices(result.meshes[0], [0, 7])
    before = matrix_of(result.frame)
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.gwrap.set_scale(distance=distance)
    if spoil is not held:
        assert (matrix_of(result.frame) == before).all()
        assert bpy.ops.gwrap.reset_placement() == {"FINISHED"}
        assert same_matrix(result.frame, Similarity())
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.mesh.primitive_cube_add()
    pick_vertices(bpy.context.view_layer.objects.active, [0, 1])
    with pytest.raises(RuntimeError, match="is not part of the result"):
        bpy.ops.gwrap.set_scale(distance=1.0)


def test_reset_leads_back_to_metres(job: Path, result: ImportedResult) -> None:
    path = job / "result" / "scene.json"
    values = json.loads(path.read_text())
    record = {"metric_from_world": Similarity(0.5).to_json(), "applied": True, "z_up": True}
    path.write_text(json.dumps({**values, "georeference": record}))
    assert bpy.ops.gwrap.reset_placement() == {"FINISHED"}
    wanted = Similarity(0.5).after(WORLD_FROM_SCENE)
    far = np.round(wanted.translation) if np.abs(wanted.translation).max() > 1e3 else 0.0
    moved = Similarity(wanted.scale, wanted.rotation, wanted.translation - far)
    assert same_matrix(result.frame, moved)
    assert stored(result) is not None
    path.write_text(json.dumps({**values, "georeference": {**record, "applied": False}}))
    assert bpy.ops.gwrap.reset_placement() == {"FINISHED"}
    assert same_matrix(result.frame, Similarity())


def test_the_frame_under_a_parent_of_the_user(result: ImportedResult) -> None:
    holder = bpy.data.objects.new("set", None)
    bpy.context.scene.collection.objects.link(holder)
    holder.location, holder.rotation_euler = (7, 8, 9), (0.5, 0, 1)
    result.frame.parent = holder
    bpy.context.view_layer.update()
    pick_vertices(result.meshes[0], [0, 2, 4])
    assert bpy.ops.gwrap.set_ground() == {"FINISHED"}
    assert in_blender(result, 0)[2] == pytest.approx(0.0, abs=1e-5)
    assert list(holder.location) == [7, 8, 9]


def push(message: str) -> None:
    bpy.ops.ed.undo_push(message=message)


def kept_in(job: Path) -> Similarity:
    found = read_placement(job / "result" / FILE_NAME, WORLD_FROM_SCENE)
    assert found is not None
    return found


def frame_now() -> bpy.types.Object:
    """Undo replaces objects: find the frame anew."""
    return next(o for o in bpy.data.objects if addon.kind_of(o) == "frame")


@pytest.mark.parametrize("mode", ["OBJECT", "EDIT"])
def test_undo_and_redo_take_the_file_along(job: Path, result: ImportedResult, mode: str) -> None:
    push("import")
    if mode == "EDIT":
        pick_vertices(result.meshes[0], [0, 7])
    else:
        put_points(np.array([in_blender(result, 0), in_blender(result, 7)]))
    push("picked")
    assert bpy.ops.gwrap.set_scale("EXEC_DEFAULT", distance=3.0) == {"FINISHED"}
    push("scaled")
    placed = placement.placement_of(frame_now())
    assert placed.scale == pytest.approx(np.sqrt(3.0), rel=1e-6)
    bpy.ops.ed.undo()
    assert same_matrix(frame_now(), Similarity())
    assert kept_in(job).scale == 1.0
    bpy.ops.ed.redo()
    assert same_matrix(frame_now(), placed)
    assert kept_in(job).to_json() == placed.to_json()


def test_undo_of_something_else_leaves_what_another_empty_has_written(
    job: Path, result: ImportedResult
) -> None:
    """A copied parent is of the same result: it must not write its own placement over this one."""
    twin = result.frame.copy()
    bpy.context.scene.collection.objects.link(twin)
    name = result.frame.name
    pick_vertices(result.meshes[0], [0, 7])
    assert bpy.ops.gwrap.set_scale("EXEC_DEFAULT", distance=3.0) == {"FINISHED"}
    push("scaled")
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("other", None))
    push("added")
    bpy.ops.ed.undo()
    kept = kept_in(job)
    assert kept.scale == pytest.approx(np.sqrt(3.0), rel=1e-6)
    assert same_matrix(bpy.data.objects[name], kept)


def start_again(job: Path) -> ImportedResult:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    imported = import_result(job / "result", bpy.context.scene)
    bpy.context.view_layer.update()
    return imported


def test_an_import_into_another_file_is_placed_the_same(job: Path, result: ImportedResult) -> None:
    tilt(result)
    pick_vertices(result.meshes[0], [0, 2, 4])
    bpy.ops.gwrap.set_ground()
    pick_vertices(result.meshes[0], [0, 7])
    bpy.ops.gwrap.set_scale(distance=0.123)
    expected = placement.placement_of(result.frame)
    lengths = [c.data.clip_end for c in result.cameras]
    again = start_again(job)
    assert placement.placement_of(again.frame).to_json() == expected.to_json(), "in double"
    assert same_matrix(again.frame, expected)
    assert [c.data.clip_end for c in again.cameras] == pytest.approx(lengths, rel=1e-5)
    values = json.loads((job / "result" / "scene.json").read_text())
    values["world_from_scene"]["scale"] *= 1.5
    (job / "result" / "scene.json").write_text(json.dumps(values))
    assert same_matrix(start_again(job).frame, Similarity()), "a placement of other cameras"


def test_keep_what_was_moved_by_hand(job: Path, result: ImportedResult) -> None:
    expected = tilt(result)
    again = start_again(job)
    assert same_matrix(again.frame, Similarity()), "a hand's move stays in its .blend"
    tilt(again)
    bpy.context.view_layer.objects.active = again.frame
    assert bpy.ops.gwrap.keep_placement() == {"FINISHED"}
    assert same_matrix(start_again(job).frame, expected)


def test_a_broken_placement_file_is_told_before_anything_changes(job: Path) -> None:
    (job / "result" / FILE_NAME).write_text('{"version": 1}')
    with pytest.raises(ParseError, match=r"placement\.json"):
        import_result(job / "result", bpy.context.scene)
    assert len(bpy.data.objects) == 0


def forget(_job: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(addon, "is_trusted", lambda _folder: False)


def remove(job: Path, _monkeypatch: pytest.MonkeyPatch) -> None:
    job.rename(job.with_name("gone"))


@pytest.mark.parametrize("spoil", [forget, remove])
def test_where_the_folder_cannot_be_written_the_scene_is_placed_all_the_same(
    job: Path,
    result: ImportedResult,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    spoil: Callable[[Path, pytest.MonkeyPatch], None],
) -> None:
    spoil(job, monkeypatch)
    pick_vertices(result.meshes[0], [0, 7])
    assert bpy.ops.gwrap.set_scale(distance=3.0) == {"FINISHED"}
    text = capfd.readouterr()
    assert "saved in this .blend file only" in text.out + text.err
    assert placement.placement_of(result.frame).scale == pytest.approx(np.sqrt(3.0), rel=1e-6)
    assert not list(job.parent.rglob(FILE_NAME))


def test_regions_and_later_meshes_live_under_the_same_transform(
    job: Path, result: ImportedResult
) -> None:
    box = result.regions[0]
    expected = region_from_object(box)
    tilt(result)
    bpy.ops.gwrap.auto_ground()
    pick_vertices(result.meshes[0], [0, 7])
    bpy.ops.gwrap.set_scale(distance=0.2)
    size = np.linalg.norm(np.ptp(expected, 0))
    found = region_from_object(box)
    assert np.abs(found - expected).max() < 1e-5 * size, "the same volume of the world"

    # A box drawn round what is seen now means what is seen now.
    corner = in_blender(result, 7)
    bpy.context.scene.cursor.location = corner
    bpy.ops.gwrap.add_region_box(around="CURSOR")
    drawn = region_from_object(bpy.context.view_layer.objects.active)
    vertex = np.array([result.meshes[0].data.vertices[7].co[:]], np.float64)
    assert np.abs(drawn.mean(0) - WORLD_FROM_SCENE.points(vertex)[0]).max() < 1e-5 * size

    time.sleep(0.01)
    write_region_result(job / "result" / "auto", half=0.5)
    write_region_result(job / "result" / "fine", half=0.25)
    placed = placement.placement_of(result.frame)
    again = import_result(job / "result", bpy.context.scene)
    bpy.context.view_layer.update()
    assert placement.placement_of(again.frame).to_json() == placed.to_json()
    fine = next(m for m in again.meshes if m[addon.REGION] == "fine")
    local = np.array(fine.data.vertices[7].co[:], np.float64)
    assert local == pytest.approx([0.25] * 3), "vertices stay in the scene frame"
    assert transformed(matrix_of(fine), local[None]) == pytest.approx(
        placed.points(local[None]), abs=1e-5
    )


def test_blend_and_usd_of_a_placed_result_are_placed(job: Path, result: ImportedResult) -> None:
    pick_vertices(result.meshes[0], [0, 4])
    bpy.ops.gwrap.set_scale(distance=0.5)
    write_blend(job / "result", job / "result" / "scene.blend")
    (mesh,) = [o for o in bpy.data.objects if addon.kind_of(o) == "mesh"]
    assert list(mesh.matrix_world.to_scale()) == pytest.approx([0.5] * 3)
    (path,) = export_usd(job / "result")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.usd_import(filepath=str(path))
    bpy.context.view_layer.update()
    (mesh,) = [o for o in bpy.data.objects if o.type == "MESH"]
    assert list(mesh.dimensions) == pytest.approx([0.5] * 3, rel=1e-5)


def test_many_steps_do_not_drift(result: ImportedResult) -> None:
    """The double is carried on, not what the empty's float32 angles round it to."""
    frame = result.frame
    wanted = Similarity()
    random = np.random.default_rng(4)
    for _ in range(40):
        turn = rotation_about(tuple(random.normal(size=3)), random.uniform(0, 6))
        step = Similarity(float(random.uniform(0.8, 1.25)), turn, random.normal(size=3))
        wanted = step.after(wanted)
        placement.place(frame, step.after(placement.placement_of(frame)))
    found = placement.placement_of(frame)
    assert np.abs(found.matrix() - wanted.matrix()).max() < 1e-12 * np.abs(wanted.matrix()).max()
    assert same_matrix(frame, wanted)
