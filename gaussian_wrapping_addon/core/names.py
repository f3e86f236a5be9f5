# SPDX-License-Identifier: GPL-3.0-or-later
"""Names of regions, folders and files; standard library only.

A region is named by its file. Its result is stored in a folder with a sanitised name
(:func:`region_name`), so that two regions may map to one folder; exported files have a stem made
from the name of the folder or object (:func:`file_stem`).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from . import limits
from .errors import UsageError

AUTOMATIC_REGIONS = ("auto", "all")
"""Values that a job accepts instead of a region file."""
REPORT_FOLDER = "report"
"""Folder of the report's pictures in a result; reserved, no region may use it."""
JOB_MARKER = ".gaussian-wrapping-job"
"""Empty file that makes a folder one of a job."""
SHARED_VARIABLE = "GW_SHARED"
"""Environment variable that names the folder that several computers share, as each sees it."""
MAX_REGION_CHARACTERS = 40
MAX_STEM_BYTES = 120
"""With suffixes, and those of atomic writing, names stay below the 255 bytes of file systems."""
SPLAT_STEM = "gaussians.splat"
"""Stem of the splat file beside the meshes."""
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

    Parameters
    ----------
    request : str
        One of :data:`AUTOMATIC_REGIONS`, or the path of a region file.
    body : object
        Content of that file.
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
    """Return the folder names of all requested regions.

    Parameters
    ----------
    bodies : mapping
        Content of the region files, by request.

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
    are written, so that a later export overwrites none of the others.

    Parameters
    ----------
    meshes : iterable of (region, level)
        All meshes of the result, not only those to be written.
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
