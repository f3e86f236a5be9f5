# SPDX-License-Identifier: GPL-3.0-or-later
"""Fallback unwrap: box projection along the axes, charts packed in shelves."""

from __future__ import annotations

import numpy as np

from ...mesh.face_graph import FaceGraph, components
from ...mesh.surface_mesh import SurfaceMesh
from ...progress import Progress
from .chart_boxes import split_wide_charts
from .chart_overlaps import split_overlaps

SMOOTHING_ROUNDS = 8
NEIGHBOUR_VOTE = 0.4
MIN_COSINE = 0.15
"""A face may be projected along an axis up to 81 degrees from its normal."""
SCALE_STEPS = 24

_AXES = np.repeat(np.eye(3), 2, axis=0) * np.array([[1.0], [-1.0]] * 3)
# For each signed axis, the two axes of a projection that is counter-clockwise from outside.
_PLANES = ((1, 2), (2, 1), (2, 0), (0, 2), (0, 1), (1, 0))


def box_unwrap(
    mesh: SurfaceMesh,
    graph: FaceGraph,
    size_px: int,
    gutter_px: int,
    progress: Progress,
    atlases: int = 1,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Unwrap by projection along the six axis directions.

    Returns
    -------
    corner_uvs : (f, 3, 2) float32
        UVs in [0, 1], v upwards; charts with overlaps are split.
    face_atlas : (f,) uint8
        Atlas of each face, below ``atlases``.
    gutter_px : float
        Texels kept between charts; fewer than requested if there is no room.
    """
    axis = _axis_of_faces(graph)
    corners = mesh.vertices[mesh.faces]
    plane = np.array(_PLANES)[axis]  # (f, 2)
    flat = np.take_along_axis(corners, plane[:, None, :], axis=2)  # (f, 3, 2)
    progress.update(0.2, "box projection")
    other = np.where(graph.opposite >= 0, graph.opposite // 3, 0)
    charts = components(graph, axis[other] == axis[:, None])
    charts = split_overlaps(flat - corners.mean(axis=(0, 1))[plane][:, None, :], charts, graph)
    progress.update(0.6, "box projection: packing")
    if atlases > 1:
        charts = split_wide_charts(flat, charts, atlases)
    return _pack(flat, charts, size_px, gutter_px, atlases)


def _axis_of_faces(graph: FaceGraph) -> np.ndarray:
    """Choose a direction for each face, smoothed so that noise does not fragment charts."""
    cosines = graph.normals @ _AXES.T  # (f, 6)
    axis = cosines.argmax(axis=1)
    rows = np.arange(len(axis))
    for _ in range(SMOOTHING_ROUNDS):
        votes = np.zeros_like(cosines)
        for corner in range(3):
            has = graph.opposite[:, corner] >= 0
            votes[rows[has], axis[graph.opposite[has, corner] // 3]] += NEIGHBOUR_VOTE
        allowed = (cosines > MIN_COSINE) | (rows[:, None] < 0)
        allowed[rows, cosines.argmax(axis=1)] = True
        chosen = np.where(allowed, cosines + votes, -np.inf).argmax(axis=1)
        if (chosen == axis).all():
            break
        axis = chosen
    return axis


def _pack(
    flat: np.ndarray, charts: np.ndarray, size_px: int, gutter_px: int, atlases: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Pack charts in shelves at the largest scale that fits; reduce the gutters if none does."""
    count = int(charts.max()) + 1
    low = np.full((count, 2), np.inf)
    high = np.full((count, 2), -np.inf)
    for corner in range(3):
        np.minimum.at(low, charts, flat[:, corner])
        np.maximum.at(high, charts, flat[:, corner])
    extent = high - low
    turned = extent[:, 1] > extent[:, 0]  # wide charts make lower shelves
    lying = np.where(turned[:, None], extent[:, ::-1], extent)
    gutter = float(gutter_px)
    while True:
        scale, positions = _largest_scale(lying, size_px, gutter, atlases)
        if positions is not None or gutter < 0.01:
            break
        gutter *= 0.7
    assert positions is not None
    local = (flat - low[charts][:, None, :]) * scale  # (f, 3, 2)
    width = extent[charts, 0][:, None] * scale
    # A rotation by 90 degrees keeps the orientation: (x, y) -> (y, width - x).
    quarter = np.stack([local[..., 1], width - local[..., 0]], axis=-1)
    local = np.where(turned[charts][:, None, None], quarter, local)
    corner_uvs = (local + positions[charts][:, None, :2]) / size_px
    face_atlas = positions[charts, 2].astype(np.uint8)
    return np.clip(corner_uvs, 0.0, 1.0).astype(np.float32), face_atlas, gutter


def _largest_scale(
    extent: np.ndarray, size_px: int, gutter: float, atlases: int
) -> tuple[float, np.ndarray | None]:
    high = size_px / max(float(extent.max()), 1e-300)
    low = 0.0
    positions = _shelves(extent * high, size_px, gutter, atlases)
    if positions is not None:
        return high, positions
    best: np.ndarray | None = None
    # Below a hundredth of the largest scale, charts would have no texels.
    low = 0.01 * high
    best = _shelves(extent * low, size_px, gutter, atlases)
    if best is None and gutter >= 0.01:
        return low, None
    if best is None:
        low = 0.0
        best = np.zeros((len(extent), 3))
    for _ in range(SCALE_STEPS):
        middle = 0.5 * (low + high)
        positions = _shelves(extent * middle, size_px, gutter, atlases)
        if positions is None:
            high = middle
        else:
            low, best = middle, positions
    return low, best


def _shelves(extent_px: np.ndarray, size_px: int, gutter: float, atlases: int) -> np.ndarray | None:
    """Return x, y of the lower left corner of each box and its atlas; ``None`` without room."""
    if float(((extent_px + gutter) ** 2).min()) < 0:
        return None
    if float(np.prod(extent_px + gutter, axis=1).sum()) > atlases * float(size_px) ** 2:
        return None
    order = np.argsort(-extent_px[:, 1], kind="stable")
    positions = np.empty((len(extent_px), 3))
    atlas = 0
    x, y, shelf = 0.5 * gutter, 0.5 * gutter, 0.0
    for index in order.tolist():
        width, height = extent_px[index]
        if x + width + 0.5 * gutter > size_px and x > 0.5 * gutter:
            x, y = 0.5 * gutter, y + shelf + gutter
            shelf = 0.0
        if y + height + 0.5 * gutter > size_px and y > 0.5 * gutter and atlas + 1 < atlases:
            atlas += 1
            x, y, shelf = 0.5 * gutter, 0.5 * gutter, 0.0
        if x + width + 0.5 * gutter > size_px or y + height + 0.5 * gutter > size_px:
            return None
        positions[index] = x, y, atlas
        x += width + gutter
        shelf = max(shelf, height)
    return positions
