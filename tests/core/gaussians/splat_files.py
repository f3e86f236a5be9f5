# SPDX-License-Identifier: GPL-3.0-or-later
"""Splat PLYs as other programs write them: any order, type, byte order, extra properties."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians

_WORDS = {"u1": "uchar", "i4": "int", "f4": "float", "f8": "double"}
_FORMATS = {"<": "binary_little_endian", ">": "binary_big_endian", "ascii": "ascii"}

Columns = dict[str, np.ndarray]


def splat_columns(gaussians: OrientedGaussians, *, normals: bool = True) -> Columns:
    """Return the columns of Inria's convention, written out independently of the package."""
    values = {name: tensor.numpy() for name, tensor in gaussians.tensors()}
    count, coefficients = values["sh"].shape[:2]
    columns = {axis: values["means"][:, i] for i, axis in enumerate("xyz")}
    if normals:
        columns.update({f"n{axis}": np.zeros(count) for axis in "xyz"})
    columns.update({f"f_dc_{c}": values["sh"][:, 0, c] for c in range(3)})
    index = 0
    for channel in range(3):
        for k in range(1, coefficients):
            columns[f"f_rest_{index}"] = values["sh"][:, k, channel]
            index += 1
    columns["opacity"] = values["opacity_logits"]
    columns.update({f"scale_{i}": values["log_scales"][:, i] for i in range(3)})
    columns.update({f"rot_{i}": values["quats"][:, i] for i in range(4)})
    return columns


def write_ply(
    path: Path,
    columns: Columns,
    *,
    encoding: str = "<",
    kinds: dict[str, str] | None = None,
    order: list[str] | None = None,
    after: tuple[str, bytes] = ("", b""),
) -> Path:
    """Write columns as the vertices of a PLY.

    ``kinds`` gives the numpy type of a column (``f4`` by default), ``after`` the header lines and
    the bytes of elements behind the vertices.
    """
    kinds = kinds or {}
    names = order or list(columns)
    count = len(next(iter(columns.values())))
    head = ["ply", f"format {_FORMATS[encoding]} 1.0", "comment by another program"]
    head += [f"element vertex {count}"]
    head += [f"property {_WORDS[kinds.get(name, 'f4')]} {name}" for name in names]
    head += [after[0]] if after[0] else []
    swap = "=" if encoding == "ascii" else encoding
    rows = np.zeros(count, [(name, swap + kinds.get(name, "f4")) for name in names])
    for name in names:
        rows[name] = columns[name]
    if encoding == "ascii":
        body = "".join(" ".join(repr(v) for v in row.tolist()) + "\n" for row in rows).encode()
    else:
        body = rows.tobytes()
    path.write_bytes(("\n".join(head) + "\nend_header\n").encode() + body + after[1])
    return path


def permuted(columns: Columns, seed: int = 0) -> list[str]:
    """Return the names of columns in another order."""
    names = list(columns)
    return [names[i] for i in np.random.default_rng(seed).permutation(len(names)).tolist()]
