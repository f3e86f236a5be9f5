# SPDX-License-Identifier: GPL-3.0-or-later
"""Normal maps and ambient occlusion of the dense mesh."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import igl
import numpy as np

from ..mesh.surface_mesh import SurfaceMesh, area_vectors
from ..mesh.tangent_frame import TangentFrames, shading_normals, tangent_frames
from ..progress import Progress
from .atlas import AtlasRaster, TexelPoints, texel_points
from .fill import fill_gutters

# -- Ray and nearest-point queries on a dense mesh, to transfer its detail to a lighter one -------
#
# Both use libigl's AABB tree in double precision, in coordinates normalised by the centre and
# size of the mesh, so that units and large offsets (UTM) do not affect the result.


BLOCK = 1 << 16
"""Points per query: bounds memory, and bounds the time for which libigl holds the GIL to a fraction
of a second."""
CAGE_SAMPLES = 20_000
"""Points of each mesh whose distance to the other mesh is measured."""
CAGE_FACTOR = 1.5
"""Margin: detail between the samples may be farther away."""
MIN_CAGE_SHARE = 1e-4
"""Share of the mesh's diagonal: minimum length of a ray, far above rounding."""
RETRY_OFFSET_SHARE = 1e-7
"""Share of the mesh's diagonal by which a ray without a hit is offset and cast again: rays in the
plane of an edge can pass between its two faces."""
RETRY_DIRECTION = np.array([0.5345, 0.2673, 0.8018])
"""Unit direction of that offset, along no likely axis of a mesh."""
NO_HIT, BY_RAY, BY_NEAREST = 0, 1, 2
"""How a correspondence on the dense mesh was found."""


@dataclass(frozen=True)
class SurfaceCorrespondences:
    """Corresponding points on the dense mesh."""

    face: np.ndarray  # (n,) int64, -1 without a correspondence
    weights: np.ndarray  # (n, 3) float64 barycentric weights of the face's corners
    method: np.ndarray  # (n,) uint8: ``NO_HIT``, ``BY_RAY`` or ``BY_NEAREST``

    def part(self, rows: np.ndarray) -> SurfaceCorrespondences:
        """Return some of them."""
        return SurfaceCorrespondences(self.face[rows], self.weights[rows], self.method[rows])


