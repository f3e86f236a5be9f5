# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes of other programs: their files, frame and UVs."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import limits
from ..array_file import read_arrays, write_arrays
from ..errors import ParseError, WorkerError
from ..files import read_json
from ..names import EXPORT_FORMATS
from ..photos.formats import forbid_ghostscript
from ..scene.camera import Similarity
from ..scene.frames import Y_UP
from .textured_mesh import Polygons, checked_polygons

# -- Read triangle meshes with their UVs from common file formats ---------------------------------

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".stl", ".off")
_CHOOSE_A_MESH = "Export the file again."


@dataclass(frozen=True)
class FileMesh:
    """A triangle mesh as its file has it."""

    vertices: np.ndarray  # (v, 3) float64, coordinates of the file
    faces: np.ndarray  # (f, 3) int64
    corner_uvs: np.ndarray | None = None
    """(f, 3, 2) float64, v upwards, not checked; ``None`` if a part of the mesh has no UVs."""
    polygons: Polygons | None = None
    """What its triangles are parts of; ``None`` if that is not known."""
    is_new: bool = False
    """Whether it was made for a bake, and Blender is to show it as an object of its own."""


def read_mesh_file(path: Path) -> FileMesh:
    """Read a triangle mesh with trimesh, in the coordinates of the file.

    Node transforms of a GLB are applied; its axes are kept (Y up). The parts of a file become one
    mesh; parts share no vertices, and vertices with several UVs may be repeated.
    Raises ParseError: not a mesh file, truncated, without faces, with values that are not finite,
    or with vertex indices out of range; WorkerError: the worker's Python lacks trimesh.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ParseError(
            path, "file name", "not a known mesh format.", f"Use one of {', '.join(MESH_SUFFIXES)}."
        )
    if not path.is_file():
        raise ParseError(path, "whole file", "the file does not exist.", "Check the path.")
    try:
        import trimesh
    except ImportError:
        raise WorkerError(
            "The worker's Python lacks trimesh, which reads meshes.",
            "pip install -r requirements-worker.txt there.",
        ) from None
    forbid_ghostscript()  # a GLB holds its textures, which trimesh opens in any format
    named = path.suffix.lower() in (".obj", ".ply")  # textures of other files, which are not read
    options: dict[str, Any] = {"skip_materials": True} if named else {}
    try:
        loaded: Any = trimesh.load(path, process=False, **options)
        # Joined here: trimesh would change the UVs of parts with different materials.
        parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        mesh = _joined([part for part in parts if isinstance(part, trimesh.Trimesh)])
    except Exception as error:  # a broken file can make the reader raise anything
        problem = f"cannot be read as a mesh ({error}); it may be truncated."
        raise ParseError(path, "whole file", problem, _CHOOSE_A_MESH) from None
    if len(mesh.faces) == 0:
        raise ParseError(path, "faces", "there are none, or the file is truncated.", _CHOOSE_A_MESH)
    faces, count = mesh.faces, len(mesh.vertices)
    if faces.min() < 0 or faces.max() >= count:
        bad = int(np.flatnonzero(((faces < 0) | (faces >= count)).any(1))[0])
        problem = "refers to a vertex that does not exist."
        raise ParseError(path, f"face {bad}", problem, _CHOOSE_A_MESH)
    _check_finite(path, mesh.vertices, _CHOOSE_A_MESH)
    return mesh


def _check_finite(path: Path, vertices: np.ndarray, hint: str) -> None:
    bad = np.flatnonzero(~np.isfinite(vertices).all(1))
    if len(bad):
        problem = f"is not finite (as are {len(bad)} in all)."
        raise ParseError(path, f"vertex {int(bad[0])}", problem, hint)


def _joined(parts: list[Any]) -> FileMesh:
    """Join the parts of a file; UVs are kept if every part has them."""
    if not parts:
        return FileMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    vertices, faces, corner_uvs, base = [], [], [], 0
    for part in parts:
        part_vertices = np.asarray(part.vertices, np.float64).reshape(-1, 3)
        part_faces = np.asarray(part.faces, np.int64).reshape(-1, 3)
        uvs = getattr(part.visual, "uv", None)
        if uvs is not None and np.shape(uvs) == (len(part_vertices), 2) and len(part_faces):
            corner_uvs.append(np.asarray(uvs, np.float64)[part_faces])
        vertices.append(part_vertices)
        faces.append(part_faces + base)
        base += len(part_vertices)
    whole = corner_uvs and len(corner_uvs) == sum(len(part) > 0 for part in faces)
    uvs = np.concatenate(corner_uvs) if whole else None
    return FileMesh(np.concatenate(vertices), np.concatenate(faces), uvs)


# -- Meshes that Blender hands over to the worker: arrays in world coordinates, in double
#    precision
#
# Needs numpy only.

SUFFIX = ".npz"
MAX_BYTES = 4 * 2**30
_HAND_OVER_AGAIN = "Start it again from Blender."


def write_handed_over(path: Path, mesh: FileMesh) -> None:
    """Write a mesh in the world frame of the job's input; OSError if that fails."""
    arrays = {} if mesh.corner_uvs is None else {"corner_uvs": np.asarray(mesh.corner_uvs)}
    if mesh.polygons is not None:
        arrays |= {"polygons": mesh.polygons.of_faces, "loops": mesh.polygons.loops}
        arrays |= {"is_new": np.array(mesh.is_new)}
    write_arrays(path, frame=np.array("world"), vertices=mesh.vertices, faces=mesh.faces, **arrays)


