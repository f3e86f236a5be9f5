# SPDX-License-Identifier: GPL-3.0-or-later
"""Points on the surface at the wanted spacing: candidates, samples on the isosurface, caps."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from .. import limits
from ..errors import MeshingError
from ..field.isosurface_projection import TOLERANCE, project_to_isosurface
from ..field.samples import DepthSamples, bracket_pairs
from ..gaussians.model import GaussianArrays
from ..mesh.sampling import EDGE_PER_RADIUS, POINTS_PER_SQUARE, sample_triangles, thin
from ..mesh.surface_mesh import normals_and_areas
from ..parallel import balanced_bounds
from ..progress import Progress, ReportWarning
from ..regions.shapes import Region
from ..scene.camera import Camera
from .delaunay import bounding_points, delaunay
from .marching_tetrahedra import IsEmpty, bisect, marching_tetrahedra
from .pivots import (
    MAX_PIVOT_GAUSSIANS,
    PivotRule,
    gaussians_reaching,
    representative_gaussians,
    two_pivots,
)
from .spacing import (
    ResolutionRequest,
    Spacing,
    check_expected_points,
    footprint_spacing,
    thinning_radius,
)

# -- Cap points: samples of a region's boundary where it cuts the solid, to close the mesh there

MAX_CANDIDATES = 1_500_000
"""Most samples of the region's boundary; finer requests get coarser caps, which are flat anyway."""

OVERSAMPLING = 5.0
RIM_TOLERANCE_SHARE = 1e-3  # length of the bracket around the rim of a cap, in edge lengths
INNER_RADII = 2.0  # spacing inside a cap, in local radii: caps are flat

# Corners first, then edges, rims and the interior: the points that define the shape are kept.
PRIORITY_CORNER, PRIORITY_EDGE, PRIORITY_RIM, PRIORITY_INNER = 0.0, 1.0, 2.0, 4.0


@dataclass(frozen=True)
class Caps:
    """Occupied points on a region's boundary, thinned."""

    points: np.ndarray  # (n, 3) float64
    normals: np.ndarray  # (n, 3) float64: outward normal of the face; zero on edges and corners
    radii: np.ndarray  # (n,) float64 for :func:`.sampling.thin`
    priority: np.ndarray  # (n,) float64 for the same


def no_caps() -> Caps:
    """Return empty caps, for a region whose boundary stays open."""
    return Caps(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))


def cap_points(
    region: Region, is_empty: IsEmpty, spacing: Spacing, rng: np.random.Generator,
    progress: Progress,
) -> Caps:  # fmt: skip
    """Sample the region's faces, sharp edges and corners where they lie in the solid.

    Segments between neighbouring occupied and empty samples of one face are bisected; the resulting
    points form the rim, where the isosurface meets the face. Inside a cap the surface's ``spacing``
    grows with the distance to the rim.
    """
    radius = max(spacing.nominal, np.sqrt(region.area * OVERSAMPLING / MAX_CANDIDATES))
    points, normals, face = _face_samples(region, radius, rng)
    progress.update(0.1, f"sampling the region's boundary ({len(points)} samples)")
    empty = is_empty(points)
    rim_in, rim_out, rim_face = _face_crossings(points, empty, face, radius)
    edge_points, edge_in, edge_out, corner_points = _edge_samples(region, is_empty, radius)
    progress.update(0.5, "sampling the region's boundary")
    inside, _ = bisect(
        np.concatenate([rim_in, edge_in]), np.concatenate([rim_out, edge_out]), is_empty,
        RIM_TOLERANCE_SHARE * radius, progress.span(0.5, 1.0),
    )  # fmt: skip
    rim, edge_rim = inside[: len(rim_in)], inside[len(rim_in) :]
    groups = (
        (corner_points, np.zeros_like(corner_points), PRIORITY_CORNER),
        (edge_rim, np.zeros_like(edge_rim), PRIORITY_CORNER),
        (edge_points, np.zeros_like(edge_points), PRIORITY_EDGE),
        (rim, region.half_spaces[0][rim_face], PRIORITY_RIM),
        (points[~empty], normals[~empty], PRIORITY_INNER),
    )
    all_points = np.concatenate([points for points, _, _ in groups])
    all_normals = np.concatenate([normals for _, normals, _ in groups])
    priority = np.concatenate([np.full(len(points), level) for points, _, level in groups])
    local = spacing.at(all_points)  # (n,)
    radii = np.where(priority == PRIORITY_INNER, INNER_RADII * local, local)
    kept = thin(all_points, all_normals, radii, priority)
    return Caps(all_points[kept], all_normals[kept], radii[kept], priority[kept])


