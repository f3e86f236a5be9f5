# SPDX-License-Identifier: GPL-3.0-or-later
"""Rules for names of regions, folders and files; standard library only."""

from __future__ import annotations

from typing import Any

from . import limits

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
