# SPDX-License-Identifier: GPL-3.0-or-later
"""What a mesh of a region will take, before it is made: points, faces, memory, time."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ... import limits
from ...errors import ResourceError
from ...mesh.surface_sampling import EDGE_PER_RADIUS, POINTS_PER_SQUARE, sample_triangles
from ...regions.convex_region import Region
from ..points.region_caps import INNER_RADII, MAX_CANDIDATES, OVERSAMPLING
from ..points.resolution import (
    AUTOMATIC_POINTS,
    MIN_VERTICES,
    VERTICES_PER_UNIFORM,
    ResolutionRequest,
    dense_points,
    kept_from_dense,
)
from ..points.spacing import LONGEST_SHARE
from ..tiles.plan import TILE_POINTS, WHOLE_POINTS

POINTS_PER_BOX = 8.0
"""Boxes that are counted hold so many sightings: with fewer, some that the surface crosses hold
none."""
BOXES_PER_SQUARE = 1.5
"""A plane crosses so many boxes per square of their side, in the mean over its directions."""

AREA_LOW, AREA_HIGH = 0.8, 1.5
"""The true area lay within these times the count on four trained scenes (0.86 to 1.11 times, and
1.27 where a part of the surface is hidden from the cameras)."""

BUDGET_LOW, BUDGET_HIGH = 0.7, 1.4
"""A number of points is met within these; the region's boundary comes on top."""

BOUNDARY_SAMPLES = 4096

POINT_BYTES = 3_500
"""Peak for each point of a mesh that is made whole, of the dense one with adaptive spacing:
tetrahedra, candidates, repair (145 000 points of a sphere took 3 100 each)."""
JOINED_POINT_BYTES = 2_000
"""The same of a tiled mesh, whose surface alone is held whole."""
SURROUNDINGS = 2.0
"""Points in and around a tile, in points of the tile."""
BASE_BYTES = 800 << 20
"""Python, compiled kernels, the Gaussians seen from each camera, the candidate surface."""

EVALUATIONS_PER_POINT = 45.0
"""Vacancy is asked for so many times for each point of the mesh, all steps together."""
POINT_S = 60e-6
"""Everything else, for each point: triangulation, thinning, repair."""
FIXED_S = 6.0
"""Pivots and the candidate surface."""
SECONDS_LOW, SECONDS_HIGH = 0.5, 2.0

PROBES = 20_000


