# SPDX-License-Identifier: GPL-3.0-or-later
"""Shapes of charts: a smooth copy of a mesh to find them on, and their fit to the true mesh."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from ...mesh.topology import area_vectors, half_edges
from .chart_overlaps import find_overlaps, signed_areas

SMOOTHING_STEPS = 2
"""More bring more charts again (the copy shrinks into folds), one leaves noise of 0.3 edges."""
MAX_MOVE_SHARE = 0.5
"""Of the mean length of a vertex's edges."""
MIN_AREA_SHARE = 0.03
"""A face left with less of its area was crushed; xatlas hung on a wire of three faces around."""
RELAXATIONS = 6
"""After six rounds the stretch of charts moves by less than 0.1 %."""
MAX_ROUNDS_BACK = 30
"""A point put back may spoil its neighbours, so all are looked at again."""
MIN_HEIGHT_SHARE = 0.02
"""Needles are given this height by their longest edge, so that their weights stay bounded."""
ANCHOR_WEIGHT = 1e-6
"""Weight that keeps a chart in its place, by the mean weight of a vertex."""


def smooth_vertices(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Move vertices toward the mean of their neighbours, by half an edge at most.

    xatlas splits charts wherever faces are noisy or badly shaped; on the copy both are milder.

    Returns
    -------
    (v, 3) float64
    """
    start = np.asarray(vertices, np.float64)
    centre = start[faces].mean(axis=(0, 1))
    start = start - centre
    begin, end = half_edges(faces)
    rows, columns = np.concatenate([begin, end]), np.concatenate([end, begin])
    count = len(start)
    degree = np.maximum(np.bincount(rows, minlength=count), 1)
    length = np.linalg.norm(start[rows] - start[columns], axis=1)
    limit = MAX_MOVE_SHARE * np.bincount(rows, length, count) / degree
    adjacency = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    isolated = np.bincount(rows, minlength=count) == 0
    points = start.copy()
    for _ in range(SMOOTHING_STEPS):
        move = (adjacency @ points) / degree[:, None] - start
        move[isolated] = 0.0
        far = np.linalg.norm(move, axis=1)
        points = start + move * np.minimum(1.0, limit / np.maximum(far, 1e-300))[:, None]
    return np.asarray(_restore_crushed_faces(points, start, faces) + centre)


def _restore_crushed_faces(points: np.ndarray, start: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Put points back to their start where a face lost most of its area: wires keep their tubes."""
    before = np.linalg.norm(area_vectors(start, faces), axis=1)
    points = points.copy()
    while True:
        crushed = np.linalg.norm(area_vectors(points, faces), axis=1) < MIN_AREA_SHARE * before
        back = np.unique(faces[crushed])
        back = back[(points[back] != start[back]).any(axis=1)]
        if len(back) == 0:
            return points
        points[back] = start[back]


def chart_points(corner_uvs: np.ndarray, charts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the different points of each chart.

    Parameters
    ----------
    corner_uvs : (f, 3, 2) float32
    charts : (f,) int

    Returns
    -------
    corners : (f, 3) int64
        Index of a point for each corner; charts share none.
    first : (n,) int64
        A corner ``3 * face + k`` at each point.
    """
    bits = np.ascontiguousarray(corner_uvs, np.float32).reshape(-1, 2) + np.float32(0.0)
    bits = bits.view(np.uint32).astype(np.int64)  # (3 f, 2); + 0.0 makes one zero of two
    order = np.lexsort((bits[:, 1], bits[:, 0], np.repeat(charts, 3)))
    keys = np.column_stack([np.repeat(charts, 3), bits])[order]
    fresh = np.concatenate([[True], (keys[1:] != keys[:-1]).any(axis=1)])
    corners = np.empty(len(order), np.int64)
    corners[order] = np.cumsum(fresh) - 1
    return corners.reshape(-1, 3), order[fresh]


def equalise_density(corner_uvs: np.ndarray, charts: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Scale each chart so that its area is that of its faces, and put its corner at the origin.

    Parameters
    ----------
    shapes : (f, 3, 2) float64
        True shape of each face, see :func:`flatten_faces`.
    """
    count = int(charts.max()) + 1
    uvs = np.asarray(corner_uvs, np.float64)
    low = np.full((count, 2), np.inf)
    high = np.full((count, 2), -np.inf)
    for corner in range(3):
        np.minimum.at(low, charts, uvs[:, corner])
        np.maximum.at(high, charts, uvs[:, corner])
    true = np.bincount(charts, np.abs(signed_areas(shapes)), count)
    flat = np.bincount(charts, np.abs(signed_areas(uvs)), count)
    # A chart without area must not grow beyond its edges.
    extent = np.maximum(np.linalg.norm(high - low, axis=1), 1e-300)
    edges = np.bincount(charts, np.linalg.norm(shapes[:, 1] - shapes[:, 0], axis=1), count)
    scale = np.minimum(np.sqrt(true / np.maximum(flat, 1e-300)), 2.0 * edges / extent)
    return np.asarray((uvs - low[charts][:, None, :]) * scale[charts][:, None, None])


def flatten_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Lay each face into the plane: (f, 3, 2) float64, counter-clockwise, first corner at 0."""
    corners = np.asarray(vertices, np.float64)[faces]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.maximum(np.linalg.norm(one, axis=1), 1e-300)
    along = (one * two).sum(axis=1) / length
    height = np.linalg.norm(np.cross(one, two), axis=1) / length
    flat = np.zeros((len(faces), 3, 2))
    flat[:, 1, 0] = length
    flat[:, 2, 0], flat[:, 2, 1] = along, height
    return flat


def relax(corner_uvs: np.ndarray, charts: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Bring the faces of charts nearer to their true shapes (as rigid as possible).

    Rounds of two steps (Liu and others 2008, "A Local/Global Approach to Mesh Parameterization"):
    the best turn of each face, then the points that fit all turned faces in the least squares
    sense. Where that turns faces over or lays them upon each other, points stay as they were.

    Parameters
    ----------
    corner_uvs : (f, 3, 2) float
        Charts of even density, counter-clockwise.
    charts : (f,) int
    shapes : (f, 3, 2) float64

    Returns
    -------
    (f, 3, 2) float64
    """
    start = np.asarray(corner_uvs, np.float64)
    corners, first = chart_points(corner_uvs.astype(np.float32), charts)
    points = start.reshape(-1, 2)[first]
    shapes = _widen_needles(shapes)
    weights = _cotangents(shapes)  # (f, 3) of the edge from corner k to k + 1
    size = len(points)
    begin, end = half_edges(corners)
    weight = weights.ravel()
    off = coo_matrix((-weight, (begin, end)), shape=(size, size)).tocsr()
    off = off + off.T
    total = -np.asarray(off.sum(axis=1)).ravel()
    anchor = ANCHOR_WEIGHT * float(np.mean(np.abs(total)))
    solve = splu((off + diags(total + anchor)).tocsc(), permc_spec="MMD_AT_PLUS_A").solve
    edges = shapes - np.roll(shapes, -1, axis=1)  # (f, 3, 2)
    for _ in range(RELAXATIONS):
        now = points[corners]
        moved = now - np.roll(now, -1, axis=1)
        cosine = (weights * (moved * edges).sum(axis=2)).sum(axis=1)
        cross = edges[..., 0] * moved[..., 1] - edges[..., 1] * moved[..., 0]
        sine = (weights * cross).sum(axis=1)
        length = np.maximum(np.hypot(cosine, sine), 1e-300)
        cosine, sine = cosine / length, sine / length
        turned = np.stack(
            [
                cosine[:, None] * edges[..., 0] - sine[:, None] * edges[..., 1],
                sine[:, None] * edges[..., 0] + cosine[:, None] * edges[..., 1],
            ],
            axis=2,
        )
        edge_targets = (weights[..., None] * turned).reshape(-1, 2)
        right_side = anchor * points
        for axis in range(2):
            right_side[:, axis] += np.bincount(begin, edge_targets[:, axis], size)
            right_side[:, axis] -= np.bincount(end, edge_targets[:, axis], size)
        points = np.asarray(solve(right_side))
    if not np.isfinite(points).all():
        return start
    return _restore_folded_faces(points, start.reshape(-1, 2)[first], corners, charts)


def _restore_folded_faces(
    points: np.ndarray, start: np.ndarray, corners: np.ndarray, charts: np.ndarray
) -> np.ndarray:
    """Put points back to their start where faces turned over or came to lie upon each other.

    Returns
    -------
    (f, 3, 2) float64
    """
    count = int(charts.max()) + 1
    before = start[corners]
    was_up = signed_areas(before) > 0.0
    folded = np.bincount(charts[find_overlaps(before, charts)[:, 0]], minlength=count)
    points = points.copy()
    for _ in range(MAX_ROUNDS_BACK):
        now = points[corners]
        pairs = find_overlaps(now, charts)
        pairs = pairs[folded[charts[pairs[:, 0]]] == 0]  # those that folded before are split later
        bad = was_up & (signed_areas(now) <= 0.0)
        bad[pairs] = True
        back = np.unique(corners[bad])
        back = back[(points[back] != start[back]).any(axis=1)]
        if len(back) == 0:
            return now
        points[back] = start[back]
    still_folded = np.bincount(charts, bad, count) > 0
    return np.where(still_folded[charts][:, None, None], before, points[corners])


def _widen_needles(shapes: np.ndarray) -> np.ndarray:
    longest = np.linalg.norm(shapes - np.roll(shapes, -1, axis=1), axis=2).max(axis=1)
    longest = np.maximum(longest, 1e-300)
    double = 2.0 * np.abs(signed_areas(shapes))
    base = np.maximum(shapes[:, 1, 0], MIN_HEIGHT_SHARE * longest)
    wanted = np.maximum(double, MIN_HEIGHT_SHARE * longest**2)
    result = shapes.copy()
    result[:, 1, 0] = base
    result[:, 2, 1] = wanted / base
    return result


def _cotangents(shapes: np.ndarray) -> np.ndarray:
    """(f, 3) half cotangent of the angle opposite to the edge from corner k to k + 1."""
    result = np.empty((len(shapes), 3))
    for k in range(3):
        apex = shapes[:, (k + 2) % 3]
        one, two = shapes[:, k] - apex, shapes[:, (k + 1) % 3] - apex
        cross = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
        result[:, k] = 0.5 * (one * two).sum(axis=1) / np.maximum(cross, 1e-300)
    return result
