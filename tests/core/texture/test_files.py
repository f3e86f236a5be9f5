# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh files: read back by independent readers, lossless where specified; bad meshes refused."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from gaussian_wrapping_addon.core.errors import MeshingError, ResourceError, UsageError
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.frames import file_offset
from gaussian_wrapping_addon.core.texture.file_checks import write_mesh_ply
from gaussian_wrapping_addon.core.texture.files import write_glb, write_obj, write_textured
from tests.core.texture.texture_scenes import box

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
UTM = Similarity(3.5, TURN, np.array([512_345.678, 4_123_456.789, 123.4]))


def cube() -> TexturedMesh:
    """A box whose faces each have their own square of a 4 x 4 atlas of colours."""
    mesh = box([0, 0, 0], [1, 2, 3], 0)
    generator = np.random.default_rng(0)
    image = generator.integers(0, 256, (32, 32, 3), dtype=np.uint8)
    k = np.arange(len(mesh.faces))
    corner = np.stack([(k % 4) / 4, (k // 4) / 4], axis=1)[:, None]
    shape = np.array([[0.03, 0.05], [0.2, 0.04], [0.06, 0.21]])
    return TexturedMesh(mesh, (corner + shape).astype(np.float32), image)


def same_triangles(one: np.ndarray, other: np.ndarray, tolerance: float) -> None:
    """Compare (f, 3, 3) corners whatever the order of faces."""

    def ordered(corners: np.ndarray) -> np.ndarray:
        rows = corners.reshape(len(corners), -1)
        return rows[np.lexsort(np.round(rows, 3).T)]

    assert one.shape == other.shape
    assert np.abs(ordered(one) - ordered(other)).max() <= tolerance


def read_glb(path: Path) -> tuple[dict, bytes]:
    """The JSON and the binary part."""
    data = path.read_bytes()
    (size,) = struct.unpack("<I", data[12:16])
    return json.loads(data[20 : 20 + size]), data[28 + size :]


@pytest.fixture
def files(tmp_path: Path) -> Path:
    folder = tmp_path / "a new" / "folder"
    write_textured(cube(), folder, ("glb", "obj", "ply"), Similarity())
    return folder


def test_names_of_the_contract_and_arrays_for_blender(files: Path) -> None:
    assert {p.name for p in files.iterdir()} == {
        "mesh.npz", "mesh.ply", "mesh.glb", "mesh.obj", "mesh.mtl", "albedo.png", "transform.json",
    }  # fmt: skip
    textured = cube()
    with np.load(files / "mesh.npz", allow_pickle=False) as arrays:
        kinds = {name: arrays[name].dtype for name in arrays.files}
        assert kinds == {"vertices": "f8", "faces": "i4", "corner_uvs": "f4"}
        assert (arrays["vertices"] == textured.mesh.vertices).all()
        assert (arrays["corner_uvs"] == textured.corner_uvs).all()
    assert (np.asarray(Image.open(files / "albedo.png")) == textured.albedo).all()


def test_glb_read_by_trimesh_is_the_same_mesh_and_image(files: Path) -> None:
    textured = cube()
    read = trimesh.load(files / "mesh.glb", force="mesh", process=False)
    y_up = textured.mesh.vertices[:, [0, 2, 1]] * [1, 1, -1]
    same_triangles(read.vertices[read.faces], y_up[textured.mesh.faces], 1e-6)
    image = np.asarray(read.visual.material.baseColorTexture.convert("RGB"))
    assert (image == textured.albedo).all()
    assert (read.faces.size, len(read.vertices)) == (36, 36)
    # Faces keep their order and trimesh's UVs point upwards like ours.
    assert np.abs(read.visual.uv[read.faces] - textured.corner_uvs).max() < 1e-6
    assert read.volume == pytest.approx(6.0, rel=1e-6)


def test_glb_follows_the_container_format_and_is_unlit_without_maps(files: Path) -> None:
    data = (files / "mesh.glb").read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert (kind, size % 4) == (b"JSON", 0)
    rest, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
    assert (kind, rest) == (b"BIN\0", len(data) - size - 28)
    document, binary = read_glb(files / "mesh.glb")
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[accessor["type"]]
        assert view["byteLength"] == 4 * width * accessor["count"]
    normals = document["bufferViews"][1]
    values = np.frombuffer(binary, "<f4", normals["byteLength"] // 4, normals["byteOffset"])
    assert np.abs(np.linalg.norm(values.reshape(-1, 3), axis=1) - 1).max() < 1e-5
    (material,) = document["materials"]
    assert set(material) == {"name", "pbrMetallicRoughness", "extensions"}
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    assert len(document["textures"]) == len(document["images"]) == 1
    assert "map_Bump" not in (files / "mesh.mtl").read_text()


def test_maps_are_written_beside_and_into_the_files(tmp_path: Path) -> None:
    generator = np.random.default_rng(4)
    normal_map = generator.integers(0, 256, (32, 32, 3), dtype=np.uint8)
    occlusion = generator.integers(0, 256, (16, 16), dtype=np.uint8)
    textured = replace(cube(), normal_map=normal_map, occlusion=occlusion)
    write_textured(textured, tmp_path, ("glb", "obj"), Similarity())
    assert (np.asarray(Image.open(tmp_path / "normal.png")) == normal_map).all()
    assert Image.open(tmp_path / "occlusion.png").mode == "L"
    assert (np.asarray(Image.open(tmp_path / "occlusion.png")) == occlusion).all()
    assert "map_Bump -bm 1 normal.png\n" in (tmp_path / "mesh.mtl").read_text()
    document, binary = read_glb(tmp_path / "mesh.glb")
    (material,) = document["materials"]
    wanted = {
        "baseColorTexture": textured.albedo,
        "normalTexture": normal_map,
        "occlusionTexture": np.repeat(occlusion[..., None], 3, axis=2),
    }
    for name, pixels in wanted.items():
        place = {**material, **material["pbrMetallicRoughness"]}[name]["index"]
        view = document["bufferViews"][
            document["images"][document["textures"][place]["source"]]["bufferView"]
        ]
        assert view["byteOffset"] % 4 == 0
        assert "target" not in view
        png = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        assert (np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) == pixels).all()
    # An unlit material would hide both.
    assert list(material["extensions"]) == ["KHR_materials_specular"]
    assert document["extensionsUsed"] == ["KHR_materials_specular"]
    read = trimesh.load(tmp_path / "mesh.glb", force="mesh", process=False)
    assert (np.asarray(read.visual.material.normalTexture.convert("RGB")) == normal_map).all()


def test_obj_read_by_trimesh_is_the_same_mesh_and_image(files: Path) -> None:
    textured = cube()
    read = trimesh.load(files / "mesh.obj", force="mesh", process=False)
    corners = textured.mesh.vertices[textured.mesh.faces]
    same_triangles(read.vertices[read.faces], corners, 1e-7)
    assert (np.asarray(read.visual.material.image.convert("RGB")) == textured.albedo).all()
    key = np.concatenate([corners.reshape(-1, 3), textured.corner_uvs.reshape(-1, 2)], axis=1)
    got = np.concatenate([read.vertices[read.faces], read.visual.uv[read.faces]], axis=2)
    order = lambda rows: rows[np.lexsort(np.round(rows, 4).T)]  # noqa: E731
    assert np.abs(order(got.reshape(-1, 5)) - order(key)).max() < 1e-6
    assert "/" not in (files / "mesh.mtl").read_text()


def test_ply_keeps_doubles_at_utm_offsets(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    vertices = generator.normal(size=(50, 3)) + UTM.translation
    faces = np.array([[k, k + 1, k + 2] for k in range(48)], np.int32)
    colors = generator.integers(0, 256, (50, 3), dtype=np.uint8)
    for given in (colors, None):
        write_mesh_ply(tmp_path / "m.ply", vertices, faces, given)
        read = trimesh.load(tmp_path / "m.ply", process=False)
        assert read.vertices.dtype == np.float64
        assert (read.vertices == vertices).all()
        assert (read.faces == faces).all()
        assert given is None or (read.visual.vertex_colors[:, :3] == colors).all()
    flat = replace(cube(), albedo=np.full((32, 32, 3), (10, 200, 30), np.uint8))
    write_textured(flat, tmp_path, (), Similarity())
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert (read.visual.vertex_colors[:, :3] == [10, 200, 30]).all()


@pytest.mark.parametrize("given", [None, np.array([512_000.0, 4_123_000.0, 100.0])])
def test_far_meshes_are_written_near_the_origin_with_their_offset(
    tmp_path: Path, given: np.ndarray | None
) -> None:
    """Levels share the offset that they are given."""
    textured = cube()
    write_textured(textured, tmp_path, ("glb", "obj"), UTM, given)
    world = UTM.points(textured.mesh.vertices)
    corners = world[textured.mesh.faces]
    facts = json.loads((tmp_path / "transform.json").read_text())
    offset = np.array(facts["offset"])
    if given is None:
        assert np.abs(world - offset).max() < 11
    else:
        assert offset.tolist() == given.tolist()
    assert (Similarity.from_json(facts["world_from_scene"]).matrix() == UTM.matrix()).all()
    ply = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert (ply.vertices == world).all()
    glb = trimesh.load(tmp_path / "mesh.glb", force="mesh", process=False)
    back = glb.vertices[:, [0, 2, 1]] * [1, -1, 1] + offset
    same_triangles(back[glb.faces], corners, 2e-6 if given is None else 1e-4)
    obj = trimesh.load(tmp_path / "mesh.obj", force="mesh", process=False)
    same_triangles((obj.vertices + offset)[obj.faces], corners, 1e-6)
    document, _ = read_glb(tmp_path / "mesh.glb")
    assert document["nodes"][0]["extras"]["world_offset"] == offset.tolist()


@pytest.mark.parametrize(
    ("centre", "size", "moved"),
    [(0.0, 1.0, False), (50.0, 1.0, False), (1e6, 10.0, True), (200.0, 1e-3, True)],
)
def test_offsets_only_where_float32_would_show(centre: float, size: float, moved: bool) -> None:
    world = np.array([[0.0, 0, 0], [size, size, size]]) + centre
    offset = file_offset(world)
    assert (np.abs(offset).max() > 0) == moved
    local = world - offset
    assert np.abs(local.astype(np.float32) - local).max() <= 1e-5 * size


def spoiled(how: str) -> TexturedMesh:
    good = cube()
    vertices, faces, uvs = good.mesh.vertices.copy(), good.mesh.faces.copy(), good.corner_uvs.copy()
    if "vertex" in how:
        vertices[2, 1] = np.nan if how == "nan vertex" else np.inf
    elif how == "nan uv":
        uvs[3] = np.nan
    elif how == "no faces":
        faces, uvs = faces[:0], uvs[:0]
    else:
        faces[0, 0] = 99
    return TexturedMesh(SurfaceMesh(vertices, faces), uvs, good.albedo)


@pytest.mark.parametrize("how", ["nan vertex", "infinite vertex", "nan uv", "no faces", "index"])
def test_bad_meshes_are_refused_and_write_nothing(how: str, tmp_path: Path) -> None:
    with pytest.raises(MeshingError) as caught:
        write_textured(spoiled(how), tmp_path / "out", ("glb", "obj"), Similarity())
    assert caught.value.hint
    assert not (tmp_path / "out").exists()


def test_nan_is_refused_by_each_writer(tmp_path: Path) -> None:
    def write(kind: str, textured: TexturedMesh, factor: float = 1.0) -> None:
        path, vertices = tmp_path / f"m.{kind}", factor * textured.mesh.vertices
        faces, uvs = textured.mesh.faces, textured.corner_uvs
        if kind == "ply":
            write_mesh_ply(path, vertices, faces)
        elif kind == "obj":
            write_obj(path, vertices, faces, uvs, ["a.png"])
        else:
            write_glb(path, vertices, faces, uvs, [b""], np.zeros(3))

    for kind in ("ply", "obj", "glb"):
        with pytest.raises(MeshingError, match="Vertex 2"):
            write(kind, spoiled("nan vertex"))
    for kind in ("obj", "glb"):
        with pytest.raises(MeshingError, match="Face 3"):
            write(kind, spoiled("nan uv"))
    with pytest.raises(MeshingError, match="not finite"):
        write("glb", cube(), 1e39)  # finite, but not in single precision
    assert list(tmp_path.iterdir()) == []


def test_places_that_cannot_be_written_are_named(tmp_path: Path) -> None:
    good = cube()
    with pytest.raises(ResourceError, match="nowhere"):
        write_mesh_ply(tmp_path / "nowhere" / "m.ply", good.mesh.vertices, good.mesh.faces)
    (tmp_path / "file").write_text("")
    for path in (tmp_path / ("x" * 300), tmp_path / "file"):
        with pytest.raises(ResourceError, match="cannot be written"):
            write_textured(good, path, ("glb",), Similarity())


def test_unknown_formats_and_names_with_spaces_are_refused(tmp_path: Path) -> None:
    mesh, uvs = cube().mesh, cube().corner_uvs
    with pytest.raises(UsageError, match="fbx"):
        write_textured(cube(), tmp_path, ("fbx",), Similarity())
    with pytest.raises(UsageError, match="cannot refer to"):
        write_obj(tmp_path / "m.obj", mesh.vertices, mesh.faces, uvs, ["my image.png"])
    assert list(tmp_path.iterdir()) == []
