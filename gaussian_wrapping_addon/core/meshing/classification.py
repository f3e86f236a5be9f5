# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside or outside: labels of tetrahedra by a minimum cut."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import limits
from ..compiled import kernel
from ..mesh.surface_mesh import area_vectors
from ..progress import Progress

# -- Exact minimum cut on the dual graph of a tetrahedral mesh, by push-relabel (numba) -----------

ARCS_PER_NODE = 6
"""Arcs scanned per node between two global relabellings, each of which scans four. The cut of
trained scenes took as long with 2, and a quarter longer with 20."""


def minimum_cut(
    arcs: np.ndarray, capacity: np.ndarray, unary: np.ndarray, progress: Progress | None = None
) -> np.ndarray:
    """Return the inside nodes of the labelling with the least cost.

    The cost is the capacity of all arcs between different labels, plus for each node the magnitude
    of its unary term where the label disagrees with its sign. Among minimum cuts the one with the
    fewest inside nodes is returned: it is unique, whatever the order of the computation.

    Flow is pushed from nodes with source capacity (negative terms) towards those with sink capacity
    (positive terms) along shortest paths (Goldberg and Tarjan, "A new approach to the maximum-flow
    problem", 1988). Nodes that can still reach remaining sink capacity are inside. Memory and, on
    meshes, time grow linearly with the nodes; millions are practical.

    Parameters
    ----------
    arcs : (k, 4) int
        Neighbours, -1 for none; mutual, each at most once in a row.
    capacity : (k, 4) int
        Capacity of each arc, >= 0 and below 2**30; the smaller of both directions counts.
    unary : (k,) int
        Unary term of each node; positive favours inside.
    progress : Progress, optional
        Updated at each global relabelling, so that the computation can be cancelled.

    Returns
    -------
    (k,) bool
    """
    progress = progress or Progress()
    count = len(arcs)
    arcs = np.ascontiguousarray(arcs, np.int32)
    residual = np.ascontiguousarray(capacity, np.int32).copy()
    reverse = np.zeros((count, 4), np.int8)
    _reverse_arc_kernel(arcs, residual, reverse)
    excess = -np.asarray(unary, np.int64)
    height, queue = np.empty(count, np.int32), np.empty(count, np.int32)
    queued = np.empty(count, np.bool_)
    while True:
        _relabel_kernel(arcs, residual, reverse, excess, height, queue)
        progress.update(0.0, "smoothing labels")
        active = np.flatnonzero((excess > 0) & (height < count))
        if len(active) == 0:
            return height < count
        queue[: len(active)] = active
        queued[:] = False
        queued[active] = True
        budget = ARCS_PER_NODE * count
        _push_kernel(arcs, residual, reverse, excess, height, queue, queued, len(active), budget)


@kernel(fast=False)
def _reverse_arc_kernel(arcs, residual, reverse):  # type: ignore[no-untyped-def]
    """Find the reverse of each arc; both directions get the smaller capacity."""
    for i in range(len(arcs)):
        for k in range(4):
            j = arcs[i, k]
            if j < 0:
                continue
            for m in range(4):
                if arcs[j, m] == i:
                    reverse[i, k] = m
                    residual[i, k] = min(residual[i, k], residual[j, m])
                    residual[j, m] = residual[i, k]


@kernel(fast=False)
def _relabel_kernel(arcs, residual, reverse, excess, height, queue):  # type: ignore[no-untyped-def]
    """Global relabelling: the residual distance of each node to sink capacity, or the node count.

    Breadth-first search from the nodes with negative excess.
    """
    count = len(arcs)
    end = 0
    for i in range(count):
        height[i] = count
        if excess[i] < 0:
            height[i] = 0
            queue[end] = i
            end += 1
    begin = 0
    while begin < end:
        j = queue[begin]
        begin += 1
        for k in range(4):
            i = arcs[j, k]
            if i >= 0 and height[i] == count and residual[i, reverse[j, k]] > 0:
                height[i] = height[j] + 1
                queue[end] = i
                end += 1


