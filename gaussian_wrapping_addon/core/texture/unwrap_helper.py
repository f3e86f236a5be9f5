# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper process that runs xatlas on chunks of a mesh; see :mod:`.unwrap` for the caller."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError
from ..helper_process import emit

PADDING_RESERVE = 1.25
"""Charts are packed with this much more padding, since the atlas is scaled to its final size."""
MAX_PACKINGS = 4
MAX_PACKING_PX = 1024
UNASSIGNED = 2**32 - 1


def main(folder: Path) -> None:
    """Unwrap ``input.npz`` into ``output.npz``.

    Input: ``vertices (v, 3) float32`` and ``corners (f, 3) uint32`` local to each chunk,
    ``vertex_bounds`` and ``face_bounds`` of the chunks, ``size_px``, ``gutter_px``. Output:
    ``corner_uvs (f, 3, 2) float32`` in texels of a square (y downwards), NaN for faces that
    xatlas ignored, ``side_px`` of the packed square, ``padding_px``, ``charts``.

    Raises
    ------
    DatasetError
        xatlas made no atlas, or several.
    """
    with np.load(folder / "input.npz", allow_pickle=False) as arrays:
        task = {name: arrays[name] for name in arrays.files}
    # Packing costs by the texel: it is done on a smaller square, with gutters in proportion.
    size_px = min(int(task["size_px"]), MAX_PACKING_PX)
    gutter_px = float(task["gutter_px"]) * size_px / float(task["size_px"])
    padding_px = math.ceil(gutter_px * PADDING_RESERVE)
    resolution_px = max(16, round(0.78 * size_px))
    best: tuple[float, Any, int] | None = None
    for attempt in range(MAX_PACKINGS):
        emit(fraction=attempt / MAX_PACKINGS, message="xatlas: charts and packing")
        atlas = _generate(task, padding_px, resolution_px)
        side_px = max(int(atlas.width), int(atlas.height))
        gutter_left_px = padding_px * size_px / max(side_px, 1)
        if best is None or gutter_left_px > best[0]:
            best = (gutter_left_px, atlas, padding_px)
        if gutter_left_px >= gutter_px:
            break
        # The square grew beyond the texture: ask for charts so much smaller, gutters kept.
        resolution_px = max(16, int(resolution_px * 0.95 * size_px / side_px))
        padding_px += 1
    assert best is not None
    _write(folder, task, best[1], best[2])
    emit(fraction=1.0, message="xatlas: done")


def _generate(task: dict[str, np.ndarray], padding_px: int, resolution_px: int) -> Any:
    import xatlas

    atlas = xatlas.Atlas()
    bounds = zip(_pairs(task["vertex_bounds"]), _pairs(task["face_bounds"]), strict=True)
    for (v0, v1), (f0, f1) in bounds:
        atlas.add_mesh(task["vertices"][v0:v1], task["corners"][f0:f1])
    packing = xatlas.PackOptions()
    packing.resolution = resolution_px
    packing.padding = padding_px
    packing.bilinear = True
    packing.rotate_charts = True
    atlas.generate(xatlas.ChartOptions(), packing)
    if atlas.atlas_count != 1 or atlas.width < 1 or atlas.height < 1:
        raise DatasetError(
            f"xatlas made {atlas.atlas_count} atlases of {atlas.width} x {atlas.height} texels.",
            "The fallback unwrap is used instead.",
        )
    return atlas


def _write(folder: Path, task: dict[str, np.ndarray], atlas: Any, padding_px: int) -> None:
    corner_uvs = np.full((len(task["corners"]), 3, 2), np.nan, np.float32)
    for index, (begin, end) in enumerate(_pairs(task["face_bounds"])):
        _, corners, uvs = atlas.get_mesh(index)
        assigned = np.asarray(atlas.get_mesh_vertex_assignment(index)[1]) != UNASSIGNED
        # Back to texels: the two sides of the atlas may differ, its texels are square.
        texels = np.asarray(uvs, np.float64) * [atlas.width, atlas.height]
        texels[~assigned] = np.nan
        corner_uvs[begin:end] = texels[np.asarray(corners).reshape(-1, 3)]
    np.savez(
        folder / "output.npz",
        corner_uvs=corner_uvs,
        side_px=max(atlas.width, atlas.height),
        padding_px=padding_px,
        charts=atlas.chart_count,
    )


def _pairs(bounds: np.ndarray) -> list[tuple[int, int]]:
    return list(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True))
