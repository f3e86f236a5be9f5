# SPDX-License-Identifier: GPL-3.0-or-later
"""Volume-preserving Taubin smoothing of closed meshes; off by default."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from ...mesh.components import face_components, volumes_and_areas
from ...mesh.topology import area_vectors, faces_per_edge, half_edges, vertices_of_half_edges
from ...progress import Progress
from ...regions.cap_planes import CapPlanes, cap_planes
from ...regions.convex_region import Region

SHRINK = 0.5
"""Share of the way to the mean of the neighbours in the first half of a step."""

GROW = -1.0 / (2.0 - 0.1)
"""Share of the second half: it undoes the shrinking of waves longer than about ten edges (the pass
band of Taubin's filter, 1 / SHRINK + 1 / GROW = 0.1)."""

MAX_TURN_COS = 0.5
"""A move that would turn a face by more than 60 degrees from its initial normal is not made at its
corners: no folds arise, and wires of three or four faces around are not crushed."""

MIN_AREA_SHARE = 0.2
"""The same for a face that would be left with less than this share of its initial area."""

VOLUME_ROUNDS = 5
"""Newton steps along the normals that restore the volume of each part."""

MAX_VOLUME_CHANGE = 0.01
"""A part whose volume cannot be restored to 1 % is not smoothed: it has too few faces for its
shape, and the filter would crush it."""


def smooth(
    vertices: np.ndarray,
    faces: np.ndarray,
    steps: int,
    progress: Progress,
    *,
    region: Region | None = None,
) -> np.ndarray:
    """Return smoothed positions, (v, 3) float64; the faces are unchanged.

    Taubin's lambda-mu filter, with neighbours weighted by inverse distance so that uneven spacing
    does not drift. The volume of each part is restored afterwards; parts where that fails keep
    their original positions. Vertices on the region's faces stay on them, vertices at open edges do
    not move, and none leaves the region.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
        Oriented 2-manifold, every vertex used.
    steps : int
        0 changes nothing.
    region : Region, optional
        The region that the mesh was made in, same frame.

    Raises
    ------
    Cancelled
        Through ``progress``.
    """
    vertices = np.asarray(vertices, np.float64)
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    if steps <= 0 or len(faces) == 0:
        return vertices.copy()
    caps = cap_planes(vertices, region)
    origin = vertices[faces].mean((0, 1))
    points = vertices - origin
    limits = caps.offsets - caps.normals @ origin
    free = ~(caps.fixed | _at_open_edges(faces, len(points)))
    weights = _neighbour_weights(points, faces)
    count, part = face_components(len(points), faces)
    volume, _ = volumes_and_areas(points, faces, part, count)
    first = area_vectors(points, faces)
    for step in range(steps):
        progress.update(step / steps, f"smoothing, step {step + 1} of {steps}")
        for share in (SHRINK, GROW):
            move = share * (weights @ points - points) * free[:, None]
            points = _safe_move(points, faces, first, move, caps, limits)
    for _ in range(VOLUME_ROUNDS):
        move = _volume_move(points, faces, part, count, volume, caps, free)
        points = _safe_move(points, faces, first, move, caps, limits)
    now, _ = volumes_and_areas(points, faces, part, count)
    crushed = np.abs(now - volume) > MAX_VOLUME_CHANGE * np.abs(volume)
    back = np.unique(faces[crushed[part]])
    points[back] = vertices[back] - origin
    # Vertices that were not moved keep their exact coordinates.
    still = (points == vertices - origin).all(1)
    return np.asarray(np.where(still[:, None], vertices, points + origin))


def _neighbour_weights(points: np.ndarray, faces: np.ndarray) -> csr_matrix:
    """Return (v, v) weights of neighbours by inverse distance; rows sum to 1."""
    begin, end = half_edges(faces)
    rows, columns = np.concatenate([begin, end]), np.concatenate([end, begin])
    length = np.linalg.norm(points[rows] - points[columns], axis=1)
    shortest = 1e-3 * length.mean()  # a needle's short edge must not outweigh everything
    weight = 1.0 / np.maximum(length, max(shortest, 1e-300))
    total = np.bincount(rows, weights=weight, minlength=len(points))
    shape = (len(points), len(points))
    return csr_matrix((weight / total[rows], (rows, columns)), shape=shape)


def _at_open_edges(faces: np.ndarray, count: int) -> np.ndarray:
    return vertices_of_half_edges(faces_per_edge(faces, count) == 1, faces, count)


def _safe_move(
    points: np.ndarray,
    faces: np.ndarray,
    first: np.ndarray,
    move: np.ndarray,
    caps: CapPlanes,
    limits: np.ndarray,
) -> np.ndarray:
    """Move vertices, except where a face would turn or shrink too far, or leave the region.

    A vertex that is held back may spoil another face, so the check is repeated until no face is
    bad; in the worst case nothing moves.

    Parameters
    ----------
    first : (f, 3) float64
        Area vectors of the faces before any move.
    limits : (k,) float64
        Offsets of the region's planes in the frame of ``points``.
    """
    moved = points + _in_planes(move, caps)
    for number, (normal, limit) in enumerate(zip(caps.normals, limits, strict=True)):
        beyond = (moved @ normal > limit) & ~(caps.planes == number).any(1)
        moved[beyond] = points[beyond]
    size = np.linalg.norm(first, axis=1)
    while True:
        after = area_vectors(moved, faces)
        length = np.linalg.norm(after, axis=1)
        bad = (first * after).sum(1) < MAX_TURN_COS * size * length
        bad |= length < MIN_AREA_SHARE * size
        corners = np.unique(faces[bad])
        back = corners[(moved[corners] != points[corners]).any(1)]
        if len(back) == 0:
            return moved
        moved[back] = points[back]


def _in_planes(move: np.ndarray, caps: CapPlanes) -> np.ndarray:
    """Project each move onto the planes that its vertex lies on."""
    result = move.copy()
    count = (caps.planes >= 0).sum(1)
    one = np.flatnonzero(count == 1)
    normals = caps.normals[caps.planes[one, 0]]
    result[one] -= (result[one] * normals).sum(1)[:, None] * normals
    two = np.flatnonzero(count == 2)
    along = np.cross(caps.normals[caps.planes[two, 0]], caps.normals[caps.planes[two, 1]])
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
    result[two] = (result[two] * along).sum(1)[:, None] * along
    result[count > 2] = 0.0
    return result


def _volume_move(
    points: np.ndarray,
    faces: np.ndarray,
    part: np.ndarray,
    count: int,
    volume: np.ndarray,
    caps: CapPlanes,
    free: np.ndarray,
) -> np.ndarray:
    """Return moves along the normals that restore the volume of each part, to first order."""
    gradient = np.zeros_like(points)  # of the volume, (v, 3)
    vectors = area_vectors(points, faces) / 6.0
    for k in range(3):
        np.add.at(gradient, faces[:, k], vectors)
    length = np.maximum(np.linalg.norm(gradient, axis=1), 1e-300)[:, None]
    move = _in_planes(gradient / length * free[:, None], caps)
    owner = np.zeros(len(points), np.int64)
    owner[faces] = part[:, None]
    slope = np.bincount(owner, weights=(gradient * move).sum(1), minlength=count)
    now, _ = volumes_and_areas(points, faces, part, count)
    with np.errstate(divide="ignore", invalid="ignore"):
        step = np.where(slope > 0.0, (volume - now) / slope, 0.0)
    return move * step[owner][:, None]
