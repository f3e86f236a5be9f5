# SPDX-License-Identifier: GPL-3.0-or-later
"""Exports from Blender: the same picture when read again, coordinates that lead back, no traces."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError, UsageError
from gaussian_wrapping_addon.core.jobs.commands.export_files import ExportRequest, export_files
from gaussian_wrapping_addon.core.jobs.store.job_file import sidecar_path
from gaussian_wrapping_addon.core.names import MESH_FORMATS
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.placement import FILE_NAME, write_placement
from gaussian_wrapping_addon.ops import export as module
from gaussian_wrapping_addon.ops.export import ObjectExport, export_objects, export_result
from gaussian_wrapping_addon.ops.scene_objects import (
    ImportedResult,
    images_of,
    import_result,
    set_shading,
    shading_of,
)
from tests.blender.reimport_pictures import IMPORTERS
from tests.blender.synthetic_result import (
    WORLD_FROM_SCENE,
    cube_mesh,
    png_bytes,
    rotation_about,
    write_region_result,
    write_result,
)
from tests.blender.test_detail import write_detail
from tests.core.texture.test_glb_validator import problems, reports
from tests.proofs import first_then_proofs

ROOT = Path(__file__).resolve().parents[2]
PLACEMENT = Similarity(0.4, rotation_about((1, 0.5, 2), 0.8), np.array([1.0, -2.0, 0.5]))
WANTED_DB = 30.0


@pytest.fixture
def imported(tmp_path: Path) -> ImportedResult:
    """A cube with a normal map and one level of detail, placed."""
    result = write_result(tmp_path / "job")
    write_detail(result / "auto", 1)
    write_placement(result / FILE_NAME, PLACEMENT, WORLD_FROM_SCENE)
    return import_result(result, bpy.context.scene)


def names_in_file() -> dict[str, list[str]]:
    kinds = ("objects", "meshes", "materials", "images", "scenes", "collections")
    return {kind: sorted(t.name for t in getattr(bpy.data, kind)) for kind in kinds}


def sidecar(path: Path) -> dict:
    return json.loads(sidecar_path(path).read_text())


def read_again(*arguments: str) -> dict:
    """Export and read in a process of its own; the textures are away when the file is read."""
    command = [sys.executable, "-m", "tests.blender.reimport_pictures", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found = dict(json.loads(done.stdout.splitlines()[-1]))
    assert found["psnr"] > WANTED_DB
    assert found["psnr_mirrored"] < 15.0  # the picture would tell
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("format", "shading", "pack"),
    first_then_proofs(
        [
            ("glb", "LIT", False), ("usd", "UNLIT", False), ("fbx", "LIT", True),
            ("own-glb", "LIT", False), ("own-obj", "LIT", False),
            ("glb", "UNLIT", False), ("obj", "LIT", False), ("usd", "LIT", False),
            ("usd", "LIT", True), ("fbx", "LIT", False), ("own-glb", "UNLIT", False),
        ],
        5,
        names=3,
    ),
)  # fmt: skip
def test_a_file_read_again_gives_the_same_picture(
    tmp_path: Path, format: str, shading: str, pack: bool
) -> None:
    found = read_again(format, shading, "pack" if pack else "no", "1", str(tmp_path))
    assert found["covered"] > 0.3
    assert found["contrast"] > 0.1
    assert found["images"] == [[128, 128]] * (2 if shading == "LIT" else 1)
    if format.endswith("glb"):
        assert found["unlit_pattern"] == (shading == "UNLIT")
    beside = [n for n in found["files"] if n.endswith(".png")]
    inside = pack or format.endswith("glb")
    images = ["auto-albedo.png", "auto-normal.png"][: len(found["images"])]
    assert beside == ([] if inside else images)
    assert found["materials"] == ["albedo" if "own" in format else "auto.001"]


@pytest.mark.proof
@pytest.mark.parametrize("format", ["glb", "own-glb", "own-obj", "obj", "usd"])
def test_two_atlases_are_read_back_with_the_same_picture(format: str, tmp_path: Path) -> None:
    found = read_again(format, "LIT", "no", "2", str(tmp_path))
    if "own" in format:
        assert found["materials"] == ["albedo", "albedo-2"]
    assert len(set(found["materials"])) == 2
    assert found["images"] == [[128, 128]] * 4
    beside = {n for n in found["files"] if n.endswith(".png")}
    wanted = {f"auto-{n}.png" for n in ("albedo", "albedo-2", "normal", "normal-2")}
    assert beside == (set() if format.endswith("glb") else wanted)


@pytest.mark.parametrize("placed", [True, False])
@pytest.mark.parametrize("format", MESH_FORMATS)
def test_coordinates_lead_back_to_the_world(
    imported: ImportedResult, tmp_path: Path, format: str, placed: bool
) -> None:
    (thing,) = imported.meshes
    request = ObjectExport(format, tmp_path / "out", placed=placed)
    (path,) = export_objects(imported.frame, [thing], request)
    values = sidecar(path)
    assert values["placed"] is placed
    before = set(bpy.data.objects)
    group, name = IMPORTERS[format]
    getattr(getattr(bpy.ops, group), name)(filepath=str(path))
    (read,) = [o for o in set(bpy.data.objects) - before if o.type == "MESH"]
    bpy.context.view_layer.update()
    points = np.array([read.matrix_world @ v.co for v in read.data.vertices], np.float64)
    if values["up"] == "+Y":  # Blender's reader has turned them
        points = points @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T
    world = WORLD_FROM_SCENE.points(cube_mesh()[0])
    back = Similarity.from_json(values["world_from_file"]).points(points)
    distance = np.linalg.norm(back[:, None] - world[None], axis=2)
    # The reader of PLY makes far doubles single before anything can be asked of them.
    allowed = 0.3 if format == "ply" and not placed else 2e-5
    assert distance.min(axis=1).max() < allowed
    assert distance.min(axis=0).max() < allowed
    if placed:
        scene = Similarity.from_json(values["scene_from_file"]).points(points)
        assert np.abs(PLACEMENT.points(scene) - np.array(
            [read.matrix_world @ v.co for v in read.data.vertices])).max() < 1e-5  # fmt: skip
    else:
        assert (np.abs(values["offset"]).max() > 1e5) == (format != "ply")
    assert (values["vertices"], values["faces"]) == (8, 12)


@pytest.mark.parametrize("format", MESH_FORMATS)
def test_the_scene_stays_as_it_was(imported: ImportedResult, tmp_path: Path, format: str) -> None:
    (thing,) = imported.meshes
    level = next(o for o in bpy.data.objects if o.name.endswith("LOD1"))
    bpy.context.view_layer.update()
    imported.frame.select_set(True)
    bpy.context.view_layer.objects.active = imported.frame
    before, hidden = names_in_file(), level.hide_viewport
    paths = export_objects(imported.frame, [thing, level], ObjectExport(format, tmp_path / "out"))
    assert [p.stem for p in paths] == ["auto", "auto-lod1"]
    assert all(sidecar(p)["level"] == k for k, p in enumerate(paths))
    assert names_in_file() == before
    assert bpy.context.view_layer.objects.active == imported.frame
    assert imported.frame.select_get()
    assert level.hide_viewport == hidden
    assert shading_of(thing.material_slots[0].material) == "LIT"


def test_khronos_finds_nothing_in_glb_from_blender(
    imported: ImportedResult, tmp_path: Path
) -> None:
    (thing,) = imported.meshes
    paths = []
    for shading in ("LIT", "UNLIT"):
        set_shading(thing.material_slots[0].material, shading)
        request = ObjectExport("glb", tmp_path / shading)
        paths += export_objects(imported.frame, [thing], request)
        assert sidecar(paths[-1])["shading"] == shading.lower()
    lit, unlit = reports(paths)
    assert problems(lit) == []
    assert problems(unlit) == []
    assert unlit["info"]["extensionsUsed"] == ["KHR_materials_unlit"]
    assert "KHR_materials_unlit" not in lit["info"]["extensionsUsed"]


def glb_json(path: Path) -> dict:
    data = path.read_bytes()
    return dict(json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")]))


def gltf_tangents(path: Path) -> dict[tuple[float, ...], np.ndarray]:
    """Of each vertex of a GLB, by its position and UV: (4,) tangent and sign."""
    document = glb_json(path)
    data = path.read_bytes()
    binary = data[28 + int.from_bytes(data[12:16], "little") :]
    (primitive,) = document["meshes"][0]["primitives"]
    rows = []
    for name, width in (("POSITION", 3), ("TEXCOORD_0", 2), ("TANGENT", 4)):
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        begin, count = view["byteOffset"], accessor["count"] * width
        rows.append(np.frombuffer(binary, "<f4", count, begin).reshape(-1, width))
    place = np.round(np.concatenate(rows[:2], axis=1).astype(np.float64), 4) + 0.0
    return dict(zip(map(tuple, place.tolist()), rows[2], strict=True))


def test_tangents_of_our_glb_are_those_of_blenders(
    imported: ImportedResult, tmp_path: Path
) -> None:
    """The cube's UVs differ at every corner, half of them mirrored here: one tangent each."""
    path = tmp_path / "job" / "result" / "auto" / "mesh.npz"
    vertices, faces, uvs = cube_mesh()
    uvs[::2, :, 0] = 1.0 - uvs[::2, :, 0]
    np.savez(path, vertices=vertices, faces=faces, corner_uvs=uvs)
    (thing,) = import_result(path.parents[1], bpy.context.scene).meshes
    (blenders,) = export_objects(imported.frame, [thing], ObjectExport("glb", tmp_path / "b"))
    request = ExportRequest(path.parents[1], tmp_path / "o", ("glb",), placed=True)
    (ours,) = export_files(request)
    wanted, found = gltf_tangents(blenders), gltf_tangents(ours)
    assert found.keys() == wanted.keys()
    assert len(found) == 36
    assert {row[3] for row in found.values()} == {-1.0, 1.0}
    for place, tangent in found.items():
        assert tangent[3] == wanted[place][3]
        assert np.abs(tangent - wanted[place]).max() < 1e-3


