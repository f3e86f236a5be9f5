# SPDX-License-Identifier: GPL-3.0-or-later
"""Charts without overlaps, along the edges of polygons."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np

from ...compiled import inline, kernel
from ...mesh.components import FaceGraph, components
from .packing_scale import signed_areas

# -- Find overlapping faces within a chart exactly, and split charts until there are none ---------


OVERLAP_DEPTH_SHARE = 1e-4
"""Minimum penetration depth of an overlap, as a share of the median edge of all faces. In typical
textures this is a hundredth of a texel, above the rounding of UVs."""
LEAST_CLASS_SHARE = 1.0 / 64.0
"""Share of the median width or height: all smaller faces are in one class."""


def find_overlaps(corner_uvs: np.ndarray, charts: np.ndarray) -> np.ndarray:
    """Find the pairs of faces of the same chart that overlap: (p, 2) int64, each once."""
    uvs = np.ascontiguousarray(corner_uvs, np.float64)
    edges = np.linalg.norm(uvs - np.roll(uvs, -1, axis=1), axis=2)
    solid = edges[edges > 0]
    if len(solid) == 0:
        return np.empty((0, 2), np.int64)
    depth = OVERLAP_DEPTH_SHARE * float(np.median(solid))
    return overlapping_pairs(uvs, charts, depth)[0]


def overlapping_pairs(uvs: np.ndarray, charts: np.ndarray, depth: float) -> tuple[np.ndarray, int]:
    """Find pairs of faces of one chart that penetrate each other by more than ``depth``.

    Returns them, (p, 2) int64, each once, and how many pairs were tested.

    Bounding boxes are sorted into classes by width and height, each within a factor of two, and
    within a class into rows of its height. A box intersects at most three rows of each class of at
    least its height, and in a row only boxes within twice the width are tested: the cost grows with
    the intersecting boxes, for any aspect ratio and orientation.
    """
    order, arrays = _rows(uvs, charts)
    found = np.empty((0, 2), np.int64)
    candidates = np.zeros(1, np.int64)
    count = int(_overlapping(*arrays, depth, found, candidates))
    if count:
        found = np.empty((count, 2), np.int64)
        _overlapping(*arrays, depth, found, candidates)
    return np.asarray(order[found], np.int64), int(candidates[0])


def _rows(uvs: np.ndarray, charts: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Return the (f,) faces sorted by chart, class, row and left border; arrays in this order."""
    low, high = uvs.min(axis=1), uvs.max(axis=1)  # (f, 2)
    size = high - low
    # One class for all very small boxes, as the number of classes below is unbounded.
    least = np.maximum(LEAST_CLASS_SHARE * np.median(size, axis=0), np.finfo(np.float64).tiny)
    exponent = np.frexp(np.maximum(size, least))[1]  # (f, 2) int32; size <= 2^exponent
    row = np.floor(np.ldexp(low[:, 1], -exponent[:, 1]))
    order = np.lexsort((low[:, 0], row, exponent[:, 0], exponent[:, 1], charts))
    chart = charts[order].astype(np.int64)
    exponent, row = exponent[order], row[order]
    new_class = _changes(chart, exponent[:, 0], exponent[:, 1])
    new_row = new_class | _changes(row)
    row_begin = np.append(np.flatnonzero(new_row), len(order))
    class_begin = np.flatnonzero(new_class)
    first_row = np.append(np.cumsum(new_row)[class_begin] - 1, len(row_begin) - 1)
    class_chart = chart[class_begin]
    classes_end = np.searchsorted(class_chart, chart, side="right")  # (f,)
    own_height = np.maximum.accumulate(np.where(new_class, np.arange(len(order)), 0))
    # Classes of a chart are sorted by height: those of at least a height are contiguous.
    height_key = np.stack([class_chart, exponent[class_begin, 1]], axis=1)
    begins = np.flatnonzero(_changes(height_key[:, 0], height_key[:, 1]))
    group = begins[np.searchsorted(begins, np.arange(len(class_begin)), side="right") - 1]
    classes_begin = group[np.searchsorted(class_begin, own_height, side="right") - 1]
    return order, (
        np.ascontiguousarray(uvs[order]), np.ascontiguousarray(low[order]),
        np.ascontiguousarray(high[order]), classes_begin, classes_end, first_row,
        np.exp2(exponent[class_begin].astype(np.float64)), row[row_begin[:-1]], row_begin,
        exponent[:, 1], exponent[class_begin, 1],
    )  # fmt: skip


def _changes(*columns: np.ndarray) -> np.ndarray:
    """Return which rows differ from the previous one, (n,) bool; the first does."""
    new = np.ones(len(columns[0]), np.bool_)
    new[1:] = np.any([column[1:] != column[:-1] for column in columns], axis=0)
    return new


