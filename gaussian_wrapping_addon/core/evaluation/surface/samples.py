# SPDX-License-Identifier: GPL-3.0-or-later
"""Sample a surface by points with normals: uniformly, by a virtual scan, or per face (legacy)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...dataset.camera import Camera
from ...dataset.similarity import Similarity
from ...errors import MeshingError, UsageError
from ...mesh.depth_buffer import depth_buffer

DEGENERATE_SHARE = 1e-12
"""A face whose doubled area is below this share of its longest edge squared has no normal."""

SCAN_NEAR_SHARE = 1e-7
"""Near plane of a virtual scan, as a share of the extent of mesh and cameras. The protocol has
none, but a point in the camera's plane has no projection."""

PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 sequence, the additive recurrence in the plane with the smallest known
discrepancy: 1 / g and 1 / g^2 with g^3 = g + 1."""


@dataclass(frozen=True)
class SurfaceSamples:
    """Points on a surface, in the frame of the mesh they come from."""

    points: np.ndarray
    """(n, 3) float64."""
    normals: np.ndarray
    """(n, 3) float64, unit length, or 0 if unknown; oriented like the surface."""

    def __len__(self) -> int:
        return len(self.points)

    def kept(self, mask: np.ndarray) -> SurfaceSamples:
        """Return the samples selected by a (n,) bool mask or an index array."""
        return SurfaceSamples(self.points[mask], self.normals[mask])

    @classmethod
    def empty(cls) -> SurfaceSamples:
        """Return an empty set of samples."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)))


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (f, 3) and areas (f,) of faces, both 0 for degenerate faces."""
    corners = vertices[faces]  # (f, 3, 3)
    edges = np.roll(corners, -1, axis=1) - corners  # (f, 3, 3), b - a, c - b, a - c
    cross = np.cross(edges[:, 0], -edges[:, 2])  # (f, 3)
    doubled = np.linalg.norm(cross, axis=1)
    longest = (edges**2).sum(2).max(1) if len(faces) else np.zeros(0)
    sound = doubled > DEGENERATE_SHARE * longest
    normals = np.where(sound[:, None], cross / np.where(sound, doubled, 1.0)[:, None], 0.0)
    return normals, np.where(sound, doubled / 2, 0.0)


def sample_uniformly(
    vertices: np.ndarray, faces: np.ndarray, count: int, *, seed: int
) -> SurfaceSamples:
    """Sample a mesh uniformly by area (docs/method.md, section 9.1).

    Stratified: one point is drawn from each of ``count`` equal parts of the area, along the list of
    faces; several points on one face follow a low-discrepancy sequence. The density on any part of
    the surface therefore depends on its area and not on its tessellation.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
    count : int
        Exact number of samples.
    seed : int
        The same seed gives bitwise identical samples.

    Returns
    -------
    SurfaceSamples
        With the normals of the faces; degenerate faces get no samples.

    Raises
    ------
    MeshingError
        No face has an area, or a used vertex is not finite.
    UsageError
        ``count`` is less than one, or a vertex index of a face is out of range.
    """
    if count < 1:
        raise UsageError(f"{count} samples were requested.", "Request at least one.")
    vertices, faces = _checked(vertices, faces)
    local, origin = _centred(vertices, faces)
    normals, areas = face_normals(local, faces)
    sound = np.flatnonzero(areas > 0)
    if len(sound) == 0:
        raise MeshingError(
            "The mesh has no area to sample.", "Check that the reconstruction is not empty."
        )
    rng = np.random.default_rng(seed)
    total = np.cumsum(areas[sound])
    where = (np.arange(count) + rng.random(count)) * (total[-1] / count)  # (n,)
    slot = np.minimum(np.searchsorted(total, where, side="right"), len(sound) - 1)
    weights = np.modf(rng.random(2) + np.arange(1, count + 1)[:, None] * PLASTIC)[0]  # (n, 2)
    weights = np.where(weights.sum(1, keepdims=True) > 1.0, 1.0 - weights, weights)
    face = sound[slot]
    a, b, c = (local[faces[face, k]] for k in range(3))
    points = a + weights[:, :1] * (b - a) + weights[:, 1:] * (c - a)  # (n, 3)
    return SurfaceSamples(points + origin, normals[face])


def sample_legacy(vertices: np.ndarray, faces: np.ndarray) -> SurfaceSamples:
    """Return all used vertices and all face centres (docs/method.md, section 9.1).

    The density depends on the tessellation: the bias that the other samplings avoid. Vertices have
    no normal here; centres have that of their face.

    Raises
    ------
    MeshingError
        There is no face, or a vertex that is used is not finite.
    """
    vertices, faces = _checked(vertices, faces)
    local, origin = _centred(vertices, faces)
    used = np.unique(faces)
    normals, _ = face_normals(local, faces)
    centres = local[faces].mean(1)
    return SurfaceSamples(
        np.concatenate([vertices[used], centres + origin]),
        np.concatenate([np.zeros((len(used), 3)), normals]),
    )


def scan_virtually(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: Sequence[Camera],
    *,
    threads: int = 1,
    step_px: float = 1.0,
) -> SurfaceSamples:
    """Collect the first hits of all pixels of cameras on a mesh (docs/method.md, section 9.1).

    No near plane and no back-face culling: faces occlude from both sides. Points lie on their faces
    to float64 precision, also at world coordinates of millions. Normals are those of the faces as
    oriented in the mesh, not turned towards the camera, so that a face seen from its inner side
    counts as wrongly oriented.

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int
    cameras : sequence of Camera
        In the frame of the mesh.
    threads : int
        Threads to use; the result does not depend on it.
    step_px : float
        Distance between rays in pixels of the cameras; 2 gives a quarter of the points.

    Returns
    -------
    SurfaceSamples
        Ordered by camera, then row; empty if no camera sees the mesh.

    Raises
    ------
    MeshingError
        There is no face, or a vertex that is used is not finite.
    UsageError
        ``step_px`` is less than one.
    """
    if not step_px >= 1.0:
        raise UsageError(f"A scan with a step of {step_px} pixels.", "Give at least 1.")
    vertices, faces = _checked(vertices, faces)
    local, origin = _centred(vertices, faces)
    faces = np.ascontiguousarray(faces, np.int32)
    normals, _ = face_normals(local, faces)
    points, directions = [np.zeros((0, 3))], [np.zeros((0, 3))]
    to_local = Similarity(translation=-origin)
    used = np.unique(faces)
    for camera in cameras:
        moved = camera.moved(to_local).resized(
            max(1, round(camera.width / step_px)), max(1, round(camera.height / step_px))
        )
        seen = moved.to_camera(local)
        near = SCAN_NEAR_SHARE * float(np.abs(seen[used]).max())
        buffer = depth_buffer(local, faces, moved, threads=threads, near=near)
        hit = buffer.face >= 0  # (h, w)
        face = buffer.face[hit]
        weights = _weights_on_faces(seen[faces[face]], moved.rays()[hit])
        points.append(np.einsum("nc,ncx->nx", weights, local[faces[face]]) + origin)
        directions.append(normals[face])
    return SurfaceSamples(np.concatenate(points), np.concatenate(directions))


def _weights_on_faces(corners: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return barycentric weights (n, 3) where rays (n, 3) from the origin hit triangles (n, 3, 3).

    Clamped to the triangle, so that rounding moves no point of a grazing ray off its face.
    """
    volumes = np.stack(
        [
            (rays * np.cross(corners[:, (k + 1) % 3], corners[:, (k + 2) % 3])).sum(1)
            for k in range(3)
        ],
        1,
    )  # (n, 3), of one sign where the ray hits the face
    sign = np.sign(volumes.sum(1, keepdims=True))
    weights = np.maximum(volumes * sign, 0.0)
    total = weights.sum(1, keepdims=True)
    return np.where(total > 0, weights / np.where(total > 0, total, 1.0), 1.0 / 3.0)


