# SPDX-License-Identifier: GPL-3.0-or-later
"""Charts: made by xatlas in chunks, scaled and relaxed to the shape of the mesh."""

from __future__ import annotations

import heapq
import logging
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from ...compiled import kernel
from ...errors import DatasetError, MemoryShortageError, MeshingError, ResourceError, WorkerError
from ...mesh.components import FaceGraph, face_graph, uv_charts
from ...mesh.surface_mesh import area_vectors, half_edges
from ...progress import Progress
from ...worker.helper_process import run_helper
from .overlaps import find_overlaps, join_polygons, set_cut_apart, split_overlaps
from .packing_scale import (
    chart_bounds,
    packing_scale,
    packing_square,
    signed_areas,
    split_wide_charts,
)

# -- Texture stretch of an unwrap -----------------------------------------------------------------


COLLAPSED_UV_AREA = 1e-14
"""Faces with less area in UVs (a hundredth of a texel is 1e-10 at 8192) have no measurable
direction; the unwrap collapses flat ones to a point."""


@dataclass(frozen=True)
class Stretch:
    """L2 texture stretch: 1 if a texel covers as much surface as on average, in all directions.

    Root mean square over directions of the distance on the surface per unit step in the texture.
    """

    mean: float  # Mean over the surface
    p95: float  # 95th percentile over the surface
    collapsed_share: float  # Share of the surface that has no area in the texture


def texture_stretch(vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray) -> Stretch:
    """Measure the stretch of each face, weighted by its area (Sander and others, 2001).

    Raises
    ------
    MeshingError
        No face has an area in the texture.
    """
    corners = np.asarray(vertices, np.float64)[faces]  # (f, 3, 3)
    uvs = np.asarray(corner_uvs, np.float64)
    edge_one, edge_two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    uv_one, uv_two = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    areas = 0.5 * np.linalg.norm(np.cross(edge_one, edge_two), axis=1)
    double = uv_one[:, 0] * uv_two[:, 1] - uv_one[:, 1] * uv_two[:, 0]
    spread = 0.5 * np.abs(double) > COLLAPSED_UV_AREA
    if not spread.any():
        raise MeshingError("No face has an area in the texture.", "Mesh the region again.")
    inverse = 1.0 / double[spread, None]
    one, two = uv_one[spread], uv_two[spread]
    along_u = (edge_one[spread] * two[:, 1:] - edge_two[spread] * one[:, 1:]) * inverse
    along_v = (edge_two[spread] * one[:, :1] - edge_one[spread] * two[:, :1]) * inverse
    length = np.sqrt(0.5 * ((along_u**2).sum(axis=1) + (along_v**2).sum(axis=1)))
    weight = areas[spread]
    scale = np.sqrt(weight.sum() / (0.5 * np.abs(double[spread])).sum())
    stretch = length / scale
    order = np.argsort(stretch)
    running = np.cumsum(weight[order])
    at = int(np.searchsorted(running, 0.95 * running[-1]))
    return Stretch(
        float((weight * stretch).sum() / weight.sum()),
        float(stretch[order[min(at, len(order) - 1)]]),
        1.0 - float(weight.sum()) / float(areas.sum()),
    )


# -- Geometry of charts: smoothing of the mesh before charting, ARAP relaxation of charts ---------


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
    """Return vertices moved towards the mean of their neighbours, by at most half an edge.

    xatlas splits charts at noisy or badly shaped faces; smoothing reduces both.
    """
    start = np.asarray(vertices, np.float64)
    centre = start[faces].mean(axis=(0, 1))
    start = start - centre
    begin, end = half_edges(faces)
    rows, columns = np.concatenate([begin, end]), np.concatenate([end, begin])
    count = len(start)
    degree = np.bincount(rows, minlength=count)
    isolated, degree = degree == 0, np.maximum(degree, 1)
    length = np.linalg.norm(start[rows] - start[columns], axis=1)
    limit = MAX_MOVE_SHARE * np.bincount(rows, length, count) / degree
    adjacency = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    points = start.copy()
    for _ in range(SMOOTHING_STEPS):
        move = (adjacency @ points) / degree[:, None] - start
        move[isolated] = 0.0
        far = np.linalg.norm(move, axis=1)
        points = start + move * np.minimum(1.0, limit / np.maximum(far, 1e-300))[:, None]
    return np.asarray(_restore_crushed_faces(points, start, faces) + centre)


