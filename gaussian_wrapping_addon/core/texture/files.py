# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of a textured mesh: GLB, OBJ, and what a result folder holds beside them."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UsageError
from ..files import write_bytes, write_json
from ..mesh.tangent_frame import shading_normals, tangent_frames
from ..mesh.textured_mesh import TexturedMesh, udim_uvs
from ..names import RESULT_FORMATS
from ..scene.camera import Similarity
from ..scene.frames import file_offset
from .file_checks import (
    OBJ_SHININESS,
    ROUGHNESS,
    SPECULAR_LEVEL,
    atlas_file,
    validate_for_export,
    vertex_colors,
    write_errors,
    write_mesh_ply,
)

# -- Encode one textured mesh as binary glTF 2.0: Y up, images embedded ---------------------------


_MAGIC = 0x46546C67
_JSON_CHUNK = 0x4E4F534A
_BINARY_CHUNK = 0x004E4942
_FLOAT, _UINT32 = 5126, 5125
_ARRAY_BUFFER, _INDEX_BUFFER = 34962, 34963


def write_glb(
    path: Path, vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray,
    png: Sequence[bytes], offset: np.ndarray, *, normal_png: Sequence[bytes] = (),
    occlusion_png: Sequence[bytes] = (), shading: str = "auto",
    face_atlas: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Write a binary glTF 2.0 with the images inside.

    Photos contain their lighting, so the material is ``KHR_materials_unlit``, with an ordinary
    rough material for readers without that extension. With a normal map or occlusion it is lit:
    readers ignore both in unlit materials. Normals are those for which the map was baked; with a
    normal map, tangents are written too. Faces with a repeated vertex are left out. Each atlas has
    a material, a primitive with its own vertices, and its images.

    Parameters
    ----------
    vertices : (v, 3) float64
        Z up, near the origin; written as (x, z, -y).
    faces : (f, 3) int32
    corner_uvs : (f, 3, 2) float32
        v upwards; glTF's v points down.
    png : sequence of bytes
        The texture of each atlas.
    offset : (3,) float64
        Offset subtracted from the world coordinates; stored in the node's extras.
    normal_png, occlusion_png : the same, optional
        Tangent-space normal map (+Y) and ambient occlusion (red channel), for the same UVs.
    shading : str
        ``"lit"``, ``"unlit"`` (then without both maps), or ``"auto"``: as described above.
    face_atlas : (f,) int, optional
        Atlas of each face, if there are several.
    """
    validate_for_export(vertices, faces, corner_uvs)
    if shading == "unlit":
        normal_png = occlusion_png = ()
    corners = np.asarray(faces)
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    atlas = np.zeros(len(corners), np.uint8) if face_atlas is None else np.asarray(face_atlas)
    faces, corner_uvs, atlas = corners[whole], np.asarray(corner_uvs)[whole], atlas[whole]
    images = {"albedo": png, "normal": normal_png, "occlusion": occlusion_png}
    present = [name for name, several in images.items() if several]
    parts = _Parts()
    tables = _Tables.of(vertices, faces, corner_uvs, with_tangents="normal" in present)
    is_unlit = shading == "unlit" or (shading == "auto" and present == ["albedo"])
    used = np.unique(atlas).tolist()
    materials = [_material(present, is_unlit, n, k * len(present)) for k, n in enumerate(used)]
    primitives = [
        {**_add_primitive(parts, tables, atlas == number), "material": k}
        for k, number in enumerate(used)
    ]
    pictures = []
    for number in used:
        for name in present:
            view = parts.add(images[name][number])
            called = Path(atlas_file(name, number)).stem
            pictures.append({"name": called, "mimeType": "image/png", "bufferView": view})
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "Gaussian Wrapping for Blender"},
        "extensionsUsed": list(materials[0]["extensions"]),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"mesh": 0, "name": "mesh", "extras": {"world_offset": np.asarray(offset).tolist()}}
        ],
        "meshes": [{"name": "mesh", "primitives": primitives}],
        "materials": materials,
        "textures": [{"source": k, "sampler": 0} for k in range(len(pictures))],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": pictures,
        "accessors": parts.accessors,
        "bufferViews": parts.views,
        "buffers": [{"byteLength": len(parts.binary)}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<III", _MAGIC, 2, 12 + 8 + len(text) + 8 + len(parts.binary))
    head += struct.pack("<II", len(text), _JSON_CHUNK) + text
    head += struct.pack("<II", len(parts.binary), _BINARY_CHUNK)
    with write_errors(path):
        write_bytes(path, head + bytes(parts.binary))


class _Parts:
    """Builder of the binary chunk with its buffer views and accessors."""

    def __init__(self) -> None:
        self.binary = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, data: bytes, target: int | None = None) -> int:
        """Append bytes; return the index of their buffer view."""
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self.binary += data + b"\0" * (-len(data) % 4)
        return len(self.views) - 1

    def add_array(self, array: np.ndarray, component: int, kind: str, target: int) -> int:
        """Append an array; return the index of its accessor."""
        view = self.add(array.tobytes(), target)
        accessor = {"bufferView": view, "componentType": component, "count": len(array)}
        self.accessors.append({**accessor, "type": kind})
        return len(self.accessors) - 1


class _Tables(NamedTuple):
    """Vertex data of a whole mesh in glTF's axes."""

    faces: np.ndarray  # (f, 3)
    uvs: np.ndarray  # (3 f, 2) float32, v upwards
    positions: np.ndarray  # (v, 3)
    normals: np.ndarray  # (v, 3)
    tangents: np.ndarray | None  # (3 f, 4) float32

    @classmethod
    def of(
        cls, vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray, *, with_tangents: bool
    ) -> _Tables:
        uvs = np.asarray(corner_uvs, np.float32).reshape(-1, 2)
        tangents = None
        if with_tangents:
            frames = tangent_frames(vertices, faces, corner_uvs)
            tangents = np.zeros((len(uvs), 4), "<f4")
            tangents[:, :3] = _y_up(frames.tangents.reshape(-1, 3))
            tangents[:, 3] = np.repeat(frames.signs, 3)
        normals = _y_up(shading_normals(vertices, faces))
        return cls(np.asarray(faces, np.int64), uvs, _y_up(vertices), normals, tangents)


def _add_primitive(parts: _Parts, tables: _Tables, chosen: np.ndarray) -> dict[str, Any]:
    """Add the chosen faces; one glTF vertex for each combination of vertex, UV and tangent."""
    rows = np.repeat(chosen, 3)
    corner_vertex, uvs = tables.faces[chosen].ravel(), tables.uvs[rows]
    key = np.zeros(len(uvs), np.dtype([("vertex", "<i8"), ("uv", "<u8"), ("tangent", "<u8", (2,))]))
    key["vertex"] = corner_vertex
    key["uv"] = np.ascontiguousarray(uvs).view(np.uint64)[:, 0]
    if tables.tangents is not None:
        key["tangent"] = tables.tangents[rows].view(np.uint64)
    rows_as_bytes = key.view(np.dtype((np.void, key.dtype.itemsize)))  # one sortable value each
    _, first, index = np.unique(rows_as_bytes, return_index=True, return_inverse=True)
    owner = corner_vertex[first]
    positions = tables.positions[owner].astype("<f4")
    coordinates = np.stack([uvs[first, 0], 1.0 - uvs[first, 1]], axis=1).astype("<f4")
    arrays = {
        "POSITION": (positions, "VEC3"),
        "NORMAL": (tables.normals[owner].astype("<f4"), "VEC3"),
        "TEXCOORD_0": (coordinates, "VEC2"),
    }
    if tables.tangents is not None:
        arrays["TANGENT"] = (tables.tangents[rows][first], "VEC4")
    attributes = {
        name: parts.add_array(array, _FLOAT, kind, _ARRAY_BUFFER)
        for name, (array, kind) in arrays.items()
    }
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    parts.accessors[attributes["POSITION"]].update(bounds)
    indices = parts.add_array(index.ravel().astype("<u4"), _UINT32, "SCALAR", _INDEX_BUFFER)
    return {"attributes": attributes, "indices": indices}


def _material(images: list[str], is_unlit: bool, atlas: int, first: int) -> dict[str, Any]:
    """Return the material of an atlas, whose textures start at index ``first``, in this order."""
    material: dict[str, Any] = {
        "name": Path(atlas_file("albedo", atlas)).stem,
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": first + images.index("albedo")},
            "metallicFactor": 0.0,
            "roughnessFactor": ROUGHNESS,
        },
    }
    for name in ("normal", "occlusion"):
        if name in images:
            material[f"{name}Texture"] = {"index": first + images.index(name)}
    extensions: dict[str, Any] = {"KHR_materials_specular": {"specularFactor": 2 * SPECULAR_LEVEL}}
    material["extensions"] = {"KHR_materials_unlit": {}} if is_unlit else extensions
    return material


