# SPDX-License-Identifier: GPL-3.0-or-later
"""Rules for names of regions, folders and files; standard library only.

A region has the name that its file gives it. Its result lies in a folder of a simpler name
(:func:`region_name`), so that two regions may ask for one folder; exported files have a stem that
is made of the folder's or the object's name (:func:`file_stem`).
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
"""What a job may ask for in place of a region file."""
REPORT_FOLDER = "report"
"""Folder of a result in which the report's pictures lie: no region's."""
MAX_REGION_CHARACTERS = 40
MAX_STEM_BYTES = 120
"""With endings, and what atomic writing adds, it stays below the 255 bytes of file systems."""
SPLAT_STEM = "gaussians.splat"
"""Of the splat that lies beside the meshes."""
_DIGITS = 8

_RESERVED = {"CON", "PRN", "AUX", "NUL", *(f"{d}{i}" for d in ("COM", "LPT") for i in range(1, 10))}


def is_reserved_name(name: str) -> bool:
    """Tell whether Windows keeps a name for itself, whatever its ending."""
    return name.split(".")[0].rstrip(" ").upper() in _RESERVED


def printable_name(name: Any) -> str:
    """Return a name that fits into any text file and its bound in bytes; empty without one.

    JSON may hold half of a surrogate pair, which no encoding writes; it becomes a question mark.
    NUL ends names in Blender and in file systems, so it is left out.
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
        Two have one name, or names that are one where case does not count: the result of one
        would replace that of the other.
    """
    names = [region_name(request, bodies.get(request)) for request in requests]
    first: dict[str, str] = {}
    for request, name in zip(requests, names, strict=True):
        wanted = _requested_name(request, bodies.get(request))
        other = first.get(name.lower())
        first[name.lower()] = wanted
        if other is not None:
            same = "" if other == wanted else f": {other!r} and {wanted!r} are kept in one folder"
            raise UsageError(
                f"Two regions have the same name, {name}{same}.", "Give each region its own name."
            )
    return names


def file_stem(region: str, level: int) -> str:
    """Return the name, without its ending, of the files of a region's level.

    No spaces, which OBJ readers do not agree on, and none of the names that Windows keeps for
    itself. What is too long is cut and ends with a number made of the whole.
    """
    clean = _sanitise(region, r"\w.-").strip("._") or "mesh"
    if is_reserved_name(clean):
        clean = f"mesh_{clean}"
    if len(clean.encode()) > MAX_STEM_BYTES:
        room = MAX_STEM_BYTES - _DIGITS - 1
        clean = f"{clean.encode()[:room].decode(errors='ignore')}-{_digest(region)}"
    return f"{clean}-lod{level}" if level else clean


def file_stems(meshes: Iterable[tuple[str, int]]) -> dict[tuple[str, int], str]:
    """Return the stems of all meshes of a result, none alike, also where case does not count.

    Those that would have one stem all end with a number made of their own name: it does not depend
    on which of them are written, so that an export at another time replaces none of the others.

    Parameters
    ----------
    meshes : iterable of (region, level)
        All that the result holds, not those to be written alone.
    """
    stems = {mesh: file_stem(*mesh) for mesh in meshes}
    count = Counter([SPLAT_STEM, *(stem.casefold() for stem in stems.values())])
    return {
        mesh: stem if count[stem.casefold()] == 1 else f"{stem}-{_digest(f'{mesh[1]} {mesh[0]}')}"
        for mesh, stem in stems.items()
    }


def _sanitise(text: str, kept: str) -> str:
    """Return a text with an underscore for each run of characters that are not kept."""
    return re.sub(f"[^{kept}]+", "_", text)


def _digest(name: str) -> str:
    return hashlib.sha256(name.encode(errors="surrogatepass")).hexdigest()[:_DIGITS]
