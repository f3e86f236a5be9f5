# SPDX-License-Identifier: GPL-3.0-or-later
"""Read the vertices of a PLY file as a table of numbers."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from .. import limits
from ..errors import ParseError
from ..regular_files import open_regular
from .header import LIST, PlyHeader


def vertex_layout(
    path: Path, header: PlyHeader, hint: str, most: int = limits.MAX_GAUSSIANS
) -> np.dtype:
    """Return the row layout of the vertices; parameters and errors as for :func:`read_vertices`."""
    if not header.elements or header.elements[0].name != "vertex":
        raise ParseError(path, "header", "the first element is not named vertex.", hint)
    vertex = header.elements[0]
    if vertex.count > most:
        raise ParseError(
            path, "header", f"{vertex.count} vertices; at most {most} are read.",
            hint,
        )  # fmt: skip
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

    Nothing is allocated before the file is known to be as long as its header declares.

    Parameters
    ----------
    path : Path
    header : PlyHeader
        Header of the file.
    hint : str
        Hint of every error.
    most : int
        Greatest number of vertices that is accepted.

    Returns
    -------
    (n,) structured array
        One field per property; for ASCII files all are float64.

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
