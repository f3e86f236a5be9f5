# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake Photos with the real worker: meshes of any origin, wherever they and the result stand."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.ops import addon, baking
from gaussian_wrapping_addon.ops.bake_objects import world_mesh
from gaussian_wrapping_addon.ops.scene_objects import shading_of
from gaussian_wrapping_addon.ui import mesh_panel
from tests.blender import job_play
from tests.blender.baked_ball import add_ball, image_of, import_ball, psnr_of_textures
from tests.blender.ball_job import write_ball_job
from tests.blender.fake_layout import draw
from tests.blender.synthetic_result import write_region_result
from tests.proofs import first_then_proofs

pytestmark = [
    pytest.mark.usefixtures("ended_workers"),
    pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="needs torch beside bpy"),
]

POLYGONS = 32 * 20
"""Of the ball: quads, and triangles around the poles."""
QUADS = 32 * 18
TRIANGLES = 2 * 32 * 18 + 2 * 32
GOOD_DB = 20.0
"""Photos of 32 x 32 pixels: what the job's own mesh reaches."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> JobFolder:
    return write_ball_job(tmp_path_factory.mktemp("ball"))


@pytest.fixture
def job(finished: JobFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobFolder:
    """A copy of the job; bakes run in this Python."""
    monkeypatch.setenv(PYTHON_VARIABLE, sys.executable)
    monkeypatch.setattr(job_play, "WAIT_S", 120.0)
    shutil.copytree(finished.root, tmp_path / "ball")
    bpy.context.scene.gwrap.texture_size = "1024"
    return JobFolder(tmp_path / "ball")


def press(job: JobFolder, *states: str) -> JobStatus:
    """Press the button and play the job to its end."""
    assert bpy.ops.gwrap.bake_photos() == {"FINISHED"}
    assert Path(bpy.context.scene.gwrap.job_folder) == job.root
    return job_play.play_to(job.root, *(states or ("DONE", "FAILED")))


@pytest.mark.parametrize("told", first_then_proofs([True, False]))
def test_a_foreign_mesh_without_uvs_gets_uvs_and_texture(
    told: bool, job: JobFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its quads and the object stay; seams may only cut quads that the worker is not told of."""
    if not told:
        monkeypatch.setattr(
            baking, "world_mesh", lambda *a, **k: world_mesh(*a, **{**k, "with_polygons": 0})
        )
    import_ball(job)
    thing = add_ball()
    roughen(thing)
    before = np.array(thing.matrix_world), len(bpy.data.objects)
    assert not thing.data.uv_layers
    painted = thing.data.color_attributes.new("Painted", "BYTE_COLOR", "CORNER")
    painted.data.foreach_set("color", np.tile([0.25, 0.5, 1.0, 1.0], len(thing.data.loops)))
    status = press(job)
    assert status.state == "DONE", status.error
    thing = bpy.context.object
    assert [layer.name for layer in thing.data.uv_layers] == ["Photos"]
    assert thing.data.uv_layers["Photos"].active_render
    sides = [len(polygon.vertices) for polygon in thing.data.polygons]
    assert sum(side - 2 for side in sides) == TRIANGLES
    assert sides.count(4) == QUADS if told else 0.5 * QUADS < sides.count(4) < QUADS
    colors = {tuple(c.color_srgb[:]) for c in thing.data.color_attributes["Painted"].data}
    assert len(colors) == 1, "divided polygons keep their other attributes"
    assert psnr_of_textures(thing) > GOOD_DB
    assert (np.array(thing.matrix_world) == before[0]).all()
    assert len(bpy.data.objects) == before[1]
    assert thing.data.validate() is False
    assert Path(image_of(thing).filepath) == job.baked / "Foreign" / "albedo.png"
    assert "% seen by photos" in draw(mesh_panel.GWRAP_PT_bake).texts
    assert job.read_status().state == "DONE"


def roughen(thing: Any) -> None:
    """Move the vertices a little, so that seams of new UVs are ragged."""
    points = np.empty(3 * len(thing.data.vertices), np.float32)
    thing.data.vertices.foreach_get("co", points)
    points += np.random.default_rng(0).normal(0.0, 0.02, len(points)).astype(np.float32)
    thing.data.vertices.foreach_set("co", points)