def _restore_crushed_faces(points: np.ndarray, start: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Restore the vertices of faces that lost most of their area, so that thin tubes stay open."""
    least = MIN_AREA_SHARE * np.linalg.norm(area_vectors(start, faces), axis=1)
    points = points.copy()
    while True:
        crushed = np.linalg.norm(area_vectors(points, faces), axis=1) < least
        if not _moved_back(points, start, faces[crushed]):
            return points


def _moved_back(points: np.ndarray, start: np.ndarray, rows: np.ndarray) -> bool:
    """Move some of the points back to the start, in place; return whether any were elsewhere."""
    back = np.unique(rows)
    back = back[(points[back] != start[back]).any(axis=1)]
    points[back] = start[back]
    return len(back) > 0


def chart_points(corner_uvs: np.ndarray, charts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index the distinct points of each chart, of (f, 3, 2) float32 UVs.

    Returns the index of a point for each corner, (f, 3); charts share no points. And a corner
    ``3 * face + k`` at each point, (n,).
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

    The shapes are those of :func:`flatten_faces`.
    """
    uvs = np.asarray(corner_uvs, np.float64)
    low, high = chart_bounds(uvs, charts)
    count = len(low)
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
    faces that flip or overlap as a result are restored. The charts, (f, 3, 2), are of uniform
    density and counter-clockwise; the shapes are those of :func:`flatten_faces`.
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
        cosine, sine = (cosine / length)[:, None], (sine / length)[:, None]
        x, y = edges[..., 0], edges[..., 1]
        turned = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=2)
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
    """Return UVs, (f, 3, 2), with the points restored of faces that flipped or overlap since."""
    count = int(charts.max()) + 1
    before = start[corners]
    was_up = signed_areas(before) > 0.0
    folded = np.bincount(charts[find_overlaps(before, charts)[:, 0]], minlength=count)
    points = points.copy()
    for _ in range(MAX_ROUNDS_BACK):
        now = points[corners]
        pairs = find_overlaps(now, charts)
        # Charts that overlapped before are split later.
        pairs = pairs[folded[charts[pairs[:, 0]]] == 0]
        bad = was_up & (signed_areas(now) <= 0.0)
        bad[pairs] = True
        if not _moved_back(points, start, corners[bad]):
            return now
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


# -- Split a mesh into chunks of connected faces, small enough for xatlas -------------------------


MAX_CHUNK_FACES = 1500
"""xatlas 0.0.11 crashes on 82k faces at once and is fast and stable at 1-2k."""
SMALL_CHUNK_SHARE = 0.125
MERGED_CHUNK_SHARE = 1.3
NORMAL_COST = 1.5
"""Cost of deviating normals relative to the cost of one chunk radius of distance."""


