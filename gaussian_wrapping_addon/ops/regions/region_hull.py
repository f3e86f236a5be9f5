# SPDX-License-Identifier: GPL-3.0-or-later
"""Convex hull of any mesh in bounded time: points that cannot be corners are dropped first."""

from __future__ import annotations

import bmesh
import numpy as np

from ...core.errors import UsageError

# Points whose hull takes about a second.
MOST_CANDIDATES = 40_000
# After the first round: of more, too many would be left after the second one too.
MOST_HIDDEN = 10 * MOST_CANDIDATES
# Hulls of fewer points are computed directly.
FEW = 4_000
# Directions, one number a round, whose furthest points span the solid that hides the others.
ROUNDS = (64, 400)
# Share of the extent by which a point left out may lie outside that solid; float32 knows no better.
INSIDE_SHARE = 1e-6
_CHUNK = 8_192

Triangles = list[tuple[int, int, int]]


def convex_hull(points: np.ndarray, name: str) -> tuple[np.ndarray, Triangles]:
    """Return the convex hull of points.

    Parameters
    ----------
    points : (n, 3) float64
    name : str
        Of the object, for messages.

    Returns
    -------
    vertices : (k, 3) float64
    triangles : list of index triples

    Raises
    ------
    UsageError
        The points enclose no volume, are not finite, or too many of them may be corners.
    """
    if len(points) < 4:
        raise UsageError(f"Region {name} has {len(points)} vertices.", "Use a box or a solid.")
    if not np.isfinite(points).all():
        raise UsageError(f"Region {name} has a position that is not finite.", "Remove it.")
    middle = 0.5 * (points.min(0) + points.max(0))
    candidates = (points - middle).astype(np.float32)  # as they come from a mesh
    for count in ROUNDS:
        # The second round is for shapes that it can bring below the limit.
        if not FEW < len(candidates) <= (MOST_HIDDEN if count == ROUNDS[-1] else np.inf):
            break
        candidates = _without_hidden(candidates, count)
    if len(candidates) > MOST_CANDIDATES:
        raise UsageError(
            f"The shape of {name} is too fine for a region: {len(candidates):,} of its "
            f"{len(points):,} vertices lie on its hull or nearly so.",
            "Add a Decimate modifier, or use a box: Add Region Box > Around Selected.",
        )
    vertices, triangles = _hull(candidates)
    if not triangles:
        raise UsageError(f"Region {name} is flat.", "Give it a thickness.")
    return vertices + middle, triangles


def _without_hidden(points: np.ndarray, count: int) -> np.ndarray:
    """Return the points without those in the hull of the furthest ones in many directions."""
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(3, count)).astype(np.float32)  # lengths do not matter
    best = np.full(count, -np.inf, np.float32)
    furthest = np.zeros(count, np.int64)
    for begin in range(0, len(points), _CHUNK):
        reach = points[begin : begin + _CHUNK] @ directions  # (chunk, count)
        first = reach.argmax(0)
        top = reach[first, np.arange(count)]
        furthest = np.where(top > best, first + begin, furthest)
        best = np.maximum(top, best)
    furthest = np.unique(furthest)
    corners, triangles = _hull(points[furthest])
    if not triangles:
        return points
    sides = corners[np.array(triangles)]  # (m, 3, 3)
    normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])  # (m, 3)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    good = lengths[:, 0] > 0.0
    normals, sides = normals[good] / lengths[good], sides[good]
    inwards = ((corners.mean(0) - sides[:, 0]) * normals).sum(1) > 0.0  # either winding comes
    normals[inwards] *= -1.0
    levels = (normals * sides[:, 0]).sum(1) + INSIDE_SHARE * float(np.ptp(corners, 0).max())
    normals, levels = normals.T.astype(np.float32), levels.astype(np.float32)
    kept = np.zeros(len(points), bool)
    for begin in range(0, len(points), _CHUNK):
        part = points[begin : begin + _CHUNK]
        kept[begin : begin + _CHUNK] = (part @ normals > levels).any(1)
    kept[furthest] = True
    return points[kept]


def _hull(points: np.ndarray) -> tuple[np.ndarray, Triangles]:
    """Return Blender's convex hull, without triangles where the points are flat."""
    work = bmesh.new()
    try:
        for point in points.tolist():
            work.verts.new(point)
        bmesh.ops.convex_hull(work, input=work.verts[:], use_existing_faces=False)
        used = {vertex for face in work.faces for vertex in face.verts}
        bmesh.ops.delete(work, geom=[v for v in work.verts if v not in used], context="VERTS")
        bmesh.ops.triangulate(work, faces=work.faces[:])
        work.verts.index_update()
        vertices = np.array([v.co[:] for v in work.verts], np.float64).reshape(-1, 3)
        triangles = [tuple(v.index for v in face.verts) for face in work.faces]
    finally:
        work.free()
    return vertices, triangles  # type: ignore[return-value]
