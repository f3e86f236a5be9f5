# SPDX-License-Identifier: GPL-3.0-or-later
"""Small handles, open boundaries, smoothing."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ..errors import MeshingError
from ..field.isosurface_projection import isosurface_residuals
from ..mesh.components import (
    compacted,
    connected,
    face_components,
    volumes_and_areas,
    without_floaters,
)
from ..mesh.simplification import decimate
from ..mesh.surface_mesh import (
    SurfaceMesh,
    area_vectors,
    edge_keys,
    edge_lengths,
    faces_per_edge,
    half_edges,
    next_half_edges,
    normals_and_areas,
    vertices_of_half_edges,
)
from ..progress import Progress, ReportWarning
from ..regions.scene_regions import ON_PLANE_SHARE, CapPlanes, cap_planes
from ..regions.shapes import Region
from ..settings import MeshingSettings
from .repair import SEPARATION_SHARE

# -- Close handles below the mesh's resolution by replacing the patch around each by a disc -------

BOX_EDGES = (2.0, 3.0, 4.5)
"""Sides of the boxes that are searched for handles, in edge lengths of the mesh, in increasing
order. Both loops of a handle, through it and around it, must lie in one box: a tube is no handle
there, nor is an opening wider than the box. A handle of half the last side is found wherever it
lies, a larger one only where a box happens to contain it."""

MAX_MOVE_EDGES = 2.25
"""Greatest distance, in edge lengths, of a removed vertex from the disc that replaces the patch,
half of the largest box: anything farther away is a structure of its own, not noise."""

MAX_LOOP_EDGES = 60
"""Patches with a longer boundary are skipped: the disc would not follow the surface."""

THIN = 1e-6
"""A triangle whose area is a smaller share of its squared side is degenerate: points on the
region's boundary can be collinear."""

MAX_PASSES = 8


class HandleClosure(NamedTuple):
    """Result of :func:`without_small_handles`."""

    faces: np.ndarray  # (g, 3) int64
    closed: int  # handles that were closed
    left: int
    """Small handles that could not be closed without cutting something else; there may be more that
    no box happens to contain."""


def without_small_handles(
    vertices: np.ndarray, faces: np.ndarray, edge_length: float
) -> HandleClosure:
    """Replace patches with handles in small boxes by discs with the same boundary.

    Such handles are below the mesh's resolution: noise of the isosurface or of the labels of thin
    tetrahedra. Vertices are neither moved nor added. A patch with more than one boundary loop is
    kept, since discs would cut what passes through it.

    ``vertices`` (v, 3), ``faces`` (f, 3): closed 2-manifold, consistently oriented; ``edge_length``
    is that of the final mesh, scene units.
    """
    faces = np.asarray(faces, np.int64)
    parts, _ = face_components(len(vertices), faces)
    euler = len(np.unique(faces)) - len(faces) // 2
    if (2 * parts - euler) // 2 == 0:  # total genus
        return HandleClosure(faces, 0, 0)
    closed, shifts = 0, [np.array(shift) for shift in product((0.0, 0.5), repeat=3)]
    for share in BOX_EDGES:
        for _ in range(MAX_PASSES):
            before = closed
            for shift in shifts:
                faces, count = _close_in_grid(vertices, faces, share, edge_length, shift)
                closed += count
            if closed == before:
                break
    side = BOX_EDGES[-1] * edge_length
    left = [int(_patches(vertices, faces, side, shift)[1].sum()) for shift in shifts]
    return HandleClosure(faces, closed, max(0, *left))


