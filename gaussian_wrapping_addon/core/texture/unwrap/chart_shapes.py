# SPDX-License-Identifier: GPL-3.0-or-later
"""Geometry of charts: smoothing of the mesh before charting, ARAP relaxation of charts."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from ...mesh.topology import area_vectors, half_edges
from .chart_overlaps import find_overlaps, signed_areas

SMOOTHING_STEPS = 2
"""More give more charts again (the copy shrinks into folds); one leaves 0.3 edges of noise."""
MAX_MOVE_SHARE = 0.5
"""Share of the mean length of a vertex's edges."""
MIN_AREA_SHARE = 0.03
"""With a smaller share of its area, a face is crushed; xatlas hung on a wire three faces around."""
RELAXATIONS = 6
"""After six rounds, the stretch of charts changes by less than 0.1 %."""
MAX_ROUNDS_BACK = 30
"""Maximum number of rounds: restoring a point may fold its neighbours, so all are tested again."""
MIN_HEIGHT_SHARE = 0.02
"""Minimum height of needles relative to their longest edge, so that their weights stay bounded."""
ANCHOR_WEIGHT = 1e-6
"""Weight that fixes the position of a chart, relative to the mean weight of a vertex."""


def smooth_vertices(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Move vertices towards the mean of their neighbours, by at most half an edge.

    xatlas splits charts at noisy or badly shaped faces; smoothing reduces both.

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
    """Restore the vertices of faces that lost most of their area, so that thin tubes stay open."""
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
    """Index the distinct points of each chart.

    Parameters
    ----------
    corner_uvs : (f, 3, 2) float32
    charts : (f,) int

    Returns
    -------
    corners : (f, 3) int64
        Index of a point for each corner; charts share no points.
    first : (n,) int64
        A corner ``3 * face + k`` at each point.
    """
    bits = np.ascontiguousarray(corner_uvs, np.float32).reshape(-1, 2) + np.float32(0.0)
    bits = bits.view(np.uint32).astype(np.int64)  # (3 f, 2); + 0.0 maps -0.0 to 0.0
    order = np.lexsort((bits[:, 1], bits[:, 0], np.repeat(charts, 3)))
    keys = np.column_stack([np.repeat(charts, 3), bits])[order]
    fresh = np.concatenate([[True], (keys[1:] != keys[:-1]).any(axis=1)])
    corners = np.empty(len(order), np.int64)
    corners[order] = np.cumsum(fresh) - 1
    return corners.reshape(-1, 3), order[fresh]


def equalise_density(corner_uvs: np.ndarray, charts: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Scale each chart to the area of its faces, and move its lower corner to the origin.

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
    """Flatten each face to the plane: (f, 3, 2) float64, counter-clockwise, first corner at 0."""
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
    """Relax charts towards the true shapes of their faces (as rigid as possible).

    Rounds of two steps (Liu and others 2008, "A Local/Global Approach to Mesh Parameterization"):
    the best rotation of each face, then the least-squares points for all rotated faces. Points of
    faces that flip or overlap as a result are restored.

    Parameters
    ----------
    corner_uvs : (f, 3, 2) float
        Charts of uniform density, counter-clockwise.
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
    weights = _cotangents(shapes)  # (f, 3) for the edge from corner k to k + 1
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
    """Restore the points of faces that flipped or overlap since the start.

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
        pairs = pairs[
            folded[charts[pairs[:, 0]]] == 0
        ]  # charts that overlapped before are split later
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
    """Return (f, 3) half cotangents of the angle opposite to the edge from corner k to k + 1."""
    result = np.empty((len(shapes), 3))
    for k in range(3):
        apex = shapes[:, (k + 2) % 3]
        one, two = shapes[:, k] - apex, shapes[:, (k + 1) % 3] - apex
        cross = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
        result[:, k] = 0.5 * (one * two).sum(axis=1) / np.maximum(cross, 1e-300)
    return result
