# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper process in which xatlas packs charts; see :func:`~.charts.pack_charts` for the caller."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ...errors import DatasetError
from ...worker.helper_process import emit
from .packing_scale import chart_bounds, packing_scale, packing_square

GROWTH = 1.1
MAX_GROWTHS = 8
SHRINKING = (0.94, 0.9, 0.85, 0.8, 0.7, 0.6)
BISECTIONS = 4
"""The scale is found to 0.6 %."""
UNASSIGNED = 2**32 - 1

_Packed = tuple[np.ndarray, np.ndarray]


def main(folder: Path) -> None:
    """Pack ``input.npz`` into ``output.npz``.

    Input: ``points (n, 2) float32``, ``corners (f, 3) uint32``, ``charts (f,) uint32``,
    ``size_px``, ``gutter_px``, ``atlases`` (maximum number of squares). Output: ``points (n, 2)
    float32`` in 0 to 1 (y downwards), NaN for those of faces that xatlas ignored; ``atlas (n,)
    int32`` the square of each, from 0; the ``gutter_px`` kept.

    Raises
    ------
    DatasetError
        xatlas could not pack the charts.
    """
    with np.load(folder / "input.npz", allow_pickle=False) as arrays:
        task = {name: arrays[name] for name in arrays.files}
    size_px = int(task["size_px"])
    side_px, padding_px = packing_square(size_px, float(task["gutter_px"]))
    while (packed := _largest(task, side_px, padding_px)) is None:
        if padding_px == 0:
            raise DatasetError("xatlas could not pack the charts.")
        padding_px //= 2
    points, atlas = packed
    np.savez(
        folder / "output.npz", points=points, atlas=atlas, gutter_px=padding_px * size_px / side_px
    )
    emit(fraction=1.0, message="xatlas: packed")


def _largest(task: dict[str, np.ndarray], side_px: int, padding_px: int) -> _Packed | None:
    """Pack at the largest scale that fits into the squares; ``None`` if none was found."""
    low, high = chart_bounds(task["points"][task["corners"]], task["charts"])
    scale = packing_scale(high - low, side_px, padding_px, int(task["atlases"]))
    packed = _pack(task, scale, side_px, padding_px)
    too_large = 0.0
    for factor in SHRINKING if packed is None else ():
        emit(fraction=0.2, message="xatlas: packing")
        too_large, scale = scale, scale * factor
        packed = _pack(task, scale, side_px, padding_px)
        if packed is not None:
            break
    if packed is None:
        return None
    for _ in range(MAX_GROWTHS if too_large == 0.0 else 0):
        emit(fraction=0.4, message="xatlas: packing")
        larger = _pack(task, scale * GROWTH, side_px, padding_px)
        if larger is None:
            too_large = scale * GROWTH
            break
        packed, scale = larger, scale * GROWTH
    for step in range(BISECTIONS if too_large > 0.0 else 0):
        emit(fraction=0.6 + 0.1 * step, message="xatlas: packing")
        middle = math.sqrt(scale * too_large)
        larger = _pack(task, middle, side_px, padding_px)
        if larger is None:
            too_large = middle
        else:
            packed, scale = larger, middle
    return packed


def _pack(
    task: dict[str, np.ndarray], scale: float, side_px: int, padding_px: int
) -> _Packed | None:
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(task["points"], task["corners"], task["charts"][:, None])
    packing = xatlas.PackOptions()
    packing.resolution = side_px
    packing.texels_per_unit = scale
    packing.padding = padding_px
    packing.bilinear = True
    # xatlas rotates charts by exchanging x and y, which mirrors them: text would be reversed.
    # Over seven test meshes, rotating saved no space on average (individually -4 to +6 %).
    packing.rotate_charts = False
    atlas.generate(xatlas.ChartOptions(), packing)
    if not 1 <= atlas.atlas_count <= int(task["atlases"]):
        return None
    if atlas.width != side_px or atlas.height != side_px:
        return None
    source, _, uvs = atlas.get_mesh(0)
    squares, charts = (np.asarray(a) for a in atlas.get_mesh_vertex_assignment(0)[:2])
    assigned = charts != UNASSIGNED
    source = np.asarray(source)[assigned]
    number = np.zeros(len(task["points"]), np.int32)
    number[source] = squares[assigned]
    points = np.full((len(task["points"]), 2), np.nan, np.float32)
    points[source] = np.asarray(uvs, np.float32)[assigned]
    # xatlas shrinks charts larger than the square, but all must keep the same density.
    texels = points[task["corners"]].astype(np.float64) * side_px
    before = task["points"][task["corners"]].astype(np.float64)
    return (points, number) if _smallest_scale(before, texels) > 0.98 * scale else None


def _smallest_scale(before: np.ndarray, after: np.ndarray) -> float:
    length = np.linalg.norm(before - np.roll(before, -1, axis=1), axis=2)
    now = np.linalg.norm(after - np.roll(after, -1, axis=1), axis=2)
    good = np.isfinite(now) & (length > 0.1 * np.median(length))
    return float((now[good] / length[good]).min()) if good.any() else 0.0
