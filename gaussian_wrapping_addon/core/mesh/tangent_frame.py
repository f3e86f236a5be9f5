# SPDX-License-Identifier: GPL-3.0-or-later
"""Tangent frames for normal maps (MikkTSpace): smooth vertex normals and corner tangents.

A reader of the map must use the same frame. Blender and glTF both specify MikkTSpace (Mikkelsen,
"Simulation of wrinkled surfaces revisited", 2008): each face's direction of increasing u, averaged
by corner angle over neighbours that share a vertex, its UV and the UVs' orientation, in the plane
of the vertex normal. Normals and tangents are interpolated without renormalisation, and the
bitangent is ``sign * cross(normal, tangent)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .components import connected
from .surface_mesh import area_vectors, next_half_edges, summed


@dataclass(frozen=True)
class TangentFrames:
    """Frames at the corners of a mesh's faces."""

    normals: np.ndarray  # (v, 3) float64 unit normals of the vertices
    tangents: np.ndarray
    """(f, 3, 3) float64 unit tangents of the corners, orthogonal to their normals."""
    signs: np.ndarray  # (f,) float64: 1, or -1 where the UVs are mirrored


def shading_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (v, 3) float64 angle-weighted unit normals, as in Blender's smooth shading.

    Vertices without a face of non-zero area get (0, 0, 1): file formats require unit length.
    """
    vertices = np.asarray(vertices, np.float64)
    corners, face_normals = vertices[faces], _unit(area_vectors(vertices, faces))
    ahead = _unit(np.roll(corners, -1, axis=1) - corners)
    behind = _unit(np.roll(corners, 1, axis=1) - corners)
    weighted = _angles(ahead, behind)[..., None] * face_normals[:, None]  # (f, 3, 3)
    normals = _unit(summed(np.asarray(faces).ravel(), weighted.reshape(-1, 3), len(vertices)))
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return normals


def tangent_frames(
    vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray
) -> TangentFrames:
    """Compute the frames of a smooth-shaded mesh with UVs.

    ``vertices`` (v, 3) float64, ``faces`` (f, 3) int32, ``corner_uvs`` (f, 3, 2) float32, v up.
    Corners of one vertex with equal UVs share their tangent. Faces without area, on the surface or
    in the atlas, do not contribute to their neighbours; they hold no texel, and their own tangents
    are arbitrary vectors orthogonal to the normals.
    """
    faces = np.asarray(faces, np.int64)
    normals = shading_normals(vertices, faces)
    corners = np.asarray(vertices, np.float64)[faces]  # (f, 3, 3)
    uvs = np.asarray(corner_uvs, np.float32)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    fine = uvs.astype(np.float64)
    uv_first, uv_second = fine[:, 1] - fine[:, 0], fine[:, 2] - fine[:, 0]
    area = uv_first[:, 0] * uv_second[:, 1] - uv_first[:, 1] * uv_second[:, 0]
    signs = np.where(area > 0.0, 1.0, -1.0)
    along = uv_second[:, 1:] * first - uv_first[:, 1:] * second
    along = _unit(along) * (signs * (area != 0.0))[:, None]  # (f, 3), towards growing u
    owner = normals[faces]  # (f, 3, 3)
    ahead = _unit(_flattened(np.roll(corners, -1, axis=1) - corners, owner))
    behind = _unit(_flattened(np.roll(corners, 1, axis=1) - corners, owner))
    angles = _angles(ahead, behind)
    weighted = angles[..., None] * _unit(_flattened(np.repeat(along[:, None], 3, axis=1), owner))
    group = _groups(faces, uvs, signs)
    total = summed(group, weighted.reshape(-1, 3), int(group.max()) + 1)
    tangents = _unit(total)[group].reshape(-1, 3, 3)
    missing = ~tangents.any(axis=2)
    if missing.any():
        axis = np.eye(3)[np.abs(owner[missing]).argmin(axis=1)]
        tangents[missing] = _unit(_flattened(axis, owner[missing]))
    return TangentFrames(normals, tangents, signs)


def _groups(faces: np.ndarray, uvs: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Label groups of corners that average their tangents, (3 f,) int64.

    Corners of a group have the same vertex, UV and orientation, and their faces are joined by edges
    around the vertex: parts of a chart that touch in a single point have separate tangents.
    """
    key = np.empty(faces.size, np.dtype([("vertex", "<i8"), ("uv", "<u8")]))
    key["vertex"] = 2 * faces.ravel() + np.repeat(signs > 0, 3)
    key["uv"] = np.ascontiguousarray(uvs.reshape(-1, 2)).view(np.uint64)[:, 0]
    welded = np.unique(key, return_inverse=True)[1].ravel()
    corner = np.arange(faces.size)
    follower = next_half_edges(corner)
    low = np.where(welded < welded[follower], corner, follower)
    high = corner + follower - low
    edge = welded[low] * (int(welded.max()) + 1) + welded[high]
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(edge[order[1:]] == edge[order[:-1]])
    one, other = order[same], order[same + 1]
    rows, columns = np.r_[low[one], high[one]], np.r_[low[other], high[other]]
    return connected(rows, columns, faces.size)[1].astype(np.int64)


def _flattened(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Project vectors onto the planes orthogonal to normals."""
    return vectors - (vectors * normals).sum(axis=-1, keepdims=True) * normals


def _angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return angles between unit vectors; 0 where one of them is zero."""
    cosine = (one * other).sum(axis=-1).clip(-1.0, 1.0)
    return np.arccos(cosine) * (one.any(axis=-1) & other.any(axis=-1))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Normalise vectors; those of zero or negligible length become 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    tiny = length <= 1e-300
    return np.where(tiny, 0.0, vectors / np.where(tiny, 1.0, length))
