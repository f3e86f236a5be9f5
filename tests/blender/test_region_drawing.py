# SPDX-License-Identifier: GPL-3.0-or-later
"""What is drawn of regions: edges, which regions, when they change, and what goes wrong."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.regions.box import CUBE_CORNERS
from gaussian_wrapping_addon.ops import addon, region_operators
from gaussian_wrapping_addon.ops.region_objects import create_region
from gaussian_wrapping_addon.ui import region_panel

pytestmark = pytest.mark.usefixtures("addon")


def box(name: str = "box") -> bpy.types.Object:
    thing = create_region(name, CUBE_CORNERS * (1, 2, 3), None, bpy.context.scene.collection)
    bpy.context.view_layer.update()
    return thing


def mesh_region() -> bpy.types.Object:
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=1)
    thing = bpy.context.view_layer.objects.active
    thing[addon.KIND] = "region"
    bpy.context.view_layer.update()
    return thing


def names() -> list[str]:
    found = region_panel.visible_regions(bpy.context.scene, bpy.context.view_layer)
    return [thing.name for thing in found]


def test_a_convex_mesh_is_its_own_edges_and_a_dent_is_none() -> None:
    thing = mesh_region()  # an icosahedron
    edges = region_panel.edges_of(thing)
    assert edges is not None
    own = {
        tuple(sorted(tuple(np.round(thing.data.vertices[i].co, 4)) for i in edge.vertices))
        for edge in thing.data.edges
    }
    drawn = {tuple(sorted(tuple(np.round(p, 4)) for p in edge)) for edge in edges.astype(float)}
    assert len(own) == 30
    same = [
        min(np.abs(np.array(a) - np.array(b)).max() for b in own) < 1e-3 for a in drawn
    ]  # fmt: skip
    assert len(drawn) == 30
    assert all(same)
    thing.data.vertices[0].co *= 0.01
    thing.data.update()
    bpy.context.view_layer.update()
    dented = region_panel.edges_of(thing)
    assert dented is not None
    assert np.linalg.norm(dented, axis=2).min() > 0.5, "nothing is drawn to a dent"


def test_what_is_no_region_draws_nothing() -> None:
    bpy.ops.curve.primitive_bezier_circle_add()
    assert region_panel.edges_of(bpy.context.view_layer.objects.active) is None
    line = bpy.data.meshes.new("line")
    line.from_pydata([(0, 0, 0), (0, 0, 1)], [(0, 1)], [])
    assert region_panel.edges_of(bpy.data.objects.new("line", line)) is None
    bpy.ops.object.empty_add(type="SPHERE")
    assert region_panel.edges_of(bpy.context.view_layer.objects.active) is None


def test_hidden_regions_are_left_out_and_the_active_one_is_last() -> None:
    first, second, third = box("a"), box("b"), box("c")
    assert sorted(names()) == ["a", "b", "c"]
    first.select_set(True)
    bpy.context.view_layer.objects.active = first
    assert names()[-1] == "a"
    second.hide_set(True)
    third.hide_viewport = True
    bpy.context.view_layer.update()
    assert names() == ["a"]
    second.hide_set(False)
    third.hide_viewport = False
    bpy.context.view_layer.update()
    bpy.data.objects.remove(third)
    assert sorted(names()) == ["a", "b"]
    second.name = "z"
    bpy.context.view_layer.update()
    assert sorted(names()) == ["a", "z"]


def test_edges_are_made_anew_only_where_the_shape_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(region_panel, "_made", lambda edges: made.append(edges) or len(made))
    cube, ball = box(), mesh_region()
    edges = region_panel.edges_of(cube)
    assert edges is not None
    steps = np.abs(edges[:, 1] - edges[:, 0])
    assert ((steps > 0).sum(1) == 1).all(), "along the axes, none across a side"
    assert len({tuple(sorted(map(tuple, edge))) for edge in edges.tolist()}) == 12
    first = region_panel._batch(cube), region_panel._batch(ball)
    assert len(made) == 2
    cube.location.x, ball.location.x = 3, 4  # the matrix moves what is drawn
    bpy.context.view_layer.update()
    assert (region_panel._batch(cube), region_panel._batch(ball)) == first
    cube.empty_display_size = 2.0
    ball.data.vertices[0].co *= 2.0
    ball.data.update()
    bpy.context.view_layer.update()
    assert region_panel._batch(cube) != first[0]
    assert region_panel._batch(ball) != first[1]
    assert len(made) == 4
    assert made[2] == pytest.approx(2.0 * made[0])
    monkeypatch.setattr(region_panel, "MOST_CACHED", 1)
    region_panel._batch(cube)
    assert len(region_panel._drawing.batches) <= 4
    region_operators.forget()
