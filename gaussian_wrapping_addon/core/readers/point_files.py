# SPDX-License-Identifier: GPL-3.0-or-later
"""Point clouds, and headers of splats."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import limits
from ..errors import DatasetError, ParseError
from ..ply import PlyHeader, read_ply_header, read_vertices

# -- Bounded reader of a point cloud in PLY format (the ``ply_file_path`` of transforms.json) -----

_AGAIN = "Export the points again as PLY with x, y, z."


def read_point_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions and colours of a PLY's vertices (ASCII or binary).

    Returns ``points``: (n, 3) float64; ``colors``: (n, 3) uint8, grey where the file has none.
    Raises ParseError with the place in the file.
    """
    header = read_ply_header(path, _AGAIN)
    rows = read_vertices(path, header, _AGAIN, limits.MAX_POINTS)
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise ParseError(path, "header", "x, y, z are missing.", _AGAIN)
    if header.encoding == "ascii":
        rows = _as_declared(header, rows)
    points = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], 1)
    colors = np.full((len(points), 3), 128, np.uint8)
    if all(name in names for name in ("red", "green", "blue")):
        values = np.stack([rows[name] for name in ("red", "green", "blue")], 1)
        if values.dtype.kind == "f":
            values = np.nan_to_num(values) * 255.0
        colors = values.clip(0, 255).astype(np.uint8)
    good = np.isfinite(points).all(1)
    return points[good], colors[good]


def _as_declared(header: PlyHeader, table: np.ndarray) -> np.ndarray:
    """Return the rows of an ASCII file in the types of its header.

    Colours may be written with a fraction; the declared type decides.
    """
    rows = np.zeros(len(table), np.dtype(list(header.elements[0].properties)))
    for name in rows.dtype.names or ():
        column = table[name]
        whole = rows.dtype[name].kind != "f"
        rows[name] = np.nan_to_num(column).clip(-1e9, 1e9) if whole else column
    return rows


# -- Tell from its header whether a file is a 3D Gaussian splat, and of which known variant -------

MAX_FILE_DEGREE = 4
"""Highest degree of the harmonics that files are known to have."""

EXPECTED = (
    "A 3D Gaussian splat has x, y, z, f_dc_0..2 (or red, green, blue), opacity, scale_0..2 and "
    "rot_0..3, as Inria's code, gsplat, nerfstudio and SuperSplat (uncompressed) write them."
)

_NEEDED = ("x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3")
_UNPACK = "Open it in a splat editor, such as SuperSplat, and export it as an uncompressed PLY."

OTHER_FORMATS = {".spz": "SPZ", ".splat": "antimatter15 .splat", ".ksplat": "KSPLAT", ".sog": "SOG"}
"""Splats in formats that are not read, by suffix."""


@dataclass(frozen=True)
class SplatHeader:
    """A splat file as its header describes it."""

    ply: PlyHeader
    degree: int
    """Of the harmonics, 0 to 4."""
    axes: int
    """3, or 2 for surfels (2D Gaussian splatting)."""
    colors: tuple[str, ...]
    """Names of the three columns of constant colour: ``f_dc_*``, or ``red green blue``."""

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return self.ply.elements[0].count

    @property
    def names(self) -> frozenset[str]:
        """All properties of a Gaussian."""
        return frozenset(self.ply.elements[0].names)


def is_splat_path(path: Path) -> bool:
    """Tell by its suffix whether a file may be a splat; raise for unsupported splat formats.

    Raises DatasetError: a splat in a compressed or other format.
    """
    suffix = path.suffix.lower()
    if suffix in OTHER_FORMATS:
        text = f"{path.name} is a splat in {OTHER_FORMATS[suffix]} format, which is not supported."
        raise DatasetError(text, _UNPACK)
    return suffix == ".ply"


def read_splat_header(path: Path) -> SplatHeader:
    """Read the header of a splat PLY, with its properties in any order and others beside them.

    Raises ParseError: the file is not a splat (names the missing property), or a compressed
    variant; DatasetError: the suffix is that of another splat format, or there are no Gaussians.
    """
    is_splat_path(path)
    ply = read_ply_header(path, EXPECTED)
    elements = {element.name: element for element in ply.elements}
    if "chunk" in elements or any("packed" in n for e in ply.elements for n in e.names):
        raise ParseError(path, "header", "a compressed splat PLY is not supported.", _UNPACK)
    if "vertex" not in elements:
        raise ParseError(path, "header", "the element vertex is missing.", EXPECTED)
    if ply.elements[0].name != "vertex":
        raise ParseError(path, "header", "the vertices do not come first.", EXPECTED)
    names = set(elements["vertex"].names)
    plain = "f_dc_0" not in names and {"red", "green", "blue"} <= names
    colors = ("red", "green", "blue") if plain else ("f_dc_0", "f_dc_1", "f_dc_2")
    missing = [name for name in (*_NEEDED, *colors) if name not in names]
    if missing:
        is_cloud = {"x", "y", "z"} <= names
        what = "a mesh" if "face" in elements else "a point cloud" if is_cloud else "another PLY"
        raise ParseError(
            path, "header", f"not a splat but {what}: property "
            f"{', '.join(missing[:3])} is missing.", EXPECTED,
        )  # fmt: skip
    header = SplatHeader(ply, _degree(path, names), 3 if "scale_2" in names else 2, colors)
    if header.count == 0:
        raise DatasetError(f"{path.name} holds no Gaussians.", "Export the splat again.")
    return header


def _degree(path: Path, names: set[str]) -> int:
    rest = {name for name in names if re.fullmatch(r"f_rest_\d+", name)}
    for degree in range(MAX_FILE_DEGREE + 1):
        count = 3 * ((degree + 1) ** 2 - 1)
        if len(rest) == count and rest == {f"f_rest_{i}" for i in range(count)}:
            return degree
    raise ParseError(
        path, "header", f"{len(rest)} f_rest properties fit no degree from 0 to "
        f"{MAX_FILE_DEGREE} (0, 9, 24, 45 or 72 of them, numbered from 0).",
        "Export the splat again.",
    )  # fmt: skip