def voxel_downsample(samples: SurfaceSamples, voxel: float) -> SurfaceSamples:
    """Replace the samples in each voxel by their mean, as point-cloud tools do.

    The grid begins half a voxel before the smallest coordinates. Mean normals are normalised; they
    are 0 where the normals in a voxel cancel.

    Parameters
    ----------
    voxel : float
        Side of a voxel, > 0, in the samples' frame.

    Returns
    -------
    SurfaceSamples
        In order of the voxels (x, then y, then z).

    Raises
    ------
    UsageError
        ``voxel`` is not a positive number, or too small to index the voxels.
    """
    group, members = _cells(samples.points, voxel)
    if len(samples) == 0:
        return samples
    low = samples.points.min(0)
    normals = _means(samples.normals, group, members)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    known = length > 1e-9  # shorter means result from normals that cancel, up to rounding
    normals = np.where(known, normals / np.where(known, length, 1.0), 0.0)
    return SurfaceSamples(_means(samples.points - low, group, members) + low, normals)


def voxel_downsample_points(points: np.ndarray, voxel: float) -> np.ndarray:
    """Downsample (n, 3) points without normals; see :func:`voxel_downsample`."""
    return voxel_downsample(SurfaceSamples(points, np.zeros_like(points)), voxel).points


def choose_per_cell(samples: SurfaceSamples, voxel: float) -> SurfaceSamples:
    """Keep in each voxel the sample nearest to the mean of its samples.

    As even as :func:`voxel_downsample`, but the samples stay on a curved surface, which means do
    not. Same grid, order and errors; ties go to the earlier sample.
    """
    group, members = _cells(samples.points, voxel)
    if len(samples) == 0:
        return samples
    local = samples.points - samples.points.min(0)
    away = ((local - _means(local, group, members)[group]) ** 2).sum(1)  # (n,)
    order = np.lexsort((away, group))  # stable: ties stay in order
    return samples.kept(order[np.cumsum(members) - members])


