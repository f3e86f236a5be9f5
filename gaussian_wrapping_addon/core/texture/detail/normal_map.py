# SPDX-License-Identifier: GPL-3.0-or-later
"""Tangent-space normal map: the detail of a dense mesh on a lighter one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...mesh.surface_mesh import SurfaceMesh
from ...mesh.tangent_frame import TangentFrames, tangent_frames
from ...progress import Progress
from ..atlas.atlas_raster import AtlasRaster
from ..atlas.texel_points import texel_points
from ..bake.fill import dilate
from .dense_surface import (
    BLOCK,
    BY_NEAREST,
    BY_RAY,
    NO_HIT,
    DenseSurface,
    SurfaceCorrespondences,
    cage_distance,
)

FLAT = (128, 128, 255)
"""Colour of the unperturbed normal, also used between charts."""


@dataclass(frozen=True)
class NormalMap:
    """Normal map and its statistics."""

    image: np.ndarray
    """(h, w, 3) uint8, +Y (OpenGL, Blender, glTF), linear data, not sRGB."""
    statistics: dict[str, Any]
    """Distance of the meshes; shares of texels found by rays, by nearest points, or not at all."""


def bake_normal_map(
    light: SurfaceMesh,
    corner_uvs: np.ndarray,
    raster: AtlasRaster,
    dense: DenseSurface,
    gutter_px: int,
    progress: Progress,
) -> NormalMap:
    """Bake the dense mesh's normals in the tangent frames of the light mesh.

    Parameters
    ----------
    light : SurfaceMesh
        The mesh that uses the map, smooth shaded.
    corner_uvs : (f, 3, 2) float32
    raster : AtlasRaster
        Raster of these UVs; the map has its size.
    dense : DenseSurface
        The mesh with the detail, in the same units.
    gutter_px : int
        Width by which charts are dilated.
    progress : Progress
        Span of this step.

    Notes
    -----
    The three numbers of a texel solve ``x T + y B + z N = n`` with the interpolated tangent,
    bitangent and normal of the light mesh, so that a renderer recovers ``n`` for any lengths and
    angles of these. Normals that point below the light surface are clamped to it: z >= 0.
    """
    size = raster.face.shape[0]
    frames = tangent_frames(light.vertices, light.faces, corner_uvs)
    progress.update(0.0, "normal map: measuring the distance of the meshes")
    cage = cage_distance(light, DenseSurface(light), dense)
    image = np.empty((size, size, 3), np.uint8)
    image[:] = FLAT
    pixels = image.reshape(-1, 3)
    texels = np.flatnonzero(raster.face.ravel() >= 0)
    counts = np.zeros(3, np.int64)
    for begin in range(0, len(texels), BLOCK):
        progress.update(begin / len(texels), "normal map: rays between the meshes")
        part = texels[begin : begin + BLOCK]
        at = texel_points(light, raster, part, frames.normals)
        matches = dense.correspondences(at.points, at.normals, cage)
        counts += np.bincount(matches.method, minlength=3)
        found = matches.method != NO_HIT
        wanted = at.normals.copy()
        rows = SurfaceCorrespondences(
            matches.face[found], matches.weights[found], matches.method[found]
        )
        wanted[found] = dense.normals(rows)
        pixels[part] = encode_normals(
            to_tangent_space(wanted, at.raw_normals, at.weights, at.face, frames)
        )
    ring = np.where(raster.face >= 0, 0, -1).astype(np.int16)
    chart = np.where(raster.face >= 0, 0, -1).astype(np.int32)
    dilate(image, ring, chart, gutter_px, inside=False)
    progress.update(1.0, "normal map: finished")
    total = max(len(texels), 1)
    statistics = {
        "size_px": size,
        "dense_faces": len(dense.faces),
        "cage_scene": cage,
        "by_ray_share": float(counts[BY_RAY] / total),
        "by_nearest_share": float(counts[BY_NEAREST] / total),
        "flat_share": float(counts[NO_HIT] / total),
    }
    return NormalMap(image, statistics)


def to_tangent_space(
    wanted: np.ndarray,
    normal: np.ndarray,
    weights: np.ndarray,
    face: np.ndarray,
    frames: TangentFrames,
) -> np.ndarray:
    """Transform unit vectors to the tangent frames of points on the light mesh.

    Parameters
    ----------
    wanted : (n, 3) float64
    normal : (n, 3) float64
        Interpolated, not of unit length.
    weights : (n, 3) float64
        Barycentric weights of the corners of ``face`` (n,).

    Returns
    -------
    (n, 3) float64
        Unit length, z >= 0.
    """
    tangent = np.einsum("nc,ncx->nx", weights, frames.tangents[face])
    bitangent = frames.signs[face][:, None] * np.cross(normal, tangent)
    axes = (np.cross(bitangent, normal), np.cross(normal, tangent), np.cross(tangent, bitangent))
    volume = (tangent * axes[0]).sum(axis=1)
    components = np.stack(
        [(wanted * axis).sum(axis=1) for axis in axes], axis=1
    )  # times the volume
    components *= np.sign(volume)[:, None]
    components[:, 2] = np.maximum(components[:, 2], 0.0)
    length = np.linalg.norm(components, axis=1, keepdims=True)
    return np.where(length > 0.0, components / np.where(length > 0.0, length, 1.0), (0.0, 0.0, 1.0))


def encode_normals(vectors: np.ndarray) -> np.ndarray:
    """Encode (n, 3) unit vectors as (n, 3) uint8: [-1, 1] to [0, 255]."""
    return np.rint((0.5 * vectors + 0.5) * 255.0).clip(0, 255).astype(np.uint8)
