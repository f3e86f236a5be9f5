# SPDX-License-Identifier: GPL-3.0-or-later
"""PLY files: headers and vertex tables, read with bounds."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import limits
from .errors import ParseError
from .files import open_regular

# -- Parse PLY headers of bounded size; the only such parser in the package -----------------------


MAX_HEADER_BYTES = 64 * 1024

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip

_ENCODINGS = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}

LIST = "list"  # Type of a list property; only elements after the vertices may have one.


@dataclass(frozen=True)
class PlyElement:
    """One element of a header."""

    name: str
    count: int
    properties: tuple[tuple[str, str], ...]
    """(name, numpy type without byte order, or ``"list"``) of each property."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the properties, in the file's order."""
        return tuple(name for name, _ in self.properties)


@dataclass(frozen=True)
class PlyHeader:
    """A parsed header."""

    encoding: str  # ``"ascii"``, or the byte order ``"<"`` or ``">"``
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    begin: int  # offset of the body in bytes

    def count(self, element: str) -> int:
        """Return the declared count of an element, 0 if it is not declared."""
        return next((found.count for found in self.elements if found.name == element), 0)


def read_ply_header(path: Path, hint: str) -> PlyHeader:
    """Read a header of at most :data:`MAX_HEADER_BYTES`; every error has the hint.

    Raises
    ------
    ParseError
        The file is no PLY, or a header line is invalid; names the line.
    """
    try:
        with open_regular(path, follow_links=True) as stream:
            head = stream.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read: {error.strerror}.", hint) from None
    if not re.match(rb"ply[ \t]*\r?\n", head):
        raise ParseError(path, "byte 0", "not a PLY file.", hint)
    end = re.search(rb"\nend_header[ \t]*\r?\n", head)
    if end is None:
        raise ParseError(path, "header", f"does not end within {MAX_HEADER_BYTES} bytes.", hint)
    encoding = ""
    comments: list[str] = []
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for number, raw in enumerate(head[: end.start()].splitlines()[1:], start=2):
        words = raw.decode("ascii", "replace").split()
        location = f"line {number}"
        if not words or words[0] == "obj_info":
            continue
        if words[0] == "comment":
            comments.append(" ".join(words[1:]))
        elif words[0] == "format":
            if len(words) < 2 or words[1] not in _ENCODINGS:
                raise ParseError(path, location, f"format {' '.join(words[1:])!r}.", hint)
            encoding = _ENCODINGS[words[1]]
        elif words[0] == "element":
            if len(words) != 3 or not re.fullmatch(r"\d{1,18}", words[2]):
                raise ParseError(path, location, "an element without a count.", hint)
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property":
            if not elements:
                raise ParseError(path, location, "a property before any element.", hint)
            elements[-1][2].append(_property(path, location, words, elements[-1][2], hint))
        else:
            raise ParseError(path, location, f"unknown header line {words[0][:40]!r}.", hint)
    if not encoding:
        raise ParseError(path, "header", "the format line is missing.", hint)
    found = tuple(PlyElement(name, count, tuple(kinds)) for name, count, kinds in elements)
    return PlyHeader(encoding, found, tuple(comments), end.end())


def _property(
    path: Path, location: str, words: list[str], before: list[tuple[str, str]], hint: str
) -> tuple[str, str]:
    """Return (name, type) of a property line."""
    is_list = len(words) == 5 and words[1] == "list"
    if is_list and words[2] in _TYPES and words[3] in _TYPES:
        name, kind = words[4], LIST
    elif len(words) == 3 and words[1] in _TYPES:
        name, kind = words[2], _TYPES[words[1]]
    else:
        raise ParseError(path, location, f"property {' '.join(words[1:])[:60]!r}.", hint)
    if name in dict(before):
        raise ParseError(path, location, f"property {name} comes twice.", hint)
    return name, kind


# -- Read the vertices of a PLY file as a table of numbers ----------------------------------------


def vertex_layout(
    path: Path, header: PlyHeader, hint: str, most: int = limits.MAX_GAUSSIANS
) -> np.dtype:
    """Return the row layout of the vertices; parameters and errors as for :func:`read_vertices`."""
    if not header.elements or header.elements[0].name != "vertex":
        raise ParseError(path, "header", "the first element is not named vertex.", hint)
    vertex = header.elements[0]
    if vertex.count > most:
        problem = f"{vertex.count} vertices; at most {most} are read."
        raise ParseError(path, "header", problem, hint)
    if not vertex.properties:
        raise ParseError(path, "header", "vertices without properties.", hint)
    if any(kind == LIST for _, kind in vertex.properties):
        raise ParseError(path, "header", "vertices with a list property.", hint)
    text = header.encoding == "ascii"
    order = "=" if text else header.encoding
    layout = np.dtype([(n, order + ("f8" if text else kind)) for n, kind in vertex.properties])
    # A number and its separator take two bytes; the last line may lack a newline.
    smallest = vertex.count * (2 * len(vertex.properties) if text else layout.itemsize)
    need_bytes = header.begin + smallest - text
    size_bytes = path.stat().st_size
    if size_bytes < need_bytes:
        raise ParseError(
            path, f"byte {size_bytes}", f"cut off: the header declares {need_bytes} bytes.", hint
        )
    return layout


def read_vertices(
    path: Path, header: PlyHeader, hint: str, most: int = limits.MAX_GAUSSIANS
) -> np.ndarray:
    """Read the vertices, the first element of a file.

    Nothing is allocated before the file is known to be as long as its header declares. Up to
    ``most`` vertices are accepted; every error has the hint. Returns an (n,) structured array with
    one field per property; for ASCII files all are float64.

    Raises
    ------
    ParseError
        The vertices do not come first, are too many or have lists, or the body is truncated.
    """
    layout = vertex_layout(path, header, hint, most)
    vertex, text = header.elements[0], header.encoding == "ascii"
    with open_regular(path, follow_links=True) as stream:
        stream.seek(header.begin)
        if not text:
            return np.fromfile(stream, layout, vertex.count)
        if vertex.count == 0:
            return np.zeros(0, layout)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of empty lines, which do not count
                table = np.loadtxt(stream, ndmin=2, comments=None, max_rows=vertex.count)  # (n, p)
        except ValueError as error:
            raise ParseError(path, "body", f"{error}.", hint) from None
    if table.shape != (vertex.count, len(vertex.properties)):
        raise ParseError(
            path, "body", f"{table.shape[0]} lines of {table.shape[1]} numbers; the header "
            f"declares {vertex.count} of {len(vertex.properties)}.", hint,
        )  # fmt: skip
    rows = np.empty(vertex.count, layout)
    for column, name in enumerate(vertex.names):
        rows[name] = table[:, column]
    return rows
