# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions that people make by accident or on purpose."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.ops import addon
from gaussian_wrapping_addon.ops.region_objects import (
    MOST_CANDIDATES,
    convex_hull,
    is_convex,
    local_hull,
)
from tests.blender.job_play import (
    play_to,
    play_until,
    select,
    start_wrap,
    status_of,
)
from tests.blender.placed_scene import region_from_object
from tests.blender.synthetic_result import WORLD_FROM_SCENE

pytestmark = pytest.mark.usefixtures("ended_workers")

LIMIT_S = 60.0
"""Of processor time, for a mesh of a million faces; it took 4."""


def volume(points: np.ndarray) -> float:
    vertices, triangles = convex_hull(points, "test")
    corners = vertices[np.array(triangles)] - vertices.mean(0)  # (m, 3, 3)
    return float(np.abs(np.linalg.det(corners)).sum()) / 6.0


def grid_mesh(side: int, shape: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> object:
    """Make an object of (side - 1)^2 quads bent to a shape."""
    u, v = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), indexing="ij")
    index = np.arange(side * side, dtype=np.int32).reshape(side, side)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).ravel()
    mesh = bpy.data.meshes.new("grid")
    mesh.vertices.add(side * side)
    mesh.vertices.foreach_set("co", shape(u, v).astype(np.float32).ravel())
    mesh.loops.add(len(quads))
    mesh.loops.foreach_set("vertex_index", quads)
    mesh.polygons.add(len(quads) // 4)
    mesh.polygons.foreach_set("loop_start", np.arange(0, len(quads), 4, dtype=np.int32))
    mesh.update(calc_edges=True)
    thing = bpy.data.objects.new("grid", mesh)
    bpy.context.scene.collection.objects.link(thing)
    bpy.context.view_layer.update()
    return thing


def ball(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    ring = np.sin(np.pi * v)
    return np.stack(
        [ring * np.cos(2 * np.pi * u), ring * np.sin(2 * np.pi * u), np.cos(np.pi * v)], -1
    )


def test_36_shear_through_the_parent_is_in_the_hull() -> None:
    parent = bpy.data.objects.new("parent", None)
    box = bpy.data.objects.new("box", None)
    for thing in (parent, box):
        bpy.context.scene.collection.objects.link(thing)
    box.empty_display_type, box.empty_display_size = "CUBE", 1.0
    box.parent, parent.scale, box.rotation_euler = parent, (3, 1, 1), (0, 0, np.pi / 4)
    bpy.context.view_layer.update()
    found = region_from_object(box)
    root = np.sqrt(2.0)
    wanted = [(x, y, z) for x, y in ((3 * root, 0), (-3 * root, 0), (0, root), (0, -root))
              for z in (-1, 1)]  # fmt: skip
    distances = np.linalg.norm(found[:, None] - np.array(wanted), axis=2)
    assert distances.min(0).max() < 1e-5
    assert volume(found) == pytest.approx(24.0, rel=1e-5)
    edges = found[[1, 2, 4]] - found[0]
    assert abs(edges[1] @ edges[2]) > 1.0, "not a box any more"


def test_36_a_million_faces_are_a_hull_or_refused() -> None:
    random = np.random.default_rng(0)
    cases: tuple[tuple[Callable[..., np.ndarray], float | None], ...] = (
        (lambda u, v: np.clip(3 * ball(u, v), -1, 1), 8.0),
        (lambda u, v: ball(u, v) * random.uniform(0.3, 1, u.shape)[..., None], 4.0),
        (ball, None),
    )
    for shape, least in cases:
        thing = grid_mesh(1001, shape)
        assert len(thing.data.polygons) == 1_000_000  # type: ignore[attr-defined]
        begun_s = time.process_time()
        if least is None:
            with pytest.raises(UsageError, match="too fine") as caught:
                local_hull(thing)  # type: ignore[arg-type]
            assert "Add Region Box" in caught.value.hint
        else:
            vertices, _ = local_hull(thing)  # type: ignore[arg-type]
            assert len(vertices) < 10_000
            assert volume(vertices) >= least * (1 - 1e-5)
        assert time.process_time() - begun_s < LIMIT_S
        bpy.data.meshes.remove(thing.data)  # type: ignore[attr-defined]


def test_36_what_is_left_out_of_a_hull_lies_in_it() -> None:
    random = np.random.default_rng(4)
    points = random.normal(size=(20_000, 3)) * (5, 1, 0.2) + (100, -40, 3)
    vertices, triangles = convex_hull(points, "cloud")
    corners = vertices[np.array(triangles)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= np.sign(((corners[:, 0] - vertices.mean(0)) * normals).sum(1, keepdims=True))
    above = points @ normals.T - (normals * corners[:, 0]).sum(1)
    assert above.max() < 1e-4
    assert len(points) < MOST_CANDIDATES


def test_36_geometry_of_a_modifier_alone() -> None:
    mesh = bpy.data.meshes.new("line")
    mesh.from_pydata([(0, 0, 0), (0, 0, 2)], [(0, 1)], [])
    thing = bpy.data.objects.new("line", mesh)
    bpy.context.scene.collection.objects.link(thing)
    bpy.context.view_layer.update()
    with pytest.raises(UsageError, match="2 vertices"):
        region_from_object(thing)
    thing.modifiers.new("skin", "SKIN")
    bpy.context.view_layer.update()
    found = region_from_object(thing)
    assert np.ptp(found, 0)[2] > 1.9
    assert volume(found) > 0.5


def test_36_a_dented_mesh_is_told_that_its_hull_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    bpy.ops.mesh.primitive_monkey_add()
    thing = bpy.context.view_layer.objects.active
    assert not is_convex(thing)
    told: list[tuple[set[str], str]] = []
    from gaussian_wrapping_addon.ops.region_operators import GWRAP_OT_use_as_region

    class Fake:
        def report(self, kind: set[str], text: str) -> None:
            told.append((kind, text))

    GWRAP_OT_use_as_region.work(Fake(), bpy.context)  # type: ignore[arg-type]
    assert told == [({"WARNING"}, f"{thing.name} is not convex: its convex hull is the region")]
    bpy.ops.mesh.primitive_ico_sphere_add()
    told.clear()
    GWRAP_OT_use_as_region.work(Fake(), bpy.context)  # type: ignore[arg-type]
    assert told == []


def test_36_an_object_of_another_scene() -> None:
    """Its own transform counts; modifiers that nobody has evaluated are refused with words."""
    other = bpy.data.scenes.new("Other")
    box = bpy.data.objects.new("box", None)
    box.empty_display_type, box.location = "CUBE", (5, 0, 0)
    other.collection.objects.link(box)
    bpy.context.view_layer.update()
    assert region_from_object(box).mean(0) == pytest.approx([5, 0, 0])
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.view_layer.objects.active
    bpy.context.scene.collection.objects.unlink(cube)
    other.collection.objects.link(cube)
    cube.location = (0, 7, 0)
    bpy.context.view_layer.update()
    assert region_from_object(cube).mean(0) == pytest.approx([0, 7, 0])
    cube.modifiers.new("array", "ARRAY")
    with pytest.raises(UsageError, match="not evaluated") as caught:
        region_from_object(cube)
    assert caught.value.hint


def test_36_an_object_of_a_library_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "library.blend"
    bpy.ops.mesh.primitive_ico_sphere_add()
    bpy.context.view_layer.objects.active.name = "Shared"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(path), link=True) as (_, into):
        into.objects = ["Shared"]
    (thing,) = into.objects
    bpy.context.scene.collection.objects.link(thing)
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = thing
    with pytest.raises(RuntimeError, match="linked from a library"):
        bpy.ops.gwrap.use_as_region()
    assert addon.kind_of(thing) == ""
    assert len(region_from_object(thing)) == 42, "its volume can be exported all the same"


def regions() -> list[bpy.types.Object]:
    return list(addon.objects_of_kind(bpy.context.scene, "region"))


def mesh_names() -> set[str]:
    return {m[addon.REGION] for m in addon.objects_of_kind(bpy.context.scene, "mesh")}


def box_at(x: float, name: str) -> bpy.types.Object:
    bpy.context.scene.cursor.location = (x, 0, 0)
    bpy.ops.gwrap.add_region_box()
    thing = bpy.context.view_layer.objects.active
    thing.name = name
    bpy.context.view_layer.update()
    return thing


@pytest.mark.parametrize("change", ["deleted", "renamed", "moved away", "collection deleted"])
def test_36_a_region_changed_while_its_job_runs(
    change: str, photos: Path, worker: Callable[[str], None]
) -> None:
    folder = start_wrap(photos)
    play_to(folder, "DONE")
    box = box_at(1.0, "Door")
    select(box)
    worker("slow")
    (folder / "finish").unlink(missing_ok=True)
    bpy.ops.gwrap.mesh_region()
    play_until(lambda: status_of(folder).fraction == 0.25, "never at work")
    before = len(regions())
    if change == "deleted":
        bpy.ops.gwrap.delete_region(name="Door")
    elif change == "renamed":
        box.name = "Window"
    elif change == "moved away":
        box.parent = None
    else:
        bpy.data.collections.remove(box.users_collection[0])
    (folder / "finish").touch()
    play_to(folder, "DONE")
    assert status_of(folder).error == ""
    assert {"auto", "Door"} <= mesh_names(), "the result is there under the name it was asked by"
    if change == "renamed":
        assert len(regions()) == before
        assert box[addon.REGION] == "Door"
        assert box.name == "Window", "the person's name stays"
    else:
        (made,) = [r for r in regions() if r[addon.REGION] == "Door" and addon.frame_of(r)]
        assert volume(region_from_object(made)) > 0.0, "a box is made of the result's own"
    assert not [o for o in bpy.data.objects if o.name.startswith("Door") and not o.users]


def test_36_copies_and_new_names_never_overwrite(photos: Path, worker: object) -> None:
    folder = start_wrap(photos)
    play_to(folder, "DONE")
    first = box_at(1.0, "Door")
    copy = first.copy()
    first.users_collection[0].objects.link(copy)
    copy.location.x += 2.0

    def mesh(*things: bpy.types.Object) -> list[str]:
        select(*things)
        bpy.ops.gwrap.mesh_region()
        bodies = read_job(folder / "job.json").region_bodies.values()
        play_to(folder, "DONE")
        return [body["blender_object_name"] for body in bodies]

    mesh(first, copy)
    assert {"auto", "Door", "Door_001"} <= mesh_names()
    assert (first[addon.REGION], copy[addon.REGION]) == ("Door", "Door_001")
    third = copy.copy()  # carries the mark of its origin
    first.users_collection[0].objects.link(third)
    copy.name = "Old Copy"
    third.name = "Third"
    mesh(third)
    assert third[addon.REGION] == "Third"
    assert {"auto", "Door", "Door_001", "Third"} == mesh_names()
    mesh(copy)
    assert copy[addon.REGION] == "Door_001", "the one that is left keeps its folder"
    assert {"auto", "Door", "Door_001", "Third"} == mesh_names()
    assert {p.name for p in (folder / "result").iterdir() if (p / "mesh.npz").is_file()} == (
        mesh_names()
    )


def test_36_a_region_far_outside_the_scene_is_sent_as_it_is(photos: Path, worker: object) -> None:
    folder = start_wrap(photos)
    play_to(folder, "DONE")
    box = box_at(1e6, "Far")
    select(box)
    bpy.ops.gwrap.mesh_region()
    ((_, body),) = read_job(folder / "job.json").region_bodies.items()
    wanted = WORLD_FROM_SCENE.points(np.array([[1e6, 0, 0]]))
    assert np.mean(body["vertices"], 0) == pytest.approx(wanted[0], rel=1e-6)
    play_to(folder, "DONE")
