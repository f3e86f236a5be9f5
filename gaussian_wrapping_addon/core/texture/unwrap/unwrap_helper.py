# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper process in which xatlas finds the charts of a mesh; see :mod:`.charts` for the caller."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DatasetError
from ...worker.helper_process import emit

ROUGH_SIDE_PX = 512
"""Charts are packed again later; here they only must not overlap."""
UNASSIGNED = 2**32 - 1


def main(folder: Path) -> None:
    """Unwrap ``input.npz`` into ``output.npz``.

    Input: ``vertices (v, 3) float32`` and ``corners (f, 3) uint32`` local to each chunk,
    ``vertex_bounds`` and ``face_bounds`` of the chunks. Output: ``corner_uvs (f, 3, 2) float32``
    of charts side by side in the plane, NaN for faces that xatlas ignored.

    Raises
    ------
    DatasetError
        xatlas made no atlas, or several.
    """
    with np.load(folder / "input.npz", allow_pickle=False) as arrays:
        task = {name: arrays[name] for name in arrays.files}
    emit(fraction=0.0, message="xatlas: finding charts")
    atlas = _generate(task)
    corner_uvs = np.full((len(task["corners"]), 3, 2), np.nan, np.float32)
    for index, (begin, end) in enumerate(pairwise(task["face_bounds"].tolist())):
        _, corners, uvs = atlas.get_mesh(index)
        assigned = np.asarray(atlas.get_mesh_vertex_assignment(index)[1]) != UNASSIGNED
        # Back to texels: the sides of the atlas may differ, but its texels are square.
        texels = np.asarray(uvs, np.float64) * [atlas.width, atlas.height]
        texels[~assigned] = np.nan
        corner_uvs[begin:end] = texels[np.asarray(corners).reshape(-1, 3)]
    np.savez(folder / "output.npz", corner_uvs=corner_uvs)
    emit(fraction=1.0, message="xatlas: charts found")


def _generate(task: dict[str, np.ndarray]) -> Any:
    import xatlas

    atlas = xatlas.Atlas()
    bounds = (pairwise(task[name].tolist()) for name in ("vertex_bounds", "face_bounds"))
    for (v0, v1), (f0, f1) in zip(*bounds, strict=True):
        atlas.add_mesh(task["vertices"][v0:v1], task["corners"][f0:f1])
    packing = xatlas.PackOptions()
    packing.resolution = ROUGH_SIDE_PX
    packing.blockAlign = True
    packing.rotate_charts = False
    atlas.generate(xatlas.ChartOptions(), packing)
    if atlas.atlas_count != 1 or atlas.width < 1 or atlas.height < 1:
        raise DatasetError(
            f"xatlas made {atlas.atlas_count} atlases of {atlas.width} x {atlas.height} texels.",
            "The fallback unwrap is used instead.",
        )
    return atlas
