# SPDX-License-Identifier: GPL-3.0-or-later
"""Label tetrahedra inside or outside: progressive sampling, then a minimum cut.

See docs/method.md, section 7.5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ... import tolerances
from ...kernels.compiled import kernel
from ...mesh.topology import area_vectors
from ...progress import Progress
from .minimum_cut import minimum_cut

Vacancy = Callable[[np.ndarray], np.ndarray]
"""Maps (n, 3) points to (n,) vacancy."""

ROUNDS = (1, 3, 6)
"""Interior samples added in each round: the centroid, then random points (10 in all, as in PAM)."""

DECIDED_MARGIN = 0.3
"""A mean vacancy this far from 0.5 needs no further samples, ..."""
DISAGREEING_NEIGHBOURS = 3
"""... unless this many neighbours have the other label."""
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
CAPACITY_STEPS = 4096.0
"""Integer steps of the median face area in the minimum cut."""
LARGEST_CAPACITY = 2**27
"""In the same steps, 32 768 median areas: larger faces are clamped to it. Flow along an arc can
double the residual capacity of its reverse, which must fit into 32 bits."""

POINTS_PER_CHUNK = 1 << 19


@dataclass(frozen=True)
class Classification:
    """Labels of tetrahedra and the statistics behind them."""

    inside: np.ndarray
    """(m,) bool."""
    vacancy: np.ndarray
    """(m,) float64 mean vacancy of the interior samples; 1 where not sampled."""
    samples: np.ndarray
    """(m,) int64 number of interior samples."""
    undecided: int
    """Tetrahedra whose label was left to the minimum cut."""
    flipped: int
    """Tetrahedra whose label the minimum cut changed."""


def classify(
    points: np.ndarray,
    tetrahedra: np.ndarray,
    neighbours: np.ndarray,
    outer: np.ndarray,
    sheet: Sheet,
    vacancy: Vacancy,
    rng: np.random.Generator,
    progress: Progress,
) -> Classification:
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
    sheet : Sheet
        From :func:`on_one_sheet`.
    """
    count = len(tetrahedra)
    total, squares = np.zeros(count), np.zeros(count)
    samples = np.zeros(count, np.int64)
    total[outer], samples[outer] = 1.0, 1
    flat = np.zeros(count, np.bool_)
    flat[sheet.rows] = True
    total[sheet.rows], samples[sheet.rows] = 0.5 + 0.5 * sheet.side, 1
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
            value = vacancy(where.reshape(-1, 3)).reshape(extra, -1).astype(np.float64)
            total[part] += value.sum(0)
            squares[part] += (value**2).sum(0)
            samples[part] += extra
        mean = total / np.maximum(samples, 1)
        inside = (mean <= tolerances.ISO_LEVEL) & ~outer
        near = np.abs(mean - tolerances.ISO_LEVEL) < DECIDED_MARGIN
        outvoted = _disagreeing(inside, neighbours) >= DISAGREEING_NEIGHBOURS
        mixed = squares > samples * (mean**2 + MIXED_DEVIATION**2)
        rows = np.flatnonzero(((near & (mixed | (samples == 1))) | outvoted) & ~outer & ~flat)
    progress.update(0.85, "smoothing labels")
    free = flat | (np.abs(mean - tolerances.ISO_LEVEL) < FIXED_MARGIN) & ~outer
    areas = face_areas(points, tetrahedra)
    smooth = regularised(inside, mean, free, neighbours, areas, progress.span(0.9, 1.0))
    progress.update(1.0, "smoothing labels")
    flipped = int((smooth != inside).sum())
    return Classification(smooth, mean, samples, int(free.sum()), flipped)


@dataclass(frozen=True)
class Sheet:
    """Tetrahedra whose corners lie on one smooth sheet of the surface."""

    rows: np.ndarray
    """(k,) int64 indices."""
    side: np.ndarray
    """(k,) float64 from -1 to 1: how far the circumcentre lies on the empty side, in spacings."""


def on_one_sheet(
    points: np.ndarray,
    tetrahedra: np.ndarray,
    normals: np.ndarray,
    outer: np.ndarray,
    radii: np.ndarray,
) -> Sheet:
    """Find flat tetrahedra: normals agree at all corners and are nearly orthogonal to the edges.

    Parameters
    ----------
    normals : (k, 3) float64
        Normals at the first k points; tetrahedra with other corners are ``outer``.
    radii : (k,) float64
        Local spacing at the first k points.
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
    return Sheet(rows, np.clip(height / radius, -1.0, 1.0))


def _interior_weights(
    shape: tuple[int, int], centroid: bool, rng: np.random.Generator
) -> np.ndarray:
    """Barycentric weights, (*shape, 4): the centroid, or uniform ones (Dirichlet(1, 1, 1, 1))."""
    if centroid:
        return np.full((*shape, 4), 0.25)
    weights = rng.standard_exponential((*shape, 4))
    return weights / weights.sum(-1, keepdims=True)


def _disagreeing(inside: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Count the neighbours with the other label, (m,); space beyond the hull is outside."""
    theirs = np.where(neighbours >= 0, inside[neighbours], False)  # (m, 4)
    return (theirs != inside[:, None]).sum(1)


def face_areas(points: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return (m, 4) areas of the faces opposite each corner."""
    result = np.empty(tetrahedra.shape)
    for k in range(4):
        faces = np.delete(tetrahedra, k, axis=1)
        result[:, k] = np.linalg.norm(area_vectors(points, faces), axis=1) / 2
    return result


def regularised(
    inside: np.ndarray,
    vacancy: np.ndarray,
    free: np.ndarray,
    neighbours: np.ndarray,
    areas: np.ndarray,
    progress: Progress | None = None,
) -> np.ndarray:
    """Label the ``free`` tetrahedra by a minimum cut.

    Minimises the area of the faces between different labels plus, for each tetrahedron labelled
    against its samples, ``DATA_WEIGHT * 2 |vacancy - 0.5|`` times its mean face area. The other
    labels are fixed, so thin parts that the field shows clearly cannot be smoothed away.

    Returns
    -------
    (m,) bool
    """
    nodes = np.flatnonzero(free)
    if len(nodes) == 0:
        return inside.copy()
    own = np.full(len(free), -1, np.int32)
    own[nodes] = np.arange(len(nodes))
    # Only the difference of source and sink capacity matters.
    arcs = np.empty((len(nodes), 4), np.int32)
    capacity, unary = np.empty((len(nodes), 4), np.int32), np.empty(len(nodes), np.int64)
    confidence = DATA_WEIGHT * 2 * np.abs(vacancy[nodes] - tolerances.ISO_LEVEL)
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