@kernel(fast=False)
def _push_kernel(  # type: ignore[no-untyped-def]
    arcs, residual, reverse, excess, height, queue, queued, waiting, budget
):
    """Push flow and relabel active nodes, first in first out, within a budget of arcs."""
    count = len(arcs)
    begin = 0
    while waiting > 0 and budget > 0:
        i = queue[begin]
        begin = begin + 1 if begin + 1 < count else 0
        waiting -= 1
        queued[i] = False
        budget -= 4
        lowest = count
        for k in range(4):
            j = arcs[i, k]
            if j < 0 or residual[i, k] == 0:
                continue
            if height[j] >= height[i]:
                lowest = min(lowest, height[j] + 1)
                continue
            flow = min(excess[i], np.int64(residual[i, k]))
            residual[i, k] -= flow
            residual[j, reverse[i, k]] += flow
            excess[i] -= flow
            excess[j] += flow
            if excess[j] > 0 and not queued[j]:
                end = begin + waiting
                queue[end if end < count else end - count] = j
                queued[j] = True
                waiting += 1
            if excess[i] == 0:
                break
        if excess[i] > 0:
            height[i] = lowest
            if lowest < count:
                end = begin + waiting
                queue[end if end < count else end - count] = i
                queued[i] = True
                waiting += 1


# -- Neighbours of tetrahedra, and the faces between inside and outside tetrahedra ----------------

OUTWARD_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Corners of the face opposite each corner of a positively oriented tetrahedron, outward."""

_KEY_BITS = 21


def tetrahedron_neighbours(tetrahedra: np.ndarray) -> np.ndarray:
    """Return the tetrahedron behind the face opposite each corner, -1 on the hull, (m, 4) int64.

    No face may belong to more than two tetrahedra.
    """
    count = len(tetrahedra)
    triples = np.sort(tetrahedra[:, OUTWARD_FACES].reshape(-1, 3), 1)  # (4m, 3)
    if count and int(triples.max()) < 1 << _KEY_BITS:
        keys = (triples[:, 0] << 2 * _KEY_BITS) | (triples[:, 1] << _KEY_BITS) | triples[:, 2]
        order = np.argsort(keys, kind="stable")
        same = keys[order[1:]] == keys[order[:-1]]
    else:
        order = np.lexsort((triples[:, 2], triples[:, 1], triples[:, 0]))
        same = (triples[order[1:]] == triples[order[:-1]]).all(1)
    first, second = order[:-1][same], order[1:][same]
    result = np.full(4 * count, -1, np.int64)
    result[first], result[second] = second // 4, first // 4
    return result.reshape(count, 4)


def faces_opposite(tetrahedra: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the faces opposite the chosen corners (m, 4) bool of tetrahedra, outward, (f, 3)."""
    tetrahedron, corner = np.nonzero(chosen)
    return tetrahedra[tetrahedron[:, None], OUTWARD_FACES[corner]]