def test_own_uvs_and_other_attributes_stay(job: JobFolder) -> None:
    import_ball(job)
    thing = add_ball(uvs=True)
    group = thing.vertex_groups.new(name="mine")
    group.add([0, 1, 2], 0.5, "REPLACE")
    before = uvs_of(thing)
    # UVs of the ball reach from 0 to 1: the poles' triangles overlap nothing.
    assert press(job).state == "DONE"
    thing = bpy.context.object
    assert (uvs_of(thing) == before).all()
    assert len(thing.data.polygons) == POLYGONS
    assert [group.name for group in thing.vertex_groups] == ["mine"]
    assert psnr_of_textures(thing) > GOOD_DB
    # Moved by its user meanwhile, and baked again: what lies elsewhere now is painted anew.
    stamp = (job.baked / "Foreign" / "albedo.png").read_bytes()
    thing.rotation_euler = (1.4, 0.2, -1.0)
    assert press(job).state == "DONE"
    assert [path.name for path in job.baked.iterdir()] == ["Foreign"]
    assert (job.baked / "Foreign" / "albedo.png").read_bytes() != stamp
    assert psnr_of_textures(bpy.context.object) > GOOD_DB


def uvs_of(thing: bpy.types.Object) -> np.ndarray:
    layer: Any = thing.data.uv_layers.active
    values = np.empty(2 * len(layer.uv), np.float32)
    layer.uv.foreach_get("vector", values)
    return values


@pytest.mark.proof
def test_udim_tiles_become_one_tiled_image(job: JobFolder) -> None:
    import_ball(job)
    thing = add_ball(uvs=True)
    layer: Any = thing.data.uv_layers.active
    for polygon in thing.data.polygons:
        if polygon.center.x > 0.0:
            for loop in polygon.loop_indices:
                layer.uv[loop].vector.x += 1.0
                layer.uv[loop].vector.y += 1.0
    bpy.context.scene.gwrap.bake.uvs = "OWN"
    assert press(job).state == "DONE"
    image = image_of(bpy.context.object)
    assert image.source == "TILED"
    assert [tile.number for tile in image.tiles] == [1001, 1012]
    assert Path(image.filepath).name == "albedo.<UDIM>.png"
    assert psnr_of_textures(bpy.context.object) > GOOD_DB


@pytest.mark.proof
def test_modifiers_of_a_mirrored_object_are_baked_for_and_stay(job: JobFolder) -> None:
    import_ball(job)
    thing = add_ball(uvs=True)
    thing.modifiers.new("More", "SUBSURF").levels = 1
    thing.scale.x *= -1.0
    assert press(job).state == "DONE"
    thing = bpy.context.object
    assert [modifier.type for modifier in thing.modifiers] == ["SUBSURF"]
    assert len(thing.data.polygons) == POLYGONS
    assert psnr_of_textures(thing) > GOOD_DB


@pytest.mark.proof
def test_fewer_faces_become_a_lighter_object_with_a_normal_map(job: JobFolder) -> None:
    frame = import_ball(job)
    thing = add_ball()
    bpy.ops.object.mode_set(mode="OBJECT")
    bake = bpy.context.scene.gwrap.bake
    bake.retopology, bake.faces = "DECIMATE", 400
    assert press(job).state == "DONE"
    light = bpy.data.objects["Foreign light"]
    assert light.parent == frame
    assert addon.kind_of(light) == "baked"
    assert abs(len(light.data.polygons) - 400) <= 8
    assert "Normal Map" in light.material_slots[0].material.node_tree.nodes
    assert (job.baked / "Foreign_light" / "normal.png").is_file()
    assert psnr_of_textures(light) > GOOD_DB
    assert thing.hide_get()
    assert bpy.context.view_layer.objects.active == light
    assert light.select_get()
    assert thing.data.materials.keys() == []
    # It is shaded and exported with the result.
    bpy.ops.gwrap.set_shading(shading="UNLIT")
    assert shading_of(light.material_slots[0].material) == "UNLIT"
    bpy.ops.gwrap.export_meshes(directory=str(job.root.parent / "files"), scope="ALL")
    exported = sorted(p.name for p in (job.root.parent / "files").glob("*.glb"))
    assert exported == ["Foreign_light.glb", "auto.glb"]
    # Once more: the same object, not another one.
    thing.hide_set(False)
    job_play.select(thing)
    bake.faces = 300
    assert press(job).state == "DONE"
    assert [t.name for t in bpy.data.objects if addon.kind_of(t) == "baked"] == ["Foreign light"]
    assert abs(len(bpy.data.objects["Foreign light"].data.polygons) - 300) <= 8