def _face_samples(
    region: Region, radius: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return thinned samples of the whole boundary, their normals and planar faces."""
    count = int(min(MAX_CANDIDATES, OVERSAMPLING * region.area / radius**2)) + 16
    pieces = region.faces()
    corners = np.concatenate(pieces)  # (t, 3, 3)
    owner = np.repeat(np.arange(len(pieces)), [len(p) for p in pieces])
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    points, triangle = sample_triangles(corners.reshape(-1, 3), triangles, count, rng)
    face = owner[triangle]
    normals = region.half_spaces[0][face]
    kept = thin(points, normals, np.full(count, radius), rng.random(count))
    return points[kept], normals[kept], face[kept]


def _face_crossings(
    points: np.ndarray, empty: np.ndarray, face: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pair occupied with empty neighbours on one planar face."""
    occupied, vacant = np.flatnonzero(~empty), np.flatnonzero(empty)
    if len(occupied) == 0 or len(vacant) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64)
    pairs = cKDTree(points[occupied]).sparse_distance_matrix(
        cKDTree(points[vacant]), 1.6 * radius, output_type="coo_matrix"
    )
    order = np.lexsort((pairs.col, pairs.row))
    first, second = occupied[pairs.row[order]], vacant[pairs.col[order]]
    same = face[first] == face[second]
    return points[first[same]], points[second[same]], face[first[same]]


