# SPDX-License-Identifier: GPL-3.0-or-later
"""Encode one textured mesh as binary glTF 2.0: Y up, images embedded."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...mesh.tangent_frame import shading_normals, tangent_frames
from .file_checks import atlas_file
from .shading import ROUGHNESS, SPECULAR_LEVEL

_MAGIC = 0x46546C67
_JSON_CHUNK = 0x4E4F534A
_BINARY_CHUNK = 0x004E4942
_FLOAT, _UINT32 = 5126, 5125
_ARRAY_BUFFER, _INDEX_BUFFER = 34962, 34963


def glb_bytes(
    vertices: np.ndarray,
    faces: np.ndarray,
    corner_uvs: np.ndarray,
    png: bytes | Sequence[bytes],
    offset: np.ndarray,
    *,
    normal_png: bytes | Sequence[bytes] | None = None,
    occlusion_png: bytes | Sequence[bytes] | None = None,
    shading: str = "auto",
    face_atlas: np.ndarray | None = None,
) -> bytes:
    """Return the content of the file.

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
    png : bytes or sequence of bytes
        The texture, or one for each atlas.
    offset : (3,) float64
        Offset subtracted from the world coordinates; stored in the node's extras.
    normal_png, occlusion_png : the same, optional
        Tangent-space normal map (+Y) and ambient occlusion (red channel), for the same UVs.
    shading : str
        ``"lit"``, ``"unlit"`` (then without both maps), or ``"auto"``: as described above.
    face_atlas : (f,) int, optional
        Atlas of each face, if there are several.
    """
    if shading == "unlit":
        normal_png = occlusion_png = None
    corners = np.asarray(faces)
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    atlas = np.zeros(len(corners), np.uint8) if face_atlas is None else np.asarray(face_atlas)
    faces, corner_uvs, atlas = corners[whole], np.asarray(corner_uvs)[whole], atlas[whole]
    images = {
        "albedo": _listed(png), "normal": _listed(normal_png), "occlusion": _listed(occlusion_png),
    }  # fmt: skip
    present = [name for name, several in images.items() if several]
    parts = _Parts()
    tables = _vertex_tables(vertices, faces, corner_uvs, with_tangents="normal" in present)
    is_unlit = shading == "unlit" or (shading == "auto" and present == ["albedo"])
    primitives: list[dict[str, Any]] = []
    materials: list[dict[str, Any]] = []
    used = np.unique(atlas).tolist()
    for number in used:
        attributes = _add_primitive(parts, tables, atlas == number)
        primitives.append({**attributes, "material": len(materials)})
        materials.append(_material(present, is_unlit, number, len(materials) * len(present)))
    pictures = []
    for number in used:
        for name in present:
            view = parts.add(images[name][number])
            called = Path(atlas_file(name, number)).stem
            pictures.append({"name": called, "mimeType": "image/png", "bufferView": view})
    binary = parts.binary
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
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        [
            struct.pack("<III", _MAGIC, 2, length),
            struct.pack("<II", len(text), _JSON_CHUNK),
            text,
            struct.pack("<II", len(binary), _BINARY_CHUNK),
            bytes(binary),
        ]
    )


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
        self.accessors.append(
            {"bufferView": view, "componentType": component, "count": len(array), "type": kind}
        )
        return len(self.accessors) - 1


class _Tables(NamedTuple):
    """Vertex data of a whole mesh in glTF's axes."""

    faces: np.ndarray  # (f, 3)
    uvs: np.ndarray  # (3 f, 2) float32, v upwards
    positions: np.ndarray  # (v, 3)
    normals: np.ndarray  # (v, 3)
    tangents: np.ndarray | None  # (3 f, 4) float32


def _vertex_tables(
    vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray, *, with_tangents: bool
) -> _Tables:
    uvs = np.asarray(corner_uvs, np.float32).reshape(-1, 2)
    tangents = None
    if with_tangents:
        frames = tangent_frames(vertices, faces, corner_uvs)
        tangents = np.zeros((len(uvs), 4), "<f4")
        tangents[:, :3] = _y_up(frames.tangents.reshape(-1, 3))
        tangents[:, 3] = np.repeat(frames.signs, 3)
    normals = _y_up(shading_normals(vertices, faces))
    return _Tables(np.asarray(faces, np.int64), uvs, _y_up(vertices), normals, tangents)


def _add_primitive(parts: _Parts, tables: _Tables, chosen: np.ndarray) -> dict[str, Any]:
    """Add the chosen faces; one glTF vertex for each combination of vertex, UV and tangent."""
    rows = np.repeat(chosen, 3)
    corner_vertex, uvs = tables.faces[chosen].ravel(), tables.uvs[rows]
    key = np.zeros(len(uvs), np.dtype([("vertex", "<i8"), ("uv", "<u8"), ("tangent", "<u8", (2,))]))
    key["vertex"] = corner_vertex
    key["uv"] = np.ascontiguousarray(uvs).view(np.uint64)[:, 0]
    if tables.tangents is not None:
        key["tangent"] = tables.tangents[rows].view(np.uint64)
    _, first, index = np.unique(_bytes_of(key), return_index=True, return_inverse=True)
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


def _listed(png: bytes | Sequence[bytes] | None) -> list[bytes]:
    if png is None:
        return []
    return [png] if isinstance(png, bytes) else list(png)


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


def _bytes_of(rows: np.ndarray) -> np.ndarray:
    """View each row of a structured array as one sortable value."""
    return rows.view(np.dtype((np.void, rows.dtype.itemsize)))


def _y_up(values: np.ndarray) -> np.ndarray:
    return np.stack([values[:, 0], values[:, 2], -values[:, 1]], axis=1)