@pytest.mark.proof
def test_quads_become_an_object_with_photos_and_maps(job: JobFolder) -> None:
    """One button: QuadriFlow, UVs, photos, the detail of the dense mesh and its occlusion."""
    frame = import_ball(job)
    thing = add_ball()
    before = file_content()
    choose_quads(400)
    bpy.context.scene.gwrap.ambient_occlusion = True
    assert {"retopology", "quads"} <= names_of_fields()
    assert press(job).state == "DONE"
    made = bpy.data.objects["Foreign quads"]
    assert made.parent == frame
    assert addon.kind_of(made) == "baked"
    assert {len(polygon.vertices) for polygon in made.data.polygons} == {4}
    assert 300 < len(made.data.polygons) < 440
    assert all(polygon.use_smooth for polygon in made.data.polygons)
    assert made.data.validate() is False
    nodes = made.material_slots[0].material.node_tree.nodes
    assert {"Normal Map", "Occlusion Texture"} <= set(nodes.keys())
    assert Path(image_of(made).filepath) == job.baked / "Foreign_quads" / "albedo.png"
    assert psnr_of_textures(made) > GOOD_DB
    request = read_job(job.job_path).bake
    assert request is not None
    assert Path(request.dense).name == "Foreign_quads-dense.npz"
    assert thing.hide_get()
    assert file_content() - before == {("objects", made.name), ("meshes", made.name)}
    assert before <= file_content()
    assert not thing.data.uv_layers
    assert not thing.data.materials
    # Once more: the same object, not another one.
    thing.hide_set(False)
    job_play.select(thing)
    made.hide_set(True)
    choose_quads(200)
    assert press(job).state == "DONE"
    assert [t.name for t in bpy.data.objects if addon.kind_of(t) == "baked"] == ["Foreign quads"]
    made = bpy.data.objects["Foreign quads"]
    assert len(made.data.polygons) < 250
    assert not made.hide_get()
    assert made.select_get()


def choose_quads(count: int) -> None:
    bake = bpy.context.scene.gwrap.bake
    bake.retopology, bake.quads = "QUADS", count


def names_of_fields() -> set[str]:
    return {field.name for field in draw(mesh_panel.GWRAP_PT_bake).fields}


def file_content() -> set[tuple[str, str]]:
    return {(k, block.name) for k in ("objects", "meshes") for block in getattr(bpy.data, k)}


@pytest.mark.proof
def test_a_bake_of_quads_that_fails_or_is_cancelled_leaves_nothing(job: JobFolder) -> None:
    import_ball(job)
    thing = add_ball()
    choose_quads(400)
    place = thing.location.copy()
    thing.location.x += 500.0
    before = file_content()
    assert "No photo sees the mesh" in press(job, "FAILED").error
    assert file_content() == before
    thing.location = place
    assert bpy.ops.gwrap.bake_photos() == {"FINISHED"}
    job_play.play_to_stage(job.root, "bake")
    assert file_content() == before
    assert bpy.ops.gwrap.cancel_job() == {"FINISHED"}
    job_play.play_to(job.root, "CANCELLED")
    assert file_content() == before
    assert not thing.hide_get()
    assert bpy.ops.gwrap.resume_job() == {"FINISHED"}
    assert job_play.play_to(job.root, "DONE", "FAILED").state == "DONE"
    assert {len(p.vertices) for p in bpy.data.objects["Foreign quads"].data.polygons} == {4}


@pytest.mark.proof
def test_detail_comes_from_another_mesh(job: JobFolder) -> None:
    import_ball(job)
    dense = add_ball("Dense")
    thing = add_ball("Retopologised", uvs=True)
    bpy.context.scene.gwrap.bake.dense = dense
    bpy.context.scene.gwrap.ambient_occlusion = True
    assert press(job).state == "DONE"
    request = read_job(job.job_path).bake
    assert request is not None
    assert Path(request.dense).name == "Retopologised-dense.npz"
    material = thing.material_slots[0].material
    assert material.node_tree.nodes["Normal Texture"].image.colorspace_settings.name == "Non-Color"
    assert not dense.material_slots
    assert material.node_tree.nodes["Occlusion Texture"].image.name == "occlusion.png"
    assert material.node_tree.nodes.active.image.name.startswith("albedo")


@pytest.mark.parametrize("case", ["elsewhere", "inside out"])
def test_what_the_worker_refuses_changes_nothing(case: str, job: JobFolder) -> None:
    import_ball(job)
    thing = add_ball()
    if case == "elsewhere":
        thing.location.x += 500.0
    else:
        thing.data.flip_normals()
    before = job.job_path.read_bytes()
    status = press(job, "FAILED")
    words = "No photo sees the mesh" if case == "elsewhere" else "point inwards"
    assert words in status.error
    assert words in draw(mesh_panel.GWRAP_PT_bake).texts
    assert job.job_path.read_bytes() == before
    assert not job.baked.exists()
    assert not list(job.stages.glob("bake-*"))
    assert not thing.data.uv_layers
    assert not thing.data.materials


