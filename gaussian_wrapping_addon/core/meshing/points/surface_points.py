# SPDX-License-Identifier: GPL-3.0-or-later
"""Sample evenly spaced points on the isosurface, starting from a candidate surface.

See docs/method.md, section 7.2.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ... import tolerances
from ...dataset.camera import Camera
from ...field.isosurface_projection import TOLERANCE, project_to_isosurface
from ...kernels.parallel import balanced_bounds
from ...mesh.surface_sampling import EDGE_PER_RADIUS, POINTS_PER_SQUARE, sample_triangles, thin
from ...mesh.topology import normals_and_areas
from ...progress import Progress
from ...regions.convex_region import Region
from ...report_warning import ReportWarning
from ..tetrahedra.marching_tetrahedra import bisect
from .candidate_surface import CandidateSurface
from .region_caps import cap_points, no_caps
from .resolution import ResolutionRequest, check_expected_points, thinning_radius
from .spacing import Spacing, footprint_spacing

KIND_SURFACE, KIND_CAP, KIND_JUMP = 0, 1, 2
"""On the isosurface; on the region's boundary; where vacancy jumps across 0.5 (at the limit of what
the cameras see)."""

PRIORITY_SURFACE = 3.0
"""Between the rims and the inner part of the caps; see region_caps."""

OVERSAMPLING = 20.0
"""Candidates per point before the first thinning."""
FIRST_THINNING = 0.4
"""Candidates closer than this share of the radius are not projected. These two constants determine
how even the points are (and surface_sampling.POINTS_PER_SQUARE)."""
MAX_BLOCK = 2_000_000
"""Candidates drawn at a time, to limit memory."""
FOOTPRINT_SAMPLES = 20_000
"""Samples of the candidate surface at which the photos' pixel footprint is evaluated."""
REPORTED_SHARE = 0.1
"""The report notes that the photos limit the edges where they do so on more than this share of the
surface."""

MAX_PROJECTION_STEPS = 14
"""Nearly all points need two or three; each further step evaluates all cameras again."""

SEARCH_SHARES = (0.25, -0.25, 0.5, -0.5, 1.0, -1.0)
"""Offsets along the normal, in radii, at which points that did not converge search a crossing."""
BRACKET_SHARE = 1e-3
"""A found crossing is bracketed to this share of the radius."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points to become vertices of the mesh."""

    points: np.ndarray
    """(n, 3) float64."""
    normals: np.ndarray
    """(n, 3) float64 unit vectors towards the empty side; 0 on edges of the region."""
    kind: np.ndarray
    """(n,) uint8."""
    radii: np.ndarray
    """(n,) float64 local thinning radius."""
    radius: float
    """Nominal thinning radius, the smallest."""
    notes: tuple[ReportWarning, ...]
    figures: dict[str, Any]


@dataclass(frozen=True)
class _ProjectedPoints:
    """Candidates that converged to a surface."""

    points: np.ndarray
    """(n, 3) float64."""
    normals: np.ndarray
    """(n, 3) float64."""
    kind: np.ndarray
    """(n,) uint8."""
    evaluations: int