class DenseSurface:
    """A finite mesh, some of it with area, prepared for queries in the mesh's units."""

    def __init__(self, mesh: SurfaceMesh) -> None:
        vertices = np.asarray(mesh.vertices, np.float64)
        self.faces = np.ascontiguousarray(mesh.faces, np.int64)
        used = vertices[self.faces.ravel()]
        low, high = used.min(axis=0), used.max(axis=0)
        self._centre, self.size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        self.vertices = vertices
        self.vertex_normals = shading_normals(vertices, self.faces)
        self._local = (vertices - self._centre) / self.size
        self.face_normals = area_vectors(self._local, self.faces)
        self._tree = igl.AABB()
        self._tree.init(self._local, self.faces)

    def normals(self, matches: SurfaceCorrespondences) -> np.ndarray:
        """Return (n, 3) float64 interpolated unit normals; that of the face if they cancel."""
        corners = self.vertex_normals[self.faces[matches.face]]  # (n, 3, 3)
        normals = np.einsum("nc,ncx->nx", matches.weights, corners)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        flat = self.face_normals[matches.face]
        flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
        return np.where(length > 1e-6, normals / np.maximum(length, 1e-6), flat)

    def points(self, matches: SurfaceCorrespondences) -> np.ndarray:
        """Return (n, 3) float64 positions."""
        return np.einsum("nc,ncx->nx", matches.weights, self.vertices[self.faces[matches.face]])

    def first_hits(
        self, points: np.ndarray, directions: np.ndarray, reach: float
    ) -> SurfaceCorrespondences:
        """Return the first hit of each ray, of (n, 3) unit directions, on either side of a face."""
        count = len(points)
        face = np.full(count, -1, np.int64)
        weights = np.zeros((count, 3))
        for begin, end in _blocks(count):
            index, _, pair = self._tree.intersect_ray_first(
                self._local, self.faces, self._normalised(points[begin:end]),
                np.ascontiguousarray(directions[begin:end], np.float64), reach / self.size,
            )  # fmt: skip
            face[begin:end] = index
            weights[begin:end, 1:] = np.where(index[:, None] >= 0, pair, 0.0)
        weights[:, 0] = 1.0 - weights[:, 1] - weights[:, 2]
        method = np.where(face >= 0, BY_RAY, NO_HIT).astype(np.uint8)
        return SurfaceCorrespondences(face, weights, method)

    def _normalised(self, points: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray((points - self._centre) / self.size)

    def nearest(self, points: np.ndarray) -> tuple[SurfaceCorrespondences, np.ndarray]:
        """Return the nearest point on the mesh for each point, and the (n,) float64 distances."""
        count = len(points)
        face, distance = np.zeros(count, np.int64), np.zeros(count)
        weights = np.zeros((count, 3))
        for begin, end in _blocks(count):
            local = self._normalised(points[begin:end])
            square, index, closest = self._tree.squared_distance(self._local, self.faces, local)
            face[begin:end] = index
            distance[begin:end] = np.sqrt(np.maximum(square, 0.0)) * self.size
            weights[begin:end] = _barycentric(closest, self._local[self.faces[index]])
        return SurfaceCorrespondences(face, weights, np.full(count, BY_NEAREST, np.uint8)), distance

    def correspondences(
        self, points: np.ndarray, normals: np.ndarray, reach: float
    ) -> SurfaceCorrespondences:
        """Find the points on this mesh that correspond to points of a lighter one.

        Rays are cast in both directions along the normal. A first hit counts if the face normal
        agrees with the normal of the point; another sheet, such as the other side of a plate, is
        hit from the wrong side and does not count. Of two hits the nearer one is used; without a
        hit, the nearest point, if its face normal agrees. Points and unit normals are (n, 3), and
        the ``reach`` of the rays is :func:`cage_distance`.
        """
        face = np.full(len(points), -1, np.int64)
        weights = np.zeros((len(points), 3))
        for shift in (0.0, RETRY_OFFSET_SHARE * self.size):
            left, origins = np.flatnonzero(face < 0), points + shift * RETRY_DIRECTION
            best = np.full(len(points), np.inf)
            for sign in (1.0, -1.0):
                hits = self.first_hits(origins[left], sign * normals[left], reach)
                rows, part = left[hits.face >= 0], hits.part(hits.face >= 0)
                away = np.linalg.norm(self.points(part) - origins[rows], axis=1)
                agrees = (self.face_normals[part.face] * normals[rows]).sum(axis=1) > 0.0
                better = agrees & (away < best[rows])
                rows, part = rows[better], part.part(better)
                best[rows], face[rows], weights[rows] = away[better], part.face, part.weights
        method = np.where(face >= 0, BY_RAY, NO_HIT).astype(np.uint8)
        left = np.flatnonzero(face < 0)
        if len(left):
            matches, _ = self.nearest(points[left])
            agrees = (self.face_normals[matches.face] * normals[left]).sum(axis=1) > 0.0
            rows = left[agrees]
            face[rows], weights[rows] = matches.face[agrees], matches.weights[agrees]
            method[rows] = BY_NEAREST
        return SurfaceCorrespondences(face, weights, method)


def cage_distance(light: SurfaceMesh, dense: DenseSurface) -> float:
    """Return the required length of rays from one mesh to the other: slightly over their distance.

    Measured in both directions at up to :data:`CAGE_SAMPLES` points of each mesh.
    """
    middles = np.asarray(light.vertices, np.float64)[light.faces].mean(axis=1)
    one = dense.nearest(_spread(middles))[1].max()
    corners = dense.vertices[np.unique(dense.faces)]
    other = DenseSurface(light).nearest(_spread(corners))[1].max()
    return max(CAGE_FACTOR * float(max(one, other)), MIN_CAGE_SHARE * dense.size)


def _spread(points: np.ndarray) -> np.ndarray:
    """Return at most ``CAGE_SAMPLES`` of the points, evenly spaced by index."""
    return points[np.unique(np.linspace(0, len(points) - 1, CAGE_SAMPLES).astype(np.int64))]


def _blocks(count: int) -> Iterator[tuple[int, int]]:
    return ((begin, min(begin + BLOCK, count)) for begin in range(0, count, BLOCK))


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return (n, 3) barycentric weights of points; equal ones for triangles without area."""
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = points - corners[:, 0]
    a, b, c = (one * one).sum(1), (one * other).sum(1), (other * other).sum(1)
    d, e = (offset * one).sum(1), (offset * other).sum(1)
    determinant = a * c - b * b
    flat = determinant <= 1e-12 * np.maximum(a, c) ** 2
    safe = np.where(flat, 1.0, determinant)
    second = np.where(flat, 1.0 / 3.0, (c * d - b * e) / safe).clip(0.0, 1.0)
    third = np.where(flat, 1.0 / 3.0, (a * e - b * d) / safe).clip(0.0, 1.0)
    return np.stack([1.0 - second - third, second, third], axis=1)


# -- Tangent-space normal map: the detail of a dense mesh on a lighter one ------------------------


FLAT = (128, 128, 255)
"""Colour of the unperturbed normal, also used between charts."""


@dataclass(frozen=True)
class DetailMap:
    """Normal map or occlusion map."""

    image: np.ndarray
    """(h, w, 3) uint8, +Y (OpenGL, Blender, glTF), linear data, not sRGB; or (h, w) uint8, 255 if
    unoccluded."""
    statistics: dict[str, Any]
    """Size; distance of the meshes, shares of texels found by rays, by nearest points, or not at
    all; or rays per texel, their reach in scene units, mean."""


def bake_normal_map(
    light: SurfaceMesh, corner_uvs: np.ndarray, raster: AtlasRaster, dense: DenseSurface,
    gutter_px: int, progress: Progress,
) -> DetailMap:  # fmt: skip
    """Bake the dense mesh's normals in the tangent frames of the light, smooth shaded mesh.

    The meshes are in the same units; the map has the size of the raster of the (f, 3, 2) UVs, and
    its charts are dilated by the gutter.

    The three numbers of a texel solve ``x T + y B + z N = n`` with the interpolated tangent,
    bitangent and normal of the light mesh, so that a renderer recovers ``n`` for any lengths and
    angles of these. Normals that point below the light surface are clamped to it: z >= 0.
    """
    size = raster.face.shape[0]
    frames = tangent_frames(light.vertices, light.faces, corner_uvs)
    progress.update(0.0, "normal map: measuring the distance of the meshes")
    cage = cage_distance(light, dense)
    image = np.full((size, size, 3), FLAT, np.uint8)
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
        wanted[found] = dense.normals(matches.part(found))
        # From [-1, 1] to [0, 255].
        encoded = (0.5 * to_tangent_space(wanted, at, frames) + 0.5) * 255.0
        pixels[part] = np.rint(encoded).clip(0, 255).astype(np.uint8)
    fill_gutters(image, raster.face >= 0, gutter_px)
    progress.update(1.0, "normal map: finished")
    total = max(len(texels), 1)
    statistics = {
        "size_px": size, "dense_faces": len(dense.faces), "cage_scene": cage,
        "by_ray_share": float(counts[BY_RAY] / total),
        "by_nearest_share": float(counts[BY_NEAREST] / total),
        "flat_share": float(counts[NO_HIT] / total),
    }  # fmt: skip
    return DetailMap(image, statistics)


def to_tangent_space(wanted: np.ndarray, at: TexelPoints, frames: TangentFrames) -> np.ndarray:
    """Transform (n, 3) unit vectors to the tangent frames of points: unit length, z >= 0."""
    normal = at.raw_normals
    tangent = np.einsum("nc,ncx->nx", at.weights, frames.tangents[at.face])
    bitangent = frames.signs[at.face][:, None] * np.cross(normal, tangent)
    axes = (np.cross(bitangent, normal), np.cross(normal, tangent), np.cross(tangent, bitangent))
    volume = (tangent * axes[0]).sum(axis=1)
    # Times the volume.
    components = np.stack([(wanted * axis).sum(axis=1) for axis in axes], axis=1)
    components *= np.sign(volume)[:, None]
    components[:, 2] = np.maximum(components[:, 2], 0.0)
    length = np.linalg.norm(components, axis=1, keepdims=True)
    return np.where(length > 0.0, components / np.where(length > 0.0, length, 1.0), (0.0, 0.0, 1.0))


# -- Ambient occlusion map of the dense mesh ------------------------------------------------------


MAX_SIDE_PX = 1024
"""Occlusion varies slowly, and each texel costs :data:`RAYS` rays."""
RAYS = 16
"""The noise of a half-open texel is about 6 %; :func:`smoothed` leaves less than 2 % of it."""
SMOOTHING_RADIUS = 2
"""Texels on each side that are averaged, as far as they lie on the same piece of surface."""
SMOOTHING_SIGMA = 1.5
MAX_DIFFERENCE = 0.3
SAME_PLANE_COSINE = 0.95
"""Texels whose normals differ by more are not averaged: edges and creases stay."""
OFF_PLANE_TEXELS = 0.5
"""Nor are those that lie further off the tangent plane, in steps between texels."""
REACH_SHARE = 0.1
"""Share of the mesh's diagonal: surfaces farther away do not occlude."""
LIFT_SHARE = 1e-6
"""Share of the mesh's diagonal: height of the ray origins above the surface."""
GOLDEN = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 low-discrepancy sequence: powers of 1 / x with x^3 = x + 1."""


def bake_occlusion(
    light: SurfaceMesh, raster: AtlasRaster, dense: DenseSurface, gutter_px: int, progress: Progress
) -> DetailMap:
    """Bake the occlusion of the dense mesh at points that correspond to texels of the light one.

    The meshes are in the same units, and may be the same; the map has the size of the raster,
    sensibly at most :data:`MAX_SIDE_PX`, and its charts are dilated by the gutter.
    """
    size = raster.face.shape[0]
    cage = cage_distance(light, dense)
    reach = REACH_SHARE * dense.size
    normals = shading_normals(light.vertices, light.faces)
    texels = np.flatnonzero(raster.face.ravel() >= 0)
    open_share = np.ones(len(texels), np.float32)
    points, directions = (np.zeros((len(texels), 3)) for _ in range(2))
    block = max(1, BLOCK // RAYS)
    for begin in range(0, len(texels), block):
        progress.update(0.9 * begin / len(texels), "ambient occlusion: casting rays")
        part = texels[begin : begin + block]
        at = texel_points(light, raster, part, normals)
        matches = dense.correspondences(at.points, at.normals, cage)
        found = matches.method != NO_HIT
        rows = begin + np.flatnonzero(found)
        open_share[rows] = sky_visibility(dense, matches.part(found), reach, part[found])
        points[begin : begin + block] = at.points
        directions[begin : begin + block] = at.normals
    progress.update(0.9, "ambient occlusion: removing noise")
    open_share = smoothed(open_share, points, directions, texels, size)
    values = np.full((size, size), 255, np.uint8)
    values.ravel()[texels] = np.rint(255.0 * open_share).astype(np.uint8)
    image = np.repeat(values[..., None], 3, axis=2)
    fill_gutters(image, raster.face >= 0, gutter_px)
    progress.update(1.0, "ambient occlusion: finished")
    mean = float(values.ravel()[texels].mean() / 255.0) if len(texels) else 1.0
    statistics = {"size_px": size, "rays": RAYS, "reach_scene": reach, "open_share": mean}
    return DetailMap(np.ascontiguousarray(image[..., 0]), statistics)


def smoothed(
    values: np.ndarray, points: np.ndarray, normals: np.ndarray, texels: np.ndarray, size: int
) -> np.ndarray:
    """Average the values of texels over their neighbours on the same piece of surface.

    Values (n,) float32, surface points and unit normals (n, 3) are those of the ``texels``: (n,)
    flat indices in an atlas of side ``size``, in ascending order.
    """
    number = np.full((size + 2 * SMOOTHING_RADIUS,) * 2, -1, np.int64)
    inner = slice(SMOOTHING_RADIUS, SMOOTHING_RADIUS + size)
    grid = np.full(size * size, -1, np.int64)
    grid[texels] = np.arange(len(texels))
    number[inner, inner] = grid.reshape(size, size)
    row, column = texels // size + SMOOTHING_RADIUS, texels % size + SMOOTHING_RADIUS
    total, weight = values.astype(np.float64), np.ones(len(values))
    steps = range(-SMOOTHING_RADIUS, SMOOTHING_RADIUS + 1)
    spacing = _spacing(points, number, row, column)
    for dy, dx in ((dy, dx) for dy in steps for dx in steps if (dy, dx) != (0, 0)):
        other = number[row + dy, column + dx]
        mine = np.flatnonzero(other >= 0)
        other = other[mine]
        offset = points[other] - points[mine]
        reach = spacing[mine] * (np.hypot(dx, dy) + 1.0)
        flat = np.abs((offset * normals[mine]).sum(axis=1)) < OFF_PLANE_TEXELS * spacing[mine]
        near = (offset**2).sum(axis=1) < reach**2  # another chart lies elsewhere
        same = (normals[other] * normals[mine]).sum(axis=1) > SAME_PLANE_COSINE
        # What differs by more than the noise is an edge of a shadow.
        alike = np.abs(values[other] - values[mine]) < MAX_DIFFERENCE
        chosen = flat & near & same & alike
        share = math.exp(-0.5 * (dx * dx + dy * dy) / SMOOTHING_SIGMA**2)
        total[mine[chosen]] += share * values[other[chosen]]
        weight[mine[chosen]] += share
    averaged: np.ndarray = (total / weight).astype(np.float32)
    return averaged


def _spacing(
    points: np.ndarray, number: np.ndarray, row: np.ndarray, column: np.ndarray
) -> np.ndarray:
    """Return (n,) distances of texels to the nearest of their four neighbours."""
    best = np.full(len(points), np.inf)
    for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        other = number[row + dy, column + dx]
        mine = np.flatnonzero(other >= 0)
        length = np.linalg.norm(points[other[mine]] - points[mine], axis=1)
        best[mine] = np.minimum(best[mine], length)
    return np.where(np.isfinite(best), best, 0.0)


def sky_visibility(
    surface: DenseSurface, matches: SurfaceCorrespondences, reach: float, numbers: np.ndarray,
    rays: int = RAYS,
) -> np.ndarray:  # fmt: skip
    """Return the share of light from a uniform sky that reaches points, each on a face of a mesh.

    (n,) float64, 1 if nothing within ``reach`` occludes the sky, weighted by the cosine to the face
    normal. The (n,) ``numbers`` offset the fixed ray pattern of each point, so that errors of
    neighbours are uncorrelated.
    """
    normals = surface.face_normals[matches.face]
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    sign = np.where(normals[:, 2] < 0.0, -1.0, 1.0)
    # Two axes orthogonal to each normal, without a special case (Duff and others, 2017).
    scale = -1.0 / (sign + normals[:, 2])
    mixed = normals[:, 0] * normals[:, 1] * scale
    one = np.stack(
        [1.0 + sign * normals[:, 0] ** 2 * scale, sign * mixed, -sign * normals[:, 0]], axis=1
    )
    other = np.stack([mixed, sign + normals[:, 1] ** 2 * scale, -normals[:, 1]], axis=1)
    turn = (np.asarray(numbers, np.int64)[:, None] % 65_521) * GOLDEN  # (n, 2)
    number = (np.arange(rays)[:, None] + 0.5) * np.array([1.0 / rays, GOLDEN[0]])
    share = (number[None] + turn[:, None]) % 1.0  # (n, rays, 2)
    # Uniform on the disc is cosine-weighted on the hemisphere.
    radius, angle = np.sqrt(share[..., 0]), 2.0 * np.pi * share[..., 1]
    height = np.sqrt(1.0 - share[..., 0])
    directions = (
        (radius * np.cos(angle))[..., None] * one[:, None]
        + (radius * np.sin(angle))[..., None] * other[:, None]
        + height[..., None] * normals[:, None]
    )  # (n, rays, 3)
    origins = surface.points(matches) + LIFT_SHARE * surface.size * normals
    origins = np.repeat(origins, rays, axis=0)
    hit = surface.first_hits(origins, directions.reshape(-1, 3), reach).face >= 0
    return 1.0 - hit.reshape(-1, rays).mean(axis=1)
