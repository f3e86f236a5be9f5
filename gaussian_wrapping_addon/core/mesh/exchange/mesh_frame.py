# SPDX-License-Identifier: GPL-3.0-or-later
"""Find the frame of a mesh file: how its coordinates lead to the world of the input."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ... import limits
from ...dataset.frames.file_frame import Y_UP
from ...dataset.similarity import Similarity
from ...errors import ParseError
from ...export_formats import EXPORT_FORMATS
from ...files import read_json

_GLB_MAGIC, _JSON_CHUNK = 0x46546C67, 0x4E4F534A
_HINT = "Export the file again, or say --up y or --up z without a sidecar."


def world_from_file(path: Path, sidecar: Path | None = None, up: str = "auto") -> Similarity:
    """Return the similarity from the coordinates of a mesh file to the world of the input.

    The first of these that exists decides: the sidecar that is named; a given ``up``; the sidecar
    of an export beside the file (``auto.glb.json``); ``transform.json`` of a result folder; the
    axes of the format, as this add-on and Blender export it, and the offset inside a GLB.

    Parameters
    ----------
    path : Path
        The mesh file.
    sidecar : Path, optional
        The sidecar of the exported file from which the mesh was made.
    up : str
        One of ``auto``, ``y``, ``z``; with an axis, nothing else is read.

    Raises
    ------
    ParseError
        The sidecar is none, or its transform is no similarity.
    """
    if sidecar is None and up != "auto":
        return _turned(up == "y", np.zeros(3))
    beside = path.with_name(path.name + ".json")
    if sidecar is not None or beside.is_file():
        return _of_sidecar(sidecar or beside)
    known = path.with_name("transform.json")
    if known.is_file():
        offset = _of_result(known, path.name)
        if offset is not None:
            return offset
    formats = {f.suffix: f.y_up for f in EXPORT_FORMATS.values() if f.of_mesh}
    is_glb = path.suffix.lower() == ".glb"
    return _turned(
        formats.get(path.suffix.lower(), False), _glb_offset(path) if is_glb else np.zeros(3)
    )


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
