# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of photos where stereo finds nothing: sky, far distance, what other photos do not show."""

from __future__ import annotations

import numpy as np

from .depth_maps import DepthMap

CELL_PX = 8
"""Side of the cells of a photo, at the size it was matched at."""

OPEN_SHARE = 0.75
"""Share of a cell's pixels that must be unexplained for the cell to be open."""

BEHIND_COST = 0.7
"""Matching cost from which a pixel is unexplained: nothing matches."""


def open_cells(depth_map: DepthMap) -> np.ndarray:
    """Return the cells of a photo where nothing matches.

    Returns
    -------
    (h // CELL_PX, w // CELL_PX) bool
    """
    unknown = (depth_map.agreeing == 0) & (depth_map.cost >= BEHIND_COST)
    if depth_map.mask is not None:
        unknown &= depth_map.mask
    found: np.ndarray = by_cell(unknown.astype(np.float64)) >= OPEN_SHARE
    return found


def cells_of(points: np.ndarray, depth_map: DepthMap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points that whole cells of a photo show.

    Parameters
    ----------
    points : (n, 3) float64
        Scene frame.

    Returns
    -------
    indices : (m,) int64
    row, column : (m,) int64
        Their cells.
    """
    indices, row, column, _ = depth_map.camera.shown(points)
    row, column = row // CELL_PX, column // CELL_PX
    rows, columns = (side // CELL_PX for side in depth_map.depth.shape)
    whole = (row < rows) & (column < columns)
    return indices[whole], row[whole], column[whole]


def shown_open(points: np.ndarray, depth_map: DepthMap) -> np.ndarray:
    """Return the indices of the points (n, 3) that a photo shows in open cells."""
    indices, row, column = cells_of(points, depth_map)
    found: np.ndarray = indices[open_cells(depth_map)[row, column]]
    return found


def by_cell(image: np.ndarray) -> np.ndarray:
    """Return the means of an image over its cells, (rows, columns) or (rows, columns, 3)."""
    rows, columns = (side // CELL_PX for side in image.shape[:2])
    whole = image[: rows * CELL_PX, : columns * CELL_PX]
    means: np.ndarray = whole.reshape(rows, CELL_PX, columns, CELL_PX, *image.shape[2:]).mean(
        (1, 3)
    )
    return means
