# SPDX-License-Identifier: GPL-3.0-or-later
"""One textured mesh as binary glTF 2.0: Y up, images embedded."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from .shading import ROUGHNESS, SPECULAR_LEVEL
from .tangent_frame import shading_normals, tangent_frames

_MAGIC = 0x46546C67
_JSON_CHUNK = 0x4E4F534A
_BINARY_CHUNK = 0x004E4942
_FLOAT, _UINT32 = 5126, 5125
_ARRAY_BUFFER, _INDEX_BUFFER = 34962, 34963


def glb_bytes(
    vertices: np.ndarray,
    faces: np.ndarray,
    corner_uvs: np.ndarray,
    png: bytes,
    offset: np.ndarray,
    *,
    normal_png: bytes | None = None,
    occlusion_png: bytes | None = None,
    shading: str = "auto",
) -> bytes:
    """Build the file.

    Photos hold their own light, so the material is ``KHR_materials_unlit``, with an ordinary
    rough material for readers that do not know it. With a normal map or occlusion it is lit:
    readers ignore both where a material is unlit. Normals are those that the map was baked for;
    tangents stand beside them where there is a normal map. Faces that name a vertex twice are
    left out.

    Parameters
    ----------
    vertices : (v, 3) float64
        Z up, near the origin; written as (x, z, -y).
    faces : (f, 3) int32
    corner_uvs : (f, 3, 2) float32
        v upwards; glTF's v points down.
    png : bytes
        The texture.
    offset : (3,) float64
        What was taken off the world coordinates; kept in the node's extras.
    normal_png, occlusion_png : bytes, optional
        Tangent-space normal map (+Y) and ambient occlusion (red channel), for the same UVs.
    shading : str
        ``"lit"``, ``"unlit"`` (then without both maps), or ``"auto"``: as said above.
    """
    if shading == "unlit":
        normal_png = occlusion_png = None
    corners = np.asarray(faces)
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    faces, corner_uvs = corners[whole], np.asarray(corner_uvs)[whole]
    corner_vertex = np.asarray(faces, np.int64).ravel()
    uvs = np.asarray(corner_uvs, np.float32).reshape(-1, 2)
    tangents = np.zeros((len(uvs), 4), "<f4")
    if normal_png is not None:
        frames = tangent_frames(vertices, faces, corner_uvs)
        tangents[:, :3] = _y_up(frames.tangents.reshape(-1, 3))
        tangents[:, 3] = np.repeat(frames.signs, 3)
    # One glTF vertex for each set of vertex, UV and tangent.
    kinds = [("vertex", "<i8"), ("uv", "<u8"), ("tangent", "<u8", (2,))]
    key = np.empty(len(uvs), np.dtype(kinds))
    key["vertex"] = corner_vertex
    key["uv"] = np.ascontiguousarray(uvs).view(np.uint64)[:, 0]
    key["tangent"] = tangents.view(np.uint64)
    _, first, index = np.unique(_bytes_of(key), return_index=True, return_inverse=True)
    owner = corner_vertex[first]
    positions = _y_up(vertices)[owner].astype("<f4")
    normals = _y_up(shading_normals(vertices, faces))[owner].astype("<f4")
    coordinates = np.stack([uvs[first, 0], 1.0 - uvs[first, 1]], axis=1).astype("<f4")
    attributes = {
        "POSITION": (positions, "VEC3"),
        "NORMAL": (normals, "VEC3"),
        "TEXCOORD_0": (coordinates, "VEC2"),
    }
    if normal_png is not None:
        attributes["TANGENT"] = (tangents[first], "VEC4")
    parts = [array.tobytes() for array, _ in attributes.values()]
    parts += [index.astype("<u4").tobytes()]
    images = {"albedo": png, "normal": normal_png, "occlusion": occlusion_png}
    pictures = {name: data for name, data in images.items() if data is not None}
    targets = [*(_ARRAY_BUFFER for _ in attributes), _INDEX_BUFFER, *(None for _ in pictures)]
    first_image = len(parts)
    parts += pictures.values()
    views: list[dict[str, Any]] = []
    binary = bytearray()
    for part, target in zip(parts, targets, strict=True):
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)}
        views.append(view if target is None else {**view, "target": target})
        binary += part + b"\0" * (-len(part) % 4)
    count = len(first)
    is_unlit = shading == "unlit" or (shading == "auto" and list(pictures) == ["albedo"])
    material = _material(list(pictures), is_unlit)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "Gaussian Wrapping for Blender"},
        "extensionsUsed": list(material["extensions"]),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"mesh": 0, "name": "mesh", "extras": {"world_offset": np.asarray(offset).tolist()}}
        ],
        "meshes": [
            {
                "name": "mesh",
                "primitives": [
                    {
                        "attributes": {name: k for k, name in enumerate(attributes)},
                        "indices": len(attributes),
                        "material": 0,
                    }
                ],
            }
        ],
        "materials": [material],
        "textures": [{"source": k, "sampler": 0} for k in range(len(pictures))],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": [
            {"name": name, "mimeType": "image/png", "bufferView": first_image + k}
            for k, name in enumerate(pictures)
        ],
        "accessors": [
            *(_accessor(k, _FLOAT, count, kind) for k, (_, kind) in enumerate(attributes.values())),
            _accessor(len(attributes), _UINT32, len(index), "SCALAR"),
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    document["accessors"][0].update(bounds)
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


def _material(images: list[str], is_unlit: bool) -> dict[str, Any]:
    """Return the material of images, named in the order of the textures."""
    material: dict[str, Any] = {
        "name": "albedo",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": images.index("albedo")},
            "metallicFactor": 0.0,
            "roughnessFactor": ROUGHNESS,
        },
    }
    for name in ("normal", "occlusion"):
        if name in images:
            material[f"{name}Texture"] = {"index": images.index(name)}
    extensions: dict[str, Any] = {"KHR_materials_specular": {"specularFactor": 2 * SPECULAR_LEVEL}}
    material["extensions"] = {"KHR_materials_unlit": {}} if is_unlit else extensions
    return material


def _bytes_of(rows: np.ndarray) -> np.ndarray:
    """View each row of a structured array as one sortable value."""
    return rows.view(np.dtype((np.void, rows.dtype.itemsize)))


def _y_up(values: np.ndarray) -> np.ndarray:
    return np.stack([values[:, 0], values[:, 2], -values[:, 1]], axis=1)


def _accessor(view: int, component: int, count: int, kind: str) -> dict[str, Any]:
    return {"bufferView": view, "componentType": component, "count": count, "type": kind}
