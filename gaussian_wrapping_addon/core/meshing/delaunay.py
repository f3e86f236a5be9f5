# SPDX-License-Identifier: GPL-3.0-or-later
"""Delaunay tetrahedralisation of points in any position, degenerate inputs included."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

import numpy as np

from ..errors import MeshingError
from ..progress import Progress
from ..worker.helper_process import run_helper

_logger = logging.getLogger(__name__)

JITTER_SHARE = 1e-7
"""Perturbation, as a share of the extent, that breaks ties between cospherical or coplanar points.
It affects connectivity only (without it shull needs minutes on lattices). With the bounding points,
which make the extent 15 times larger, it is about 1e-6 of the extent of the others."""

HELPER_DEADLINE_S = 600.0
HELPER_BYTES_PER_POINT = 8_000
HELPER_BASE_BYTES = 4 << 30
"""Address space: Qhull needs about 2 kB per point; the libraries map much more than they use."""

BOUNDING_SHARE = 7.3
BOUNDING_SPREAD_SHARE = 0.1
"""Distance of the bounding points and their irregularity, in half extents."""


def bounding_points(points: np.ndarray, seed: int) -> np.ndarray:
    """Return the 8 perturbed corners of a large box around ``points``, (8, 3) float64.

    With them every given point lies strictly inside the hull, and flat or collinear points have
    tetrahedra too.
    """
    low, high = points.min(0), points.max(0)
    extent = max(float((high - low).max()) / 2, np.finfo(np.float64).tiny * 1e6)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    noise = np.random.default_rng(seed).normal(size=(8, 3))
    return (low + high) / 2 + (corners * BOUNDING_SHARE + noise * BOUNDING_SPREAD_SHARE) * extent


def delaunay(
    points: np.ndarray, *, seed: int, progress: Progress, jitter_share: float = JITTER_SHARE
) -> np.ndarray:
    """Return the Delaunay tetrahedra of ``points``.

    Exact duplicates are used once, by their first occurrence. Connectivity is computed on
    coordinates perturbed by :data:`JITTER_SHARE` of the extent, so in the given coordinates a
    tetrahedron of coplanar points can have a volume of about zero, of either sign.

    ``jitter_share``: size of the perturbation; 0 where the caller has already perturbed the points.
    Returns (m, 4) int64 indices into ``points`` (n, 3), positively oriented (in the perturbed
    coordinates).
    Raises MeshingError: fewer than four distinct points, or a point that is not finite;
    ResourceError, WorkerError, Cancelled: from the fallback process.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshingError(f"Points of shape {points.shape} are invalid.", "Give (n, 3).")
    if not np.isfinite(points).all():
        raise MeshingError("A point to be triangulated is not finite.", "Check the Gaussians.")
    unique, first = np.unique(points, axis=0, return_index=True)
    if len(unique) < 4:
        raise MeshingError(
            f"{len(unique)} distinct points have no tetrahedron.", "Choose a larger region."
        )
    first.sort()
    low, high = unique.min(0), unique.max(0)
    extent = float((high - low).max())
    # Centred: at UTM coordinates the perturbation would be lost in rounding.
    local = (points[first] - (low + high) / 2) / extent
    local += jitter_share * np.random.default_rng(seed).uniform(-1.0, 1.0, local.shape)
    progress.update(0.0, f"triangulating {len(local)} points")
    try:
        import shull

        tetrahedra = np.asarray(shull.Delaunay3d(local).simplices, np.int64)
    except ValueError as error:
        _logger.warning("shull refused %d points (%s); using Qhull", len(local), error)
        tetrahedra = qhull_tetrahedra(local, progress)
    progress.update(1.0, f"{len(tetrahedra)} tetrahedra")
    return first[oriented(local, tetrahedra)]


def oriented(points: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Orient tetrahedra positively: swap two corners where the volume is negative."""
    result = tetrahedra.copy()
    negative = signed_volumes(points, tetrahedra) < 0
    result[negative, 2], result[negative, 3] = tetrahedra[negative, 3], tetrahedra[negative, 2]
    return result


def signed_volumes(points: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return (m,) signed volumes of (m, 4) tetrahedra."""
    result = np.empty(len(tetrahedra))
    for begin in range(0, len(tetrahedra), 1 << 18):
        part = slice(begin, begin + (1 << 18))
        a, b, c, d = (points[tetrahedra[part, k]] for k in range(4))
        result[part] = ((b - a) * np.cross(c - a, d - a)).sum(1) / 6.0
    return result


def qhull_tetrahedra(points: np.ndarray, progress: Progress) -> np.ndarray:
    """Run Qhull with joggled input in a helper process: it can hang or crash on hard input."""
    with tempfile.TemporaryDirectory(prefix="gwrap_delaunay_") as name:
        folder = Path(name)
        np.save(folder / "points.npy", points)
        memory = HELPER_BASE_BYTES + HELPER_BYTES_PER_POINT * len(points)
        run_helper(
            "meshing.delaunay_helper", folder, progress, deadline_s=HELPER_DEADLINE_S,
            memory_bytes=memory,
        )  # fmt: skip
        return np.load(folder / "tetrahedra.npy", allow_pickle=False).astype(np.int64)
