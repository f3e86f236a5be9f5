# SPDX-License-Identifier: GPL-3.0-or-later
"""The version of the code that runs parts: two computers must have the same."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

_CORE = Path(__file__).resolve().parents[2]
_DIGITS = 12


@cache
def code_version() -> str:
    """Return a hash of all files of ``core``, whatever the line ends of their checkout."""
    hashed = hashlib.sha256()
    for path in sorted(_CORE.rglob("*.py"), key=lambda path: path.relative_to(_CORE).as_posix()):
        hashed.update(path.relative_to(_CORE).as_posix().encode())
        hashed.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return hashed.hexdigest()[:_DIGITS]