def test_a_duplicate_does_not_replace_the_original(
    imported: ImportedResult, tmp_path: Path
) -> None:
    """A copied object has the tags of the other; each keeps its name, alone or with the other."""
    thing = imported.meshes[0]
    copy = thing.copy()
    bpy.context.scene.collection.objects.link(copy)
    paths = export_objects(imported.frame, [thing, copy], ObjectExport("ply", tmp_path))
    assert len(set(paths)) == 2
    assert all(path.is_file() for path in paths)
    assert paths[0].name == "auto.ply"
    assert export_objects(imported.frame, [copy], ObjectExport("ply", tmp_path)) == paths[1:]


def test_what_a_person_changed_is_exported(imported: ImportedResult, tmp_path: Path) -> None:
    (thing,) = imported.meshes
    thing.modifiers.new("twice", "ARRAY").use_relative_offset = False
    thing.location.x += 2.0
    (path,) = export_objects(imported.frame, [thing], ObjectExport("ply", tmp_path))
    bpy.ops.wm.ply_import(filepath=str(path))
    read = bpy.context.view_layer.objects.active
    points = np.array([v.co[:] for v in read.data.vertices])
    assert len(points) == 16
    wanted = PLACEMENT.points(np.tile(cube_mesh()[0] + [2.0, 0, 0], (2, 1)))
    assert np.abs(points - wanted).max() < 1e-5
    assert sidecar(path)["vertices"] == 16


