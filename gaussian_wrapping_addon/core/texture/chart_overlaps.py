# SPDX-License-Identifier: GPL-3.0-or-later
"""Faces of one chart that cover each other, found exactly, and charts split until none does."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..compiled import inline, kernel
from .face_graph import FaceGraph, components

OVERLAP_DEPTH_SHARE = 1e-4
"""Two faces overlap when they cannot be moved apart by this share of the median edge of all. In
textures in use that is a hundredth of a texel; rounding of UVs stays below."""


def signed_areas(flat: np.ndarray) -> np.ndarray:
    """Return (f,) areas of (f, 3, 2) triangles, positive when counter-clockwise."""
    one, two = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    return np.asarray(0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]))


def conflicts(corner_uvs: np.ndarray, charts: np.ndarray) -> np.ndarray:
    """Find the pairs of faces of the same chart that overlap.

    Returns
    -------
    (p, 2) int64
        Each pair once.
    """
    uvs = np.ascontiguousarray(corner_uvs, np.float64)
    edges = np.linalg.norm(uvs - np.roll(uvs, -1, axis=1), axis=2)
    solid = edges[edges > 0]
    if len(solid) == 0:
        return np.empty((0, 2), np.int64)
    depth = OVERLAP_DEPTH_SHARE * float(np.median(solid))
    left = uvs[..., 0].min(axis=1)
    order = np.lexsort((left, charts))
    chart = np.ascontiguousarray(charts[order], np.int64)
    sorted_uvs = np.ascontiguousarray(uvs[order])
    found = np.empty((0, 2), np.int64)
    count = int(_overlapping(sorted_uvs, chart, depth, found))
    if count:
        found = np.empty((count, 2), np.int64)
        _overlapping(sorted_uvs, chart, depth, found)
    return np.asarray(order[found], np.int64)


def split_overlaps(corner_uvs: np.ndarray, charts: np.ndarray, graph: FaceGraph) -> np.ndarray:
    """Split charts until no two faces of one overlap; UVs stay.

    A new chart grows from the face in the middle of the old one over shared edges, and leaves out
    what it would cover or what is turned over; what is left is split in the same way.

    Parameters
    ----------
    corner_uvs : (f, 3, 2) float
        Finite; charts may lie upon each other.
    charts : (f,) int
        Each connected.

    Returns
    -------
    (f,) int32
        New labels from 0.
    """
    pairs = conflicts(corner_uvs, charts)
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
    neighbours = np.where(graph.opposite >= 0, graph.opposite // 3, -1).astype(np.int64)
    centres = np.asarray(corner_uvs, np.float64).mean(axis=1)
    middle = (
        np.stack([np.bincount(charts, centres[:, axis], count) for axis in range(2)], axis=1)
        / np.maximum(np.bincount(charts, minlength=count), 1)[:, None]
    )
    distance = np.linalg.norm(centres - middle[charts], axis=1)
    faces = np.flatnonzero(broken[charts])
    faces = faces[np.lexsort((distance[faces], charts[faces]))]
    pieces = _grow_pieces(
        np.ascontiguousarray(charts, np.int64), faces, neighbours, np.sign(areas), starts,
        np.ascontiguousarray(both[:, 1]), count,
    )  # fmt: skip
    other = np.where(graph.opposite >= 0, graph.opposite // 3, 0)
    return components(graph, pieces[other] == pieces[:, None])


@inline
def _apart(a: Any, b: Any, ccw: float) -> float:
    """Return the widest gap between two triangles over the directions of the first one's edges."""
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
def _turn(a: Any) -> float:
    double = (a[1, 0] - a[0, 0]) * (a[2, 1] - a[0, 1]) - (a[2, 0] - a[0, 0]) * (a[1, 1] - a[0, 1])
    return 1.0 if double > 0.0 else (-1.0 if double < 0.0 else 0.0)


@kernel(fast=False)
def _overlapping(uvs: Any, chart: Any, depth: float, found: Any) -> int:
    count = 0
    for i in range(len(uvs)):
        one = uvs[i]
        turn = _turn(one)
        if turn == 0.0:
            continue
        right = max(one[0, 0], one[1, 0], one[2, 0])
        low = min(one[0, 1], one[1, 1], one[2, 1])
        high = max(one[0, 1], one[1, 1], one[2, 1])
        for j in range(i + 1, len(uvs)):
            other = uvs[j]
            if chart[j] != chart[i]:
                break
            if min(other[0, 0], other[1, 0], other[2, 0]) > right - depth:
                break
            if max(other[0, 1], other[1, 1], other[2, 1]) < low + depth:
                continue
            if min(other[0, 1], other[1, 1], other[2, 1]) > high - depth:
                continue
            turn_other = _turn(other)
            if turn_other == 0.0:
                continue
            if _apart(one, other, turn) > -depth or _apart(other, one, turn_other) > -depth:
                continue
            if count < len(found):
                found[count, 0] = i
                found[count, 1] = j
            count += 1
    return count


@kernel(fast=False)
def _grow_pieces(
    charts: Any, faces: Any, neighbours: Any, turn: Any, starts: Any, others: Any, label: int
) -> np.ndarray:
    """Give the faces listed (by chart, from the middle outwards) labels of pieces."""
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
                if turn[other] * turn[seed] < 0.0:
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