def _edge_samples(
    region: Region, is_empty: IsEmpty, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return occupied points on sharp edges, crossing segments on these, and occupied corners."""
    rows, owners = [], []
    for index, (begin, end) in enumerate(region.edges()):
        steps = max(1, round(float(np.linalg.norm(end - begin)) / radius / 1.2))
        share = np.linspace(0.0, 1.0, steps + 1)[:, None]  # (steps + 1, 1)
        rows.append(begin * (1 - share) + end * share)
        owners.append(np.full(steps + 1, index))
    points, owner = np.concatenate(rows), np.concatenate(owners)
    empty = is_empty(points)
    ends = np.append(True, owner[1:] != owner[:-1]) | np.append(owner[1:] != owner[:-1], True)
    change = np.flatnonzero((empty[1:] != empty[:-1]) & (owner[1:] == owner[:-1]))
    inside, outside = change + empty[change], change + ~empty[change]
    corners = np.unique(points[ends & ~empty], axis=0)
    return points[~empty & ~ends], points[inside], points[outside], corners


# -- Candidate surface: a first, coarse isosurface by two-pivot marching tetrahedra ---------------
#
# See docs/method.md, section 6.

PROBES = 4096
"""Sample points through the region besides the pivots: a Gaussian as large as the region may have
both pivots outside it."""

MARGIN_SHARE = 0.02
"""Gaussians up to this share of the diagonal beyond the region are included, so that the surface
near the boundary is not the hull of too few pivots."""

HALO_SHARE = 0.5
"""Pivots farther from the region than this share of its diagonal are left out: the bounding points
close the triangulation, and the field need not be known there."""

NO_SURFACE_HINT = "Draw the region around something that was photographed."

BRACKET_SHARE = 0.003
"""Edges are bisected to this share of the region's diagonal; later steps refine the position."""


@dataclass(frozen=True)
class CandidateSurface:
    """A triangle soup near the isosurface, in the region and slightly beyond it."""

    vertices: np.ndarray  # (v, 3) float64
    faces: np.ndarray  # (f, 3) int64, facing the empty side
    gaussians: int  # Gaussians that reach the region
    pivots: int  # points that were triangulated


def candidate_surface(
    arrays: GaussianArrays, region: Region, is_empty: IsEmpty, tolerance: float, seed: int,
    progress: Progress, depth_samples: DepthSamples | None = None,
) -> CandidateSurface:  # fmt: skip
    """Extract the isosurface on the Delaunay edges of two pivots per Gaussian and depth sample.

    Parameters
    ----------
    tolerance : float
        Length of the bracket on crossing edges; 0 stands for :data:`BRACKET_SHARE`.
    depth_samples : DepthSamples, optional
        Of the region: parts about as thin as a pixel are found only by these.

    Raises
    ------
    MeshingError
        No Gaussian reaches the region, or nothing in it is occupied by the solid.
    """
    margin = MARGIN_SHARE * region.diagonal
    is_empty = _within_halo(is_empty, region)
    cloud = pivot_cloud(arrays, region, is_empty, seed, depth_samples)
    pivots = cloud.points
    points = np.concatenate([pivots, bounding_points(pivots, seed)])
    tetrahedra = delaunay(points, seed=seed, progress=progress.span(0.0, 0.3))
    progress.update(0.3, f"evaluating {len(pivots)} pivots")
    inside = np.zeros(len(points), np.bool_)  # bounding points are empty by definition
    inside[: len(pivots)] = ~is_empty(pivots)
    edges, faces = marching_tetrahedra(_near(points, tetrahedra, region, margin), inside)
    if len(faces) == 0:
        raise no_surface_error(region)
    tolerance = tolerance or BRACKET_SHARE * region.diagonal
    ends = bisect(points[edges[:, 0]], points[edges[:, 1]], is_empty, tolerance,
                  progress.span(0.6, 1.0))  # fmt: skip
    vertices = (ends[0] + ends[1]) / 2
    kept = region.distance(vertices[faces].mean(1)) <= margin
    if not kept.any():
        raise no_surface_error(region)
    return CandidateSurface(vertices, faces[kept], cloud.gaussians, len(pivots))


@dataclass(frozen=True)
class PivotCloud:
    """Points whose Delaunay edges are searched for the isosurface of a region."""

    points: np.ndarray  # (p, 3) float64, all within :func:`halo_bounds`
    gaussians: int  # Gaussians that reach the region
    chosen: int  # those of them that contributed pivots


def pivot_cloud(
    arrays: GaussianArrays, region: Region, is_empty: IsEmpty, seed: int,
    depth_samples: DepthSamples | None, *, pivots_of: PivotRule = two_pivots,
) -> PivotCloud:  # fmt: skip
    """Collect pivots, probes and pairs that bracket the visible surface, in and around a region.

    Raises MeshingError: no Gaussian reaches the region.
    """
    own = pivots_and_probes(arrays, region, seed, pivots_of)
    if depth_samples is None:
        return own
    points = np.concatenate(bracket_pairs(depth_samples, is_empty))
    return replace(own, points=np.concatenate([own.points, _in_halo(points, region)]))


def pivots_and_probes(
    arrays: GaussianArrays, region: Region, seed: int, pivots_of: PivotRule
) -> PivotCloud:
    """Collect pivots and probes alone, in and around a region, without evaluating the field.

    Raises MeshingError: no Gaussian reaches the region.
    """
    index = _reaching(arrays, region)
    chosen = representative_gaussians(arrays, index, MAX_PIVOT_GAUSSIANS)
    pivots = pivots_of(arrays, chosen)
    near = pivots[region.distance(pivots) <= HALO_SHARE * region.diagonal]
    points = np.concatenate([near, _probes(region, MARGIN_SHARE * region.diagonal, seed)])
    return PivotCloud(_in_halo(points, region), len(index), len(chosen))


def pivots_alone(arrays: GaussianArrays, region: Region, pivots_of: PivotRule) -> PivotCloud:
    """Collect the pivots of all Gaussians that reach a region, faint ones too, and nothing else.

    These are the points of the paper (docs/method.md, section 6.1): without samples of depth maps,
    probes, or a limit on the number of Gaussians. Pivots in the region's halo are kept. Raises
    MeshingError: no Gaussian reaches the region.
    """
    index = _reaching(arrays, region, faint=True)
    return PivotCloud(_in_halo(pivots_of(arrays, index), region), len(index), len(index))


def _reaching(arrays: GaussianArrays, region: Region, *, faint: bool = False) -> np.ndarray:
    index = gaussians_reaching(arrays, region, MARGIN_SHARE * region.diagonal, faint=faint)
    if len(index) == 0:
        raise MeshingError(f"No Gaussian reaches region {region.name!r}.", NO_SURFACE_HINT)
    return index


def _in_halo(points: np.ndarray, region: Region) -> np.ndarray:
    return points[_is_in_halo(points, region)]


def _is_in_halo(points: np.ndarray, region: Region) -> np.ndarray:
    low, high = halo_bounds(region)
    return np.asarray(((points >= low) & (points <= high)).all(1))


def halo_bounds(region: Region) -> np.ndarray:
    """Return the box, (2, 3) float64, of all points whose label matters for a region."""
    low, high = region.bounds
    halo = HALO_SHARE * region.diagonal
    return np.stack([low - halo, high + halo])


def _within_halo(is_empty: IsEmpty, region: Region) -> IsEmpty:
    """Restrict ``is_empty`` to the halo; all other points are empty, as the bounding points are."""

    def inside_only(points: np.ndarray) -> np.ndarray:
        near = _is_in_halo(points, region)
        empty = np.ones(len(points), np.bool_)
        empty[near] = is_empty(points[near])
        return empty

    return inside_only


def no_surface_error(region: Region, missing: str = "surface") -> MeshingError:
    """Return the error of a region without a surface."""
    return MeshingError(f"Region {region.name!r} holds no {missing}.", NO_SURFACE_HINT)


def _probes(region: Region, margin: float, seed: int) -> np.ndarray:
    """Return about :data:`PROBES` jittered lattice points in and just around the region."""
    low, high = region.bounds[0] - margin, region.bounds[1] + margin
    side = float(np.prod(high - low) / PROBES) ** (1 / 3)
    counts = np.maximum(1, np.ceil((high - low) / side)).astype(int)
    lattice = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), -1)
    lattice = lattice.reshape(-1, 3)  # (k, 3)
    jitter = np.random.default_rng(seed).random(lattice.shape)
    points = low + (lattice + jitter) / counts * (high - low)
    return points[region.distance(points) <= margin]