def _close_in_grid(
    vertices: np.ndarray, faces: np.ndarray, share: float, edge_length: float, shift: np.ndarray
) -> tuple[np.ndarray, int]:
    """Close the handles in the boxes of one grid; return the faces and the number of handles."""
    patch, handles, loops = _patches(vertices, faces, share * edge_length, shift)
    chosen = np.flatnonzero((handles > 0) & (loops == 1))
    if len(chosen) == 0:
        return faces, 0
    count = len(vertices)
    keys = np.sort(_edge_keys(faces, count))
    order = np.argsort(patch, kind="stable")
    bounds = np.searchsorted(patch[order], np.stack([chosen, chosen + 1], axis=1))
    kept = np.ones(len(faces), np.bool_)
    covers: list[np.ndarray] = []
    covered: set[int] = set()
    closed = 0
    for label, (first, last) in zip(chosen.tolist(), bounds.tolist(), strict=True):
        rows = order[first:last]
        loop = _boundary_loop(faces[rows])
        if loop is None or len(loop) > MAX_LOOP_EDGES:
            continue
        pairs = edge_keys(loop[:, None], loop[None, :], count)  # (n, n)
        forbidden = keys[np.minimum(np.searchsorted(keys, pairs), len(keys) - 1)] == pairs
        forbidden &= ~np.isin(pairs, _edge_keys(faces[rows], count))
        forbidden |= np.array([[key in covered for key in row] for row in pairs.tolist()])
        cover = _least_area_triangles(vertices[loop], loop, forbidden)
        if cover is None:
            continue
        gone = np.setdiff1d(faces[rows], loop)
        if _farthest(vertices[gone], vertices[cover]) > MAX_MOVE_EDGES * edge_length:
            continue
        kept[rows] = False
        covers.append(cover)
        covered.update(_edge_keys(cover, count).tolist())
        closed += int(handles[label])
    return np.concatenate([faces[kept], *covers]), closed


def _farthest(points: np.ndarray, triangles: np.ndarray) -> float:
    """Return the largest distance of points (n, 3) to the centroids and corners of (t, 3, 3)."""
    if len(points) == 0:
        return 0.0
    near = np.concatenate([triangles.mean(1), triangles.reshape(-1, 3)])
    return float(cKDTree(near).query(points)[0].max())


