# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of one rendering."""

from __future__ import annotations

from dataclasses import dataclass

from ... import limits, tolerances


@dataclass(frozen=True)
class RenderOptions:
    """Options of one rendering."""

    depth: bool = True
    """Solve the 0.5-isosurface depth (and its gradient); off where no depth loss is active."""
    sh_degree: int | None = None
    """Use only this degree of the stored harmonics; ``None`` uses all."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near_z: float = tolerances.NEAR_Z
    depth_valid_transmittance: float = tolerances.DEPTH_VALID_TRANSMITTANCE
    threads: int = 0
    """0 uses every core this process may use."""
    statistics: bool = False
    """Gather all of :class:`~.images.RenderStatistics` (wrapping, pruning)."""
    screen_gradients: bool = False
    """Gather only ``visible``, ``radii_px``, ``grad_px`` and ``grad_abs_px`` (density control):
    spares the sums of blending weights."""
    budget_bytes: int = limits.RENDER_BUDGET_BYTES
    """What everything that grows with the (tile, Gaussian) pairs may take. An image whose pairs do
    not fit is rendered in bands of tiles; a band is never smaller than one tile."""

    @property
    def gathers_statistics(self) -> bool:
        """Whether a rendering has statistics at all."""
        return self.statistics or self.screen_gradients