def _near(points: np.ndarray, tetrahedra: np.ndarray, region: Region, margin: float) -> np.ndarray:
    """Drop the tetrahedra that lie wholly beyond one face of the region."""
    normals, offsets = region.half_spaces
    kept = np.ones(len(tetrahedra), np.bool_)
    for normal, offset in zip(normals, offsets, strict=True):
        beyond = (points - region.center) @ normal - offset > margin
        kept &= ~beyond[tetrahedra].all(1)
    return tetrahedra[kept]


# -- Sample evenly spaced points on the isosurface, starting from a candidate surface -------------
#
# See docs/method.md, section 7.2.

KIND_SURFACE, KIND_CAP, KIND_JUMP = 0, 1, 2
"""On the isosurface; on the region's boundary; where vacancy jumps across 0.5 (at the limit of what
the cameras see)."""

PRIORITY_SURFACE = 3.0  # between the rims and the inner part of the caps
POINT_OVERSAMPLING = 20.0  # candidates per point before the first thinning
FIRST_THINNING = 0.4
"""Candidates closer than this share of the radius are not projected. These two constants determine
how even the points are (and sampling.POINTS_PER_SQUARE)."""
MAX_BLOCK = 2_000_000  # candidates drawn at a time, to limit memory
FOOTPRINT_SAMPLES = 20_000
"""Samples of the candidate surface at which the photos' pixel footprint is evaluated."""
REPORTED_SHARE = 0.1
"""The report notes that the photos limit the edges where they do so on more than this share of the
surface."""

MAX_PROJECTION_STEPS = 14
"""Nearly all points need two or three; each further step evaluates all cameras again."""

SEARCH_SHARES = (0.25, -0.25, 0.5, -0.5, 1.0, -1.0)
"""Offsets along the normal, in radii, at which points that did not converge search a crossing."""
SURFACE_POINTS_BRACKET_SHARE = 1e-3  # a found crossing is bracketed to this share of the radius


@dataclass(frozen=True)
class SurfacePoints:
    """Points to become vertices of the mesh."""

    points: np.ndarray  # (n, 3) float64
    normals: np.ndarray
    """(n, 3) float64 unit vectors towards the empty side; 0 on edges of the region."""
    kind: np.ndarray  # (n,) uint8
    radii: np.ndarray  # (n,) float64 local thinning radius
    radius: float  # nominal thinning radius, the smallest
    notes: tuple[ReportWarning, ...]
    figures: dict[str, Any]


@dataclass(frozen=True)
class Field:
    """The fields that define the surface; duck-typed."""

    vacancy: Any
    """``VacancyField``, or any object with ``vacancy(points)`` and ``is_empty(points)``."""
    vectors: Any  # ``VectorField``, or any object with ``evaluate(points)``
    threads: int


