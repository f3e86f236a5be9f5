# SPDX-License-Identifier: GPL-3.0-or-later
"""How a training is divided into blocks, and the settings of the coarse training before it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from ...errors import UsageError
from ...limits import MAX_BLOCKS
from ...settings import TrainingSettings

SMALLEST_PX = 32
"""Least long side of the photos of the coarse training: that of the setting."""


@dataclass(frozen=True)
class BlockSettings:
    """How a training is divided. The shares are of the settings of the whole training."""

    blocks: int = 2
    margin: float = 0.2
    """A block also trains what lies so far outside of its cell, as a share of the cell's size."""
    coarse_iterations: float = 0.3
    """Share of the iterations that the coarse training has."""
    begin: float = 0.1
    """Share of the schedule at which blocks begin. Earlier than the coarse training has come: what
    they add takes most rounds of growth, and moves fastest, at first."""
    coarse_gaussians: float = 0.5
    """Share of the Gaussians that the coarse training has at most; less for more blocks, so that it
    does not need the most memory (:attr:`coarse_share`)."""
    coarse_px: float = 0.5
    """Share of the photos' long side at which it trains."""
    coverage: float = 0.95
    """A block takes the fewest photos that together show this share, by weight, of what lies in its
    cell and margin."""
    hidden_share: float = 0.002
    """Of the Gaussians around a block, those stay away that make up less than this share of the
    weights in each of its photos."""
    polish_iterations: float = 0.1
    """Share of the iterations that the joined Gaussians are trained together."""

    def __post_init__(self) -> None:
        if not 1 <= self.blocks <= MAX_BLOCKS:
            raise UsageError(
                f"A training cannot be divided into {self.blocks} blocks.",
                f"Give a number from 1 to {MAX_BLOCKS}.",
            )
        bounds = {
            "margin": (0.0, 1.0), "coarse_iterations": (0.01, 1.0), "begin": (0.0, 0.9),
            "coarse_gaussians": (0.01, 1.0), "coarse_px": (0.05, 1.0), "coverage": (0.5, 1.0),
            "hidden_share": (0.0, 0.1), "polish_iterations": (0.0, 1.0),
        }  # fmt: skip
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not low <= value <= high:  # false for NaN
                raise UsageError(
                    f"{name} of a training in blocks is {value}.", f"Give {low} to {high}."
                )

    @classmethod
    def of(cls, settings: TrainingSettings) -> BlockSettings:
        """Return how settings of a whole training divide it."""
        return cls(settings.blocks, polish_iterations=settings.polish)

    @property
    def coarse_share(self) -> float:
        """Share of the Gaussians that the coarse training has at most: of two blocks, or less."""
        return min(self.coarse_gaussians, 2.0 / self.blocks)

    def coarse(self, settings: TrainingSettings) -> TrainingSettings:
        """Return the settings of the coarse training that comes before the blocks."""
        return dataclasses.replace(
            settings,
            iterations=max(1, round(self.coarse_iterations * settings.iterations)),
            extra_iterations=0,
            max_gaussians=max(1, round(self.coarse_share * settings.max_gaussians)),
            max_image_px=max(SMALLEST_PX, math.ceil(self.coarse_px * settings.max_image_px)),
        )
