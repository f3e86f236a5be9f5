# SPDX-License-Identifier: GPL-3.0-or-later
"""Precision, recall, F1 and Chamfer distance of a surface."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from ..errors import DatasetError, MeshingError, ParseError, UsageError
from ..files import finite_json
from ..mesh.depth_buffer import depth_buffer
from ..mesh.sampling import distances_to_cloud, distances_to_mesh
from ..parallel import default_threads
from ..regions.scene_regions import read_region
from ..regions.shapes import Region
from ..scene.camera import Camera, Similarity

# -- Sample a surface by points with normals: uniformly, by a virtual scan, or per face (legacy)


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

    points: np.ndarray  # (n, 3) float64
    normals: np.ndarray  # (n, 3) float64, unit length, or 0 if unknown; oriented like the surface.

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

    Of vertices (v, 3) float64 and faces (f, 3) int, exactly ``count`` samples are drawn, with the
    normals of their faces; degenerate faces get none. The same seed gives bitwise identical ones.

    Raises
    ------
    MeshingError
        No face has an area, or a used vertex is not finite.
    UsageError
        ``count`` is less than one, or a vertex index of a face is out of range.
    """
    if count < 1:
        raise UsageError(f"{count} samples were requested.", "Request at least one.")
    vertices, faces = _checked_samples(vertices, faces)
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
    vertices, faces = _checked_samples(vertices, faces)
    local, origin = _centred(vertices, faces)
    used = np.unique(faces)
    normals, _ = face_normals(local, faces)
    centres = local[faces].mean(1)
    return SurfaceSamples(
        np.concatenate([vertices[used], centres + origin]),
        np.concatenate([np.zeros((len(used), 3)), normals]),
    )


def scan_virtually(
    vertices: np.ndarray, faces: np.ndarray, cameras: Sequence[Camera], *, threads: int = 1,
    step_px: float = 1.0,
) -> SurfaceSamples:  # fmt: skip
    """Collect the first hits of all pixels of cameras on a mesh (docs/method.md, section 9.1).

    No near plane and no back-face culling: faces occlude from both sides. Points lie on their faces
    to float64 precision, also at world coordinates of millions. Normals are those of the faces as
    oriented in the mesh, not turned towards the camera, so that a face seen from its inner side
    counts as wrongly oriented.

    Parameters
    ----------
    vertices, faces : (v, 3) float64, (f, 3) int
    cameras : sequence of Camera
        In the frame of the mesh.
    threads : int
        The result does not depend on it.
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
    vertices, faces = _checked_samples(vertices, faces)
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
    pairs = [(corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]) for k in range(3)]
    # (n, 3), of one sign where the ray hits the face
    volumes = np.stack([(rays * np.cross(*pair)).sum(1) for pair in pairs], 1)
    sign = np.sign(volumes.sum(1, keepdims=True))
    weights = np.maximum(volumes * sign, 0.0)
    total = weights.sum(1, keepdims=True)
    return np.where(total > 0, weights / np.where(total > 0, total, 1.0), 1.0 / 3.0)


def voxel_downsample(points: np.ndarray, voxel: float) -> np.ndarray:
    """Replace the points (n, 3) in each voxel of this side by their mean, as cloud tools do.

    The grid begins half a voxel before the smallest coordinates; the means are in the order of the
    voxels (x, then y, then z).

    Raises
    ------
    UsageError
        ``voxel`` is not a positive number, or too small to index the voxels.
    """
    group, members = _cells(points, voxel)
    if len(points) == 0:
        return points
    low = points.min(0)
    return _means(points - low, group, members) + low


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


def _checked_samples(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


# -- Ground truth of a reconstruction: the true surface, its samples and their visibility ---------


TRUTH_FILE = "truth.npz"
CROP_FILE = "crop.json"
MIN_CAMERAS = 2
"""A sample counts as visible if this many training cameras see it; fewer give no depth."""

_AGAIN = "Make the scene again."


@dataclass(frozen=True)
class Truth:
    """The true surface, in the frame of the surfaces compared with it.

    Raises
    ------
    DatasetError
        Arrays of different lengths, values that are not finite, or no samples.
    """

    samples: SurfaceSamples
    vertices: np.ndarray | None = None  # (v, 3) float64, or ``None`` if only a cloud is known
    faces: np.ndarray | None = None  # (f, 3) int
    thin: np.ndarray | None = None
    """(n,) bool: the sample lies on a thin structure; ``None`` if not labelled."""
    seen: np.ndarray | None = None
    """(n,) int32: number of training cameras that see the sample; ``None`` if unknown."""
    crop: Region | None = None  # samples outside are not evaluated

    def __post_init__(self) -> None:
        count = len(self.samples)
        if count == 0:
            raise DatasetError("The ground truth has no samples.", _AGAIN)
        if self.samples.points.shape != (count, 3) or self.samples.normals.shape != (count, 3):
            raise DatasetError("The ground truth's points or normals are not (n, 3).", _AGAIN)
        if not (np.isfinite(self.samples.points).all() and np.isfinite(self.samples.normals).all()):
            raise DatasetError("The ground truth has values that are not finite.", _AGAIN)
        for name, values in (("thin", self.thin), ("seen", self.seen)):
            if values is not None and values.shape != (count,):
                raise DatasetError(
                    f"The ground truth has {count} samples, but {name!r} has the shape "
                    f"{values.shape}.",
                    _AGAIN,
                )
        if (self.vertices is None) != (self.faces is None):
            raise DatasetError("The ground truth has vertices or faces, not both.", _AGAIN)

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Vertices and faces, or ``None`` for a cloud."""
        if self.vertices is None or self.faces is None:
            return None
        return self.vertices, self.faces

    def judged(self) -> np.ndarray:
        """Return whether each sample is inside the crop, (n,) bool."""
        if self.crop is None:
            return np.ones(len(self.samples), np.bool_)
        return self.crop.contains(self.samples.points)

    def visible(self) -> np.ndarray:
        """Return whether enough cameras see each sample, (n,) bool; true if unknown."""
        if self.seen is None:
            return np.ones(len(self.samples), np.bool_)
        return self.seen >= MIN_CAMERAS

    def kept(self, mask: np.ndarray) -> Truth:
        """Return the same surface with the samples selected by a (n,) bool mask."""
        return replace(
            self,
            samples=self.samples.kept(mask),
            thin=None if self.thin is None else self.thin[mask],
            seen=None if self.seen is None else self.seen[mask],
        )


