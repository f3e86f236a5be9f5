# SPDX-License-Identifier: GPL-3.0-or-later
"""Names of files and folders, and the table of export formats, that several layers share."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import limits
from .errors import UsageError

# -- Names of regions, folders and files; standard library only -----------------------------------
#
# A region is named by its file. Its result is stored in a folder with a sanitised name
# (:func:`region_name`), so that two regions may map to one folder; exported files have a stem
# made from the name of the folder or object (:func:`file_stem`).


AUTO = "auto"
AUTOMATIC_REGIONS = (AUTO, "all")  # values that a job accepts instead of a region file
REPORT_FOLDER = "report"
"""Folder of the report's pictures in a result; reserved, no region may use it."""
JOB_MARKER = ".gaussian-wrapping-job"  # empty file that makes a folder one of a job
SHARED_VARIABLE = "GW_SHARED"
"""Environment variable that names the folder that several computers share, as each sees it."""
MAX_REGION_CHARACTERS = 40
MAX_STEM_BYTES = 120
"""With suffixes, and those of atomic writing, names stay below the 255 bytes of file systems."""
SPLAT_STEM = "gaussians.splat"  # stem of the splat file beside the meshes
_DIGITS = 8

_RESERVED = {"CON", "PRN", "AUX", "NUL", *(f"{d}{i}" for d in ("COM", "LPT") for i in range(1, 10))}


def is_reserved_name(name: str) -> bool:
    """Return whether Windows reserves a name, with any suffix."""
    return name.split(".")[0].rstrip(" ").upper() in _RESERVED


def printable_name(name: Any) -> str:
    """Return a name that can be written to any text file, limited in bytes; empty if there is none.

    JSON may contain a lone surrogate, which no encoding can write; it becomes a question mark. NUL
    terminates names in Blender and in file systems, so it is removed.
    """
    text = name.replace("\0", "") if isinstance(name, str) else ""
    if not text.strip():
        return ""
    encoded = text.encode(errors="replace")
    return encoded[: limits.MAX_NAME_BYTES].decode(errors="ignore")


def region_name(request: str, body: Any) -> str:
    """Return the folder name of a requested region: ASCII, short, never empty.

    The request is one of :data:`AUTOMATIC_REGIONS`, or the path of a region file with this body.
    """
    if request in AUTOMATIC_REGIONS:
        return request
    text = _requested_name(request, body)
    clean = _sanitise(text, r"A-Za-z0-9_-").strip("_")[:MAX_REGION_CHARACTERS]
    if not clean or clean.lower() in AUTOMATIC_REGIONS:
        text = json.dumps([request], separators=(",", ":"))
        return f"region_{hashlib.sha256(text.encode()).hexdigest()[:6]}"
    taken = clean.lower() == REPORT_FOLDER or is_reserved_name(clean)
    return f"region_{clean}" if taken else clean


def _requested_name(request: str, body: Any) -> str:
    wanted = body.get("blender_object_name") if isinstance(body, dict) else None
    return wanted if isinstance(wanted, str) and wanted.strip() else Path(request).stem


def region_names(requests: Sequence[str], bodies: Mapping[str, Any]) -> list[str]:
    """Return the folder names of all requested regions, by the contents of the region files.

    Raises
    ------
    UsageError
        If two have the same name, ignoring case: one result would overwrite the other.
    """
    names = [region_name(request, bodies.get(request)) for request in requests]
    first: dict[str, str] = {}
    for request, name in zip(requests, names, strict=True):
        wanted = _requested_name(request, bodies.get(request))
        other = first.get(name.lower())
        first[name.lower()] = wanted
        if other is not None:
            same = "" if other == wanted else f": {other!r} and {wanted!r} use the same folder"
            raise UsageError(
                f"Two regions have the same name, {name}{same}.", "Give each region its own name."
            )
    return names


def file_stem(region: str, level: int) -> str:
    """Return the file name, without suffix, of a region's level of detail.

    Without spaces, which OBJ readers treat differently, and never a name reserved by Windows. Long
    names are truncated and end with a hash of the full name.
    """
    clean = _sanitise(region, r"\w.-").strip("._") or "mesh"
    if is_reserved_name(clean):
        clean = f"mesh_{clean}"
    if len(clean.encode()) > MAX_STEM_BYTES:
        room = MAX_STEM_BYTES - _DIGITS - 1
        clean = f"{clean.encode()[:room].decode(errors='ignore')}-{_digest(region)}"
    return f"{clean}-lod{level}" if level else clean


