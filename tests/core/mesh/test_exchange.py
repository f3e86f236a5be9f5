# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh files of other programs: vertices, faces, UVs, frames; broken files are refused by place."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.mesh.exchange import (
    FileMesh,
    read_handed_over,
    read_mesh_file,
    world_from_file,
    write_handed_over,
)
from gaussian_wrapping_addon.core.mesh.textured_mesh import Polygons
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.frames import FileFrame
from gaussian_wrapping_addon.core.texture.files import write_glb, write_obj

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0], [0, 0, 3]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 4]])
UVS = np.array(
    [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]], [[1.25, 0.5], [1.5, 0.5], [1.5, 1.0]]]
)


def triangles(mesh: FileMesh) -> list[list[float]]:
    """Return the corners with their UVs, as rows in a fixed order."""
    corners = mesh.vertices[mesh.faces].reshape(len(mesh.faces), -1)
    parts = [corners] if mesh.corner_uvs is None else [corners, mesh.corner_uvs.reshape(-1, 6)]
    return sorted(np.concatenate(parts, axis=1).round(6).tolist())


def test_obj_of_several_materials_keeps_uvs_and_tiles(tmp_path: Path) -> None:
    path = tmp_path / "two.obj"
    lines = ["mtllib two.mtl", *(f"v {x} {y} {z}" for x, y, z in VERTICES)]
    lines += [f"vt {u} {v}" for u, v in UVS.reshape(-1, 2)]
    for face, corners in enumerate(FACES + 1):
        words = " ".join(f"{v}/{3 * face + k + 1}" for k, v in enumerate(corners))
        lines += [f"usemtl {'first' if face < 2 else 'second'}", f"f {words}"]
    path.write_text("\n".join(lines))
    found = read_mesh_file(path)
    assert found.corner_uvs is not None
    assert triangles(found) == triangles(FileMesh(VERTICES, FACES, UVS))


def test_polygons_become_triangles_and_ply_has_uvs_of_vertices(tmp_path: Path) -> None:
    path = tmp_path / "quad.ply"
    rows = [(0, 0, 0, 0, 0), (1, 0, 0, 1, 0), (1, 1, 0, 1, 1), (0, 1, 0, 0, 1)]
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\n"
        + "".join(f"property float {name}\n" for name in "xyzst")
        + "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        + "\n".join(" ".join(map(str, row)) for row in rows)
        + "\n4 0 1 2 3\n"
    )
    found = read_mesh_file(path)
    assert found.faces.shape == (2, 3)
    assert found.corner_uvs is not None
    assert np.array_equal(found.corner_uvs, found.vertices[found.faces][..., :2])


def test_parts_without_uvs_make_a_mesh_without(tmp_path: Path) -> None:
    path = tmp_path / "scene.glb"
    scene = trimesh.Scene(trimesh.creation.box())
    moved = trimesh.transformations.translation_matrix([5, 0, 0])
    scene.add_geometry(trimesh.creation.box(), transform=moved)
    path.write_bytes(scene.export(file_type="glb"))
    found = read_mesh_file(path)
    assert found.corner_uvs is None
    assert found.faces.shape == (24, 3)
    assert found.vertices[:, 0].max() == 5.5


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [("empty.obj", b"", "cannot be read|there are none"), ("points.obj", b"v 0 0 0\n", "none"),
     ("nan.obj", b"v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n", "vertex 2: is not finite"),
     ("cut.glb", b"glTF\x02\0\0\0\xff\xff\0\0", "cannot be read"),
     ("text.ply", b"not a mesh", "cannot be read"), ("photo.jpg", b"", "not a known mesh format"),
     ("range.off", b"OFF\n1 1 0\n0 0 0\n3 0 1 2\n", "face 0: refers|cannot be read")],
)  # fmt: skip
def test_broken_files_are_refused_by_place(
    name: str, content: bytes, words: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ParseError, match=words) as caught:
        read_mesh_file(path)
    assert name in caught.value.message
    assert caught.value.hint


WORLD_FROM_SCENE = Similarity(2.0, np.eye(3)[[1, 2, 0]], np.array([500_000.0, 4e6, 30.0]))
SCENE = VERTICES + 0.25


@pytest.mark.parametrize("format", ["glb", "obj", "ply"])
def test_sidecars_lead_back_to_the_world(format: str, tmp_path: Path) -> None:
    """An export far from the origin, placed or not, read again and brought back."""
    world = WORLD_FROM_SCENE.points(SCENE)
    frame = FileFrame(format, WORLD_FROM_SCENE, np.array([500_000.0, 4e6, 0.0]))
    path = tmp_path / f"mesh.{format}"
    path.touch()
    values = frame.to_json(WORLD_FROM_SCENE, Similarity())
    write_json(tmp_path / f"mesh.{format}.json", values)
    in_file = frame.file_from_scene().points(SCENE)
    assert np.abs(in_file).max() < 100.0
    back = world_from_file(path).points(in_file)
    assert np.abs(back - world).max() < 1e-8
    # The same sidecar for a file of another name, and none for it without being told.
    other = tmp_path / f"edited.{format}"
    other.touch()
    told = world_from_file(other, tmp_path / f"mesh.{format}.json").points(in_file)
    assert np.array_equal(told, back)
    if os.name != "nt":  # links need rights on Windows
        link = tmp_path / "link.json"
        link.symlink_to(tmp_path / f"mesh.{format}.json")
        assert np.array_equal(world_from_file(other, link).points(in_file), back)
    assert np.abs(world_from_file(other).points(in_file) - world).max() > 1e5