@pytest.mark.parametrize(
    ("format", "what"), [*((f, "vertex") for f in MESH_FORMATS), ("glb", "uv"), ("obj", "empty")]
)
def test_what_is_not_finite_is_refused(
    imported: ImportedResult, tmp_path: Path, format: str, what: str
) -> None:
    (thing,) = imported.meshes
    if what == "vertex":
        thing.data.vertices[3].co.y = float("nan")
    elif what == "uv":
        thing.data.uv_layers.active.uv[4].vector.x = float("nan")
    else:
        thing.data.clear_geometry()
    before = names_in_file()
    with pytest.raises(MeshingError, match=r"(not finite|has no faces)") as caught:
        export_objects(imported.frame, [thing], ObjectExport(format, tmp_path / "out"))
    assert "auto" in str(caught.value)
    assert list((tmp_path / "out").iterdir()) == []
    assert names_in_file() == before


def test_what_cannot_be_done_is_said(
    imported: ImportedResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (thing,) = imported.meshes
    frame = imported.frame
    with pytest.raises(UsageError, match="not an export format"):
        export_objects(frame, [thing], ObjectExport("stl", tmp_path))
    with pytest.raises(UsageError, match="no mesh"):
        export_objects(frame, [], ObjectExport("glb", tmp_path))
    with monkeypatch.context() as patch:
        patch.setitem(module._OPERATORS, "fbx", "export_scene.none_such")
        with pytest.raises(UsageError, match="no FBX exporter"):
            export_objects(frame, [thing], ObjectExport("fbx", tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    albedo = tmp_path / "job" / "result" / "auto" / "albedo.png"
    albedo.write_bytes(albedo.read_bytes()[:20])
    images_of(frame)[0].reload()
    for format in ("glb", "obj", "fbx"):
        with pytest.raises(UsageError, match=r"albedo\.png cannot be read"):
            export_objects(frame, [thing], ObjectExport(format, tmp_path / "out"))
    albedo.unlink()
    for format in ("glb", "obj"):
        with pytest.raises(UsageError, match=r"albedo\.png does not exist"):
            export_objects(frame, [thing], ObjectExport(format, tmp_path / "out"))


def test_images_are_packed_on_request_and_exported_from_there(
    imported: ImportedResult, tmp_path: Path, addon: object
) -> None:
    (thing,) = imported.meshes
    images = images_of(imported.frame)
    assert len(images) == 4  # of the mesh and its level
    assert not any(image.packed_file for image in images)
    folder = tmp_path / "job" / "result"
    kept = (folder / "auto" / "albedo.png").read_bytes()
    assert bpy.ops.gwrap.pack_images() == {"FINISHED"}
    assert all(image.packed_file for image in images)
    for path in folder.glob("**/*.png"):
        path.rename(path.with_suffix(".away"))
    export_objects(imported.frame, [thing], ObjectExport("obj", tmp_path / "out"))
    assert (tmp_path / "out" / "auto-albedo.png").read_bytes() == kept
    assert bpy.ops.gwrap.pack_images(pack=False) == {"FINISHED"}
    assert not any(image.packed_file for image in images)
    assert (folder / "auto" / "albedo.png").read_bytes() == kept


def test_the_operator(imported: ImportedResult, tmp_path: Path, addon: object) -> None:
    (thing,) = imported.meshes
    bpy.context.view_layer.update()
    thing.select_set(True)
    bpy.context.view_layer.objects.active = thing
    out = tmp_path / "out"
    assert bpy.ops.gwrap.export_meshes(directory=str(out), format="GLB") == {"FINISHED"}
    assert sorted(p.name for p in out.iterdir()) == ["auto.glb", "auto.glb.json"]
    done = bpy.ops.gwrap.export_meshes(
        directory=str(out), format="USD", scope="ALL", levels=True, pack=True, placed=False
    )
    assert done == {"FINISHED"}
    names = {p.name for p in out.iterdir()}
    assert {"auto.usdz", "auto-lod1.usdz", "auto.usdz.json"} <= names
    assert sidecar(out / "auto-lod1.usdz")["placed"] is False
    thing.select_set(False)
    with pytest.raises(RuntimeError, match="No mesh of a result is selected"):
        bpy.ops.gwrap.export_meshes(directory=str(out))
    thing.data.vertices[0].co.x = float("nan")
    with pytest.raises(RuntimeError, match="not finite"):
        bpy.ops.gwrap.export_meshes(directory=str(tmp_path / "bad"), scope="ALL")
    assert list((tmp_path / "bad").iterdir()) == []


def test_a_result_folder_is_exported_in_the_background(tmp_path: Path) -> None:
    result = write_result(tmp_path / "job", regions=("auto", "nose"))
    write_detail(result / "auto", 1, with_normals=False)
    write_placement(result / FILE_NAME, PLACEMENT, WORLD_FROM_SCENE)
    out = tmp_path / "out"
    requests = [ObjectExport("usd", out), ObjectExport("fbx", out, placed=False)]
    paths = export_result(result, requests, levels=True, shading="unlit")
    assert sorted(p.name for p in paths) == [
        f"{stem}.{suffix}"
        for stem in ("auto-lod1", "auto", "nose")
        for suffix in ("fbx", "usdc")
    ]  # fmt: skip
    for path in paths:
        values = sidecar(path)
        assert values["shading"] == ("emission" if path.suffix == ".usdc" else "lit")
        assert values["placed"] is (path.suffix == ".usdc")
        assert values["blender_from_scene"] == PLACEMENT.to_json()
    (path,) = export_result(result, [ObjectExport("obj", out)], regions=("nose",))
    assert path.name == "nose.obj"
    with pytest.raises(UsageError, match="no mesh mouth"):
        export_result(result, requests, regions=("mouth",))


def test_occlusion_is_in_lit_glb_files_alone(tmp_path: Path) -> None:
    """Blender draws nothing of it; imported again without it, the material loses it."""
    result = write_result(tmp_path / "job")
    dark = result / "auto" / "occlusion.png"
    dark.write_bytes(png_bytes(np.full((16, 16, 3), 90, np.uint8)))
    found = import_result(result, bpy.context.scene)
    (thing,) = found.meshes
    material = thing.data.materials[0]
    assert material.node_tree.nodes.active.image.name.startswith("albedo")
    before = names_in_file()
    (path,) = export_objects(found.frame, [thing], ObjectExport("glb", tmp_path / "lit"))
    values = glb_json(path)
    texture = values["materials"][0]["occlusionTexture"]["index"]
    assert values["images"][values["textures"][texture]["source"]]["name"] == "auto-occlusion"
    assert len(values["images"]) == 2
    (path,) = export_objects(found.frame, [thing], ObjectExport("obj", tmp_path / "obj"))
    assert sorted(p.name for p in path.parent.glob("*.png")) == ["auto-albedo.png"]
    set_shading(material, "UNLIT")
    (path,) = export_objects(found.frame, [thing], ObjectExport("glb", tmp_path / "unlit"))
    assert "occlusionTexture" not in glb_json(path)["materials"][0]
    assert names_in_file() == before
    dark.unlink()
    write_region_result(result / "auto", half=0.7)
    import_result(result, bpy.context.scene)
    assert [n.name for n in material.node_tree.nodes if "cclusion" in n.name] == []