def read_handed_over(path: Path) -> FileMesh:
    """Read a file of :func:`write_handed_over`.

    Raises ParseError: it is none, or its mesh has no faces, values that are not finite, or indices
    out of range.
    """
    if not path.is_file():
        raise ParseError(path, "whole file", "the file does not exist.", _HAND_OVER_AGAIN)
    arrays = read_arrays(
        path, ("frame", "vertices", "faces"), most_bytes=MAX_BYTES, hint=_HAND_OVER_AGAIN,
        optional=("corner_uvs", "polygons", "loops", "is_new"),
    )  # fmt: skip
    try:
        if str(arrays["frame"]) != "world":
            raise ValueError("not in world coordinates")
        vertices = np.asarray(arrays["vertices"], np.float64)
        faces = arrays["faces"]
        uvs = arrays["corner_uvs"].astype(np.float64) if "corner_uvs" in arrays else None
        if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.dtype.kind not in "iu":
            raise ValueError("not lists of triples")
        if uvs is not None and uvs.shape != (len(faces), 3, 2):
            raise ValueError("UVs are not those of the faces")
        polygons = None
        if "polygons" in arrays and "loops" in arrays:
            polygons = checked_polygons(arrays["polygons"], arrays["loops"], len(faces))
        is_new = polygons is not None and bool(arrays.get("is_new", np.array(False)).any())
    except (ValueError, TypeError) as error:
        raise ParseError(
            path, "whole file", f"not a mesh handed over by Blender ({error}).", _HAND_OVER_AGAIN
        ) from None
    if len(faces) == 0:
        raise ParseError(path, "faces", "there are none.", "Choose a mesh with faces.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ParseError(path, "faces", "an index is out of range.", _HAND_OVER_AGAIN)
    _check_finite(path, vertices, "Delete these vertices, or undo what made them.")
    return FileMesh(vertices, faces.astype(np.int64), uvs, polygons, is_new)


# -- Find the frame of a mesh file: how its coordinates lead to the world of the input ------------

_GLB_MAGIC, _JSON_CHUNK = 0x46546C67, 0x4E4F534A
_HINT = "Export the file again, or say --up y or --up z without a sidecar."


def world_from_file(path: Path, sidecar: Path | None = None, up: str = "auto") -> Similarity:
    """Return the similarity from the coordinates of a mesh file to the world of the input.

    The first of these that exists decides: ``sidecar``, that of the exported file from which the
    mesh was made; ``up``, one of ``auto``, ``y``, ``z``; the sidecar of an export beside the file
    (``auto.glb.json``); ``transform.json`` of a result folder; the axes of the format, as this
    add-on and Blender export it, and the offset inside a GLB.
    Raises ParseError: the sidecar is none, or its transform is no similarity.
    """
    if sidecar is None and up != "auto":
        return _turned(up == "y", np.zeros(3))
    beside = path.with_name(path.name + ".json")
    if sidecar is not None or beside.is_file():
        return _of_sidecar(sidecar or beside)
    known = path.with_name("transform.json")
    if known.is_file() and (found := _of_result(known, path.name)) is not None:
        return found
    formats = {f.suffix: f.y_up for f in EXPORT_FORMATS.values() if f.of_mesh}
    suffix = path.suffix.lower()
    offset = _glb_offset(path) if suffix == ".glb" else np.zeros(3)
    return _turned(formats.get(suffix, False), offset)


def _turned(y_up: bool, offset: np.ndarray) -> Similarity:
    return Similarity(1.0, Y_UP.T if y_up else np.eye(3), offset)


def _of_sidecar(path: Path) -> Similarity:
    if not path.is_file():
        raise ParseError(path, "whole file", "the sidecar does not exist.", "Check the path.")
    values = read_json(path, follow_links=True)
    try:
        found = Similarity.from_json(values["world_from_file"])
        if not (np.isfinite(found.matrix()).all() and found.scale > 0.0):
            raise ValueError("a number is not finite")
        if np.abs(found.rotation @ found.rotation.T - np.eye(3)).max() > 1e-6:
            raise ValueError("its rotation is none")
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ParseError(path, "world_from_file", f"not a transform ({error}).", _HINT) from None
    return found


def _of_result(path: Path, name: str) -> Similarity | None:
    """Return the transform of a file of a result folder; ``None`` if it is not described there."""
    values = read_json(path, follow_links=True)
    frames = values.get("frames") if isinstance(values, dict) else None
    if not isinstance(frames, dict) or name not in frames or name == "mesh.npz":
        return None
    if name == "mesh.ply":  # double precision, without an offset
        return Similarity()
    return _turned(name.endswith(".glb"), _checked_offset(values.get("offset"), path, "offset"))


def _checked_offset(value: Any, path: Path, location: str) -> np.ndarray:
    try:
        offset = np.asarray(value, np.float64).reshape(3)
    except (TypeError, ValueError):
        offset = np.full(3, np.nan)
    if not np.isfinite(offset).all():
        raise ParseError(path, location, "not three finite numbers.", _HINT)
    return offset


def _glb_offset(path: Path) -> np.ndarray:
    """Return the offset that this add-on writes into the node of a GLB; 0 without one."""
    try:
        with path.open("rb") as stream:
            magic, _, _, length, kind = struct.unpack("<IIIII", stream.read(20))
            if (magic, kind) != (_GLB_MAGIC, _JSON_CHUNK) or length > limits.MAX_JSON_BYTES:
                return np.zeros(3)
            nodes = json.loads(stream.read(length))["nodes"]
        found = [node["extras"]["world_offset"] for node in nodes if "extras" in node]
    except (OSError, struct.error, ValueError, KeyError, TypeError, RecursionError):
        return np.zeros(3)  # the reader of the mesh says what is wrong with the file
    return _checked_offset(found[0], path, "extras.world_offset") if found else np.zeros(3)
