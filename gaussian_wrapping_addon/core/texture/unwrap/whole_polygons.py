# SPDX-License-Identifier: GPL-3.0-or-later
"""Charts that cut no polygon: triangles follow the rest of their polygon into one chart."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from ...mesh.face_graph import FaceGraph, components
from .chart_overlaps import signed_areas

SAME_POINT_SHARE = 0.5
"""A point that a chart has of a vertex already is used again within this share of the edge."""


def join_polygons(
    corner_uvs: np.ndarray,
    charts: np.ndarray,
    faces: np.ndarray,
    shapes: np.ndarray,
    graph: FaceGraph,
    polygons: np.ndarray,
) -> np.ndarray:
    """Move the triangles of cut polygons into the chart that holds most of the polygon.

    A moved triangle is laid beside its neighbour of the same polygon, in its true shape, or between
    the points that the chart has already. It may overlap others there.

    Parameters
    ----------
    corner_uvs : (f, 3, 2) float64
        Charts at the scale of the surface, counter-clockwise.
    charts : (f,) int
    faces : (f, 3) int
    shapes : (f, 3, 2) float64
        Of :func:`.chart_shapes.flatten_faces`.
    graph : FaceGraph
    polygons : (f,) int
        Polygon of each face.

    Returns
    -------
    (f, 3, 2) float64
    """
    cut = _cut(charts, polygons)
    if not cut.any():
        return corner_uvs
    uvs = corner_uvs.copy()
    areas = np.abs(signed_areas(shapes))
    points = _points_of_charts(uvs, charts, faces, np.unique(faces[cut]))
    for rows in _rows_of_polygons(polygons, cut):
        kinds, inverse = np.unique(charts[rows], return_inverse=True)
        home = int(kinds[np.argmax(np.bincount(inverse.ravel(), areas[rows]))])
        placed = [row for row in rows.tolist() if charts[row] == home]
        for row, corner, beside in _spread(placed, set(rows.tolist()), graph):
            near, far = _laid_beside(uvs, faces, shapes, row, corner, beside)
            known = points[home, int(faces[row, (corner + 2) % 3])]
            reach = SAME_POINT_SHARE * float(np.linalg.norm(near[1] - near[0]))
            gaps = [float(np.linalg.norm(point - far)) for point in known]
            if gaps and min(gaps) <= reach:
                far = known[int(np.argmin(gaps))]
            else:
                known.append(far)
            uvs[row, corner], uvs[row, (corner + 1) % 3] = near
            uvs[row, (corner + 2) % 3] = far
    return uvs


def set_cut_apart(
    corner_uvs: np.ndarray,
    charts: np.ndarray,
    faces: np.ndarray,
    shapes: np.ndarray,
    graph: FaceGraph,
    polygons: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Give quads that are still cut, where charts would fold, a chart of their own each.

    Polygons with more than four sides may stay cut: laid flat, their triangles could overlap.

    Parameters
    ----------
    corner_uvs, charts, faces, shapes, graph, polygons
        As for :func:`join_polygons`.

    Returns
    -------
    corner_uvs : (f, 3, 2) float64
    charts : (f,) int32
        Labels from 0; each chart is connected.
    """
    cut = _cut(charts, polygons) & (np.bincount(polygons)[polygons] == 2)
    if not cut.any():
        return corner_uvs, charts
    uvs, labels = corner_uvs.copy(), charts.astype(np.int64)
    fresh = int(labels.max()) + 1
    for rows in _rows_of_polygons(polygons, cut):
        first = int(rows[0])
        steps = list(_spread([first], set(rows.tolist()), graph))
        if not steps:
            continue  # its triangles share no edge
        uvs[first] = shapes[first]
        row, corner, beside = steps[0]
        near, far = _laid_beside(uvs, faces, shapes, row, corner, beside)
        uvs[row, corner], uvs[row, (corner + 1) % 3] = near
        uvs[row, (corner + 2) % 3] = far
        labels[rows] = fresh
        fresh += 1
    other = np.where(graph.opposite >= 0, graph.opposite // 3, 0)
    return uvs, components(graph, labels[other] == labels[:, None])


def _cut(charts: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """Return which faces, (f,) bool, are of a polygon in several charts."""
    count = int(polygons.max()) + 1
    low, high = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    np.minimum.at(low, polygons, charts)
    np.maximum.at(high, polygons, charts)
    return np.asarray((low < high)[polygons])


def _rows_of_polygons(polygons: np.ndarray, chosen: np.ndarray) -> list[np.ndarray]:
    rows = np.flatnonzero(chosen)
    rows = rows[np.argsort(polygons[rows], kind="stable")]
    return np.split(rows, np.flatnonzero(np.diff(polygons[rows])) + 1)


def _points_of_charts(
    uvs: np.ndarray, charts: np.ndarray, faces: np.ndarray, vertices: np.ndarray
) -> defaultdict[tuple[int, int], list[np.ndarray]]:
    """Return the points that each chart has of the given vertices, by (chart, vertex)."""
    points: defaultdict[tuple[int, int], list[np.ndarray]] = defaultdict(list)
    face, corner = np.nonzero(np.isin(faces, vertices))
    for chart, vertex, point in zip(
        charts[face].tolist(), faces[face, corner].tolist(), uvs[face, corner], strict=True
    ):
        known = points[chart, vertex]
        if not any((point == other).all() for other in known):
            known.append(point)
    return points


def _spread(placed: list[int], rows: set[int], graph: FaceGraph) -> Iterator[tuple[int, int, int]]:
    """Walk from placed triangles to the others over their shared edges.

    Yields
    ------
    row, corner, beside : int
        A triangle, its corner where the edge begins, and the placed triangle's half-edge.
    """
    queue, waiting = list(placed), rows - set(placed)
    for row in queue:
        for corner in range(3):
            opposite = int(graph.opposite[row, corner])
            other = opposite // 3
            if opposite >= 0 and other in waiting:
                waiting.remove(other)
                queue.append(other)
                yield other, opposite % 3, 3 * row + corner


def _laid_beside(
    uvs: np.ndarray, faces: np.ndarray, shapes: np.ndarray, row: int, corner: int, beside: int
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return the points of a triangle's edge, and of its third corner in the true shape."""
    face, at = divmod(beside, 3)
    begin, end = uvs[face, at], uvs[face, (at + 1) % 3]
    if faces[face, at] != faces[row, corner]:
        begin, end = end, begin
    one, two, three = (shapes[row, (corner + k) % 3] for k in range(3))
    edge, side, wanted = (complex(*v) for v in (two - one, three - one, end - begin))
    turned = side * wanted / edge if edge else 0j
    return (begin.copy(), end.copy()), begin + np.array([turned.real, turned.imag])
