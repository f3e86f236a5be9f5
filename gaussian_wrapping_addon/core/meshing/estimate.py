# SPDX-License-Identifier: GPL-3.0-or-later
"""Points, faces, memory and time of a mesh, before it is made."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .. import limits
from ..errors import ResourceError
from ..field.samples import MAX_DEPTH_SAMPLES
from ..gaussians.model import GaussianArrays
from ..mesh.sampling import EDGE_PER_RADIUS, POINTS_PER_SQUARE, sample_triangles
from ..regions.shapes import Region
from .pivots import pivot_rule
from .spacing import (
    AUTOMATIC_POINTS,
    LONGEST_SHARE,
    MIN_VERTICES,
    VERTICES_PER_UNIFORM,
    ResolutionRequest,
    dense_points,
    kept_from_dense,
    times_longer,
)
from .surface_points import (
    INNER_RADII,
    MAX_CANDIDATES,
    OVERSAMPLING,
    pivots_alone,
    pivots_and_probes,
)
from .tiles.plan import TILE_POINTS, WHOLE_POINTS

# -- Estimate points, faces, memory and time of primal adaptive meshing before it starts ----------

POINTS_PER_BOX = 8.0
"""Mean depth samples per counted box: with fewer, some boxes that the surface crosses hold none."""
BOXES_PER_SQUARE = 1.5
"""Boxes that a plane crosses per square of their side, on average over its directions."""

AREA_LOW, AREA_HIGH = 0.8, 1.5
"""Bounds of the true area as factors of the count. On four trained scenes the factor was 0.86 to
1.11, and 1.27 where part of the surface is hidden from the cameras."""

BUDGET_LOW, BUDGET_HIGH = 0.7, 1.4
"""A requested number of points is met within these factors; cap points come on top."""

BOUNDARY_SAMPLES = 4096

POINT_BYTES = 3_500
"""Peak per point of a mesh made in one piece (with adaptive spacing, of the dense mesh):
tetrahedra, candidates, repair (145 000 points of a sphere took 3 100 each)."""
JOINED_VERTEX_BYTES = 1_200
"""Peak per vertex of the simplified mesh while tiles are joined
(measured: 1 000)."""
GATHERED_POINT_BYTES = 300
"""Peak per dense point while the points of all tiles are thinned together (measured: 210)."""
SURROUNDINGS = 2.0  # points in and around a tile, as a multiple of its own
BASE_BYTES = 800 << 20
"""Python, compiled kernels, the Gaussians projected into each camera, the candidate surface."""

EVALUATIONS_PER_POINT = 45.0  # evaluations of vacancy per point of the mesh, over all steps
POINT_S = 60e-6  # everything else, per point: triangulation, thinning, repair
FIXED_S = 6.0  # pivots and candidate surface
SECONDS_LOW, SECONDS_HIGH = 0.5, 2.0

PROBES = 20_000


@dataclass(frozen=True)
class MeshEstimate:
    """Ranges that the measured values of the finished mesh should lie in."""

    area: float  # area of the surface in the region, squared scene units
    cap_area: float  # area of the caps on the region's boundary
    by_edge: bool  # requested by an edge length, not by a number of points
    adaptive: bool
    points_low: int
    points_high: int
    dense_low: int
    dense_high: int
    """Points of the dense mesh that is simplified to these; the same with uniform spacing. They
    determine time and memory."""
    seconds_low: float
    seconds_high: float
    memory_bytes: int  # peak without tiles, at the high end
    memory_low_bytes: int  # peak without tiles, at the low end
    tiled_memory_bytes: int  # peak with tiles, at the low end

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the estimate as lines of text."""
        low, high = self.seconds_low, self.seconds_high
        sizes = (self.memory_low_bytes, self.memory_bytes, self.tiled_memory_bytes)
        gigabytes = [f"{size / 2**30:.1f}" for size in sizes]
        unit, share = ("s", 1.0) if high < 90 else ("min", 60.0)
        return [
            f"triangles: {two_digits(2 * self.points_low)} to {two_digits(2 * self.points_high)}",
            f"time: {max(1, round(low / share))} to {max(1, round(high / share))} {unit}",
            f"memory: {gigabytes[0]} to {gigabytes[1]} GB whole, from {gigabytes[2]} GB in tiles",
        ]

    def tiles_for(self, memory_bytes: int) -> bool:
        """Return whether to mesh the region in tiles, given the memory (0: unknown)."""
        return self.dense_high > WHOLE_POINTS or 0 < memory_bytes < self.memory_bytes

    def refuse(self, memory_bytes: int, *, tiled: bool) -> None:
        """Refuse a request that exceeds the points limit or the memory even at the low end.

        Raises ResourceError: its hint names what would fit.
        """
        if self.by_edge and self.dense_low > limits.MAX_MESH_POINTS:
            raise ResourceError(
                f"This mesh needs at least {two_digits(self.dense_low)} points; "
                f"the limit is {two_digits(limits.MAX_MESH_POINTS)}.",
                f"{self._coarser(limits.MAX_MESH_POINTS)}, or a smaller region.",
            )
        needed = self.tiled_memory_bytes if tiled else self.memory_low_bytes
        if memory_bytes <= 0 or needed <= memory_bytes:
            return
        room = max(memory_bytes - BASE_BYTES, 0)
        points = room / POINT_BYTES
        if tiled:
            share = self.points_low / max(self.dense_low, 1)
            each = GATHERED_POINT_BYTES + share * JOINED_VERTEX_BYTES
            points = max(points, (room - _tile_bytes(TILE_POINTS)) / each)
        hint = self._coarser(points)
        if room <= BASE_BYTES // 8:
            hint = "Close other programs"
        if not tiled and self.tiled_memory_bytes <= memory_bytes:
            hint += ", or tiles"
        raise ResourceError(
            f"This mesh needs at least {needed / 2**30:.1f} GB of memory; "
            f"{memory_bytes / 2**30:.1f} GB are free.",
            f"{hint}.",
        )

    def _coarser(self, dense: float) -> str:
        """Return the hint for a dense mesh of at most this many points."""
        stay = kept_from_dense(dense) if self.adaptive else dense
        before = kept_from_dense(self.dense_low) if self.adaptive else float(self.dense_low)
        factor = times_longer(before, max(stay, 1.0))
        return f"Use edges {factor} times longer (at most {two_digits_below(int(stay))} points)"