def add_line() -> None:
    mesh = bpy.data.meshes.new("Line")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0)], [(0, 1)], [])
    thing = bpy.data.objects.new("Line", mesh)
    bpy.context.collection.objects.link(thing)
    job_play.select(thing)


def with_modifier() -> None:
    add_ball().modifiers.new("More", "SUBSURF").levels = 1


def without_uvs() -> None:
    add_ball()
    bpy.context.scene.gwrap.bake.uvs = "OWN"


def uneven_for_quads() -> None:
    faces = add_ball().data.polygons
    next(face for face in faces if face.loop_total == 4).flip()  # the order of faces may differ
    choose_quads(400)


def not_finite_for_quads() -> None:
    not_finite()
    choose_quads(400)


def not_finite() -> None:
    add_ball().data.vertices[3].co.x = float("nan")


@pytest.mark.parametrize(
    ("make", "words"),
    [(add_line, "Line has no faces"), (with_modifier, "Modifiers of Foreign change its faces"),
     (without_uvs, "Foreign has no UV map"), (not_finite, "Vertex 3 of Foreign is not finite"),
     (uneven_for_quads, "QuadriFlow cannot work on Foreign: faces point to opposite sides at 4"),
     (not_finite_for_quads, "Vertex 3 of Foreign is not finite")],
)  # fmt: skip
def test_what_cannot_be_baked_is_refused_before_a_worker_starts(
    make: Any, words: str, job: JobFolder
) -> None:
    import_ball(job)
    make()
    before = job.job_path.read_bytes()
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.gwrap.bake_photos()
    assert job.job_path.read_bytes() == before
    assert not (job.root / "handed-over").exists()


def test_without_a_mesh_or_a_result_the_button_cannot_be_pressed(job: JobFolder) -> None:
    assert not bpy.ops.gwrap.bake_photos.poll()
    frame = import_ball(job)
    bpy.context.view_layer.objects.active = frame
    assert not bpy.ops.gwrap.bake_photos.poll()
    add_ball()
    assert bpy.ops.gwrap.bake_photos.poll()
    bpy.ops.object.mode_set(mode="EDIT")
    assert not bpy.ops.gwrap.bake_photos.poll()


def test_a_mesh_edited_meanwhile_keeps_its_edits_and_says_so(job: JobFolder) -> None:
    import_ball(job)
    thing = add_ball()
    assert bpy.ops.gwrap.bake_photos() == {"FINISHED"}
    for vertex in thing.data.vertices:
        vertex.co.z *= 1.0 + 0.2 * (vertex.co.x > 0.0)
    status = job_play.play_to(job.root, "DONE", "FAILED")
    assert status.state == "FAILED"
    assert "Foreign has changed since" in status.error
    assert not thing.data.uv_layers
    assert not thing.data.materials


@pytest.mark.proof
def test_a_result_mesh_that_is_made_anew_loses_its_bake(job: JobFolder) -> None:
    """The cube inside the ball, baked onto, then meshed again: the texture is the region's."""
    frame = import_ball(job)
    (thing,) = (child for child in frame.children if addon.kind_of(child) == "mesh")
    job_play.select(thing)
    assert press(job).state == "DONE"
    assert Path(image_of(thing).filepath).parent == job.baked / "auto"
    write_region_result(job.result / "auto", half=0.7)
    assert bpy.ops.gwrap.import_result(directory=str(job.result)) == {"FINISHED"}
    assert Path(image_of(thing).filepath) == job.result / "auto" / "albedo.png"
    assert addon.BAKE not in thing


@pytest.mark.proof
def test_a_cancelled_bake_is_resumed_onto_its_object(job: JobFolder) -> None:
    import_ball(job)
    thing = add_ball()
    assert bpy.ops.gwrap.bake_photos() == {"FINISHED"}
    job_play.play_to_stage(job.root, "bake")
    assert "gwrap.cancel_job" in draw(mesh_panel.GWRAP_PT_bake).operators
    assert bpy.ops.gwrap.cancel_job() == {"FINISHED"}
    job_play.play_to(job.root, "CANCELLED")
    assert not thing.data.uv_layers
    assert "gwrap.resume_job" in draw(mesh_panel.GWRAP_PT_bake).operators
    assert bpy.ops.gwrap.resume_job() == {"FINISHED"}
    assert job_play.play_to(job.root, "DONE", "FAILED").state == "DONE"
    assert psnr_of_textures(bpy.data.objects["Foreign"]) > GOOD_DB
