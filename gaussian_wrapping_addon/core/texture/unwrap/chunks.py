# SPDX-License-Identifier: GPL-3.0-or-later
"""Split a mesh into chunks of connected faces, small enough for xatlas."""

from __future__ import annotations

import heapq
from typing import Any

import numpy as np

from ...kernels.compiled import kernel
from ...mesh.face_graph import FaceGraph

MAX_CHUNK_FACES = 1500
"""xatlas 0.0.11 crashes on 82k faces at once and is fast and stable at 1-2k."""
SMALL_CHUNK_SHARE = 0.125
MERGED_CHUNK_SHARE = 1.3
NORMAL_COST = 1.5
"""Cost of deviating normals relative to the cost of one chunk radius of distance."""


def split_into_chunks(graph: FaceGraph, max_faces: int = MAX_CHUNK_FACES) -> np.ndarray:
    """Label faces by chunk.

    Chunks grow from a seed over shared edges, by distance and deviation of normals; small chunks
    are merged with the neighbour with which they share most edges; isolated small pieces are
    bundled.

    Returns
    -------
    (f,) int32
        Labels from 0; every chunk has at most ``1.3 * max_faces`` faces.
    """
    radius = float(np.sqrt(max(graph.areas.mean(), 1e-300) * max_faces / np.pi))
    neighbours = np.where(graph.opposite >= 0, graph.opposite // 3, -1).astype(np.int32)
    labels = _grow(neighbours, graph.centroids, graph.normals, radius, max_faces)
    return _merge_small(labels, neighbours, max_faces)


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
            bundle[index] = used
            used += 1
            continue
        if filled + size > max_faces:
            current, filled = used, 0
            used += 1
        bundle[index] = current
        filled += size
    return bundle[inverse]