def split_into_chunks(graph: FaceGraph) -> np.ndarray:
    """Label faces by chunk.

    Chunks grow from a seed over shared edges, by distance and deviation of normals; small chunks
    are merged with the neighbour with which they share most edges; isolated small pieces are
    bundled. Returns labels from 0, (f,) int32; a chunk has at most 1.3 times
    :data:`MAX_CHUNK_FACES`.
    """
    radius = float(np.sqrt(max(graph.areas.mean(), 1e-300) * MAX_CHUNK_FACES / np.pi))
    neighbours = (graph.opposite // 3).astype(np.int32)  # -1 without one
    labels = _grow(neighbours, graph.centroids, graph.normals, radius, MAX_CHUNK_FACES)
    return _merge_small(labels, neighbours, MAX_CHUNK_FACES)


@kernel(fast=False)
def _grow(
    neighbours: Any, centroids: Any, normals: Any, radius: float, max_faces: int
) -> np.ndarray:
    count = len(neighbours)
    labels = np.full(count, -1, np.int32)
    # Seeds from the border of finished chunks keep the next chunk adjacent to them.
    border = np.empty(count, np.int32)
    border_begin, border_end = 0, 0
    queued = np.zeros(count, np.bool_)
    label = 0
    scan = 0
    while True:
        seed = -1
        while border_begin < border_end and seed < 0:
            if labels[border[border_begin]] < 0:
                seed = border[border_begin]
            border_begin += 1
        while seed < 0 and scan < count:
            if labels[scan] < 0:
                seed = scan
            scan += 1
        if seed < 0:
            break
        heap = [(0.0, np.int64(seed))]
        size = 0
        while len(heap) > 0 and size < max_faces:
            face = heapq.heappop(heap)[1]
            if labels[face] >= 0:
                continue
            labels[face] = label
            size += 1
            for k in range(3):
                other = np.int64(neighbours[face, k])
                if other < 0 or labels[other] >= 0:
                    continue
                distance2 = 0.0
                alike = 0.0
                for axis in range(3):
                    distance2 += (centroids[other, axis] - centroids[seed, axis]) ** 2
                    alike += normals[other, axis] * normals[seed, axis]
                cost = np.sqrt(distance2) / radius + NORMAL_COST * (1.0 - alike)
                heapq.heappush(heap, (cost, other))
        for entry in heap:
            other = entry[1]
            if labels[other] < 0 and not queued[other]:
                queued[other] = True
                border[border_end] = other
                border_end += 1
        label += 1
    return labels


def _merge_small(labels: np.ndarray, neighbours: np.ndarray, max_faces: int) -> np.ndarray:
    count = int(labels.max()) + 1
    sizes = np.bincount(labels, minlength=count)
    face, corner = np.nonzero(neighbours >= 0)
    one, other = labels[face], labels[neighbours[face, corner]]
    crossing = one != other
    pairs, shared = np.unique(
        one[crossing].astype(np.int64) * count + other[crossing], return_counts=True
    )
    touching: dict[int, dict[int, int]] = {}
    for pair, edges in zip(pairs.tolist(), shared.tolist(), strict=True):
        touching.setdefault(pair // count, {})[pair % count] = edges
    target = np.arange(count)
    limit = MERGED_CHUNK_SHARE * max_faces
    small = np.flatnonzero(sizes < SMALL_CHUNK_SHARE * max_faces)
    for chunk in small[np.argsort(sizes[small], kind="stable")].tolist():
        shared_with: dict[int, int] = {}
        for neighbour, edges in touching.get(chunk, {}).items():
            root = _root(target, neighbour)
            shared_with[root] = shared_with.get(root, 0) + edges
        own = _root(target, chunk)
        options = [
            (edges, -root)
            for root, edges in shared_with.items()
            if root != own and sizes[root] + sizes[own] <= limit
        ]
        if options:
            root = -max(options)[1]
            target[own] = root
            sizes[root] += sizes[own]
            sizes[own] = 0
    labels = np.array([_root(target, c) for c in range(count)])[labels]
    return _bundle(labels, max_faces)


def _root(target: np.ndarray, chunk: int) -> int:
    while target[chunk] != chunk:
        chunk = int(target[chunk])
    return chunk


def _bundle(labels: np.ndarray, max_faces: int) -> np.ndarray:
    """Bundle chunks that are still small (isolated pieces) until a chunk is full."""
    kept, inverse, sizes = np.unique(labels, return_inverse=True, return_counts=True)
    bundle = np.empty(len(kept), np.int32)
    current, filled, used = -1, max_faces, 0
    for index, size in enumerate(sizes.tolist()):
        if size >= SMALL_CHUNK_SHARE * max_faces:
            bundle[index], used = used, used + 1
            continue
        if filled + size > max_faces:
            current, filled, used = used, 0, used + 1
        bundle[index] = current
        filled += size
    return bundle[inverse]


# -- Find charts of a mesh with xatlas in a helper process, without folds, and pack them ----------


_logger = logging.getLogger(__name__)

CHARTS_HELPER = "texture.unwrap.unwrap_helper"
PACK_HELPER = "texture.unwrap.pack_helper"
HELPER_MEMORY_BYTES = 8 * 2**30
DEADLINE_BASE_S = 30.0
DEADLINE_PER_FACE_S = 1e-3
"""Noisy meshes take about 1e-4 s per face, with packing; ten times that is a hang."""
MAX_MEAN_STRETCH = 1.1
"""With more mean stretch of the charts of the smoothed copy, the mesh itself is charted too."""
MIN_DENSITY_GAIN = 1.2
"""Factor in texels per edge by which the charts of the mesh itself must be better: there are many
more of them, each with seams, and bounding boxes favour small charts."""
MAX_LOST_SHARE = 1e-3
"""The mesh itself is charted too if a larger share of the surface has no area in the charts."""


@dataclass(frozen=True)
class Charts:
    """Charts in the plane, each at the scale of the surface, not yet packed."""

    faces: np.ndarray
    """(k,) int64 indices of the given faces that have a chart."""
    corner_uvs: np.ndarray
    """(k, 3, 2) float64."""
    labels: np.ndarray
    """(k,) int32."""
    stretch: Stretch
    polygons: np.ndarray | None = None
    """(k,) int64 polygon of each face, if polygons are to stay whole."""

    def density(self, size_px: int, gutter_px: int, atlases: int) -> float:
        """Return the approximate texels per edge on all but 5 % of the surface."""
        low, high = chart_bounds(self.corner_uvs, self.labels)
        side_px, padding_px = packing_square(size_px, gutter_px)
        scale = packing_scale(high - low, side_px, padding_px, atlases) * size_px / side_px
        return scale / max(self.stretch.p95, 1.0)


def find_charts(
    vertices: np.ndarray, faces: np.ndarray, size_px: int, gutter_px: int, folder: Path,
    progress: Progress, atlases: int, polygons: np.ndarray | None,
) -> Charts:  # fmt: skip
    """Cut the mesh into charts without folds with xatlas.

    Charts are found on a smoothed copy: on meshes as rough as real ones, xatlas makes up to twelve
    times as many. The charts are then relaxed to the shape of the mesh itself. If too much stretch
    remains, the mesh itself is charted too, and the result with the higher texel density is kept.

    Parameters
    ----------
    vertices : (v, 3) float64
        Median edge about 1, near the origin.
    faces : (f, 3) int32
        Faces with non-zero area.
    size_px, gutter_px, atlases : int
        Side of the texture, texels to keep free between charts, and number of textures.
    folder : Path
        For the files of the helper process.
    polygons : (f,) int64 or None
        Polygon that each face is a part of. Charts cut none of them, but for folded ones with more
        than four sides.

    Raises
    ------
    WorkerError, DatasetError, ResourceError
        xatlas crashed, returned invalid results, took too long or got too little memory.
    """
    copy, rest = smooth_vertices(vertices, faces), progress.span(0.6, 1.0)
    try:
        first = _charts(vertices, copy, faces, folder, progress.span(0.0, 0.6), polygons)
    except MemoryShortageError:
        raise
    except (WorkerError, ResourceError, DatasetError) as error:
        _logger.info("xatlas failed on the smoothed copy: %s", error.message)
        return _charts(vertices, vertices, faces, folder, rest, polygons)
    stretch = first.stretch
    too_stretched = stretch.mean > MAX_MEAN_STRETCH or stretch.collapsed_share > MAX_LOST_SHARE
    if not too_stretched and len(first.faces) == len(faces):
        return first
    second = _charts(vertices, vertices, faces, folder, rest, polygons)
    density = [one.density(size_px, gutter_px, atlases) for one in (first, second)]
    _logger.debug("texels for an edge: %.2f, without smoothing %.2f", *density)
    lost = first.stretch.collapsed_share - second.stretch.collapsed_share
    lost += (len(second.faces) - len(first.faces)) / len(faces)
    return second if lost > MAX_LOST_SHARE or density[1] > MIN_DENSITY_GAIN * density[0] else first


def _charts(
    vertices: np.ndarray, positions: np.ndarray, faces: np.ndarray, folder: Path,
    progress: Progress, polygons: np.ndarray | None,
) -> Charts:  # fmt: skip
    """Cut the mesh into charts at given positions, and relax these to ``vertices``."""
    corner_uvs = _run_xatlas(positions, faces, folder, progress.span(0.0, 0.7))
    kept = np.flatnonzero(np.isfinite(corner_uvs).all(axis=(1, 2)))
    if len(kept) == 0:
        raise WorkerError("xatlas assigned no face to a chart.")
    faces, corner_uvs = faces[kept], corner_uvs[kept]
    graph = face_graph(vertices, faces)
    progress.update(0.75, "fitting charts to the surface")
    labels = uv_charts(graph, faces, corner_uvs)
    shapes = flatten_faces(vertices, faces)
    flat = corner_uvs.astype(np.float64)
    flat[np.bincount(labels, signed_areas(flat))[labels] < 0.0, :, 0] *= -1.0  # mirrored charts
    flat = equalise_density(flat, labels, shapes)
    if polygons is not None:
        polygons = polygons[kept]
        flat = join_polygons(flat, labels, faces, shapes, graph, polygons)
        labels = uv_charts(graph, faces, flat)
    flat = relax(flat, labels, shapes)
    progress.update(0.9, "splitting charts that fold")
    labels = split_overlaps(flat, labels, graph)
    if polygons is not None:
        flat, labels = set_cut_apart(flat, labels, faces, shapes, graph, polygons)
    flat = equalise_density(flat, labels, shapes)
    side = max(float(np.abs(flat).max()), 1e-300)
    stretch = texture_stretch(vertices, faces, flat / side)
    return Charts(kept, flat, labels, stretch, polygons)


def _run_xatlas(
    positions: np.ndarray, faces: np.ndarray, folder: Path, progress: Progress
) -> np.ndarray:
    """Return (f, 3, 2) float32, NaN for faces that xatlas ignored."""
    progress.update(0.0, "splitting the mesh for xatlas")
    labels = split_into_chunks(face_graph(positions, faces))
    order = np.argsort(labels, kind="stable")
    face_bounds = np.concatenate([[0], np.cumsum(np.bincount(labels))])
    vertices, local, vertex_bounds = [], [], [0]
    for begin, end in pairwise(face_bounds.tolist()):
        used, inverse = np.unique(faces[order[begin:end]], return_inverse=True)
        vertices.append(positions[used].astype(np.float32))
        local.append(inverse.reshape(-1, 3).astype(np.uint32))
        vertex_bounds.append(vertex_bounds[-1] + len(used))
    task = {
        "vertices": np.concatenate(vertices), "corners": np.concatenate(local),
        "vertex_bounds": np.array(vertex_bounds), "face_bounds": face_bounds,
    }  # fmt: skip
    result = _run(CHARTS_HELPER, folder, len(faces), progress.span(0.1, 1.0), task)["corner_uvs"]
    if result.shape != (len(faces), 3, 2):
        raise WorkerError("xatlas returned UVs of another mesh.")
    corner_uvs = np.empty((len(faces), 3, 2), np.float32)
    corner_uvs[order] = result
    return corner_uvs


def _run(
    helper: str, folder: Path, faces: int, progress: Progress, task: dict[str, Any]
) -> dict[str, np.ndarray]:
    np.savez(folder / "input.npz", **task)
    output = folder / "output.npz"
    output.unlink(missing_ok=True)
    deadline_s = DEADLINE_BASE_S + DEADLINE_PER_FACE_S * faces
    run_helper(helper, folder, progress, deadline_s=deadline_s, memory_bytes=HELPER_MEMORY_BYTES)
    with np.load(output, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def pack_charts(
    charts: Charts, size_px: int, gutter_px: int, folder: Path, progress: Progress, atlases: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Pack charts into at most ``atlases`` unit squares, all at the same scale.

    Returns
    -------
    corner_uvs : (k, 3, 2) float32
        v upwards, no chart mirrored; NaN for faces that were not packed.
    face_atlas : (k,) uint8
        Square of each face.
    gutter_px : float
        Texels kept between charts; fewer than requested if there is no room.

    Raises
    ------
    WorkerError, DatasetError, ResourceError
        xatlas crashed, returned invalid results, took too long or got too little memory.
    """
    # Rows of a texture go down, v goes up: flipped here, so that charts keep their orientation.
    flat = (charts.corner_uvs * [1.0, -1.0]).astype(np.float32)
    labels = charts.labels
    if atlases > 1:
        labels = split_wide_charts(charts.corner_uvs, labels, atlases, charts.polygons)
    corners, first = chart_points(flat, labels)
    task = {
        "points": flat.reshape(-1, 2)[first], "corners": corners.astype(np.uint32),
        "charts": labels.astype(np.uint32), "size_px": size_px, "gutter_px": gutter_px,
        "atlases": atlases,
    }  # fmt: skip
    output = _run(PACK_HELPER, folder, len(flat), progress, task)
    points, numbers = output["points"], output["atlas"]
    if points.shape != (len(first), 2) or numbers.shape != (len(first),):
        raise WorkerError("xatlas returned UVs of other charts.")
    corner_uvs = points[corners].astype(np.float32)
    corner_uvs[..., 1] = 1.0 - corner_uvs[..., 1]
    # All corners of a face are in one chart, and so in one atlas.
    return corner_uvs, numbers[corners[:, 0]].astype(np.uint8), float(output["gutter_px"])
