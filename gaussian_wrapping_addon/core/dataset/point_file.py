# SPDX-License-Identifier: GPL-3.0-or-later
"""Bounded reader of a point cloud in PLY format (the ``ply_file_path`` of transforms.json)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .. import limits
from ..errors import ParseError

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_MAX_HEADER_BYTES = 64 * 1024
_AGAIN = "Export the points again as PLY with x, y, z."


def read_point_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions and colours of a PLY's vertices (ASCII or binary).

    Returns
    -------
    points : (n, 3) float64
    colors : (n, 3) uint8
        Grey where the file has none.

    Raises
    ------
    ParseError
        With the place in the file.
    """
    try:
        with path.open("rb") as stream:
            start = stream.read(_MAX_HEADER_BYTES)
            end = start.find(b"end_header")
            line_end = start.find(b"\n", end)
            if not start.startswith(b"ply") or end < 0 or line_end < 0:
                raise ParseError(
                    path, "header", "not a PLY file, or its header has no end.", _AGAIN
                )
            count, kinds, encoding = _read_header(path, start[:end].decode(errors="replace"))
            layout = np.dtype(kinds)
            size_bytes = path.stat().st_size - (line_end + 1)
            smallest = layout.itemsize if encoding != "ascii" else 2 * len(kinds)
            # The last line of an ASCII file may lack its line end.
            if count * smallest > size_bytes + 1:
                raise ParseError(
                    path, "header", f"{count} points are announced but only {size_bytes} bytes "
                    "follow.", _AGAIN,
                )  # fmt: skip
            stream.seek(line_end + 1)
            if encoding == "ascii":
                rows = _read_ascii(path, stream.read(), count, layout)
            else:
                rows = np.frombuffer(stream.read(count * layout.itemsize), layout)
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read: {error.strerror}.", _AGAIN) from None
    points = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], 1)
    colors = np.full((len(points), 3), 128, np.uint8)
    if all(name in (layout.names or ()) for name in ("red", "green", "blue")):
        values = np.stack([rows[name] for name in ("red", "green", "blue")], 1)
        if values.dtype.kind == "f":
            values = np.nan_to_num(values) * 255.0
        colors = values.clip(0, 255).astype(np.uint8)
    good = np.isfinite(points).all(1)
    return points[good], colors[good]


def _read_header(path: Path, text: str) -> tuple[int, list[tuple[str, str]], str]:
    """Return vertex count, [(property, numpy type)], and ``ascii``, ``<`` or ``>``."""
    encoding, count, element = "", -1, ""
    kinds: list[tuple[str, str]] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        place = f"line {number}"
        if words[0] == "format" and len(words) >= 2:
            encoding = {
                "ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"
            }.get(words[1], "")  # fmt: skip
        elif words[0] == "element" and len(words) == 3:
            if not words[2].isdecimal() or len(words[2]) > 18:
                raise ParseError(path, place, "the count is not a number.", _AGAIN)
            if element == "" and words[1] != "vertex":
                raise ParseError(path, place, "vertices must come first.", _AGAIN)
            element = words[1]
            if element == "vertex":
                count = int(words[2])
        elif words[0] == "property" and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES or words[2] in dict(kinds):
                raise ParseError(path, place, f"property not understood: {line[:60]}.", _AGAIN)
            kinds.append((words[2], _TYPES[words[1]]))
    if not encoding or count < 0 or not {"x", "y", "z"} <= set(dict(kinds)):
        raise ParseError(path, "header", "format, vertices or x, y, z are missing.", _AGAIN)
    if count > limits.MAX_POINTS:
        raise ParseError(path, "header", f"{count} points are too many.", "Thin them out.")
    order = encoding if encoding in "<>" else "="
    return count, [(name, order + kind) for name, kind in kinds], encoding


def _read_ascii(path: Path, body: bytes, count: int, layout: np.dtype) -> np.ndarray:
    names = layout.names or ()
    words = body.split(maxsplit=count * len(names))[: count * len(names)]
    if len(words) < count * len(names):
        raise ParseError(path, "body", f"fewer than {count} points follow.", _AGAIN)
    try:
        table = np.array([float(word) for word in words]).reshape(count, len(names))
    except ValueError as error:
        raise ParseError(path, "body", f"{error}.", _AGAIN) from None
    # Colours may be written with a fraction; the declared type decides.
    rows = np.zeros(count, layout)
    for i, name in enumerate(names):
        column = table[:, i]
        rows[name] = column if layout[name].kind == "f" else np.nan_to_num(column).clip(-1e9, 1e9)
    return rows