def read_truth(folder: Path) -> Truth:
    """Read ``truth.npz`` and ``crop.json`` of a ground-truth scene's folder.

    ``truth.npz`` holds ``vertices`` (v, 3) and ``faces`` (f, 3) of the closed true surface,
    outward, in the world frame of the cameras; ``points`` and unit ``normals`` (n, 3); ``thin``
    (n,) bool; ``seen`` (n,) int32, the number of training cameras that see a sample. ``crop.json``
    is a bounding volume (docs/method.md, section 7.3) in the same frame.

    Raises
    ------
    ParseError
        States the file and the entry that is missing or invalid.
    """
    path = Path(folder) / TRUTH_FILE
    try:
        with np.load(path, allow_pickle=False) as stored:
            entries = {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise ParseError(path, "whole file", f"cannot be read ({error}).", _AGAIN) from None
    shapes = (
        ("vertices", 3, "f"), ("faces", 3, "iu"), ("points", 3, "f"), ("normals", 3, "f"),
        ("thin", 0, "b"), ("seen", 0, "iu"),
    )  # fmt: skip
    for name, width, kinds in shapes:
        if name not in entries:
            raise ParseError(path, name, "is missing.", _AGAIN)
        values = entries[name]
        if values.ndim != (2 if width else 1) or (width and values.shape[1] != width):
            raise ParseError(path, name, f"has the shape {values.shape}.", _AGAIN)
        if values.dtype.kind not in kinds:
            raise ParseError(path, name, f"has the type {values.dtype}.", _AGAIN)
    faces = entries["faces"].astype(np.int64)
    if len(faces) and not (faces.min() >= 0 and faces.max() < len(entries["vertices"])):
        raise ParseError(path, "faces", "refers to vertices that do not exist.", _AGAIN)
    samples = SurfaceSamples(
        entries["points"].astype(np.float64), entries["normals"].astype(np.float64)
    )
    try:
        return Truth(
            samples, entries["vertices"].astype(np.float64), faces, entries["thin"],
            entries["seen"].astype(np.int32), read_region(Path(folder) / CROP_FILE),
        )  # fmt: skip
    except ParseError:
        raise
    except DatasetError as error:
        raise ParseError(path, "arrays", error.message, error.hint) from None


# -- Scores of a reconstructed surface: precision, recall, F1, Chamfer distance, normals ----------
#
# See docs/method.md, section 9.1.


PROTOCOLS = ("uniform", "scan", "legacy")

MIN_THIN_SHARE = 0.01
"""Recall of thin parts is not meaningful if a smaller share of the true samples is thin."""

SCAN_RAYS = 4_000_000
"""Rays of a virtual scan, which steps over pixels of more: at most about 400 MB of points."""

Shares = tuple[float, ...]  # one number in [0, 1] for each threshold
_Mesh = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class SurfaceScore:
    """Scores of one surface under one protocol; conventions: :func:`score_surface`."""

    thresholds: tuple[float, ...]
    precision: Shares
    recall: Shares
    f1: Shares
    visible_recall: Shares | None
    """Recall over the true samples that cameras see; ``None`` if visibility is unknown."""
    thin_recall: Shares | None
    """Recall over visible samples on thin structures; ``None`` without any."""
    accuracy_mean: float
    accuracy_median: float
    """Distance from the predicted samples to the truth; infinite without samples."""
    completeness_mean: float
    completeness_median: float
    """Distance from the true samples to the prediction; infinite if that is empty."""
    chamfer_mean: float
    chamfer_median: float
    """Mean of accuracy and completeness (means, medians)."""
    normal_consistency: float
    """Mean absolute cosine between corresponding normals, averaged over both directions."""
    normal_agreement: float
    """Share of corresponding points whose normals point to the same side, averaged likewise."""
    predicted_count: int
    truth_count: int
    visible_count: int
    thin_count: int
    """Number of evaluated samples."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; infinite distances become ``None``."""
        return dict(finite_json(dataclasses.asdict(self)))


@dataclass(frozen=True)
class CloudScore:
    """Scores of one cloud against another at one threshold."""

    threshold: float
    precision: float
    recall: float
    f1: float
    accuracy_mean: float
    completeness_mean: float
    """Mean distances; infinite if the prediction is empty."""
    predicted_count: int
    truth_count: int
    """Number of points after downsampling."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; infinite distances become ``None``."""
        return dict(finite_json(dataclasses.asdict(self)))


def score_surface(
    predicted: SurfaceSamples, predicted_mesh: _Mesh | None, truth: Truth,
    thresholds: Sequence[float], *, reached: SurfaceSamples | None = None, threads: int = 1,
) -> SurfaceScore:  # fmt: skip
    """Compare samples of a surface with the truth.

    The crop selects the samples that are evaluated, on either side, but not what they are compared
    with: a sample at its boundary may have its counterpart outside. Conventions:

    - precision: share of evaluated predicted samples within the threshold (``<=``) of the truth's
      mesh, or of its cloud if it has no mesh;
    - recall: share of evaluated true samples within it of ``predicted_mesh``, or if that is
      ``None`` of the samples ``reached``, or else of the predicted ones; visible recall: of those
      that at least :data:`MIN_CAMERAS` cameras see; thin recall: of those that are thin and, if
      known, visible;
    - F1: harmonic mean of the two, 0 if both are 0;
    - normals: over all evaluated samples of either side, at any distance, if both the sample and
      its nearest counterpart have a normal; 0 without such pairs;
    - an empty prediction, or one outside the crop, has precision, recall, F1 and normal scores of
      0 and infinite distances if there is nothing to measure from or to. No figure is NaN.

    Parameters
    ----------
    predicted : SurfaceSamples
        In the truth's frame, like the mesh.
    predicted_mesh : (vertices, faces) or None
        Given for the uniform protocol; ``None`` for scan and legacy, which evaluate a cloud.
    thresholds : sequence of float
        Distances > 0 in the truth's frame.
    reached : SurfaceSamples, optional
        A denser set from which ``predicted`` was evenly subsampled.
    threads : int
        Of the search in clouds; the result does not depend on it.

    Raises
    ------
    UsageError
        A threshold is not a positive number, or no true sample is inside the crop.
    """
    limits = _checked_scores(thresholds)
    judged = truth.judged()
    if not judged.any():
        raise UsageError("No true sample lies inside the crop.", "Check the crop's frame.")
    inside = np.ones(len(predicted), np.bool_)
    if truth.crop is not None and len(predicted):
        inside = truth.crop.contains(predicted.points)
    true, shown = truth.samples.kept(judged), predicted.kept(inside)

    accuracy, there = _nearest(shown, truth.mesh, truth.samples, threads)
    if len(shown):
        cloud = predicted if reached is None else reached
        completeness, back = _nearest(true, predicted_mesh, cloud, threads)
    else:
        completeness, back = np.full(len(true), np.inf), np.zeros((len(true), 3))
    visible = truth.visible()[judged]
    thin = np.zeros(len(true), np.bool_) if truth.thin is None else truth.thin[judged] & visible
    precision, recall = _shares(accuracy, limits), _shares(completeness, limits)
    knows_seen = truth.seen is not None and bool(visible.any())
    cosines = (shown.normals * there).sum(1), (true.normals * back).sum(1)
    known = shown.normals.any(1) & there.any(1), true.normals.any(1) & back.any(1)
    pairs = [cosine[mask] for cosine, mask in zip(cosines, known, strict=True)]
    means = _mean(accuracy), _mean(completeness)
    medians = _median(accuracy), _median(completeness)
    return SurfaceScore(
        thresholds=limits, precision=precision, recall=recall,
        f1=tuple(_f1(p, r) for p, r in zip(precision, recall, strict=True)),
        visible_recall=_shares(completeness[visible], limits) if knows_seen else None,
        thin_recall=_shares(completeness[thin], limits) if thin.any() else None,
        accuracy_mean=means[0], accuracy_median=medians[0], completeness_mean=means[1],
        completeness_median=medians[1], chamfer_mean=(means[0] + means[1]) / 2,
        chamfer_median=(medians[0] + medians[1]) / 2,
        normal_consistency=_symmetric_mean([np.abs(values) for values in pairs]),
        normal_agreement=_symmetric_mean([(values > 0).astype(np.float64) for values in pairs]),
        predicted_count=len(shown), truth_count=len(true),
        visible_count=int(visible.sum()) if knows_seen else 0, thin_count=int(thin.sum()),
    )  # fmt: skip


def score_protocols(
    vertices: np.ndarray, faces: np.ndarray, truth: Truth, cameras: Sequence[Camera],
    thresholds: Sequence[float], *, count: int = 200_000, seed: int = 0, threads: int = 1,
    protocols: Sequence[str] = PROTOCOLS,
) -> dict[str, SurfaceScore]:  # fmt: skip
    """Score a mesh by several protocols (docs/method.md, section 9.1).

    - ``uniform``: ``count`` samples uniform over the mesh; recall is measured against the mesh
      itself, so it does not depend on their density. Inner sides and hidden parts count.
    - ``scan``: the surface seen by the cameras, downsampled to one point per voxel of half the
      smallest threshold, so that parts near many cameras do not weigh more. Recall is measured
      against all points seen, and only over the true samples that at least :data:`MIN_CAMERAS`
      cameras see (all, if unknown), because a scan cannot reach others. Hidden parts do not count
      on either side. The distance between neighbouring points of the scan must be well below the
      thresholds.
    - ``legacy``: vertices and face centres; recall is measured against these points. Biased by
      tessellation: only for comparison with older figures.

    Parameters
    ----------
    vertices, faces : (v, 3), (f, 3)
        The mesh in the truth's frame, possibly empty.
    cameras : sequence of Camera
        In the truth's frame; only used by ``scan``.
    thresholds : sequence of float
        Distances > 0.
    count, seed
        See :func:`sample_uniformly`.
    threads : int
        0 for every core; the result does not depend on it. Distances to meshes always use every
        core (see :func:`~.sampling.distances_to_mesh`).
    protocols : sequence of str
        Elements of :data:`PROTOCOLS`, in the order of the result.

    Raises
    ------
    UsageError
        An unknown protocol, a scan without cameras or without a visible true sample, or as in
        :func:`score_surface`.
    MeshingError
        A vertex is not finite.
    """
    limits = _checked_scores(thresholds)
    threads = threads or default_threads()
    result: dict[str, SurfaceScore] = {}
    for protocol in protocols:
        judged, mesh, reached = truth, None, None
        if protocol == "uniform":
            predicted, mesh = _uniform(vertices, faces, count, seed), (vertices, faces)
        elif protocol == "scan":
            if len(cameras) == 0:
                raise UsageError("A virtual scan needs cameras.", "Give those of the photos.")
            visible = truth.visible()
            if not visible.any():
                raise UsageError(
                    f"No true sample is seen by {MIN_CAMERAS} cameras.", "Require fewer cameras."
                )
            judged = truth.kept(visible)
            predicted = SurfaceSamples.empty()
            if len(faces):
                rays = sum(camera.width * camera.height for camera in cameras)
                step = max(1.0, math.sqrt(rays / SCAN_RAYS))
                reached = scan_virtually(vertices, faces, cameras, threads=threads, step_px=step)
                predicted = choose_per_cell(reached, min(limits) / 2)
        elif protocol == "legacy":
            predicted = sample_legacy(vertices, faces) if len(faces) else SurfaceSamples.empty()
        else:
            raise UsageError(f"Protocol {protocol!r} is unknown.", f"Use {', '.join(PROTOCOLS)}.")
        # A mesh of degenerate faces only counts as empty.
        result[protocol] = score_surface(
            predicted, mesh if len(predicted) else None, judged, limits,
            reached=reached, threads=threads,
        )  # fmt: skip
    return result


def score_clouds(
    predicted_points: np.ndarray, truth_points: np.ndarray, threshold: float, *,
    voxel: float | None, threads: int = 1,
) -> CloudScore:  # fmt: skip
    """Compare point clouds by the protocol of Tanks and Temples, after alignment and crop.

    See docs/method.md, section 9.1.

    Parameters
    ----------
    predicted_points, truth_points : (n, 3), (m, 3) float64
        Without predicted ones precision, recall and F1 are 0.
    threshold : float
        A point counts within this distance (``<=``).
    voxel : float or None
        Both clouds are first downsampled to one mean per voxel of this side; the protocol uses
        half of the threshold. ``None``: no downsampling.
    threads : int
        Of the search; the result does not depend on it.

    Raises
    ------
    UsageError
        The truth is empty, a value is not finite, or threshold or voxel is not positive.
    """
    (limit,) = _checked_scores([threshold])
    clouds = []
    for name, points in (("predicted", predicted_points), ("true", truth_points)):
        points = np.asarray(points, np.float64).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise UsageError(f"The {name} cloud has a point that is not finite.", "Remove it.")
        if voxel is not None:
            points = voxel_downsample(points, voxel)
        clouds.append(points)
    predicted, truth = clouds
    if len(truth) == 0:
        raise UsageError("The true cloud is empty.", "Check the crop and the alignment.")
    accuracy, _ = distances_to_cloud(predicted, truth, threads=threads)
    completeness, _ = distances_to_cloud(truth, predicted, threads=threads)
    precision, recall = _shares(accuracy, (limit,))[0], _shares(completeness, (limit,))[0]
    return CloudScore(
        limit, precision, recall, _f1(precision, recall), _mean(accuracy), _mean(completeness),
        len(predicted), len(truth),
    )  # fmt: skip


def _uniform(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int) -> SurfaceSamples:
    if len(faces) == 0 or (
        np.isfinite(vertices[np.unique(faces)]).all() and not face_normals(vertices, faces)[1].any()
    ):
        return SurfaceSamples.empty()
    return sample_uniformly(vertices, faces, count, seed=seed)


def _nearest(
    samples: SurfaceSamples, mesh: _Mesh | None, cloud: SurfaceSamples, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (n,) to the mesh, or to the cloud without one, and normals (n, 3) there."""
    if mesh is not None:
        distances, face, _ = distances_to_mesh(samples.points, *mesh)
        if len(mesh[1]) == 0:
            return distances, np.zeros((len(samples), 3))
        corners = np.asarray(mesh[0], np.float64)[np.asarray(mesh[1])[face]]  # (n, 3, 3)
        flat = (corners - corners[:, :1]).reshape(-1, 3)
        return distances, face_normals(flat, np.arange(len(flat)).reshape(-1, 3))[0]
    distances, index = distances_to_cloud(samples.points, cloud.points, threads=threads)
    if len(cloud) == 0:
        return distances, np.zeros((len(samples), 3))
    return distances, cloud.normals[index]


def _checked_scores(thresholds: Sequence[float]) -> tuple[float, ...]:
    limits = tuple(float(value) for value in thresholds)
    if not limits or not all(math.isfinite(value) and value > 0 for value in limits):
        raise UsageError(f"Thresholds of {limits} cannot be used.", "Give lengths > 0.")
    return limits


def _shares(distances: np.ndarray, limits: tuple[float, ...]) -> Shares:
    if len(distances) == 0:
        return (0.0,) * len(limits)
    return tuple(float((distances <= limit).mean()) for limit in limits)


def _f1(precision: float, recall: float) -> float:
    total = precision + recall
    return 2.0 * precision * recall / total if total > 0 else 0.0


def _mean(distances: np.ndarray) -> float:
    return float(distances.mean()) if len(distances) else math.inf


def _median(distances: np.ndarray) -> float:
    return float(np.median(distances)) if len(distances) else math.inf


def _symmetric_mean(pairs: list[np.ndarray]) -> float:
    """Return the mean of both directions' means; of one if the other has no pair; 0 without any."""
    means = [float(values.mean()) for values in pairs if len(values)]
    return sum(means) / len(means) if means else 0.0