def _tile_bytes(points: float) -> float:
    """Return the peak memory of a tile."""
    return SURROUNDINGS * points * POINT_BYTES


def two_digits(number: int) -> str:
    """Format a number with two significant digits."""
    digits = max(0, len(str(max(number, 1))) - 2)
    return f"{round(number, -digits):_}".replace("_", " ")


def two_digits_below(number: int) -> str:
    """Format a number with two significant digits, the others dropped."""
    step = 10 ** max(0, len(str(number)) - 2)
    return two_digits(number // step * step)


def box_counting_area(points: np.ndarray) -> float:
    """Estimate the area of the surface that (n, 3) points lie on, by box counting.

    Both sides of a wall thinner than a box count once: the estimate is low for those.
    """
    if len(points) < 2 * POINTS_PER_BOX:
        return 0.0
    low = points.min(0)
    side = float((points.max(0) - low).max()) / 4.0
    if side <= 0.0:
        return 0.0
    best = 0.0
    while True:
        boxes = _distinct(np.floor((points - low) / side).astype(np.int64))
        if best > 0.0 and len(points) < POINTS_PER_BOX * boxes:
            return best
        best = boxes * side**2 / BOXES_PER_SQUARE
        if len(points) < POINTS_PER_BOX * boxes or side < 1e-9:
            return best
        side /= 1.25


def _distinct(cells: np.ndarray) -> int:
    """Return the number of distinct rows of (n, 3) int64 cells, none negative."""
    extent = cells.max(0) + 1
    if math.prod(extent.tolist()) > np.iinfo(np.int64).max:
        return len(np.unique(cells, axis=0))
    # A tenth of the time of sorting rows.
    return len(np.unique(np.ravel_multi_index(tuple(cells.T), tuple(extent))))


def occupied_boundary_area(region: Region, is_empty: Any) -> float:
    """Estimate the area of the region's boundary that lies in the solid, by sampling."""
    corners = np.concatenate(region.faces()).reshape(-1, 3)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    points, _ = sample_triangles(corners, triangles, BOUNDARY_SAMPLES, np.random.default_rng(0))
    return region.area * float(np.mean(~is_empty(points)))


def evaluation_seconds(vacancy: Any, points: np.ndarray) -> float:
    """Measure the time of one evaluation of vacancy near the surface."""
    if len(points) == 0:
        return 0.0
    some = points[:: max(1, len(points) // PROBES)]
    vacancy.vacancy(some[:64])  # warm-up: prepares the cameras, loads the kernels
    begun_s = time.perf_counter()
    vacancy.vacancy(some)
    return (time.perf_counter() - begun_s) / len(some)


def estimate_mesh(
    area: float, cap_area: float, request: ResolutionRequest, *,
    adaptive: bool, evaluation_s: float = 0.0, resolved: np.ndarray | None = None,
) -> MeshEstimate:  # fmt: skip
    """Estimate the cost of a mesh.

    Parameters
    ----------
    area, cap_area : float
        From :func:`box_counting_area` and :func:`occupied_boundary_area`.
    evaluation_s : float
        From :func:`evaluation_seconds`.
    resolved : (n,) float64, optional
        Shortest edge that the photos resolve at samples of the surface, which limits adaptive
        spacing; from :func:`.spacing.resolved_edges`.
    """
    by_edge = request.edge_length > 0
    if by_edge:
        even = POINTS_PER_SQUARE * area * (EDGE_PER_RADIUS / request.edge_length) ** 2
        low, high = AREA_LOW * even, AREA_HIGH * even
    else:
        even = float(request.points or AUTOMATIC_POINTS)
        low, high = BUDGET_LOW * even, BUDGET_HIGH * even
    stay_low, stay_high, share = low, high, 1.0
    if adaptive:
        stay = VERTICES_PER_UNIFORM if by_edge else 1.0
        stay_low, stay_high = stay * low, max(stay * high, MIN_VERTICES)
        middle = max(stay * even, MIN_VERTICES)
        share = middle / dense_points(middle)
        even = dense_points(middle)
        # The area is not known yet, but a number of points determines the dense mesh directly.
        low, high = BUDGET_LOW * even, BUDGET_HIGH * even
        if by_edge:
            low, high = dense_points(stay_low), dense_points(stay_high)
    # A region within the solid has no surface other than its caps.
    radius = math.sqrt(POINTS_PER_SQUARE * max(area, 0.1 * cap_area) / max(even, 1.0))
    if by_edge:  # of the dense mesh
        radius = request.edge_length / EDGE_PER_RADIUS
        radius *= math.sqrt(share / VERTICES_PER_UNIFORM) if adaptive else 1.0
    caps = 0.0
    if cap_area > 0.0:
        caps = POINTS_PER_SQUARE * cap_area / (INNER_RADII * radius) ** 2
        caps = min(caps, POINTS_PER_SQUARE * MAX_CANDIDATES / OVERSAMPLING)
    if adaptive and resolved is not None and len(resolved):
        edge = EDGE_PER_RADIUS * radius
        low *= float(np.mean((edge / np.clip(resolved, edge, LONGEST_SHARE * edge)) ** 2))
    high += caps
    low += 0.0 if adaptive else 0.5 * caps
    stay_low = min(stay_low, low) if adaptive else low
    stay_high = max(stay_high, share * high) if adaptive else high
    each_s = EVALUATIONS_PER_POINT * evaluation_s + POINT_S
    tiled = BASE_BYTES + low * GATHERED_POINT_BYTES + _tile_bytes(min(low, TILE_POINTS))
    tiled += min(stay_low, low) * JOINED_VERTEX_BYTES
    whole_low = BASE_BYTES + low * POINT_BYTES
    return MeshEstimate(
        area, cap_area, by_edge, adaptive,
        int(stay_low), int(stay_high), int(low), int(high),
        SECONDS_LOW * (FIXED_S + low * each_s), SECONDS_HIGH * (FIXED_S + high * each_s),
        int(BASE_BYTES + high * POINT_BYTES), int(whole_low), int(min(tiled, whole_low)),
    )  # fmt: skip


# -- Estimate the cost of pivot meshing from the Gaussians and depth samples in a region ----------
#
# The resolution is that of the Gaussians, so points are counted, not requested; each has about
# six tetrahedra, as in any Delaunay triangulation of points near surfaces.

TETRAHEDRA_LOW, TETRAHEDRA_HIGH = 5.0, 8.0
"""Per point, after clipping to the region (5.8 to 7.0 for spheres and tori)."""
TETRAHEDRA_ALONE_HIGH = 20.0
"""With the pivots alone: nothing lies between the surfaces, so that tetrahedra across the gap are
long and more of them meet in a point (8.1 to 14.3 for spheres and tori)."""

FACES_LOW, FACES_HIGH = 0.5, 3.0
"""Per pivot of the Gaussians (1.2 with nine pivots, most of which lie off the surface, to 2.4 with
two; fewer at the region's boundary)."""
FACES_ALONE_HIGH = 6.0  # the same with the pivots alone (up to 3.3: a torus, two pivots)
PAIR_FACES_LOW, PAIR_FACES_HIGH = 3.0, 7.0
"""Per point from depth samples, all next to the surface (5 to 6 on a trained scene)."""

POINT_LOW_BYTES, PIVOT_BYTES = 1_500, 6_500
"""Peak per point (1 900 with nine pivots to 5 900 with three)."""

EVALUATIONS_LOW, EVALUATIONS_HIGH = 2.0, 22.0
"""Evaluations of vacancy per point, bisection of edges included (5.9 to 21.5). An evaluation may
take as little as a quarter of the time that is measured at the surface."""

POINT_LOW_S, PIVOT_S = 15e-6, 120e-6  # everything else, per point

PAIRED_LOW, PAIRED_HIGH = 1.0, 4.0
"""Points per depth sample of the estimate: two where the inside is found behind it; a job uses more
cameras than an estimate."""


@dataclass(frozen=True)
class PivotEstimate:
    """Ranges like those of :class:`~.estimate.MeshEstimate`, for pivot meshing."""

    gaussians: int  # Gaussians that reach the region
    pivots_low: int
    pivots_high: int  # points that are triangulated
    tetrahedra_low: int
    tetrahedra_high: int
    points_low: int
    points_high: int  # vertices of the mesh
    seconds_low: float
    seconds_high: float
    memory_low_bytes: int
    memory_bytes: int

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the estimate as lines of text."""
        return [
            f"tetrahedra: {two_digits(self.tetrahedra_low)} to {two_digits(self.tetrahedra_high)}",
            f"triangles: {two_digits(2 * self.points_low)} to {two_digits(2 * self.points_high)}",
            f"time: {_span(self.seconds_low)} to {_span(self.seconds_high)}",
            f"memory: {self.memory_low_bytes / 2**30:.1f} to {self.memory_bytes / 2**30:.1f} GB",
        ]

    def refuse(self, memory_bytes: int) -> None:
        """Refuse a mesh that exceeds the memory (0: unknown) even at the low end: ResourceError."""
        if memory_bytes <= 0 or self.memory_low_bytes <= memory_bytes:
            return
        raise ResourceError(
            f"Meshing {two_digits(self.gaussians)} Gaussians by pivots needs at least "
            f"{self.memory_low_bytes / 2**30:.1f} GB of memory; {memory_bytes / 2**30:.1f} GB are "
            "free.",
            "Draw a smaller region, use fewer pivots, or use the method pam.",
        )


def _span(seconds: float) -> str:
    return f"{max(1, round(seconds))} s" if seconds < 90 else f"{round(seconds / 60)} min"


def estimate_pivot_mesh(
    arrays: GaussianArrays, region: Region, pivots: int, depth_samples: int, *,
    box: str = "normal", alone: bool = False, evaluation_s: float = 0.0,
) -> PivotEstimate:  # fmt: skip
    """Estimate the cost of :func:`~.pivot_meshing.mesh_by_pivots`.

    Parameters
    ----------
    arrays, region
        Same frame.
    pivots : int
        Number of pivots per Gaussian.
    depth_samples : int
        Number of depth samples in the region.
    box : str
        Of nine pivots, the setting ``pivot_box``.
    alone : bool
        Whether nothing is triangulated but the pivots (``pivot_samples = "none"``).
    evaluation_s : float
        Time of one evaluation of vacancy, from :func:`~.estimate.evaluation_seconds`.

    Raises
    ------
    MeshingError
        No Gaussian reaches the region.
    """
    rule = pivot_rule(pivots, box)
    if alone:
        own, depth_samples = pivots_alone(arrays, region, rule), 0
        tetrahedra_high, faces_high = TETRAHEDRA_ALONE_HIGH, FACES_ALONE_HIGH
    else:
        own = pivots_and_probes(arrays, region, 0, rule)
        tetrahedra_high, faces_high = TETRAHEDRA_HIGH, FACES_HIGH
    pairs_low = PAIRED_LOW * min(depth_samples, MAX_DEPTH_SAMPLES)
    pairs_high = min(PAIRED_HIGH * depth_samples, 2.0 * MAX_DEPTH_SAMPLES)
    low, high = len(own.points) + pairs_low, len(own.points) + pairs_high
    few = FACES_LOW * len(own.points) + PAIR_FACES_LOW * pairs_low
    many = faces_high * len(own.points) + PAIR_FACES_HIGH * pairs_high
    return PivotEstimate(
        own.gaussians, int(low), int(high),
        int(TETRAHEDRA_LOW * low), int(tetrahedra_high * high), int(few / 2), int(many / 2),
        0.5 * FIXED_S + low * (EVALUATIONS_LOW * evaluation_s + POINT_LOW_S),
        2.0 * FIXED_S + high * (EVALUATIONS_HIGH * evaluation_s + PIVOT_S),
        int(BASE_BYTES / 2 + low * POINT_LOW_BYTES),
        int(BASE_BYTES + high * PIVOT_BYTES * tetrahedra_high / TETRAHEDRA_HIGH),
    )  # fmt: skip