def of_neighbours(labels: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Return the labels (m,) bool of the neighbours, (m, 4); false beyond the hull."""
    return np.where(neighbours >= 0, labels[neighbours], False)


def boundary_faces(
    tetrahedra: np.ndarray, neighbours: np.ndarray, inside: np.ndarray
) -> np.ndarray:
    """Return the faces of inside tetrahedra with an outside neighbour or none, (f, 3) int64.

    Oriented outward where the tetrahedra are positively oriented. The set is closed: every edge
    has as many faces in one direction as in the other.
    """
    return faces_opposite(tetrahedra, inside[:, None] & ~of_neighbours(inside, neighbours))


# -- Label tetrahedra inside or outside: progressive sampling, then a minimum cut -----------------
#
# See docs/method.md, section 7.5.


ROUNDS = (1, 3, 6)
"""Interior samples added in each round: the centroid, then random points (10 in all, as in PAM)."""

DECIDED_MARGIN = 0.3  # a mean vacancy this far from 0.5 needs no further samples, ...
DISAGREEING_NEIGHBOURS = 3  # ... unless this many neighbours have the other label
MIXED_DEVIATION = 0.1
"""Samples near 0.5 whose standard deviation is below this come from a sliver on the surface: more
samples add nothing, and the minimum cut decides."""

SHEET_COSINE = 0.5
SHEET_SLOPE = 0.2
SHEET_EDGE = 12.0
"""Bounds for a flat tetrahedron: least cosine between the normals at its corners, largest slope of
its edges along them, and greatest edge length in spacings. With a slope of 0.4, edges that cross a
plate five times thinner than they are long counted as lying on one side: it got holes."""

FIXED_MARGIN = 0.05
"""Tetrahedra at least this far from 0.5 after all rounds keep their label. With 0.25, smoothing
removed a tenth of the wheel's spokes: their interior has a vacancy of 0.2 to 0.4, and cutting a
thin tube saves much area. From 0.1 to 0.05 the mean distances of wheel, fence and torus to the
truth fall or stay, and fewer spokes break; with 0 the torus gets small noisy components."""
DATA_WEIGHT = 1.0
"""Cost of a label against the samples, in units of the tetrahedron's own mean face area."""
CAPACITY_STEPS = 4096.0  # integer steps of the median face area in the minimum cut
LARGEST_CAPACITY = 2**27
"""In the same steps, 32 768 median areas: larger faces are clamped to it. Flow along an arc can
double the residual capacity of its reverse, which must fit into 32 bits."""

POINTS_PER_CHUNK = 1 << 19


@dataclass(frozen=True)
class Classification:
    """Labels of tetrahedra and the statistics behind them."""

    inside: np.ndarray  # (m,) bool

    samples: np.ndarray  # (m,) int64 number of interior samples
    undecided: int  # tetrahedra whose label was left to the minimum cut
    flipped: int  # tetrahedra whose label the minimum cut changed


def classify(
    points: np.ndarray, tetrahedra: np.ndarray, neighbours: np.ndarray, outer: np.ndarray,
    normals: np.ndarray, radii: np.ndarray, field: Any, rng: np.random.Generator,
    progress: Progress,
) -> Classification:  # fmt: skip
    """Label tetrahedra by the vacancy of interior points (docs/method.md, section 7.5).

    A tetrahedron whose corners lie on one smooth sheet is flat: whichever its label, the surface
    is the same up to the spacing squared. Flat tetrahedra are labelled by the side of the sheet
    on which their circumcentre lies, which yields the Delaunay triangulation restricted to the
    surface, with well-shaped triangles. Labelled by interior samples, a cylinder would get the long
    edges of a convex hull.

    Parameters
    ----------
    points : (n, 3) float64
    tetrahedra : (m, 4) int64
    neighbours : (m, 4) int64
        Tetrahedron behind the face opposite each corner, -1 on the hull.
    outer : (m,) bool
        Outside by definition (beyond the region), not sampled.
    """
    count = len(tetrahedra)
    total, squares = np.zeros(count), np.zeros(count)
    samples = np.zeros(count, np.int64)
    total[outer], samples[outer] = 1.0, 1
    rows, side = _on_one_sheet(points, tetrahedra, normals, outer, radii)
    flat = np.zeros(count, np.bool_)
    flat[rows] = True
    total[rows], samples[rows] = 0.5 + 0.5 * side, 1
    rows = np.flatnonzero(~outer & ~flat)
    for index, extra in enumerate(ROUNDS):
        span = progress.span(0.8 * index / len(ROUNDS), 0.8 * (index + 1) / len(ROUNDS))
        size = max(1, POINTS_PER_CHUNK // extra)
        for begin in range(0, len(rows), size):
            span.update(begin / len(rows), f"classifying {len(rows)} tetrahedra")
            part = rows[begin : begin + size]
            weights = _interior_weights((extra, len(part)), index == 0, rng)
            where = np.einsum("ekc,kcx->ekx", weights, points[tetrahedra[part]])
            # One call for all samples: each call visits every camera, however few the points.
            value = field.vacancy(where.reshape(-1, 3)).filled
            value = value.reshape(extra, -1).astype(np.float64)
            total[part] += value.sum(0)
            squares[part] += (value**2).sum(0)
            samples[part] += extra
        mean = total / np.maximum(samples, 1)
        inside = (mean <= limits.ISO_LEVEL) & ~outer
        near = np.abs(mean - limits.ISO_LEVEL) < DECIDED_MARGIN
        others = of_neighbours(inside, neighbours) != inside[:, None]
        outvoted = others.sum(1) >= DISAGREEING_NEIGHBOURS
        mixed = squares > samples * (mean**2 + MIXED_DEVIATION**2)
        rows = np.flatnonzero(((near & (mixed | (samples == 1))) | outvoted) & ~outer & ~flat)
    progress.update(0.85, "smoothing labels")
    free = flat | (np.abs(mean - limits.ISO_LEVEL) < FIXED_MARGIN) & ~outer
    # (m, 4) areas of the faces opposite each corner.
    doubled = (area_vectors(points, np.delete(tetrahedra, k, axis=1)) for k in range(4))
    areas = np.stack([np.linalg.norm(each, axis=1) / 2 for each in doubled], axis=1)
    smooth = regularised(inside, mean, free, neighbours, areas, progress.span(0.9, 1.0))
    progress.update(1.0, "smoothing labels")
    return Classification(smooth, samples, int(free.sum()), int((smooth != inside).sum()))


def _on_one_sheet(
    points: np.ndarray, tetrahedra: np.ndarray, normals: np.ndarray, outer: np.ndarray,
    radii: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Find flat tetrahedra: normals agree at all corners and are nearly orthogonal to the edges.

    Returns their indices, and how far the circumcentre of each lies on the empty side, in spacings
    from -1 to 1.
    """
    rows = np.flatnonzero(~outer)
    corners = tetrahedra[rows]
    pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    for i, j in pairs:
        agree = (normals[corners[:, i]] * normals[corners[:, j]]).sum(1) > SHEET_COSINE
        rows, corners = rows[agree], corners[agree]
    up = normals[corners].sum(1)  # (k, 3)
    up /= np.linalg.norm(up, axis=1)[:, None]
    for i, j in pairs:
        edge = points[corners[:, i]] - points[corners[:, j]]
        length = np.linalg.norm(edge, axis=1)
        flat = np.abs((edge * up).sum(1)) < SHEET_SLOPE * length
        flat &= length < SHEET_EDGE * np.minimum(radii[corners[:, i]], radii[corners[:, j]])
        rows, corners, up = rows[flat], corners[flat], up[flat]
    radius = radii[corners].mean(1)  # (k,)
    base = points[corners[:, 0]]
    a, b, c = (points[corners[:, k]] - base for k in (1, 2, 3))
    cross = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    volume = 2.0 * (a * cross[0]).sum(1)  # 12 times the tetrahedron's
    squares = [(edge**2).sum(1)[:, None] for edge in (a, b, c)]
    # The circumcentre of coplanar corners is infinitely far; either side will do.
    safe = np.where(np.abs(volume) > 1e-12 * radius**3, volume, 1e-12 * radius**3)
    offset = sum(s * x for s, x in zip(squares, cross, strict=True)) / safe[:, None]
    height = ((offset - (a + b + c) / 4) * up).sum(1)
    return rows, np.clip(height / radius, -1.0, 1.0)


def _interior_weights(
    shape: tuple[int, int], centroid: bool, rng: np.random.Generator
) -> np.ndarray:
    """Barycentric weights, (*shape, 4): the centroid, or uniform ones (Dirichlet(1, 1, 1, 1))."""
    if centroid:
        return np.full((*shape, 4), 0.25)
    weights = rng.standard_exponential((*shape, 4))
    return weights / weights.sum(-1, keepdims=True)


def regularised(
    inside: np.ndarray, vacancy: np.ndarray, free: np.ndarray, neighbours: np.ndarray,
    areas: np.ndarray, progress: Progress | None = None,
) -> np.ndarray:  # fmt: skip
    """Label the ``free`` tetrahedra by a minimum cut; return all labels, (m,) bool.

    Minimises the area of the faces between different labels plus, for each tetrahedron labelled
    against its samples, ``DATA_WEIGHT * 2 |vacancy - 0.5|`` times its mean face area. The other
    labels are fixed, so thin parts that the field shows clearly cannot be smoothed away.
    """
    nodes = np.flatnonzero(free)
    if len(nodes) == 0:
        return inside.copy()
    own = np.full(len(free), -1, np.int32)
    own[nodes] = np.arange(len(nodes))
    # Only the difference of source and sink capacity matters.
    arcs = np.empty((len(nodes), 4), np.int32)
    capacity, unary = np.empty((len(nodes), 4), np.int32), np.empty(len(nodes), np.int64)
    confidence = DATA_WEIGHT * 2 * np.abs(vacancy[nodes] - limits.ISO_LEVEL)
    steps = CAPACITY_STEPS / max(float(np.median(areas[nodes])), 1e-300)
    _graph_kernel(
        nodes, own, inside, confidence, neighbours, areas, steps, float(LARGEST_CAPACITY), arcs,
        capacity, unary,
    )  # fmt: skip
    result = inside.copy()
    result[nodes] = minimum_cut(arcs, capacity, unary, progress)
    return result


@kernel(fast=False)
def _graph_kernel(  # type: ignore[no-untyped-def]
    nodes, own, inside, confidence, neighbours, areas, steps, limit, arcs, capacity, unary
):
    """Build the graph of the free tetrahedra: arcs, integer capacities and unary terms."""
    for row in range(len(nodes)):
        i = nodes[row]
        mean = 0.0
        for k in range(4):
            mean += areas[i, k] / 4.0
        term = confidence[row] * mean if inside[i] else -confidence[row] * mean
        for k in range(4):
            j = neighbours[i, k]
            arcs[row, k] = own[j] if j >= 0 else -1
            capacity[row, k] = np.int32(np.rint(min(areas[i, k] * steps, limit)))
            if arcs[row, k] < 0:
                term += areas[i, k] if j >= 0 and inside[j] else -areas[i, k]
        unary[row] = np.int64(np.rint(min(max(term * steps, -4.0 * limit), 4.0 * limit)))