def file_stems(meshes: Iterable[tuple[str, int]]) -> dict[tuple[str, int], str]:
    """Return the stems of all meshes of a result, unique even if case is ignored.

    Colliding stems all end with a hash of their own name, which does not depend on which of them
    are written, so that a later export overwrites none of the others. Meshes are all (region,
    level) of the result, not only those to be written.
    """
    stems = {mesh: file_stem(*mesh) for mesh in meshes}
    count = Counter([SPLAT_STEM, *(stem.casefold() for stem in stems.values())])
    return {
        mesh: stem if count[stem.casefold()] == 1 else f"{stem}-{_digest(f'{mesh[1]} {mesh[0]}')}"
        for mesh, stem in stems.items()
    }


def _sanitise(text: str, kept: str) -> str:
    """Replace each run of characters outside ``kept`` by an underscore."""
    return re.sub(f"[^{kept}]+", "_", text)


def _digest(name: str) -> str:
    return hashlib.sha256(name.encode(errors="surrogatepass")).hexdigest()[:_DIGITS]


# -- Table of export formats for jobs, command line and Blender -----------------------------------
#
# Standard library only, so that the command line's help needs no numpy.


SHADINGS = ("auto", "lit", "unlit")


@dataclass(frozen=True)
class ExportFormat:
    """Names, writer and capabilities of an export format."""

    name: str  # identifier in options and job files
    label: str  # label in Blender's panel
    help: str  # content, for the panel's tooltip
    suffix: str
    needs_blender: bool = False
    """Whether only Blender's exporter writes it; the worker writes the others."""
    in_jobs: bool = True  # whether a job can write it with its result (``--export``)
    of_mesh: bool = True  # Whether it contains a mesh; otherwise the Gaussians.
    textures: str = "beside"
    """``"inside"`` the file, ``"beside"`` it, ``"either"`` (an option), or ``"none"``."""
    packed_suffix: str = ""  # suffix of a file with packed textures, if it differs from ``suffix``
    y_up: bool = False  # Whether its up axis is Y; otherwise Z.
    doubles: bool = False  # whether coordinates are double precision and need no offset
    unlit: str = "lit"
    """Export of an unlit material in Blender: ``"keep"``, ``"emission"`` or ``"lit"``."""

    def file_suffix(self, *, pack: bool) -> str:
        """Return the suffix of a file, with textures packed into it or not."""
        return (self.packed_suffix if pack else "") or self.suffix


EXPORT_FORMATS = {
    format.name: format
    for format in (
        ExportFormat(
            "glb", "glTF Binary (.glb)", "Textures inside; lit or unlit as the material is",
            ".glb", textures="inside", y_up=True, unlit="keep",
        ),
        ExportFormat("obj", "OBJ (.obj)", "Textures beside the file", ".obj", y_up=True),
        ExportFormat(
            "ply", "PLY (.ply)", "Double precision and vertex colours, no texture",
            ".ply", textures="none", doubles=True,
        ),
        ExportFormat(
            "splat", "Gaussians (.ply)", "Gaussians for splat viewers",
            ".ply", in_jobs=False, of_mesh=False, textures="none",
        ),
        ExportFormat(
            "usd", "USD (.usdc)", "Textures beside the file, or inside as .usdz",
            ".usdc", needs_blender=True, textures="either", packed_suffix=".usdz",
            unlit="emission",
        ),
        ExportFormat(
            "fbx", "FBX (.fbx)", "Textures beside the file, or inside",
            ".fbx", needs_blender=True, in_jobs=False, textures="either", y_up=True,
        ),
    )
}  # fmt: skip
"""Every format, by name."""

WORKER_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if not f.needs_blender)
BLENDER_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if f.needs_blender)
JOB_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if f.in_jobs)
MESH_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if f.of_mesh)
"""Formats of **Export Meshes** in Blender."""
RESULT_FORMATS = tuple(name for name in JOB_FORMATS if name in WORKER_FORMATS)
"""Formats that the worker writes to a result."""
PACKABLE_FORMATS = tuple(f.name for f in EXPORT_FORMATS.values() if f.textures == "either")


# -- The kinds of parts that a mesh in tiles is made of; standard library only --------------------


POINTS, GATHER, FACES = "points", "gather", "faces"
TILE_KINDS = (POINTS, GATHER, FACES)
"""In the order in which they are made."""

CPU = "cpu"  # the processor, as the name of a device
