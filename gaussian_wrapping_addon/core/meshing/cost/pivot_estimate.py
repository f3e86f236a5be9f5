# SPDX-License-Identifier: GPL-3.0-or-later
"""What meshing a region by pivots will take, from the Gaussians and depth_samples in it.

The resolution is that of the Gaussians, so the points are counted, not asked for; each point has
about six tetrahedra, as in any Delaunay triangulation of points near surfaces.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from ...errors import ResourceError
from ...field.depth_samples import MAX_DEPTH_SAMPLES
from ...gaussians.model import GaussianArrays
from ...regions.convex_region import Region
from ..points.candidate_surface import pivots_and_probes
from ..points.pivots import PIVOTS
from .mesh_estimate import BASE_BYTES, FIXED_S, two_digits

TETRAHEDRA_LOW, TETRAHEDRA_HIGH = 5.0, 8.0
"""For each point, after the cut at the region (5.8 to 7.0 of spheres and tori)."""

FACES_LOW, FACES_HIGH = 0.5, 3.0
"""For each point of the Gaussians (1.2 with nine pivots, of which most lie off the surface, to 2.4
with two; fewer where the region ends)."""
PAIR_FACES_LOW, PAIR_FACES_HIGH = 3.0, 7.0
"""For each point of the depth_samples, all next to the surface (5 to 6 on a trained scene)."""

POINT_LOW_BYTES, POINT_BYTES = 1_500, 6_500
"""Peak for each point (1 900 with nine pivots to 5 900 with three)."""

EVALUATIONS_LOW, EVALUATIONS_HIGH = 2.0, 22.0
"""Vacancy is asked for so often for each point, bisection of edges included (5.9 to 21.5). Where it
is asked it may take less time than at the surface, where that is measured: to a quarter."""

POINT_LOW_S, POINT_S = 15e-6, 120e-6
"""Everything else, for each point."""

PAIRED_LOW, PAIRED_HIGH = 1.0, 4.0
"""Points for each sighting that the estimate has: two where the inside is found behind it; a job
looks from more cameras than an estimate."""


@dataclass(frozen=True)
class PivotEstimate:
    """Honest ranges, as :class:`~.mesh_estimate.MeshEstimate` gives them for the other method."""

    gaussians: int
    """That reach the region."""
    pivots_low: int
    pivots_high: int
    """Points that are connected."""
    tetrahedra_low: int
    tetrahedra_high: int
    points_low: int
    points_high: int
    """Of the mesh."""
    seconds_low: float
    seconds_high: float
    memory_low_bytes: int
    memory_bytes: int

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return what people want to know, a line each."""
        low_gb, high_gb = (
            f"{size / 2**30:.1f}" for size in (self.memory_low_bytes, self.memory_bytes)
        )
        return [
            f"tetrahedra: {two_digits(self.tetrahedra_low)} to {two_digits(self.tetrahedra_high)}",
            f"triangles: {two_digits(2 * self.points_low)} to {two_digits(2 * self.points_high)}",
            f"time: {_span(self.seconds_low)} to {_span(self.seconds_high)}",
            f"memory: {low_gb} to {high_gb} GB",
        ]

    def refuse(self, memory_bytes: int) -> None:
        """Refuse what does not fit into so much memory (0: unknown) even at the low end.

        Raises
        ------
        ResourceError
            Names what would fit.
        """
        if memory_bytes <= 0 or self.memory_low_bytes <= memory_bytes:
            return
        raise ResourceError(
            f"Meshing {two_digits(self.gaussians)} Gaussians by pivots needs at least "
            f"{self.memory_low_bytes / 2**30:.1f} GB of memory; {memory_bytes / 2**30:.1f} GB are "
            "free.",
            "Draw a smaller region, use fewer pivots, or mesh it by the method pam.",
        )


def _span(seconds: float) -> str:
    return f"{max(1, round(seconds))} s" if seconds < 90 else f"{round(seconds / 60)} min"


def estimate_pivot_mesh(
    arrays: GaussianArrays, region: Region, pivots: int, depth_samples: int, *,
    evaluation_s: float = 0.0, seed: int = 0,
) -> PivotEstimate:  # fmt: skip
    """Return what :func:`~..pivot_meshing.mesh_by_pivots` will take.

    Parameters
    ----------
    arrays, region
        Same frame.
    pivots : int
        Of each Gaussian.
    depth_samples : int
        How many there are in the region.
    evaluation_s : float
        Time of one evaluation of vacancy, from :func:`~.mesh_estimate.evaluation_seconds`.

    Raises
    ------
    MeshingError
        No Gaussian reaches the region.
    """
    own = pivots_and_probes(arrays, region, seed, PIVOTS[pivots])
    pairs_low = PAIRED_LOW * min(depth_samples, MAX_DEPTH_SAMPLES)
    pairs_high = min(PAIRED_HIGH * depth_samples, 2.0 * MAX_DEPTH_SAMPLES)
    low, high = len(own.points) + pairs_low, len(own.points) + pairs_high
    few = FACES_LOW * len(own.points) + PAIR_FACES_LOW * pairs_low
    many = FACES_HIGH * len(own.points) + PAIR_FACES_HIGH * pairs_high
    return PivotEstimate(
        own.gaussians,
        int(low),
        int(high),
        int(TETRAHEDRA_LOW * low),
        int(TETRAHEDRA_HIGH * high),
        int(few / 2),
        int(many / 2),
        0.5 * FIXED_S + low * (EVALUATIONS_LOW * evaluation_s + POINT_LOW_S),
        2.0 * FIXED_S + high * (EVALUATIONS_HIGH * evaluation_s + POINT_S),
        int(BASE_BYTES / 2 + low * POINT_LOW_BYTES),
        int(BASE_BYTES + high * POINT_BYTES),
    )