def test_files_of_a_result_folder_lead_back_to_the_world(tmp_path: Path) -> None:
    offset = np.array([500_000.0, 4e6, 0.0])
    world = WORLD_FROM_SCENE.points(SCENE)
    frames = {"mesh.npz": "scene", "mesh.ply": "world", "mesh.obj": "", "mesh.glb": ""}
    write_json(tmp_path / "transform.json", {"offset": offset.tolist(), "frames": frames})
    corner_uvs = (UVS / 2.0).astype(np.float32)
    png = b"\x89PNG"
    write_glb(tmp_path / "mesh.glb", world - offset, FACES, corner_uvs, [png], offset)
    write_obj(tmp_path / "mesh.obj", world - offset, FACES, corner_uvs, ["albedo.png"])
    for name in ("mesh.glb", "mesh.obj"):
        path = tmp_path / name
        found = world_from_file(path).points(read_mesh_file(path).vertices)
        assert (
            np.abs(np.sort(found, axis=0)[[0, -1]] - np.sort(world, axis=0)[[0, -1]]).max() < 1e-4
        )
    assert np.array_equal(world_from_file(tmp_path / "mesh.ply").points(world), world)
    # Copied elsewhere, the GLB still has its offset.
    alone = tmp_path / "elsewhere" / "copy.glb"
    alone.parent.mkdir()
    alone.write_bytes((tmp_path / "mesh.glb").read_bytes())
    found = world_from_file(alone).points(read_mesh_file(alone).vertices)
    assert np.abs(np.sort(found, axis=0)[0] - world.min(0)).max() < 1e-4


def test_axes_without_a_sidecar_are_those_of_the_format_or_as_told(tmp_path: Path) -> None:
    up = np.array([[0.0, 1.0, 0.0]])
    for name, turned in (("a.glb", True), ("a.obj", True), ("a.ply", False), ("a.stl", False)):
        path = tmp_path / name
        path.touch()
        expected = [[0.0, 0.0, 1.0]] if turned else up.tolist()
        assert world_from_file(path).points(up).tolist() == expected
    assert world_from_file(tmp_path / "a.ply", up="y").points(up).tolist() == [[0.0, 0.0, 1.0]]
    assert world_from_file(tmp_path / "a.obj", up="z").points(up).tolist() == up.tolist()


@pytest.mark.parametrize(
    "values", [[], {}, {"world_from_file": {"scale": 0.0}}, {"world_from_file": {
        "scale": 1.0, "rotation": np.diag([1.0, 1.0, 2.0]).tolist(), "translation": [0, 0, 0]}}],
)  # fmt: skip
def test_sidecars_that_are_none_are_refused(values: object, tmp_path: Path) -> None:
    (tmp_path / "a.ply").touch()
    (tmp_path / "a.ply.json").write_text(json.dumps(values))
    with pytest.raises(ParseError, match=r"a\.ply\.json, world_from_file"):
        world_from_file(tmp_path / "a.ply")


def test_what_blender_hands_over_comes_back_bit_for_bit(tmp_path: Path) -> None:
    world = WORLD_FROM_SCENE.points(SCENE)
    polygons = Polygons(np.zeros(len(FACES), np.int64), np.arange(3 * len(FACES)).reshape(-1, 3))
    for mesh in (
        FileMesh(world, FACES),
        FileMesh(world, FACES, UVS),
        FileMesh(world, FACES, polygons=polygons),
        FileMesh(world, FACES, polygons=polygons, is_new=True),
    ):
        write_handed_over(tmp_path / "m.npz", mesh)
        found = read_handed_over(tmp_path / "m.npz")
        assert np.array_equal(found.vertices, world)
        assert np.array_equal(found.faces, FACES)
        assert (found.corner_uvs is None) == (mesh.corner_uvs is None)
        assert mesh.corner_uvs is None or np.array_equal(found.corner_uvs, UVS)
        assert (found.polygons is None) == (mesh.polygons is None)
        if found.polygons is not None:
            assert np.array_equal(found.polygons.of_faces, polygons.of_faces)
            assert np.array_equal(found.polygons.loops, polygons.loops)
        assert found.is_new == mesh.is_new


@pytest.mark.parametrize(
    ("changed", "words"),
    [({"frame": np.array("scene")}, "not in world coordinates"),
     ({"faces": FACES[:0], "corner_uvs": UVS[:0]}, "there are none"),
     ({"faces": FACES + 2}, "out of range"),
     ({"faces": np.array([[0.0, 1.0, 2.0]])}, "not lists of triples"),
     ({"vertices": np.where(VERTICES == 3, np.nan, VERTICES)}, "vertex 4: is not finite"),
     ({"corner_uvs": UVS[:1]}, "not those of the faces"),
     ({"polygons": np.zeros(1, int), "loops": FACES}, "polygons are not integers of shape"),
     ({"polygons": np.zeros(len(FACES), int), "loops": FACES - 9}, "loops are out of range")],
)  # fmt: skip
def test_handed_over_files_that_are_none_are_refused(
    changed: dict, words: str, tmp_path: Path
) -> None:
    arrays = {"frame": np.array("world"), "vertices": VERTICES, "faces": FACES, "corner_uvs": UVS}
    np.savez(tmp_path / "m.npz", **{**arrays, **changed})
    with pytest.raises(ParseError, match=words):
        read_handed_over(tmp_path / "m.npz")
    (tmp_path / "m.npz").write_bytes(b"PK")
    with pytest.raises(ParseError, match=r"m\.npz, whole file: damaged"):
        read_handed_over(tmp_path / "m.npz")
