# SPDX-License-Identifier: GPL-3.0-or-later
"""Quads by the real QuadriFlow: of any mesh that it can work on, and without a trace."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import bmesh
import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.mesh.textured_mesh import JoinedMesh, Polygons, join_triangles
from gaussian_wrapping_addon.ops import bake_objects
from gaussian_wrapping_addon.ops.bake_objects import Triangulation, quads_of, triangulation_of

WANTED = 400


def add_ball(radius: float = 1.0, subdivisions: int = 4) -> Any:
    """Add a ball of triangles away from the origin."""
    place = (100.0, -20.0, 3.0)
    bpy.ops.mesh.primitive_ico_sphere_add(
        subdivisions=subdivisions, radius=radius, location=place, calc_uvs=False
    )
    bpy.context.view_layer.update()
    return bpy.context.object


def quads_on(thing: Any, wanted: int = WANTED) -> Triangulation:
    return quads_of(thing.name, triangulation_of(thing), wanted)


def joined(found: Triangulation) -> JoinedMesh:
    """Return the polygons of triangles, without UVs."""
    none = np.zeros((*found.faces.shape, 2))
    return join_triangles(found.faces, none, Polygons(found.polygons, found.loops))


def file_content() -> object:
    """Return what is in the file, and what is active and selected."""
    names = {
        (kind, block.name)
        for kind in ("objects", "meshes", "materials", "collections")
        for block in getattr(bpy.data, kind)
    }
    things = {thing.name for thing in bpy.context.scene.objects}
    chosen = {thing.name for thing in bpy.context.selected_objects}
    return names, things, chosen, bpy.context.view_layer.objects.active.name


def volume(found: Triangulation) -> float:
    corners = (found.vertices - found.vertices.mean(axis=0))[found.faces]
    return float(np.einsum("fx,fx->", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]) / 6.0)


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (1.0, 2.0, -0.5), (1e-3, 1e-3, 1e-3)])
def test_quads_lie_on_the_object_and_nothing_else_changes(scale: tuple[float, ...]) -> None:
    thing = add_ball()
    thing.scale, thing.rotation_euler = scale, (0.4, -0.2, 1.0)
    bpy.context.view_layer.update()
    before = file_content()
    found = quads_on(thing)
    assert file_content() == before
    assert len(thing.data.polygons) == 1280
    mesh = joined(found)
    assert set(np.diff(np.append(mesh.starts, len(mesh.corners)))) == {4}
    assert 0.7 * WANTED < len(mesh.starts) < 1.1 * WANTED
    local = (found.vertices - np.array(thing.matrix_world)[:3, 3]) @ np.linalg.inv(
        np.array(thing.matrix_world)[:3, :3]
    ).T
    assert np.abs(np.linalg.norm(local, axis=1) - 1.0).max() < 0.03
    ball = 4.0 / 3.0 * np.pi * abs(np.prod(scale))
    assert volume(found) == pytest.approx(ball, rel=0.05)  # positive: faces point outwards


def test_quads_of_a_scaled_object_are_squares_where_it_is_shown() -> None:
    """Not squares that are scaled with the object."""
    thing = add_ball(subdivisions=5)
    before = quads_on(thing, 1000)
    thing.scale = (1.0, 1.0, 4.0)
    bpy.context.view_layer.update()
    scaled = replace(before, vertices=before.vertices * [1.0, 1.0, 4.0])
    assert sides(quads_on(thing, 1000)) < 0.85 * sides(scaled)


def sides(found: Triangulation) -> float:
    """Return how much longer than the shortest side of a quad the longest is."""
    corners = found.vertices[joined(found).corners.reshape(-1, 4)]
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return float(np.median(lengths.max(axis=1) / lengths.min(axis=1)))


def test_the_same_mesh_gives_the_same_quads() -> None:
    thing = add_ball()
    one, other = quads_on(thing), quads_on(thing)
    assert np.array_equal(one.vertices, other.vertices)
    assert np.array_equal(one.faces, other.faces)


def test_edges_too_short_for_blender_are_none_of_the_user_s_business() -> None:
    """Blender refuses edges below 1e-4, as fine meshes of small things have."""
    thing = add_ball(radius=1e-3)
    assert len(joined(quads_on(thing)).starts) > 0.7 * WANTED
    assert bpy.ops.object.quadriflow_remesh(mode="FACES", target_faces=WANTED) == {"CANCELLED"}


def test_repeated_and_loose_corners_and_edges_without_length_do_not_matter() -> None:
    """As glTF files have them, and as cuts and booleans leave them."""
    thing = add_ball()
    one, other = thing.data.edges[7].vertices
    thing.data.vertices[one].co = thing.data.vertices[other].co.lerp(
        thing.data.vertices[one].co, 1e-7
    )
    assert volume(quads_on(thing)) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.05)
    corners = [v for polygon in thing.data.polygons for v in polygon.vertices]
    points = [thing.data.vertices[v].co.copy() for v in corners]
    thing.data.clear_geometry()
    faces = np.arange(len(points)).reshape(-1, 3).tolist()
    thing.data.from_pydata([*points, (9.0, 9.0, 9.0)], [], faces)
    assert volume(quads_on(thing)) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.05)
    for vertex in thing.data.vertices:
        vertex.co = (1.0, 2.0, 3.0)
    with pytest.raises(UsageError, match="have no area"):
        quads_on(thing)


def test_modifiers_count_and_large_meshes_are_decimated(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(bake_objects, "MAX_TRIANGLES", 2000)
    caplog.set_level("INFO", bake_objects.__name__)
    thing = add_ball()
    thing.modifiers.new("More", "SUBSURF").levels = 1
    before = file_content()
    found = quads_on(thing)
    assert file_content() == before
    assert "decimating 7680 triangles to 2000" in caplog.text
    assert volume(found) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.1)


def test_the_border_of_an_open_mesh_stays() -> None:
    thing = add_ball()
    edit(thing, lambda work: bmesh.ops.bisect_plane(
        work, geom=[*work.verts, *work.edges, *work.faces], plane_co=(0, 0, 0),
        plane_no=(0, 0, 1), clear_outer=True,
    ))  # fmt: skip
    found = quads_on(thing)
    edges = np.sort(np.stack([found.faces, np.roll(found.faces, -1, 1)], -1).reshape(-1, 2), 1)
    border, count = np.unique(edges, axis=0, return_counts=True)
    border = np.unique(border[count == 1])
    assert len(border) > 20
    assert np.abs(found.vertices[border, 2] - thing.location.z).max() < 0.02


def edit(thing: Any, change: Callable[[Any], object]) -> None:
    work = bmesh.new()
    work.from_mesh(thing.data)
    for kind in (work.verts, work.edges, work.faces):
        kind.ensure_lookup_table()
    change(work)
    work.to_mesh(thing.data)
    work.free()


def flip(work: Any) -> None:
    work.faces[5].normal_flip()


def add_fin(work: Any) -> None:
    work.faces.new((*work.edges[0].verts, work.verts.new((2.0, 2.0, 2.0))))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (flip, "faces point to opposite sides at 3 of its edges"),
        (add_fin, "more than two faces meet at 1 of its edges"),
    ],
)
def test_what_quadriflow_cannot_work_on_is_refused_with_numbers(
    change: Callable[[Any], None], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    thing = add_ball()
    edit(thing, change)
    before = file_content()
    with pytest.raises(UsageError, match=words) as caught:
        quads_on(thing)
    assert thing.name in caught.value.message
    assert "Voxel" in caught.value.hint
    # Blender itself refuses it too, without saying why: that is reported as well.
    monkeypatch.setattr(bake_objects, "_refuse_unsound", lambda *_: False)
    with pytest.raises(UsageError, match=r"made no quads of the 128\d triangles"):
        quads_on(thing)
    assert file_content() == before
