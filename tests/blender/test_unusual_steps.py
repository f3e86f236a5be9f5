# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps in an order that nobody planned: none may cost an earlier result, none may raise."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.ops import addon
from gaussian_wrapping_addon.ops.scene_objects import import_result
from tests.blender.job_play import meshes, play_to, play_until, start_wrap
from tests.blender.synthetic_result import write_region_result

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture
def job(ended_workers: None, worker: object, tmp_path: Path) -> Path:
    """The folder of a finished job whose result the scene shows."""
    folder = start_wrap(_photos(tmp_path / "first"))
    play_to(folder, "DONE")
    play_until(lambda: meshes() > 0, "the result is imported")
    return folder


def _photos(folder: Path) -> Path:
    folder.mkdir()
    (folder / "a.jpg").write_bytes(b"x")
    return folder


def _of_kind(kind: str) -> list[bpy.types.Object]:
    return [thing for thing in bpy.data.objects if addon.kind_of(thing) == kind]


def test_photos_typed_over_others_leave_the_finished_job_alone(job: Path, tmp_path: Path) -> None:
    before = (job / "job.json").read_bytes()
    second = start_wrap(_photos(tmp_path / "second"))
    play_to(second, "DONE")
    assert second == tmp_path / "second_wrap"
    assert (job / "job.json").read_bytes() == before


def test_the_same_photos_again_keep_a_chosen_output(job: Path, tmp_path: Path) -> None:
    bpy.context.scene.gwrap.output = str(tmp_path / "chosen")
    assert start_wrap(tmp_path / "first") == tmp_path / "chosen"
    play_to(tmp_path / "chosen", "DONE")
    assert start_wrap(tmp_path / "first") == tmp_path / "chosen"
    play_to(tmp_path / "chosen", "DONE")


def test_a_whole_disk_as_source_is_refused() -> None:
    scene = bpy.context.scene
    scene.gwrap.source = Path.cwd().anchor
    with pytest.raises(RuntimeError, match="whole disk"):
        bpy.ops.gwrap.wrap_scene()
    assert scene.gwrap.job_folder == ""


@pytest.mark.usefixtures("job")
def test_a_box_is_added_where_the_results_collection_is_left_out() -> None:
    layer = bpy.context.view_layer
    for child in layer.layer_collection.children:
        child.exclude = True
    before = len(_of_kind("region"))
    assert bpy.ops.gwrap.add_region_box(around="CURSOR") == {"FINISHED"}
    assert len(_of_kind("region")) == before + 1
    assert layer.objects.active.parent == _of_kind("frame")[0]


@pytest.mark.usefixtures("job")
@pytest.mark.parametrize("overridden", [False, True])
def test_a_box_is_added_to_a_result_that_is_linked(overridden: bool, tmp_path: Path) -> None:
    library = tmp_path / "library ü.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(library))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(library), link=True) as (there, wanted):
        wanted.collections = [name for name in there.collections if name.endswith("_wrap")]
    (linked,) = wanted.collections
    bpy.context.scene.collection.children.link(linked)
    if overridden:
        linked.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    bpy.context.view_layer.update()
    assert bpy.ops.gwrap.add_region_box(around="RESULT") == {"FINISHED"}
    thing = bpy.context.view_layer.objects.active
    assert thing.library is None
    assert addon.kind_of(thing.parent) == "frame"


def test_a_full_copy_of_a_scene_gets_its_own_meshes(job: Path) -> None:
    first = bpy.context.scene
    before = set(first.objects)
    bpy.ops.scene.new(type="FULL_COPY")
    copied = bpy.context.scene
    bpy.ops.gwrap.add_region_box(around="RESULT")
    assert bpy.ops.gwrap.mesh_region() == {"FINISHED"}
    play_until(lambda: meshes() == 2, "the copy has two meshes")
    assert set(first.objects) == before
    assert not before & set(copied.objects)
    assert job.is_dir()


def test_a_new_box_does_not_take_the_name_of_a_mesh_whose_box_was_deleted(job: Path) -> None:
    bpy.ops.gwrap.add_region_box(around="RESULT")
    assert bpy.ops.gwrap.mesh_region() == {"FINISHED"}
    play_until(lambda: meshes() == 2, "the region is meshed")
    thing = next(t for t in _of_kind("mesh") if t[addon.REGION] == "Region")
    assert bpy.ops.gwrap.delete_region(name="Region") == {"FINISHED"}
    bpy.ops.gwrap.add_region_box(around="RESULT")
    assert bpy.ops.gwrap.mesh_region() == {"FINISHED"}
    play_until(lambda: meshes() == 3, "the second region stands beside the first")
    names = {path.name for path in (job / "result").iterdir() if path.is_dir()}
    assert names == {"auto", "Region", "Region_2"}
    assert thing[addon.REGION] == "Region"


def test_a_mesh_in_edit_mode_in_another_scene_is_brought_up_to_date_later(job: Path) -> None:
    (thing,) = _of_kind("mesh")
    first = bpy.context.scene
    bpy.context.view_layer.objects.active = thing
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.context.window.scene = bpy.data.scenes.new("Second")
    write_region_result(job / "result" / thing[addon.REGION], half=0.2)
    with pytest.raises(UsageError, match="Edit Mode"):
        import_result(job / "result", bpy.context.scene)
    bpy.context.window.scene = first
    bpy.ops.object.mode_set(mode="OBJECT")
    import_result(job / "result", first)
    corners = np.array([v.co[:] for v in thing.data.vertices])
    assert np.ptp(corners, axis=0) == pytest.approx(0.4)
