# SPDX-License-Identifier: GPL-3.0-or-later
"""A dragged cage changes location and scale of its box alone, under any parent."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.regions.box import CUBE_CORNERS
from gaussian_wrapping_addon.ops import addon
from gaussian_wrapping_addon.ops.region_objects import (
    LEAST_HALF,
    cage_frame,
    cage_matrix,
    hull_in_blender,
    is_editable_box,
    set_cage_matrix,
    steadied,
)

pytestmark = pytest.mark.usefixtures("addon")


def make_box(*, parent: bool = True, scale: tuple = (0.5, 2.0, 0.1)) -> bpy.types.Object:
    collection = bpy.context.scene.collection
    thing = bpy.data.objects.new("box", None)
    thing.empty_display_type, thing.empty_display_size = "CUBE", 0.7
    thing[addon.KIND] = "region"
    thing.location, thing.rotation_euler, thing.scale = (0.4, -0.3, 0.9), (0.2, 0.5, -1.1), scale
    thing.delta_location, thing.delta_scale = (0.1, 0, 0), (1, 2, 1)
    collection.objects.link(thing)
    if parent:
        frame = bpy.data.objects.new("frame", None)
        frame.location, frame.rotation_euler = (10, -4, 2), (0.1, 0.7, 0.3)
        frame.scale = (1.5, 0.5, 2.0)  # with the box's rotation this shears
        collection.objects.link(frame)
        thing.parent = frame
    bpy.context.view_layer.update()
    return thing


def corners(thing: bpy.types.Object) -> np.ndarray:
    bpy.context.view_layer.update()
    return hull_in_blender(thing)[0]


@pytest.mark.parametrize(
    ("parent", "scale"), [(False, (0.5, 2.0, 0.1)), (True, (-0.5, 2.0, 0.1)), (True, (-1, -1, -1))]
)
def test_the_cage_is_the_box_and_moves_one_side(parent: bool, scale: tuple) -> None:
    thing = make_box(parent=parent, scale=scale)
    cage = cage_matrix(thing)
    whole = cage_frame(thing, np.zeros(3)) @ cage
    drawn = CUBE_CORNERS @ whole[:3, :3].T + whole[:3, 3]
    distances = np.linalg.norm(drawn[:, None] - corners(thing)[None], axis=2)
    assert distances.min(1).max() < 1e-5
    before, rotation = corners(thing), thing.rotation_euler.copy()
    wider = cage.copy()
    wider[0, 0] *= 1.5
    wider[0, 3] += 0.5 * cage[0, 0]  # the side at the lower end stays
    set_cage_matrix(thing, wider)
    after = corners(thing)
    assert thing.rotation_euler == rotation
    assert np.sign(thing.scale[:]).tolist() == np.sign(scale).tolist()
    assert cage_matrix(thing) == pytest.approx(wider, abs=1e-5)
    still = np.linalg.norm(before[:, None] - after[None], axis=2).min(1) < 1e-4
    assert still.sum() == 4, "the four corners of the side that stands still"


def test_a_side_stops_before_it_meets_the_opposite_one() -> None:
    thing = make_box()
    cage = cage_matrix(thing)
    low = cage[1, 3] - cage[1, 1]
    for half in (0.0, -0.4):
        inside_out = cage.copy()
        inside_out[1, 1] = half
        inside_out[1, 3] = low + half
        set_cage_matrix(thing, inside_out)
        found = cage_matrix(thing)
        assert found[1, 1] == pytest.approx(LEAST_HALF, rel=1e-3)
        assert found[1, 3] - found[1, 1] == pytest.approx(low, abs=1e-5)
        assert hull_in_blender(thing), "still a volume"
    before = thing.matrix_basis.copy()
    set_cage_matrix(thing, np.full((4, 4), np.nan))
    assert thing.matrix_basis == before


def test_a_touched_side_does_not_jump() -> None:
    before = np.diag([2.0, 1.0, 1.0, 1.0])
    first, later = before.copy(), before.copy()
    first[0, 0], first[0, 3] = 1.5, -0.5  # Blender wants +x, seen at an angle, at 1 instead of 2
    later[0, 0], later[0, 3] = 1.75, -0.25  # and then at 1.5: half as much again
    assert steadied(first, first, before) == pytest.approx(before)
    found = steadied(later, first, before)
    assert found[0, 3] + found[0, 0] == pytest.approx(3.0)
    assert found[0, 3] - found[0, 0] == pytest.approx(-2.0), "the other side stays"


def test_what_a_cage_cannot_edit() -> None:
    thing = make_box()
    assert is_editable_box(thing)
    for change, back in (
        ({"empty_display_type": "SPHERE"}, {"empty_display_type": "CUBE"}),
        ({"scale": (1, 0, 1)}, {"scale": (1, 1, 1)}),
        ({"lock_scale": (True, False, False)}, {"lock_scale": (False,) * 3}),
    ):
        for name, value in change.items():
            setattr(thing, name, value)
        assert not is_editable_box(thing), change
        for name, value in back.items():
            setattr(thing, name, value)
        assert is_editable_box(thing)
    constraint = thing.constraints.new("COPY_LOCATION")
    assert not is_editable_box(thing)
    thing.constraints.remove(constraint)
    thing.parent.scale = (0, 0, 0)
    bpy.context.view_layer.update()
    assert not is_editable_box(thing)
    assert not is_editable_box(None)