def _cells(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the occupied voxel of each point (n,), and the points per voxel (c,)."""
    if not (np.isfinite(voxel) and voxel > 0):
        raise UsageError(
            f"A voxel of {voxel} cannot be used for downsampling.", "Give a length > 0."
        )
    if len(points) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    local = points - points.min(0)
    cells = np.floor(local / voxel + 0.5)  # (n, 3)
    size = cells.max(0) + 1
    if not np.prod(size) < 2.0**62:
        raise UsageError(
            f"Voxels of {voxel} are too small for samples that extend over {local.max():.6g}.",
            "Give a larger voxel.",
        )
    whole, sides = cells.astype(np.int64), size.astype(np.int64)
    key = (whole[:, 0] * sides[1] + whole[:, 1]) * sides[2] + whole[:, 2]
    _, group, members = np.unique(key, return_inverse=True, return_counts=True)
    return group, members


def _means(values: np.ndarray, group: np.ndarray, members: np.ndarray) -> np.ndarray:
    """Return the mean of the rows (n, 3) of each group, (c, 3)."""
    sums = [np.bincount(group, values[:, k], len(members)) for k in range(3)]
    return np.stack(sums, 1) / members[:, None]


def _checked(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise UsageError(
            f"A mesh has arrays of shapes {vertices.shape} and {faces.shape}.",
            "Give vertices (v, 3) and faces (f, 3).",
        )
    if len(faces) == 0:
        raise MeshingError("The mesh has no faces.", "Check that the reconstruction is not empty.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UsageError(
            f"The mesh's faces have vertex indices outside 0 to {len(vertices) - 1}.",
            "Export the mesh again.",
        )
    if not np.isfinite(vertices[np.unique(faces)]).all():
        raise MeshingError(
            "The mesh has a vertex that is not finite.", "Remove it, or make the mesh again."
        )
    return vertices, faces


def _centred(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices relative to the centre of the used ones' bounds, and that centre (3,)."""
    used = vertices[np.unique(faces)]
    origin = (used.min(0) + used.max(0)) / 2
    return vertices - origin, origin