class SurfaceSampler:
    """Samples a candidate surface and projects the points onto the isosurface."""

    def __init__(
        self, field: Field, region: Region, surface: CandidateSurface,
        cameras: Sequence[Camera] = (),
    ) -> None:  # fmt: skip
        """Limit the spacing to what ``cameras`` resolve, if any are given."""
        self._vacancy, self._vectors, self._threads = field.vacancy, field.vectors, field.threads
        self._region, self._cameras, self._vertices = region, cameras, surface.vertices
        centers = surface.vertices[surface.faces].mean(1)
        self._faces = surface.faces[region.contains(centers, 0.0)]
        if len(self._faces) == 0:  # the whole surface lies in the margin
            self._faces = surface.faces
        self._normals, self._areas = normals_and_areas(self._vertices, self._faces)
        self.area = float(self._areas.sum())

    def spacing(
        self, request: ResolutionRequest, rng: np.random.Generator
    ) -> tuple[Spacing, tuple[ReportWarning, ...]]:
        """Return the local radii that meet a request, and notes for the report.

        Raises ResourceError: the request needs more points than the limit.
        """
        spacing, notes = self._spacing(request, rng)
        check_expected_points(self._expected(spacing)[1], request)
        return spacing, notes

    def _expected(self, spacing: Spacing) -> tuple[np.ndarray, float]:
        """Return the radius at each face as a share of the nominal one, and the expected points."""
        share = spacing.at(self._vertices[self._faces].mean(1), self._threads) / spacing.nominal
        weight = float((self._areas * share**-2.0).sum())
        return share, POINTS_PER_SQUARE * weight / spacing.nominal**2

    def sample(
        self, request: ResolutionRequest, rng: np.random.Generator, progress: Progress, *,
        spacing: Spacing | None = None, owned: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> SurfacePoints:  # fmt: skip
        """Return surface, jump and cap points at the requested density.

        Tiles, whose boundary does not bound the solid, give the ``spacing`` of the whole surface
        (:meth:`spacing`), and ``owned``, which maps (n, 3) points to (n,) bool: only these are
        kept, and no cap points are made.
        Raises ResourceError: the request needs more points than the limit.
        """
        notes: tuple[ReportWarning, ...] = ()
        if spacing is None:
            spacing, notes = self._spacing(request, rng)
        progress.update(0.0, "sampling the surface")
        share, expected = self._expected(spacing)
        check_expected_points(expected, request)
        count = int(POINT_OVERSAMPLING * expected) + 64
        points, face = self._candidates(spacing.nominal, share, count, rng)
        progress.update(0.1, f"projecting {len(points)} points onto the surface")
        radii = spacing.at(points, self._threads)
        moved, normals, kind, evaluations = self._project(
            points, face, radii, progress.span(0.1, 0.8)
        )
        caps = no_caps()
        if owned is None:
            caps = cap_points(
                self._region, self._vacancy.is_empty, spacing, rng, progress.span(0.8, 1.0)
            )
        else:
            mine = owned(moved)
            moved, normals, kind = moved[mine], normals[mine], kind[mine]
        radii = spacing.at(moved, self._threads)
        # Jumps come last among surface points: points on the isosurface are preferred.
        priority = PRIORITY_SURFACE + 0.5 * (rng.random(len(moved)) + (kind == KIND_JUMP))
        all_points = np.concatenate([caps.points, moved])
        normals = np.concatenate([caps.normals, normals])
        radii = np.concatenate([caps.radii, radii])
        kept = thin(all_points, normals, radii, np.concatenate([caps.priority, priority]))
        kinds = np.concatenate([np.full(len(caps.points), KIND_CAP, np.uint8), kind])[kept]
        figures = {
            "candidates": len(points),
            "dropped_candidates": len(points) - len(moved),
            "surface_points": int((kinds == KIND_SURFACE).sum()),
            "jump_points": int((kinds == KIND_JUMP).sum()),
            "cap_points": int((kinds == KIND_CAP).sum()),
            "projection_evaluations": evaluations,
            "shortest_spacing_scene": EDGE_PER_RADIUS * float(radii[kept].min(initial=np.inf)),
            "longest_spacing_scene": EDGE_PER_RADIUS * float(radii[kept].max(initial=0.0)),
            "limited_by_photos_share": spacing.limited,
        }
        return SurfacePoints(
            all_points[kept], normals[kept], kinds, radii[kept], spacing.nominal, notes, figures
        )

    def _spacing(
        self, request: ResolutionRequest, rng: np.random.Generator
    ) -> tuple[Spacing, tuple[ReportWarning, ...]]:
        """Choose the local radii, and note how much of the surface the photos limit."""
        radius = thinning_radius(request, self.area, self._region)
        if len(self._cameras) == 0:
            return Spacing.uniform(radius), ()
        points, _ = sample_triangles(self._vertices, self._faces, FOOTPRINT_SAMPLES, rng)
        spacing = footprint_spacing(points, self._cameras, radius)
        if spacing.limited <= REPORTED_SHARE:
            return spacing, ()
        share = f"On {spacing.limited:.0%} of the surface"
        text = f"{share} the photos resolve no shorter edges; uniform spacing would make them."
        return spacing, (ReportWarning("photos-limit-edges", text),)

    def _project(
        self, points: np.ndarray, face: np.ndarray, radii: np.ndarray, progress: Progress
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        """Project points of the candidate surface onto the isosurface or a jump of vacancy.

        Returns those that converged, their normals and kinds, and the number of evaluations.
        """
        normals = self._normals_at(points, self._normals[face])
        found = project_to_isosurface(
            points, self._vacancy, self._vectors, progress.span(0.0, 0.8),
            max_steps=MAX_PROJECTION_STEPS,
        )  # fmt: skip
        kind = np.full(len(points), KIND_SURFACE, np.uint8)
        lost = np.flatnonzero(~found.on_surface)
        moved, good = found.points.copy(), found.on_surface.copy()
        moved[lost], kind_of_lost = self._search_along_normals(
            points[lost], normals[lost], radii[lost], progress.span(0.8, 1.0)
        )
        good[lost] = kind_of_lost >= 0
        kind[lost] = np.maximum(kind_of_lost, 0)
        good &= self._region.contains(moved, 0.0)
        normals = self._normals_at(moved[good], normals[good])
        return moved[good], normals, kind[good], int(found.vacancy_evaluations)

    def _candidates(
        self, radius: float, share: np.ndarray, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw ``count`` candidates and thin them, block by block; return points and faces."""
        weight = self._areas * share**-2.0  # (f,)
        bounds = balanced_bounds(weight, -(-count // MAX_BLOCK))
        points, face = [], []
        for begin, end in itertools.pairwise(bounds.tolist()):
            part = int(count * weight[begin:end].sum() / weight.sum()) + 1
            drawn, where = sample_triangles(
                self._vertices, self._faces[begin:end], part, rng, share[begin:end] ** -2.0
            )
            kept = self._thinned(drawn, where + begin, radius * share, rng)
            points.append(drawn[kept])
            face.append(where[kept] + begin)
        all_points, all_faces = np.concatenate(points), np.concatenate(face)
        if len(points) > 1:  # blocks touch
            kept = self._thinned(all_points, all_faces, radius * share, rng)
            all_points, all_faces = all_points[kept], all_faces[kept]
        return all_points, all_faces

    def _thinned(
        self, points: np.ndarray, face: np.ndarray, radii: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        priority = rng.random(len(points))
        return thin(points, self._normals[face], FIRST_THINNING * radii[face], priority)

    def _normals_at(self, points: np.ndarray, fallback: np.ndarray) -> np.ndarray:
        """Return the field's outward directions, or the triangle's normal where there is none or
        the two disagree (the far side of a thin wall, a wrongly oriented Gaussian)."""
        outward = self._vectors.evaluate(points).outward  # (n, 3) unit or 0
        agree = (outward * fallback).sum(1) > 0  # false for NaN
        return np.where(agree[:, None], outward, fallback)

    def _search_along_normals(
        self, points: np.ndarray, normals: np.ndarray, radii: np.ndarray, progress: Progress
    ) -> tuple[np.ndarray, np.ndarray]:
        """Search a crossing along the normal where the projection found none.

        Returns midpoints of the brackets (k, 3), and :data:`KIND_SURFACE`, :data:`KIND_JUMP`, or -1
        without a crossing.
        """
        kind = np.full(len(points), -1)
        moved = points.copy()
        if len(points) == 0:
            return moved, kind
        start = self._vacancy.is_empty(points)
        other, pending = points.copy(), np.arange(len(points))
        for share in SEARCH_SHARES:
            step = share * radii[pending, None]
            trial = points[pending] + step * normals[pending]
            hit = self._vacancy.is_empty(trial) != start[pending]
            other[pending[hit]] = trial[hit]
            kind[pending[hit]] = KIND_JUMP
            pending = pending[~hit]
        rows = np.flatnonzero(kind >= 0)
        empty = start[rows, None]
        inside, outside = bisect(
            np.where(empty, other[rows], points[rows]), np.where(empty, points[rows], other[rows]),
            self._vacancy.is_empty, SURFACE_POINTS_BRACKET_SHARE * float(radii.min()), progress,
        )  # fmt: skip
        moved[rows] = (inside + outside) / 2
        value = self._vacancy.vacancy(moved[rows]).vacancy
        kind[rows[np.abs(value - limits.ISO_LEVEL) <= TOLERANCE]] = KIND_SURFACE
        return moved, kind
