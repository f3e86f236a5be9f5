# SPDX-License-Identifier: GPL-3.0-or-later
"""Boxes as regions, and what all regions answer."""

from __future__ import annotations

import itertools

import numpy as np

from .. import limits
from ..errors import MeshingError

# -- Validate that the corners of a region enclose a volume ---------------------------------------


FLAT_SHARE = 1e-6
"""A body thinner than this share of its diagonal counts as flat."""


def check_volume(vertices: np.ndarray, name: str) -> None:
    """Raise an error for (n, 3) corners of the region of that name that enclose no volume.

    Raises
    ------
    MeshingError
        Fewer than four corners, too many, not finite, or all in one plane.
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < 4:
        text = f"Region {name!r} needs at least four corners."
        raise MeshingError(text, "Draw a box around the object.")
    if len(vertices) > limits.MAX_REGION_VERTICES:
        text = f"Region {name!r} has {len(vertices)} corners; the limit is "
        text += f"{limits.MAX_REGION_VERTICES}."
        raise MeshingError(text, "Use a simpler body, such as a box.")
    if not np.isfinite(vertices).all():
        raise MeshingError(f"Region {name!r} has a corner that is not finite.", "Draw it again.")
    if not _is_thick(vertices):
        raise flat_region_error(name)


def flat_region_error(name: str) -> MeshingError:
    """Return the error for a region without volume."""
    return MeshingError(f"Region {name!r} is flat: it encloses no volume.", "Give it some height.")


def _is_thick(vertices: np.ndarray) -> bool:
    low, high = vertices.min(0), vertices.max(0)
    diagonal = float(np.linalg.norm(high - low))
    if diagonal <= 0.0:
        return False
    # Rounded as where the hull is made: far from the origin, rounding alone makes bodies flat.
    scaled = (vertices - (low + high) / 2) / diagonal  # (n, 3)
    widths = np.linalg.svd(scaled - scaled.mean(0), compute_uv=False)  # (3,)
    return bool(widths[2] / np.sqrt(len(scaled)) >= FLAT_SHARE)


# -- Detection of boxes among convex bodies, and the visible edges of a convex hull ---------------


# Corners of the cube that an Empty with display size 1 draws; triangles seen from outside.
CUBE_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))  # (8, 3)
CUBE_TRIANGLES = (
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
)  # fmt: skip

# Adjacent faces of a hull count as one if the cosine of their angle differs from 1 by less.
FLAT_EDGE = 1e-6
# Share of the diagonal by which corners of a box may be off (float32 matrices of Blender).
BOX_TOLERANCE = 1e-5


def hull_edges(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the (k, 2) visible edges of a convex hull of triangles, not within flat faces."""
    corners = vertices[triangles]  # (m, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # (m, 3)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    owners = np.tile(np.arange(len(triangles)), 3)  # (3m,)
    edges, which, counts = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort(which.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])  # (k,)
    one, other = normals[owners[order[first]]], normals[owners[order[first + counts - 1]]]
    # The sign of a normal follows the triangle's winding, which is not defined for these hulls.
    flat = (counts == 2) & (np.abs((one * other).sum(1)) > 1.0 - FLAT_EDGE)
    return np.asarray(edges[~flat])


def box_matrix(vertices: np.ndarray) -> np.ndarray | None:
    """Return the matrix that maps :data:`CUBE_CORNERS` onto (n, 3) corners, or None for no box.

    It is (4, 4): rotation, positive scale and translation, with axes as close to x, y, z as
    possible.
    """
    if vertices.shape != (8, 3):
        return None
    tolerance = BOX_TOLERANCE * float(np.linalg.norm(np.ptp(vertices, 0)))
    offsets = vertices[1:] - vertices[0]  # (7, 3)
    for indices in itertools.combinations(range(7), 3):
        edges = offsets[list(indices)]  # (3, 3), one edge a row
        lengths = np.linalg.norm(edges, axis=1)
        gram = edges @ edges.T
        skew = np.abs(gram - np.diag(np.diag(gram))).max()
        if lengths.min() <= tolerance or skew > tolerance * lengths.max():
            continue
        corners = vertices[0] + 0.5 * (CUBE_CORNERS + 1.0) @ edges  # (8, 3)
        distances = np.linalg.norm(corners[:, None] - vertices[None], axis=2)  # (8, 8)
        if distances.min(0).max() <= tolerance and distances.min(1).max() <= tolerance:
            return _nearest_axes(vertices.mean(0), edges, lengths)
    return None


def _nearest_axes(center: np.ndarray, edges: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Assign the edges to x, y, z such that the rotation is smallest."""
    best, best_trace = np.eye(4), -np.inf
    for order in itertools.permutations(range(3)):
        rotation = (edges / lengths[:, None])[list(order)].T  # (3, 3), one axis a column
        rotation = rotation * np.where(np.diag(rotation) < 0.0, -1.0, 1.0)
        if np.linalg.det(rotation) < 0.0:
            rotation[:, int(np.argmin(np.diag(rotation)))] *= -1.0
        if np.trace(rotation) > best_trace + 1e-9:
            best_trace = float(np.trace(rotation))
            best = np.eye(4)
            best[:3, :3] = rotation * (0.5 * lengths[list(order)])
            best[:3, 3] = center
    return best