def split_overlaps(corner_uvs: np.ndarray, charts: np.ndarray, graph: FaceGraph) -> np.ndarray:
    """Split charts until no two faces of one overlap; UVs are unchanged.

    A new chart grows from the central face of the old one over shared edges, without faces that it
    would overlap or that are flipped; the remaining faces are split in the same way. UVs are
    finite; different charts, each connected, may overlap. Returns labels from 0, (f,) int32.
    """
    pairs = find_overlaps(corner_uvs, charts)
    areas = signed_areas(np.asarray(corner_uvs, np.float64))
    count = int(charts.max()) + 1
    up = np.bincount(charts, areas > 0, count)
    down = np.bincount(charts, areas < 0, count)
    broken = (up > 0) & (down > 0)
    broken[charts[pairs[:, 0]]] = True
    if not broken.any():
        return np.asarray(charts, np.int32)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    starts = np.searchsorted(both[:, 0], np.arange(len(charts) + 1))
    neighbours = (graph.opposite // 3).astype(np.int64)  # -1 without one
    centres = np.asarray(corner_uvs, np.float64).mean(axis=1)
    sums = np.stack([np.bincount(charts, centres[:, axis], count) for axis in range(2)], axis=1)
    middle = sums / np.maximum(np.bincount(charts, minlength=count), 1)[:, None]
    distance = np.linalg.norm(centres - middle[charts], axis=1)
    faces = np.flatnonzero(broken[charts])
    faces = faces[np.lexsort((distance[faces], charts[faces]))]
    pieces = _grow_pieces(
        np.ascontiguousarray(charts, np.int64), faces, neighbours, np.sign(areas), starts,
        np.ascontiguousarray(both[:, 1]), count,
    )  # fmt: skip
    return connected_pieces(graph, pieces)


def connected_pieces(graph: FaceGraph, labels: np.ndarray) -> np.ndarray:
    """Return labels from 0, (f,) int32, of the connected pieces of faces with the same label."""
    return components(graph, labels[graph.opposite // 3] == labels[:, None])


@inline
def _separation(a: Any, b: Any, ccw: float) -> float:
    """Return the largest separation of two triangles along the first one's edge normals."""
    widest = -np.inf
    for k in range(3):
        ax, ay = a[k, 0], a[k, 1]
        dx, dy = a[(k + 1) % 3, 0] - ax, a[(k + 1) % 3, 1] - ay
        length = np.hypot(dx, dy)
        if length == 0.0:
            continue
        nearest = np.inf
        for j in range(3):
            out = ccw * (dy * (b[j, 0] - ax) - dx * (b[j, 1] - ay)) / length
            nearest = min(nearest, out)
        widest = max(widest, nearest)
    return widest


@inline
def _orientation(a: Any) -> float:
    double = (a[1, 0] - a[0, 0]) * (a[2, 1] - a[0, 1]) - (a[2, 0] - a[0, 0]) * (a[1, 1] - a[0, 1])
    return 1.0 if double > 0.0 else (-1.0 if double < 0.0 else 0.0)


@inline
def _first_at_least(values: Any, begin: int, end: int, wanted: float) -> int:
    while begin < end:
        middle = (begin + end) // 2
        if values[middle] < wanted:
            begin = middle + 1
        else:
            end = middle
    return begin


@kernel(fast=False)
def _overlapping(
    uvs: Any, low: Any, high: Any, classes_begin: Any, classes_end: Any, first_row: Any,
    class_size: Any, row: Any, row_begin: Any, height: Any, class_height: Any,
    depth: float, found: Any, candidates: Any,
) -> int:  # fmt: skip
    count = 0
    candidates[0] = 0
    left = low[:, 0]
    for i in range(len(uvs)):
        one = uvs[i]
        orientation = _orientation(one)
        if orientation == 0.0:
            continue
        for c in range(classes_begin[i], classes_end[i]):
            same_height = class_height[c] == height[i]
            wide, tall = class_size[c, 0], class_size[c, 1]
            last = np.floor(high[i, 1] / tall)
            r = _first_at_least(row, first_row[c], first_row[c + 1], np.floor(low[i, 1] / tall) - 1)
            while r < first_row[c + 1] and row[r] <= last:
                begin = row_begin[r]
                if same_height:  # each pair once
                    begin = max(begin, i + 1)
                j = _first_at_least(left, begin, row_begin[r + 1], low[i, 0] - wide)
                while j < row_begin[r + 1] and left[j] <= high[i, 0] - depth:
                    candidates[0] += 1
                    apart = high[j, 0] < low[i, 0] + depth or high[j, 1] < low[i, 1] + depth
                    if not apart and low[j, 1] <= high[i, 1] - depth:
                        other = uvs[j]
                        orientation_other = _orientation(other)
                        if orientation_other != 0.0 and (
                            _separation(one, other, orientation) <= -depth
                            and _separation(other, one, orientation_other) <= -depth
                        ):
                            if count < len(found):
                                found[count, 0] = i
                                found[count, 1] = j
                            count += 1
                    j += 1
                r += 1
    return count


@kernel(fast=False)
def _grow_pieces(
    charts: Any, faces: Any, neighbours: Any, orientation: Any, starts: Any, others: Any, label: int
) -> np.ndarray:
    """Label the pieces of the given faces (sorted by chart, from the centre outwards)."""
    piece = charts.copy()
    waiting = np.zeros(len(charts), np.bool_)
    for face in faces:
        waiting[face] = True
    queue = np.empty(len(charts), np.int64)
    for seed in faces:
        if not waiting[seed]:
            continue
        begin, end = 0, 1
        queue[0] = seed
        waiting[seed] = False
        piece[seed] = label
        while begin < end:
            face = queue[begin]
            begin += 1
            for k in range(3):
                other = neighbours[face, k]
                if other < 0 or not waiting[other] or charts[other] != charts[seed]:
                    continue
                if orientation[other] * orientation[seed] < 0.0:
                    continue
                free = True
                for at in range(starts[other], starts[other + 1]):
                    if piece[others[at]] == label:
                        free = False
                        break
                if not free:
                    continue
                waiting[other] = False
                piece[other] = label
                queue[end] = other
                end += 1
        label += 1
    return piece


# -- Charts that cut no polygon: triangles follow the rest of their polygon into one chart --------


SAME_POINT_SHARE = 0.5
"""A point that a chart has of a vertex already is used again within this share of the edge."""


def join_polygons(
    corner_uvs: np.ndarray, charts: np.ndarray, faces: np.ndarray, shapes: np.ndarray,
    graph: FaceGraph, polygons: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Move the triangles of cut polygons into the chart that holds most of the polygon.

    A moved triangle is laid beside its neighbour of the same polygon, in its true shape, or between
    the points that the chart has already. It may overlap others there.

    The charts, (f, 3, 2), are at the scale of the surface and counter-clockwise; the shapes of the
    faces are those of :func:`.charts.flatten_faces`. Returns new UVs.
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
            begin, end, far = _lay_beside(uvs, faces, shapes, row, corner, beside)
            known = points[home, int(faces[row, (corner + 2) % 3])]
            reach = SAME_POINT_SHARE * float(np.linalg.norm(end - begin))
            gaps = [float(np.linalg.norm(point - far)) for point in known]
            if gaps and min(gaps) <= reach:
                uvs[row, (corner + 2) % 3] = known[int(np.argmin(gaps))]
            else:
                known.append(far)
    return uvs


def set_cut_apart(
    corner_uvs: np.ndarray, charts: np.ndarray, faces: np.ndarray, shapes: np.ndarray,
    graph: FaceGraph, polygons: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Give quads that are still cut, where charts would fold, a chart of their own each.

    Polygons with more than four sides may stay cut: laid flat, their triangles could overlap. The
    parameters are those of :func:`join_polygons`. Returns UVs, and the charts, each connected.
    """
    cut = _cut(charts, polygons) & (np.bincount(polygons)[polygons] == 2)
    if not cut.any():
        return corner_uvs, charts
    uvs, labels = corner_uvs.copy(), charts.astype(np.int64)
    fresh = int(labels.max()) + 1
    for rows in _rows_of_polygons(polygons, cut):
        first = int(rows[0])
        for row, corner, beside in _spread([first], set(rows.tolist()), graph):  # the other, if any
            uvs[first] = shapes[first]
            _lay_beside(uvs, faces, shapes, row, corner, beside)
            labels[rows] = fresh
            fresh += 1
    return uvs, connected_pieces(graph, labels)


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

    Yields each triangle, its corner where the edge begins, and the placed triangle's half-edge.
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


def _lay_beside(
    uvs: np.ndarray, faces: np.ndarray, shapes: np.ndarray, row: int, corner: int, beside: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Set and return the points of a triangle's edge, and of its third corner in the true shape."""
    face, at = divmod(beside, 3)
    begin, end = uvs[face, at], uvs[face, (at + 1) % 3]
    if faces[face, at] != faces[row, corner]:
        begin, end = end, begin
    one, two, three = (shapes[row, (corner + k) % 3] for k in range(3))
    edge, side, wanted = (complex(*v) for v in (two - one, three - one, end - begin))
    turned = side * wanted / edge if edge else 0j
    far = begin + np.array([turned.real, turned.imag])
    uvs[row, corner], uvs[row, (corner + 1) % 3], uvs[row, (corner + 2) % 3] = begin, end, far
    return begin, end, far