def _patches(
    vertices: np.ndarray, faces: np.ndarray, side: float, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Group adjacent faces whose centroids lie in the same box.

    Returns the patch of each face, (f,) int64, and for each patch its genus, 0 also where the
    boundary touches itself, and its number of boundary loops.
    """
    middle = vertices[faces].mean(1)
    box = np.floor((middle - middle.min(0)) / side + shift).astype(np.int64)  # (f, 3)
    size = box.max(0) + 1
    box_id = (box[:, 0] * size[1] + box[:, 1]) * size[2] + box[:, 2]
    count = len(vertices)
    begin, end = half_edges(faces)
    order = np.argsort(edge_keys(begin, end, count), kind="stable")
    # A closed 2-manifold: edges come in pairs.
    one, two = order[0::2] // 3, order[1::2] // 3  # (e,) faces beside each edge
    same = box_id[one] == box_id[two]
    number, label = connected(one[same], two[same], len(faces))
    label = label.astype(np.int64)
    # Edges inside a patch and on its boundary; an edge between two patches belongs to both.
    low, high = begin[order[0::2]], end[order[0::2]]
    between = label[one] != label[two]
    outline = count * np.concatenate([label[one[between]], label[two[between]]])
    corner = np.unique(np.repeat(label, 3) * count + begin)
    euler = np.bincount(corner // count, minlength=number) + np.bincount(label, minlength=number)
    euler -= np.bincount(np.append(label[one], label[two[between]]), minlength=number)
    ends = np.append(outline + np.tile(low[between], 2), outline + np.tile(high[between], 2))
    nodes, index, degree = np.unique(ends, return_inverse=True, return_counts=True)
    low_end, high_end = index.reshape(2, -1)
    loop_count, loop_label = connected(low_end, high_end, len(nodes))
    loop_patch = np.zeros(loop_count, np.int64)
    loop_patch[loop_label] = nodes // count
    loops = np.bincount(loop_patch, minlength=number)
    touching = np.bincount(nodes[degree != 2] // count, minlength=number) > 0
    # A patch without a boundary is a whole small part: its handles are small as well, but no disc
    # can replace it.
    handles = np.where(touching | (loops == 0), 0, (2 - euler - loops) // 2)
    return label, handles, loops


def _edge_keys(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the edge keys of all half-edges, (3f,) int64."""
    return edge_keys(*half_edges(faces), count)


def _boundary_loop(faces: np.ndarray) -> np.ndarray | None:
    """Return the boundary vertices of a patch in the order of its half-edges, (n,) int64."""
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()
    pairs = {(a, b) for a, b in half}
    following = {a: b for a, b in half if (b, a) not in pairs}
    start = next(iter(following))
    loop = [start]
    while (after := following[loop[-1]]) != start:
        loop.append(after)
        if len(loop) > len(following):
            return None
    return np.array(loop, np.int64) if len(loop) == len(following) else None


def _least_area_triangles(
    points: np.ndarray, loop: np.ndarray, forbidden: np.ndarray
) -> np.ndarray | None:
    """Return the triangles of least area that span a loop, (n - 2, 3), or None.

    Dynamic programming over the loop's sub-polygons, O(n^3). ``forbidden`` (n, n) are the pairs
    that must not be joined, since the mesh has that edge elsewhere.
    """
    count = len(loop)
    cost = np.full((count, count), np.inf)
    split = np.full((count, count), -1, np.int64)
    cost[np.arange(count - 1), np.arange(1, count)] = 0.0
    for gap in range(2, count):
        for i in range(count - gap):
            j = i + gap
            if gap < count - 1 and forbidden[i, j]:
                continue
            middle = np.arange(i + 1, j)
            arms = np.cross(points[middle] - points[i], points[j] - points[i])
            areas = np.linalg.norm(arms, axis=1)
            thin = areas <= THIN * ((points[middle] - points[i]) ** 2).sum(1)
            total = cost[i, middle] + cost[middle, j] + np.where(thin, np.inf, areas)
            best = int(np.argmin(total))
            cost[i, j], split[i, j] = total[best], middle[best]
    if not np.isfinite(cost[0, count - 1]):
        return None
    triangles, waiting = [], [(0, count - 1)]
    while waiting:
        i, j = waiting.pop()
        if j - i >= 2:
            k = int(split[i, j])
            triangles.append((i, k, j))
            waiting += [(i, k), (k, j)]
    return loop[np.array(triangles, np.int64)]


# -- Open a closed mesh where its region cuts the solid, by removing the caps ---------------------

MOVED_SHARE = 1.5 * SEPARATION_SHARE
"""A vertex moved by the repair may be off its plane by this share of its face's longest edge."""

ALONG_COSINE = 0.9
"""A face with such a vertex belongs to a cap only if its normal agrees with the plane's: least
cosine."""


def without_caps(
    mesh: SurfaceMesh, region: Region, min_component_share: float = 0.0
) -> SurfaceMesh:
    """Remove the caps: the faces that close a mesh at the region's boundary.

    The result is consistently oriented and manifold, with boundary edges on the region's planes
    alone. A solid may fall into pieces; small ones are removed like floaters. ``provenance`` counts
    the removed faces, the removed pieces and the remaining parts.

    ``mesh`` is a closed 2-manifold, made in ``region``; ``min_component_share`` is as for
    :func:`~.components.without_floaters`: 0 keeps every piece.
    Raises MeshingError: no faces remain: the region lies within a solid.
    """
    vertices, faces = mesh.vertices.copy(), np.asarray(mesh.faces, np.int64)
    on_cap = np.zeros(len(faces), np.bool_)
    tolerance = ON_PLANE_SHARE * region.diagonal
    on_any = (cap_planes(vertices, region).planes >= 0).any(1)  # (v,)
    for normal, offset in zip(*region.half_spaces, strict=True):
        distance = (vertices - region.center) @ normal - offset  # (v,)
        cap = _cap_faces(vertices, faces, normal, distance, on_any, tolerance)
        # Rim vertices moved by the repair are projected back onto the plane. Those on another plane
        # stay there: between the planes of a round region they would leave it.
        rim = np.unique(faces[cap])
        rim = rim[~on_any[rim]]
        vertices[rim] -= distance[rim, None] * normal
        vertices[rim] = _within(vertices[rim], region)
        on_cap |= cap
    stays = faces[~on_cap]
    if len(stays) == 0:
        raise MeshingError(
            f"Region {region.name!r} lies within a solid: with an open boundary nothing is left.",
            "Draw the region around a surface, or keep the boundary closed.",
        )
    split, source = split_fans(stays)
    pieces = without_floaters(vertices[source], split, min_component_share)
    vertices, split, _ = compacted(vertices[source], pieces.faces)
    rim = (cap_planes(vertices, region).planes >= 0).any(1)
    counted = {
        "boundary": "open",
        "cap_faces_left_out": int(on_cap.sum()),
        "components": pieces.kept,
        "removed_open_pieces": pieces.removed,
        "removed_open_area_share": pieces.removed_area_share,
        "vertices_on_region_boundary": int(rim.sum()),
    }
    return SurfaceMesh(vertices, split.astype(np.int32), {**mesh.provenance, **counted})


def _within(points: np.ndarray, region: Region) -> np.ndarray:
    """Project points (n, 3) just outside a region onto the plane that they crossed."""
    normals, offsets = region.half_spaces
    points = points.copy()
    for _ in range(len(normals)):
        beyond = (points - region.center) @ normals.T - offsets  # (n, k)
        worst = beyond.argmax(1)
        out = beyond[np.arange(len(points)), worst]
        left = out > ON_PLANE_SHARE * region.diagonal
        if not left.any():
            break
        points[left] -= out[left, None] * normals[worst[left]]
    return points


def _cap_faces(
    vertices: np.ndarray, faces: np.ndarray, normal: np.ndarray, distance: np.ndarray,
    on_any: np.ndarray, tolerance: float,
) -> np.ndarray:  # fmt: skip
    """Return which faces lie on one plane of the region, (f,) bool.

    A face with a corner moved by the repair counts, unless other corners lie on other planes.
    """
    exact = np.abs(distance) <= tolerance  # (v,)
    cap = exact[faces].all(1)
    own = (exact | ~on_any)[faces].all(1)
    near = np.flatnonzero(exact[faces].any(1) & ~cap & own)
    longest = edge_lengths(vertices, faces[near]).max(1)
    unit, _ = normals_and_areas(vertices, faces[near])
    close = np.abs(distance[faces[near]]).max(1) <= MOVED_SHARE * longest
    cap[near[close & (unit @ normal >= ALONG_COSINE)]] = True
    return cap


def split_fans(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split vertices so that each fan of faces has its own; edges may have one or two faces.

    Returns (f, 3) faces of new vertices, and the old vertex of each new one, (w,) int64.
    """
    keys = _edge_keys(faces, int(faces.max()) + 1)
    order = np.argsort(keys, kind="stable")
    same = keys[order[1:]] == keys[order[:-1]]
    first, second = order[:-1][same], order[1:][same]  # half-edges of one edge, opposite ways
    rows, columns = np.r_[first, next_half_edges(first)], np.r_[next_half_edges(second), second]
    _, label = connected(rows, columns, faces.size)
    _, first_corner, number = np.unique(label, return_index=True, return_inverse=True)
    return number.reshape(-1, 3), faces.reshape(-1)[first_corner]


# -- Volume-preserving Taubin smoothing of closed meshes; off by default --------------------------

SHRINK = 0.5  # share of the way to the mean of the neighbours in the first half of a step

GROW = -1.0 / (2.0 - 0.1)
"""Share of the second half: it undoes the shrinking of waves longer than about ten edges (the pass
band of Taubin's filter, 1 / SHRINK + 1 / GROW = 0.1)."""

MAX_TURN_COS = 0.5
"""A move that would turn a face by more than 60 degrees from its initial normal is not made at its
corners: no folds arise, and wires of three or four faces around are not crushed."""

MIN_AREA_SHARE = 0.2
"""The same for a face that would be left with less than this share of its initial area."""

VOLUME_ROUNDS = 5  # Newton steps along the normals that restore the volume of each part

MAX_VOLUME_CHANGE = 0.01
"""A part whose volume cannot be restored to 1 % is not smoothed: it has too few faces for its
shape, and the filter would crush it."""


def smooth(
    vertices: np.ndarray, faces: np.ndarray, steps: int, progress: Progress, *,
    region: Region | None = None,
) -> np.ndarray:  # fmt: skip
    """Return smoothed positions, (v, 3) float64; the faces are unchanged.

    Taubin's lambda-mu filter, with neighbours weighted by inverse distance so that uneven spacing
    does not drift. The volume of each part is restored afterwards; parts where that fails keep
    their original positions. Vertices on the faces of the region that the mesh was made in stay on
    them, vertices at open edges do not move, and none leaves the region.

    ``vertices`` (v, 3), ``faces`` (f, 3): oriented 2-manifold, every vertex used.
    """
    vertices = np.asarray(vertices, np.float64)
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    if steps <= 0 or len(faces) == 0:
        return vertices.copy()
    caps = cap_planes(vertices, region)
    origin = vertices[faces].mean((0, 1))
    points = vertices - origin
    limits = caps.offsets - caps.normals @ origin
    open_edges = faces_per_edge(faces, len(points)) == 1
    free = ~(caps.fixed | vertices_of_half_edges(open_edges, faces, len(points)))
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


def _safe_move(
    points: np.ndarray, faces: np.ndarray, first: np.ndarray, move: np.ndarray, caps: CapPlanes,
    limits: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Move vertices, except where a face would turn or shrink too far, or leave the region.

    A vertex that is held back may spoil another face, so the check is repeated until no face is
    bad; in the worst case nothing moves. ``first`` (f, 3) are the area vectors of the faces before
    any move, ``limits`` (k,) the offsets of the region's planes in the frame of ``points``.
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
    points: np.ndarray, faces: np.ndarray, part: np.ndarray, count: int, volume: np.ndarray,
    caps: CapPlanes, free: np.ndarray,
) -> np.ndarray:  # fmt: skip
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


# -- Optional post-processing of a mesh: smoothing and decimation ---------------------------------

_logger = logging.getLogger(__name__)


class CleanUpResult(NamedTuple):
    """The processed mesh, and the one before decimation if it was decimated."""

    mesh: SurfaceMesh
    dense: SurfaceMesh | None


def clean_up(
    mesh: SurfaceMesh, region: Region, settings: MeshingSettings, vacancy: Any, progress: Progress
) -> CleanUpResult:
    """Smooth, then decimate, as the settings request; otherwise return the mesh unchanged.

    Both keep a closed 2-manifold closed and manifold, with its parts and their genus. They move
    vertices off the isosurface, so ``level_error_*`` of the provenance is measured again, at all
    vertices that are not on the region's boundary.

    ``mesh`` was made in ``region``; ``vacancy`` is a VacancyField, or any object with
    ``vacancy(points)``.
    """
    target, steps = settings.target_faces, settings.smooth_steps
    notes = list(mesh.provenance.get("notes", []))
    if steps == 0 and not 0 < target < len(mesh.faces):
        if target > 0:
            text = (
                f"The mesh has {len(mesh.faces)} faces, fewer than the {target} requested: "
                "nothing was decimated."
            )
            notes.append(ReportWarning("not-decimated", text).to_json())
            mesh = replace(mesh, provenance={**mesh.provenance, "notes": notes})
        return CleanUpResult(mesh, None)
    vertices, faces = mesh.vertices, np.asarray(mesh.faces, np.int64)
    if steps > 0:
        vertices = smooth(vertices, faces, steps, progress.span(0.0, 0.4), region=region)
    dense = None
    if 0 < target < len(faces):
        dense = SurfaceMesh(vertices, np.asarray(mesh.faces, np.int32))
        result = decimate(vertices, faces, target, progress.span(0.4, 0.9), region=region)
        vertices, faces = result.vertices, result.faces
        if not result.reached:
            text = (
                f"{len(faces)} faces are left of {len(mesh.faces)}, more than the "
                f"{target} requested: fewer would fold or tear the mesh."
            )
            notes.append(ReportWarning("more-faces-left", text).to_json())
        _logger.info("Decimated %d faces to %d", len(mesh.faces), len(faces))
    progress.update(0.9, "measuring the mesh")
    capped = (cap_planes(vertices, region).planes >= 0).any(1)
    provenance = {
        **mesh.provenance,
        "notes": notes,
        "smooth_steps": steps,
        "target_faces": target,
        "faces_before_clean_up": len(mesh.faces),
        **isosurface_residuals(vacancy, vertices[~capped]),
        "vertices_on_surface": int((~capped).sum()),
        "vertices_on_region_boundary": int(capped.sum()),
        "vertices_at_end_of_sight": 0,
        "vertices_moved_apart": 0,
    }
    progress.update(1.0, f"{len(faces)} faces")
    cleaned = SurfaceMesh(vertices, faces.astype(np.int32), provenance)
    return CleanUpResult(cleaned, dense if len(faces) < len(mesh.faces) else None)
