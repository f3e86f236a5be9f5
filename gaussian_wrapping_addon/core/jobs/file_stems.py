# SPDX-License-Identifier: GPL-3.0-or-later
"""Names of files and folders made of names of regions: safe everywhere, no two the same."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable

from ..names import is_reserved_name

MAX_STEM_BYTES = 120
"""With endings, and what atomic writing adds, it stays below the 255 bytes of file systems."""
SPLAT_STEM = "gaussians.splat"
"""Of the splat that lies beside the meshes."""
_DIGITS = 8


def file_stem(region: str, level: int) -> str:
    """Return the name, without its ending, of the files of a region's level.

    No spaces, which OBJ readers do not agree on, and none of the names that Windows keeps for
    itself. What is too long is cut and ends with a number made of the whole.
    """
    clean = re.sub(r"[^\w.-]+", "_", region).strip("._") or "mesh"
    if is_reserved_name(clean):
        clean = f"mesh_{clean}"
    if len(clean.encode()) > MAX_STEM_BYTES:
        room = MAX_STEM_BYTES - _DIGITS - 1
        clean = f"{clean.encode()[:room].decode(errors='ignore')}-{_number(region)}"
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
    plain = {mesh: file_stem(*mesh) for mesh in meshes}
    count = Counter([SPLAT_STEM, *(stem.casefold() for stem in plain.values())])
    return {
        mesh: stem if count[stem.casefold()] == 1 else f"{stem}-{_number(f'{mesh[1]} {mesh[0]}')}"
        for mesh, stem in plain.items()
    }


def _number(name: str) -> str:
    return hashlib.sha256(name.encode(errors="surrogatepass")).hexdigest()[:_DIGITS]
