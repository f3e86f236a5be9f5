# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering options."""

from __future__ import annotations

from dataclasses import dataclass

from ... import limits, tolerances


@dataclass(frozen=True)
class RenderOptions:
    """Options of one rendering."""

    depth: bool = True
    """Solve the 0.5-isosurface depth (and its gradient); disable where no depth loss is active."""
    sh_degree: int | None = None
    """Use only this degree of the stored harmonics; ``None`` uses all."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near_z: float = tolerances.NEAR_Z
    depth_valid_transmittance: float = tolerances.DEPTH_VALID_TRANSMITTANCE
    threads: int = 0
    """0 uses every core available to this process."""
    statistics: bool = False
    """Collect all of :class:`~.images.RenderStatistics` (wrapping, pruning)."""
    screen_gradients: bool = False
    """Collect only ``visible``, ``radii_px``, ``grad_px`` and ``grad_abs_px`` (density control),
    without the sums of blending weights."""
    budget_bytes: int = limits.RENDER_BUDGET_BYTES
    """Memory for everything that grows with the number of tile intersections. An image whose
    intersections do not fit is rendered in bands of tiles; a band is at least one tile."""

    @property
    def gathers_statistics(self) -> bool:
        """Whether a rendering collects any statistics."""
        return self.statistics or self.screen_gradients
