# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface points of texels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...mesh.surface_mesh import SurfaceMesh
from .atlas_raster import AtlasRaster


@dataclass(frozen=True)
class TexelPoints:
    """Surface points of texels."""

    face: np.ndarray
    """(n,) int32."""
    weights: np.ndarray
    """(n, 3) float64 barycentric weights of the face's corners."""
    points: np.ndarray
    """(n, 3) float64 positions."""
    raw_normals: np.ndarray
    """(n, 3) float64 interpolated vertex normals, not of unit length."""
    normals: np.ndarray
    """(n, 3) float64 the same, normalised."""


def texel_points(
    mesh: SurfaceMesh, raster: AtlasRaster, texels: np.ndarray, normals: np.ndarray
) -> TexelPoints:
    """Return the surface points of some texels.

    Parameters
    ----------
    mesh : SurfaceMesh
    raster : AtlasRaster
        Raster of its UVs.
    texels : (n,) int64
        Flat indices of texels with a face.
    normals : (v, 3) float64
        Vertex normals.
    """
    face = raster.face.ravel()[texels]
    bary = raster.bary.reshape(-1, 2)[texels].astype(np.float64)
    weights = np.concatenate([bary, 1.0 - bary.sum(axis=1, keepdims=True)], axis=1)
    corners = np.asarray(mesh.faces)[face]  # (n, 3)
    points = np.einsum("nc,ncx->nx", weights, np.asarray(mesh.vertices, np.float64)[corners])
    raw = np.einsum("nc,ncx->nx", weights, normals[corners])
    length = np.linalg.norm(raw, axis=1, keepdims=True)
    return TexelPoints(face, weights, points, raw, raw / np.maximum(length, 1e-12))
