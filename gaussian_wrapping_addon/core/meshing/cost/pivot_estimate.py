# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimate the cost of pivot meshing from the Gaussians and depth samples in a region.

The resolution is that of the Gaussians, so points are counted, not requested; each has about six
tetrahedra, as in any Delaunay triangulation of points near surfaces.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from ...errors import ResourceError
from ...field.depth_samples import MAX_DEPTH_SAMPLES
from ...gaussians.model import GaussianArrays
from ...regions.convex_region import Region
from ..points.candidate_surface import pivots_alone, pivots_and_probes
from ..points.pivots import pivot_rule
from .mesh_estimate import BASE_BYTES, FIXED_S, two_digits

TETRAHEDRA_LOW, TETRAHEDRA_HIGH = 5.0, 8.0
"""Per point, after clipping to the region (5.8 to 7.0 for spheres and tori)."""
TETRAHEDRA_ALONE_HIGH = 20.0
"""With the pivots alone: nothing lies between the surfaces, so that tetrahedra across the gap are
long and more of them meet in a point (8.1 to 14.3 for spheres and tori)."""

FACES_LOW, FACES_HIGH = 0.5, 3.0
"""Per pivot of the Gaussians (1.2 with nine pivots, most of which lie off the surface, to 2.4 with
two; fewer at the region's boundary)."""
FACES_ALONE_HIGH = 6.0
"""The same with the pivots alone (up to 3.3: a torus, two pivots)."""
PAIR_FACES_LOW, PAIR_FACES_HIGH = 3.0, 7.0
"""Per point from depth samples, all next to the surface (5 to 6 on a trained scene)."""

POINT_LOW_BYTES, POINT_BYTES = 1_500, 6_500
"""Peak per point (1 900 with nine pivots to 5 900 with three)."""

EVALUATIONS_LOW, EVALUATIONS_HIGH = 2.0, 22.0
"""Evaluations of vacancy per point, bisection of edges included (5.9 to 21.5). An evaluation may
take as little as a quarter of the time that is measured at the surface."""

POINT_LOW_S, POINT_S = 15e-6, 120e-6
"""Everything else, per point."""

PAIRED_LOW, PAIRED_HIGH = 1.0, 4.0
"""Points per depth sample of the estimate: two where the inside is found behind it; a job uses more
cameras than an estimate."""


@dataclass(frozen=True)
class PivotEstimate:
    """Ranges like those of :class:`~.mesh_estimate.MeshEstimate`, for pivot meshing."""

    gaussians: int
    """Gaussians that reach the region."""
    pivots_low: int
    pivots_high: int
    """Points that are triangulated."""
    tetrahedra_low: int
    tetrahedra_high: int
    points_low: int
    points_high: int
    """Vertices of the mesh."""
    seconds_low: float
    seconds_high: float
    memory_low_bytes: int
    memory_bytes: int

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the estimate as lines of text."""
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
        """Refuse a mesh that exceeds the memory (0: unknown) even at the low end.

        Raises
        ------
        ResourceError
            Its hint names what would fit.
        """
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
    box: str = "normal", alone: bool = False, evaluation_s: float = 0.0, seed: int = 0,
) -> PivotEstimate:  # fmt: skip
    """Estimate the cost of :func:`~..pivot_meshing.mesh_by_pivots`.

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
        Time of one evaluation of vacancy, from :func:`~.mesh_estimate.evaluation_seconds`.

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
        own = pivots_and_probes(arrays, region, seed, rule)
        tetrahedra_high, faces_high = TETRAHEDRA_HIGH, FACES_HIGH
    pairs_low = PAIRED_LOW * min(depth_samples, MAX_DEPTH_SAMPLES)
    pairs_high = min(PAIRED_HIGH * depth_samples, 2.0 * MAX_DEPTH_SAMPLES)
    low, high = len(own.points) + pairs_low, len(own.points) + pairs_high
    few = FACES_LOW * len(own.points) + PAIR_FACES_LOW * pairs_low
    many = faces_high * len(own.points) + PAIR_FACES_HIGH * pairs_high
    return PivotEstimate(
        own.gaussians,
        int(low),
        int(high),
        int(TETRAHEDRA_LOW * low),
        int(tetrahedra_high * high),
        int(few / 2),
        int(many / 2),
        0.5 * FIXED_S + low * (EVALUATIONS_LOW * evaluation_s + POINT_LOW_S),
        2.0 * FIXED_S + high * (EVALUATIONS_HIGH * evaluation_s + POINT_S),
        int(BASE_BYTES / 2 + low * POINT_LOW_BYTES),
        int(BASE_BYTES + high * POINT_BYTES * tetrahedra_high / TETRAHEDRA_HIGH),
    )
