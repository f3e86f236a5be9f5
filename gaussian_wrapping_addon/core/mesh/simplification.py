# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes with fewer faces: decimation, vertex selection, edge flips."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import igl
import numpy as np

from ..compiled import kernel
from ..errors import MeshingError
from ..progress import Progress
from ..regions.scene_regions import cap_planes
from ..regions.shapes import Region
from .components import compacted
from .edge_collapse import (
    COLUMNS,
    COUNTERS,
    DONE,
    EMPTY,
    FACES_LEFT,
    FULL,
    HEAP_COLUMNS,
    HEAP_ROOM,
    HEAP_SIZE,
    OPTIMAL_HEAP_COLUMNS,
    POINT_WEIGHT,
    VERTICES_LEFT,
    Limits,
    add_face_quadrics,
    collapse_edges,
    collapse_half_edges,
    link_corners,
    push_edges,
    push_vertices,
)
from .surface_mesh import edge_keys, half_edges, normals_and_areas, vertices_of_half_edges

# -- State of a simplification run, and the driver loop of its collapse kernels -------------------

Heap = tuple[np.ndarray, ...]  # see :mod:`.edge_collapse`


class Simplification:
    """A mesh under simplification, modified in place.

    ``points`` (v, 3) float64 are in units of about the mesh's size; ``faces`` (f, 3) int64 are an
    oriented 2-manifold. ``quadrics`` (v, 11) float64 replace those of the faces, which are weighted
    by ``scale`` and ``point_weight`` (:func:`.edge_collapse.add_face_quadrics`).
    """

    def __init__(
        self, points: np.ndarray, faces: np.ndarray, scale: float, point_weight: float,
        quadrics: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        count = len(points)
        head, following = np.full(count, -1, np.int64), np.full(faces.size, -1, np.int64)
        link_corners(faces, head, following)
        self.points, self._faces = np.ascontiguousarray(points), faces
        self.stamps = np.zeros(count, np.int64)
        if quadrics is None:
            quadrics = np.zeros((count, COLUMNS))
            add_face_quadrics(self.points, faces, quadrics, scale, point_weight)
        marks = np.zeros(count, np.int64)
        # What kernels take, see :mod:`.edge_collapse`.
        self.mesh = (self.points, faces, head, following, quadrics, self.stamps, marks)
        self.counts = np.zeros(COUNTERS, np.int64)
        self.counts[FACES_LEFT] = len(faces)
        self.counts[VERTICES_LEFT] = (head >= 0).sum()

    @property
    def faces_left(self) -> int:
        """Number of remaining faces."""
        return int(self.counts[FACES_LEFT])

    def faces(self) -> np.ndarray:
        """Return the remaining faces, (g, 3) int64, in their original order."""
        return self._faces[self._faces[:, 0] >= 0]

    def empty_heap(self, size: int, columns: int) -> Heap:
        """Return a heap for at least ``size`` entries with this many integer columns."""
        self.counts[HEAP_SIZE] = 0
        size = max(size, 2 * HEAP_ROOM)
        return (np.zeros(size), *(np.zeros(size, np.int64) for _ in range(columns)))

    def run(self, heap: Heap, collapse: Callable[[Heap], int]) -> None:
        """Call a collapse kernel until its target is reached or its heap empty.

        ``collapse`` continues with the heap and returns a code such as
        :data:`.edge_collapse.DONE`.
        """
        while (state := collapse(heap)) not in (DONE, EMPTY):
            if state == FULL:
                heap = tuple(np.concatenate([column, np.zeros_like(column)]) for column in heap)


# -- Simplify a dense closed mesh to a subset of its vertices, by half-edge collapses -------------
#
# Point density alone cannot adapt to a surface that curves in one direction only (a wire, a
# fold), where long triangles along it suffice. Removing the cheapest vertex first finds both
# where and in which directions edges may be long. No vertex moves, so all stay on the isosurface.

SHAPE_WEIGHT = 1e-6
"""Weight of squared length relative to squared height in the cost: it decides on flat surfaces."""

LEAST_ROUNDNESS = 0.03
"""Least height over longest edge of a changed triangle, unless it was narrower before."""

LEAST_COSINE = 0.3  # least cosine between the normals of a triangle before and after a change

_NO_LIMIT = np.iinfo(np.int64).max


def select_vertices(
    vertices: np.ndarray, faces: np.ndarray, target: int, longest: float
) -> np.ndarray:
    """Collapse edges onto one of their ends until ``target`` vertices are left.

    The cost of a vertex is its quadric error: the area-weighted sum of squared distances from the
    vertex that replaces it to the planes of all faces that it represents. A closed 2-manifold stays
    one, with the same genus and parts; no face turns over or becomes narrow.

    ``vertices`` (v, 3) float64, ``faces`` (f, 3): a closed 2-manifold, every vertex used. More than
    ``target`` vertices remain if no other can be removed; no new edge is longer than ``longest``.
    Returns (g, 3) int64 faces over the same vertices, most of which are unused.
    """
    if len(vertices) <= target:
        return np.asarray(faces, np.int64)
    low, high = vertices.min(0), vertices.max(0)
    units = Units((low + high) / 2, float((high - low).max()))
    return merge_vertices(vertices, faces, units, target, longest).faces


class Units(NamedTuple):
    """What coordinates and costs are measured in; meshes whose costs are compared share it."""

    center: np.ndarray  # (3,) float64
    length: float  # about the size of the mesh

    def local(self, vertices: np.ndarray) -> np.ndarray:
        """Return vertices relative to the centre, in units of the length."""
        return np.ascontiguousarray((vertices - self.center) / self.length)


class Merged(NamedTuple):
    """Result of :func:`merge_vertices`."""

    faces: np.ndarray  # (g, 3) int64 over the same vertices, most of which are unused
    into: np.ndarray  # (v,) int64: the vertex that each has merged into, -1 for those that are left
    level: np.ndarray
    """(v,) float64: the highest cost up to the merger of each, infinite for those that are left.
    So those with a level of at most c have merged before all others."""
    quadrics: np.ndarray  # (v, 11) float64: of those left, with those of all that merged into them


def merge_vertices(
    vertices: np.ndarray, faces: np.ndarray, units: Units, target: int, longest: float, *,
    most: float = np.inf, locked: np.ndarray | None = None, quadrics: np.ndarray | None = None,
) -> Merged:  # fmt: skip
    """Select vertices as :func:`select_vertices`, also on a part of a mesh.

    Parameters
    ----------
    faces : (f, 3) int
        Of a closed 2-manifold, at least all those at vertices that are not locked.
    most : float
        Highest cost of a merger.
    locked : (v,) bool, optional
        Vertices that stay, and that no other merges into.
    quadrics : (v, 11) float64, optional
        Instead of those of the faces, in the same units.
    """
    # Planes are weighted by twice the area of their face; corners have no weight.
    run = Simplification(
        units.local(vertices), np.array(faces, np.int64, order="C"), 1.0, 0.0,
        None if quadrics is None else quadrics.copy(),
    )  # fmt: skip
    count = len(vertices)
    bounds = ((longest / units.length) ** 2, SHAPE_WEIGHT, LEAST_ROUNDNESS, LEAST_COSINE)
    into, level = np.full(count, -1, np.int64), np.full(count, np.inf)
    log = (np.zeros(count, np.bool_) if locked is None else locked, into, level, np.zeros(1))
    heap = run.empty_heap(2 * count, HEAP_COLUMNS)
    push_vertices(run.mesh, heap, run.counts, bounds, log)

    def collapse(heap: Heap) -> int:
        return int(
            collapse_half_edges(run.mesh, heap, run.counts, bounds, log, target, most, _NO_LIMIT)
        )

    run.run(heap, collapse)
    return Merged(run.faces(), into, level, run.mesh[4])


def quadrics_of(vertices: np.ndarray, faces: np.ndarray, units: Units) -> np.ndarray:
    """Return the quadric of each vertex, (v, 11) float64: the sum over its faces."""
    result = np.zeros((len(vertices), COLUMNS))
    faces = np.ascontiguousarray(faces, np.int64)
    add_face_quadrics(units.local(vertices), faces, result, 1.0, 0.0)
    return result


def left_of(into: np.ndarray, level: np.ndarray, most: float) -> np.ndarray:
    """Return for each vertex the one that stands for it after all mergers up to a level, (v,).

    ``into``, ``level``: (v,), see :class:`Merged`.
    """
    stands = np.arange(len(into))
    gone = level <= most
    stands[gone] = into[gone]
    while not np.array_equal(further := stands[stands], stands):
        stands = further
    return stands


# -- Decimate a mesh by edge collapses that preserve a closed manifold, in order of quadric error
#
# Libraries that do the same break thin parts (their collapses join sheets) or fold faces over.

MIN_TARGET = 4  # faces of a tetrahedron: no closed surface has fewer
EDGES_PER_CALL = 100_000  # edges processed between two checks for cancellation: about 0.2 s

LIMITS = Limits(0.0, -0.97, 1e-4)
"""Bends up to 166 degrees, and no face turns over (90 degrees). Tighter bounds measured worse: they
force collapses where these cost more. Needles are allowed, since wires and plates need long narrow
faces; the bound is still far above what counts as degenerate (1e-6)."""


@dataclass(frozen=True)
class DecimationResult:
    """A mesh with fewer faces."""

    vertices: np.ndarray  # (w, 3) float64
    faces: np.ndarray  # (g, 3) int64
    reached: bool  # whether the target was reached


def decimate(
    vertices: np.ndarray, faces: np.ndarray, target: int, progress: Progress, *,
    region: Region | None = None,
) -> DecimationResult:  # fmt: skip
    """Collapse edges until ``target`` faces are left, or one more.

    A closed oriented 2-manifold stays one, and every part keeps its genus; the same holds for open
    manifolds, whose boundary is kept. No face turns over or folds back onto its neighbour. Vertices
    on the faces of the region that the mesh was made in stay on them, and none leaves it.

    ``vertices`` (v, 3), ``faces`` (f, 3): consistently oriented 2-manifold, every vertex used.
    ``target``: at least :data:`MIN_TARGET`; a mesh with fewer faces is returned unchanged.
    Raises MeshingError: the target is too small, or the faces are no oriented manifold.
    """
    if target < MIN_TARGET:
        raise MeshingError(
            f"A closed mesh of {target} faces does not exist.", f"Ask for {MIN_TARGET} or more."
        )
    faces = np.array(faces, np.int64).reshape(-1, 3)
    vertices = np.asarray(vertices, np.float64)
    if len(faces) <= target:
        return DecimationResult(vertices, faces, True)
    caps = cap_planes(vertices, region)
    # In units of the mesh's size: neither the unit nor UTM coordinates change a decision.
    low, high = vertices[faces].min((0, 1)), vertices[faces].max((0, 1))
    center, size = (low + high) / 2, float(np.linalg.norm(high - low))
    if not (np.isfinite(size) and size > 0.0):
        raise MeshingError(
            "A mesh without a finite size cannot be decimated.", "Mesh the region again."
        )
    locked = caps.fixed | _on_boundary(faces, len(vertices))
    # Planes are weighted by the area of their face.
    run = Simplification((vertices - center) / size, faces, 0.5, POINT_WEIGHT)
    offsets = (caps.offsets - caps.normals @ center) / size
    bounds = (caps.planes, locked, np.ascontiguousarray(caps.normals), offsets)
    scratch, first = np.zeros((8, 3)), len(faces)

    def one_pass(before: int, progress: Progress) -> None:
        """Process every edge once, and changed edges again, until the heap is empty."""
        heap = run.empty_heap(3 * before, OPTIMAL_HEAP_COLUMNS)
        push_edges(run.mesh, bounds, heap, run.counts, scratch)

        def collapse(heap: Heap) -> int:
            state: int = collapse_edges(
                run.mesh, bounds, heap, run.counts, tuple(LIMITS), scratch, target, EDGES_PER_CALL
            )
            left = run.faces_left
            share = (before - left) / max(before - target, 1)
            progress.update(min(share, 1.0), f"{left} of {first} faces left")
            return state

        run.run(heap, collapse)

    while True:
        before = run.faces_left
        one_pass(before, progress.span(min((first - before) / (first - target), 1.0), 1.0))
        # Refused collapses may be allowed now that their surroundings have changed.
        if run.faces_left <= target or run.faces_left == before:
            break
    moved = run.stamps > 0
    result = np.where(moved[:, None], run.points * size + center, vertices)
    result, kept, _ = compacted(result, run.faces())
    progress.update(1.0, f"{len(kept)} faces left")
    return DecimationResult(result, kept, len(kept) <= target)


def _on_boundary(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the vertices at boundary edges, (v,) bool; reject what is no oriented manifold."""
    begin, end = half_edges(faces)
    forward, backward = np.sort(begin * count + end), end * count + begin
    position = np.minimum(np.searchsorted(forward, backward), len(forward) - 1)
    if (forward[1:] == forward[:-1]).any() or (begin == end).any():
        raise MeshingError(
            "Only an oriented manifold can be decimated.",
            "Send the job folder's log.txt with a bug report.",
        )
    return vertices_of_half_edges(forward[position] != backward, faces, count)


# -- Flip edges of a coarse closed mesh to approximate the dense mesh that it was simplified from
#
# Half-edge collapses leave the edges in arbitrary directions. Flipping some of them lowers the
# surface error of an adaptive mesh by a tenth, with the same vertices.

PASSES = 6  # nearly all flips happen in the first two; the third and fourth find a few more

LEAST_GAIN = 0.02
"""Share of the error of two triangles that a flip must save; below it, rounding would decide."""

FLAT_HEIGHT = 1e-4  # errors below this share of the edges are ignored: flat parts are not changed


def flip_edges(
    vertices: np.ndarray, faces: np.ndarray, dense_vertices: np.ndarray, dense_faces: np.ndarray,
    longest: float, movable: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Flip edges while that brings the faces closer to a dense mesh of the same surface.

    Vertices, genus and parts do not change; no face turns over or becomes narrow. The error of a
    triangle is computed from the heights of the surface over the midpoints of its edges, with a
    quadratic model of the surface.

    ``vertices`` (v, 3) lie on the dense mesh; ``faces`` (f, 3), a closed 2-manifold, and
    ``dense_faces`` are oriented alike; ``longest`` is the greatest length of a new edge.
    ``movable``: (f,) bool, for a part of a mesh: faces that may change; all faces at their corners
    are given. Returns (f, 3) int64.
    """
    faces = np.array(faces, np.int64)
    if len(faces) == 0 or len(dense_faces) == 0:
        return faces
    low, high = dense_vertices.min(0), dense_vertices.max(0)
    # Relative to the mesh: far from the origin nearest points would be rounded.
    points = vertices - (low + high) / 2
    surface = _SurfaceHeights(points, dense_vertices - (low + high) / 2, dense_faces)
    for _ in range(PASSES):
        if _one_pass(points, faces, surface, longest, movable) == 0:
            break
    return faces


class _SurfaceHeights:
    """Heights of the surface over the midpoints of edges, each computed once."""

    def __init__(self, points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._points, self._count = points, len(points)
        self._vertices = np.ascontiguousarray(vertices, np.float64)
        self._faces = np.ascontiguousarray(faces, np.int64)
        self._normals, _ = normals_and_areas(self._vertices, self._faces)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        self._keys = np.zeros(0, np.int64)
        self._heights, self._up = np.zeros(0), np.zeros((0, 3))

    def over(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return heights (k,), negative inside, and normals (k, 3) of the surface there."""
        wanted = edge_keys(a, b, self._count)
        fresh = np.setdiff1d(wanted, self._keys)
        if len(fresh):
            middle = (self._points[fresh // self._count] + self._points[fresh % self._count]) / 2
            _, face, nearest = self._tree.squared_distance(self._vertices, self._faces, middle)
            up, away = self._normals[face], middle - nearest
            height = np.copysign(np.linalg.norm(away, axis=1), (away * up).sum(1))
            keys = np.concatenate([self._keys, fresh])
            order = np.argsort(keys, kind="stable")
            self._keys = keys[order]
            self._heights = np.concatenate([self._heights, height])[order]
            self._up = np.concatenate([self._up, up])[order]
        at = np.searchsorted(self._keys, wanted)
        return self._heights[at], self._up[at]


def _one_pass(
    points: np.ndarray, faces: np.ndarray, surface: _SurfaceHeights, longest: float,
    movable: np.ndarray | None,
) -> int:  # fmt: skip
    """Flip the best edges, no two in the same face, in place; return their number."""
    # Half-edge 3 f + k leads from corner k of face f to the next, opposite the third.
    count = len(points)
    start, end, tip = (np.roll(faces, -k, 1).ravel() for k in range(3))
    forward, backward = start * count + end, end * count + start
    order = np.argsort(forward)
    twin = order[np.minimum(np.searchsorted(forward[order], backward), len(order) - 1)]
    one = np.flatnonzero(start < end)
    if movable is not None:
        one = one[forward[twin[one]] == backward[one]]
        one = one[movable[one // 3] & movable[twin[one] // 3]]
    other = twin[one]
    a, b, c, d = start[one], end[one], tip[one], tip[other]

    # Cheap tests first: shapes of the two new faces, and that their edge does not exist yet.
    normal_1, area_1, round_1 = _shapes(points, a, b, c)
    normal_2, area_2, round_2 = _shapes(points, b, a, d)
    normal_3, area_3, round_3 = _shapes(points, a, d, c)
    normal_4, area_4, round_4 = _shapes(points, d, b, c)
    up = normal_1 * area_1[:, None] + normal_2 * area_2[:, None]
    up /= np.maximum(np.linalg.norm(up, axis=1), 1e-300)[:, None]
    least = np.minimum(LEAST_ROUNDNESS, np.minimum(round_1, round_2))
    allowed = np.minimum(round_3, round_4) >= least
    for normal in (normal_3, normal_4):
        allowed &= (normal * up).sum(1) > LEAST_COSINE
    allowed &= (normal_3 * normal_4).sum(1) > 0.0
    allowed &= np.linalg.norm(points[c] - points[d], axis=1) <= longest
    edges = edge_keys(a, b, count) if movable is None else edge_keys(start, end, count)
    allowed &= ~np.isin(edge_keys(c, d, count), edges)

    rows = np.flatnonzero(allowed)
    one, other, a, b, c, d = (x[rows] for x in (one, other, a, b, c, d))
    across, there = surface.over(c, d)
    along, bc, ca = surface.over(a, b)[0], surface.over(b, c)[0], surface.over(c, a)[0]
    ad, db = surface.over(a, d)[0], surface.over(d, b)[0]
    before = _error(area_1[rows], along, bc, ca) + _error(area_2[rows], along, ad, db)
    after = _error(area_3[rows], ad, across, ca) + _error(area_4[rows], db, bc, across)
    flat = FLAT_HEIGHT * (area_1 + area_2)[rows] ** 1.5
    # Where the nearest surface is the far side of a thin wall, the height is unknown.
    good = (after < (1.0 - LEAST_GAIN) * before) & (before > flat)
    good &= (there * up[rows]).sum(1) > LEAST_COSINE
    best = np.flatnonzero(good)
    best = best[np.argsort((after - before)[best], kind="stable")]
    keys, number = np.unique(edge_keys(c, d, count)[best], return_inverse=True)
    best = best[_independent(one[best] // 3, other[best] // 3, number, len(faces), len(keys))]
    a, b, c, d = a[best], b[best], c[best], d[best]
    faces[one[best] // 3] = np.stack([a, d, c], 1)
    faces[other[best] // 3] = np.stack([d, b, c], 1)
    return len(best)


def _shapes(
    points: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit normals, areas, and twice the area over the longest edge squared."""
    first, second = points[b] - points[a], points[c] - points[a]
    cross = np.cross(first, second)
    length = np.linalg.norm(cross, axis=1)
    longest = np.maximum((first**2).sum(1), (second**2).sum(1))
    longest = np.maximum(longest, ((second - first) ** 2).sum(1))
    normal = cross / np.maximum(length, 1e-300)[:, None]
    return normal, length / 2, length / np.maximum(longest, 1e-300)


def _error(area: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the area times the root mean square height of ``4 (x l1 l2 + y l2 l3 + z l3 l1)``.

    That is the quadratic surface through the corners, with these heights over the midpoints of the
    edges; l are barycentric coordinates, and the mean of (4 l1 l2)^2 is 8 / 45.
    """
    return area * np.sqrt(8.0 / 45.0 * (x * x + y * y + z * z + x * y + y * z + z * x))


@kernel(fast=False)
def _independent(faces_1, faces_2, edge, face_count, edge_count):  # type: ignore[no-untyped-def]
    """Select flips in order, such that no face and no new edge is used twice."""
    locked, made = np.zeros(face_count, np.bool_), np.zeros(edge_count, np.bool_)
    taken = np.zeros(len(faces_1), np.bool_)
    for i in range(len(faces_1)):
        if locked[faces_1[i]] or locked[faces_2[i]] or made[edge[i]]:
            continue
        locked[faces_1[i]], locked[faces_2[i]], made[edge[i]] = True, True, True
        taken[i] = True
    return taken