def _y_up(values: np.ndarray) -> np.ndarray:
    return np.stack([values[:, 0], values[:, 2], -values[:, 1]], axis=1)


# -- Write textured meshes: arrays for Blender, PLY, OBJ, GLB, and their coordinate frames --------
#
# | file | coordinates |
# |---|---|
# | ``mesh.npz`` | scene frame, float64 |
# | ``mesh.ply`` | world, double |
# | ``mesh.obj`` | world minus ``offset``, world axes |
# | ``mesh.glb`` | world minus ``offset``, rotated from Z up to Y up (x, z, -y), float32 |
#
# ``offset`` is 0 unless the mesh is so far from the origin that float32 precision would be
# visible; it is written to ``transform.json`` and into the GLB's node.


def write_obj(
    path: Path, vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray,
    image_names: Sequence[str], normal_names: Sequence[str] = (),
    face_atlas: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Write an OBJ and its ``.mtl``, which refers to images in the same folder.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int32
    corner_uvs : (f, 3, 2) float32
        v upwards, as in OBJ.
    image_names : sequence of str
        One per atlas; without spaces, which OBJ readers handle differently.
    normal_names : the same, optional
        Normal maps, written as ``map_Bump``, as Blender writes and reads them.
    face_atlas : (f,) int, optional
        Atlas of each face, if there are several; each has its own material.
    """
    validate_for_export(vertices, faces, corner_uvs)
    for name in image_names:
        if any(c.isspace() for c in name + path.name):
            raise UsageError(f"OBJ files cannot refer to {name!r}.", "Use a name without spaces.")
    uvs, corner = np.unique(corner_uvs.reshape(-1, 2), axis=0, return_inverse=True)
    corner = corner.reshape(-1, 3) + 1
    owner = np.asarray(faces) + 1
    table = np.stack([owner, corner, owner], axis=2).reshape(-1, 9)
    text = io.StringIO()
    text.write(f"mtllib {path.stem}.mtl\no {path.stem}\n")
    np.savetxt(text, vertices, fmt="v %.9g %.9g %.9g")
    np.savetxt(text, uvs, fmt="vt %.7f %.7f")
    # Without normals, readers shade faces flat, which does not match the normal map.
    np.savetxt(text, shading_normals(vertices, faces), fmt="vn %.6f %.6f %.6f")
    atlas = np.zeros(len(table), np.uint8) if face_atlas is None else face_atlas
    shine = " ".join([str(SPECULAR_LEVEL)] * 3)
    material = ""
    for number, name in enumerate(image_names):
        called = Path(atlas_file("albedo", number)).stem
        text.write(f"usemtl {called}\n")
        np.savetxt(text, table[atlas == number], fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")
        material += f"newmtl {called}\nNs {OBJ_SHININESS:.6g}\nKa 1 1 1\nKd 1 1 1\nKs {shine}\n"
        material += f"Ni 1.5\nd 1\nillum 2\nmap_Kd {name}\n"
        if normal_names:
            material += f"map_Bump -bm 1 {normal_names[number]}\n"
    with write_errors(path):
        write_bytes(path.with_suffix(".mtl"), material.encode())
        write_bytes(path, text.getvalue().encode())


def write_textured(
    textured: TexturedMesh, folder: Path, formats: tuple[str, ...], world_from_scene: Similarity,
    offset: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Write ``mesh.npz``, ``albedo.png``, ``mesh.ply``, ``transform.json`` and further formats.

    ``normal.png`` and ``occlusion.png`` are written if the mesh has these maps; further atlases
    are ``albedo-2.png`` and on, or ``albedo.1001.png`` and on if the mesh has UDIM tiles. Then the
    UVs of the OBJ lie in their tiles; those of the other files lie in [0, 1]. The mesh is in the
    scene frame.

    Parameters
    ----------
    formats : tuple of str
        Elements of :data:`RESULT_FORMATS`; ``"ply"`` is always written.
    world_from_scene : Similarity
        Transform to the world frame of the input.
    offset : (3,) float64, optional
        Offset subtracted in the files, to align several of them; by default
        :func:`file_offset`.

    Raises
    ------
    MeshingError
        The mesh is empty or not finite.
    UsageError
        Unknown format.
    ResourceError
        The folder cannot be written.
    """
    unknown = sorted(set(formats) - set(RESULT_FORMATS))
    if unknown:
        known = ", ".join(RESULT_FORMATS)
        raise UsageError(f"Unknown export format {unknown[0]!r}.", f"Use {known}.")
    mesh = textured.mesh
    validate_for_export(mesh.vertices, mesh.faces, textured.corner_uvs)
    corner_uvs, face_atlas, udims = textured.corner_uvs, textured.face_atlas, textured.udims
    world = world_from_scene.points(mesh.vertices)
    offset = file_offset(world) if offset is None else offset
    atlases = textured.atlases
    images = {
        "albedo": [a.albedo for a in atlases],
        "normal": [a.normal_map for a in atlases if a.normal_map is not None],
        "occlusion": [a.occlusion for a in atlases if a.occlusion is not None],
    }
    pngs = {name: [png_bytes(image) for image in several] for name, several in images.items()}
    names = {
        name: [atlas_file(name, number, udims) for number in range(len(several))]
        for name, several in images.items()
    }
    arrays: dict[str, np.ndarray] = {
        "vertices": np.asarray(mesh.vertices, np.float64),
        "faces": np.asarray(mesh.faces, np.int32),
        "corner_uvs": np.asarray(corner_uvs, np.float32),
    }
    if face_atlas is not None:
        arrays["face_atlas"] = np.asarray(face_atlas, np.uint8)
    if udims:
        arrays["udims"] = np.asarray(udims, np.int32)
    frames = {
        "mesh.npz": "scene", "mesh.ply": "world", "mesh.obj": "world = file + offset",
        "mesh.glb": "world = (x, -z, y) of the file + offset",
    }  # fmt: skip
    transform = {
        "version": 1, "offset": offset.tolist(), "world_from_scene": world_from_scene.to_json(),
        "frames": frames,
    }  # fmt: skip
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        stream = io.BytesIO()
        np.savez(stream, **arrays)
        write_bytes(folder / "mesh.npz", stream.getvalue())
        for kind, several in pngs.items():
            for name, data in zip(names[kind], several, strict=True):
                write_bytes(folder / name, data)
        write_json(folder / "transform.json", transform)
    colors = vertex_colors(len(world), mesh.faces, corner_uvs, images["albedo"], face_atlas)
    write_mesh_ply(folder / "mesh.ply", world, mesh.faces, colors)
    local = world - offset
    if "obj" in formats:
        placed = udim_uvs(corner_uvs, face_atlas, udims) if udims else corner_uvs
        write_obj(
            folder / "mesh.obj", local, mesh.faces, placed, names["albedo"], names["normal"],
            face_atlas,
        )  # fmt: skip
    if "glb" in formats:
        write_glb(
            folder / "mesh.glb", local, mesh.faces, corner_uvs, pngs["albedo"], offset,
            normal_png=pngs["normal"], occlusion_png=pngs["occlusion"], face_atlas=face_atlas,
        )  # fmt: skip


def png_bytes(image: np.ndarray) -> bytes:
    """Encode (h, w, 3) or grey (h, w) uint8 as PNG."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="PNG", compress_level=4)
    return stream.getvalue()