@dataclass(frozen=True)
class MeshEstimate:
    """Honest ranges: what is measured of a finished mesh should lie in them."""

    area: float
    """Of the surface in the region, squared scene units."""
    cap_area: float
    """Of the region's boundary that closes the solid."""
    by_edge: bool
    """Asked for by an edge length, not by a number of points."""
    adaptive: bool
    points_low: int
    points_high: int
    dense_low: int
    dense_high: int
    """Points of the mesh that is made first, of which those stay; the same with uniform spacing.
    They decide about time and memory."""
    seconds_low: float
    seconds_high: float
    memory_bytes: int
    """Peak of a mesh made whole, at the high end."""
    memory_low_bytes: int
    """The same at the low end."""
    tiled_memory_bytes: int
    """Peak of a mesh made in tiles, at the low end."""

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return what people want to know, a line each."""
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
        """Tell whether the region is better meshed in tiles, with so much memory (0: unknown)."""
        return self.dense_high > WHOLE_POINTS or 0 < memory_bytes < self.memory_bytes

    def refuse(self, memory_bytes: int, *, tiled: bool) -> None:
        """Refuse what passes the most points, or the memory, even at the low end.

        Raises
        ------
        ResourceError
            Names what would fit.
        """
        if self.by_edge and self.dense_low > limits.MAX_MESH_POINTS:
            raise ResourceError(
                f"This mesh needs at least {two_digits(self.dense_low)} points; "
                f"{two_digits(limits.MAX_MESH_POINTS)} is the most.",
                f"{self._coarser(limits.MAX_MESH_POINTS)}, or a smaller region.",
            )
        needed = self.tiled_memory_bytes if tiled else self.memory_low_bytes
        if memory_bytes <= 0 or needed <= memory_bytes:
            return
        room = max(memory_bytes - BASE_BYTES, 0)
        points = room / POINT_BYTES
        if tiled:
            points = max(points, (room - _tile_bytes(TILE_POINTS)) / JOINED_POINT_BYTES)
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
        """Return what to ask for so that the mesh made first has so many points."""
        stay = kept_from_dense(dense) if self.adaptive else dense
        before = kept_from_dense(self.dense_low) if self.adaptive else float(self.dense_low)
        factor = math.ceil(105.0 * math.sqrt(before / max(stay, 1.0))) / 100.0
        return f"Use edges {factor:.2f} times longer (about {two_digits(int(stay))} points)"


def _tile_bytes(points: float) -> float:
    """Return the peak of a tile at work."""
    return SURROUNDINGS * points * POINT_BYTES


def two_digits(number: int) -> str:
    """Return a number with two digits that count."""
    digits = max(0, len(str(max(number, 1))) - 2)
    return f"{round(number, -digits):_}".replace("_", " ")


def box_counting_area(points: np.ndarray) -> float:
    """Return about the area of the surface that (n, 3) points lie on, by counting boxes.

    Thinner things than a box count once, not twice: the count is low for those.
    """
    if len(points) < 2 * POINTS_PER_BOX:
        return 0.0
    low = points.min(0)
    side = float((points.max(0) - low).max()) / 4.0
    if side <= 0.0:
        return 0.0
    best = 0.0
    while True:
        boxes = len(np.unique(np.floor((points - low) / side).astype(np.int64), axis=0))
        if best > 0.0 and len(points) < POINTS_PER_BOX * boxes:
            return best
        best = boxes * side**2 / BOXES_PER_SQUARE
        if len(points) < POINTS_PER_BOX * boxes or side < 1e-9:
            return best
        side /= 1.25


def occupied_boundary_area(region: Region, is_empty: Any) -> float:
    """Return about the area of the region's boundary that lies in the solid."""
    corners = np.concatenate(region.faces()).reshape(-1, 3)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    points, _ = sample_triangles(corners, triangles, BOUNDARY_SAMPLES, np.random.default_rng(0))
    return region.area * float(np.mean(~is_empty(points)))


def evaluation_seconds(vacancy: Any, points: np.ndarray) -> float:
    """Return the time of one evaluation of vacancy near the surface, measured here and now."""
    if len(points) == 0:
        return 0.0
    some = points[:: max(1, len(points) // PROBES)]
    vacancy.vacancy(some[:64])  # prepares the cameras, loads the kernels
    begun_s = time.perf_counter()
    vacancy.vacancy(some)
    return (time.perf_counter() - begun_s) / len(some)


def estimate_mesh(
    area: float,
    cap_area: float,
    request: ResolutionRequest,
    *,
    adaptive: bool,
    evaluation_s: float = 0.0,
    resolved: np.ndarray | None = None,
) -> MeshEstimate:
    """Return what a mesh will take.

    Parameters
    ----------
    area, cap_area : float
        From :func:`box_counting_area` and :func:`occupied_boundary_area`.
    evaluation_s : float
        From :func:`evaluation_seconds`.
    resolved : (n,) float64, optional
        Shortest edge that the photos resolve at places spread over the surface, which limits
        adaptive spacing; from :func:`..points.spacing.resolved_edges`.
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
        # The area is not known yet, but a number of points decides about the dense mesh at once.
        low, high = BUDGET_LOW * even, BUDGET_HIGH * even
        if by_edge:
            low, high = dense_points(stay_low), dense_points(stay_high)
    # A region within the solid has no surface but its own boundary.
    radius = math.sqrt(POINTS_PER_SQUARE * max(area, 0.1 * cap_area) / max(even, 1.0))
    if by_edge:  # of the mesh that is made first
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
    tiled = BASE_BYTES + low * JOINED_POINT_BYTES + _tile_bytes(min(low, TILE_POINTS))
    whole_low = BASE_BYTES + low * POINT_BYTES
    return MeshEstimate(
        area,
        cap_area,
        by_edge,
        adaptive,
        int(stay_low),
        int(stay_high),
        int(low),
        int(high),
        SECONDS_LOW * (FIXED_S + low * each_s),
        SECONDS_HIGH * (FIXED_S + high * each_s),
        int(BASE_BYTES + high * POINT_BYTES),
        int(whole_low),
        int(min(tiled, whole_low)),
    )
