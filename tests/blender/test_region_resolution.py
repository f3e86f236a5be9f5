# SPDX-License-Identifier: GPL-3.0-or-later
"""Edge lengths of single regions: which decides, and what is refused."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.meshing import spacing
from gaussian_wrapping_addon.ops import region_operators
from gaussian_wrapping_addon.ops.region_operators import checked_edge_length, own_lengths
from gaussian_wrapping_addon.ops.scene_objects import import_result
from tests.blender.synthetic_result import WORLD_FROM_SCENE, write_result

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture
def region(tmp_path: Path) -> bpy.types.Object:
    imported = import_result(write_result(tmp_path / "job"), bpy.context.scene)
    bpy.context.view_layer.update()
    return imported.regions[0]


def test_a_regions_own_length_goes_before_the_scenes(region: bpy.types.Object) -> None:
    scene = bpy.context.scene
    assert own_lengths(scene, [region], region.parent) == [None]
    scene.gwrap.resolution, scene.gwrap.edge_length = "EDGE_LENGTH", 0.1
    assert checked_edge_length(scene, region) == pytest.approx(0.1)
    region.gwrap.own_edge_length, region.gwrap.edge_length = True, 0.02
    assert checked_edge_length(scene, region) == pytest.approx(0.02)
    region.parent.scale = (2, 2, 2)
    bpy.context.view_layer.update()
    (length,) = own_lengths(scene, [region], region.parent)
    assert length == pytest.approx(0.02 / 2 * WORLD_FROM_SCENE.scale)
    scene.gwrap.method = "PIVOTS"
    assert own_lengths(scene, [region], region.parent) == [None]


@pytest.mark.parametrize(
    ("length", "words"),
    [(float("nan"), "not valid"), (float("inf"), "not valid"), (0.0, "not valid"),
     (-1.0, "not valid"), (1e3, "too coarse"), (1e-6, "too many")],
)  # fmt: skip
def test_impossible_lengths_are_refused(
    region: bpy.types.Object, length: float, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    region.gwrap.own_edge_length = True
    # Past the property's own limits, as another file or script might.
    monkeypatch.setattr(region_operators, "edge_length_in_blender", lambda *_: length)
    with pytest.raises(UsageError, match=words) as caught:
        checked_edge_length(bpy.context.scene, region)
    assert caught.value.hint


def test_the_limit_is_the_workers() -> None:
    assert region_operators.FINEST_SHARE == spacing.FINEST_SHARE