class SurfaceSampler:
    """Samples a candidate surface and projects the points onto the isosurface."""

    def __init__(
        self,
        vacancy: Any,
        vectors: Any,
        region: Region,
        surface: CandidateSurface,
        threads: int,
        *,
        cameras: Sequence[Camera] = (),
    ) -> None:
        """Limit the spacing to what ``cameras`` resolve, if any are given."""
        self._vacancy, self._vectors, self._region = vacancy, vectors, region
        self._cameras = cameras
        self._vertices = surface.vertices
        centers = surface.vertices[surface.faces].mean(1)
        self._faces = surface.faces[region.contains(centers, 0.0)]
        if len(self._faces) == 0:  # the whole surface lies in the margin
            self._faces = surface.faces
        self._normals, areas = normals_and_areas(self._vertices, self._faces)
        self.area = float(areas.sum())
        self._threads = threads

    def spacing(
        self, request: ResolutionRequest, rng: np.random.Generator
    ) -> tuple[Spacing, tuple[ReportWarning, ...]]:
        """Return the local radii that meet a request, and notes for the report.

        Raises
        ------
        ResourceError
            The request needs more points than the limit.
        """
        spacing, notes = self._spacing(request, rng)
        check_expected_points(self._expected(spacing)[1], request)
        return spacing, notes

    def _expected(self, spacing: Spacing) -> tuple[np.ndarray, float]:
        """Return the radius at each face as a share of the nominal one, and the expected points."""
        share = spacing.at(self._vertices[self._faces].mean(1), self._threads) / spacing.nominal
        _, areas = normals_and_areas(self._vertices, self._faces)
        weight = float((areas * share**-2.0).sum())
        return share, POINTS_PER_SQUARE * weight / spacing.nominal**2

    def sample(
        self,
        request: ResolutionRequest,
        rng: np.random.Generator,
        progress: Progress,
        *,
        spacing: Spacing | None = None,
        owned: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> SurfacePoints:
        """Return surface, jump and cap points at the requested density.

        Parameters
        ----------
        spacing : Spacing, optional
            Precomputed by :meth:`spacing` for the whole surface.
        owned : callable, optional
            Maps (n, 3) points to (n,) bool: only these are kept, and no cap points are made. For
            tiles, whose boundary does not bound the solid.

        Raises
        ------
        ResourceError
            The request needs more points than the limit.
        """
        notes: tuple[ReportWarning, ...] = ()
        if spacing is None:
            spacing, notes = self._spacing(request, rng)
        progress.update(0.0, "sampling the surface")
        share, expected = self._expected(spacing)
        check_expected_points(expected, request)
        points, face = self._candidates(
            spacing.nominal, share, int(OVERSAMPLING * expected) + 64, rng
        )
        progress.update(0.1, f"projecting {len(points)} points onto the surface")
        radii = spacing.at(points, self._threads)
        projected = self._project(points, face, radii, progress.span(0.1, 0.8))
        moved, normals, kind = projected.points, projected.normals, projected.kind
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
            "projection_evaluations": projected.evaluations,
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
        notes: tuple[ReportWarning, ...] = ()
        if spacing.limited > REPORTED_SHARE:
            share = f"On {spacing.limited:.0%} of the surface"
            text = f"{share} the photos resolve no shorter edges; uniform spacing would make them."
            notes = (ReportWarning("photos-limit-edges", text),)
        return spacing, notes

    def _project(
        self, points: np.ndarray, face: np.ndarray, radii: np.ndarray, progress: Progress
    ) -> _ProjectedPoints:
        """Project points of the candidate surface onto the isosurface or a jump of vacancy."""
        normals = self._normals_at(points, self._normals[face])
        found = project_to_isosurface(
            points,
            self._vacancy,
            self._vectors,
            progress.span(0.0, 0.8),
            max_steps=MAX_PROJECTION_STEPS,
        )
        kind = np.full(len(points), KIND_SURFACE, np.uint8)
        lost = np.flatnonzero(~found.on_surface)
        moved = found.points.copy()
        searched, kind_of_lost = self._search_along_normals(
            points[lost], normals[lost], radii[lost], progress.span(0.8, 1.0)
        )
        moved[lost] = searched
        good = found.on_surface.copy()
        good[lost] = kind_of_lost >= 0
        kind[lost] = np.maximum(kind_of_lost, 0)
        good &= self._region.contains(moved, 0.0)
        normals = self._normals_at(moved[good], normals[good])
        return _ProjectedPoints(moved[good], normals, kind[good], int(found.vacancy_evaluations))

    def _candidates(
        self, radius: float, share: np.ndarray, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw ``count`` candidates and thin them, block by block.

        Returns
        -------
        points : (n, 3) float64
        face : (n,) int64
        """
        _, areas = normals_and_areas(self._vertices, self._faces)
        weight = areas * share**-2.0  # (f,)
        blocks = -(-count // MAX_BLOCK)
        bounds = balanced_bounds(weight, blocks)
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

        Returns
        -------
        points : (k, 3)
            Midpoint of the bracket.
        kind : (k,) int
            :data:`KIND_SURFACE`, :data:`KIND_JUMP`, or -1 without a crossing.
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
            np.where(empty, other[rows], points[rows]),
            np.where(empty, points[rows], other[rows]),
            self._vacancy.is_empty,
            BRACKET_SHARE * float(radii.min()),
            progress,
        )
        moved[rows] = (inside + outside) / 2
        value = self._vacancy.vacancy(moved[rows]).vacancy
        exact = np.abs(value - tolerances.ISO_LEVEL) <= TOLERANCE
        kind[rows[exact]] = KIND_SURFACE
        return moved, kind
