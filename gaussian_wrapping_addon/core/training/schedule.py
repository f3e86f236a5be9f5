# SPDX-License-Identifier: GPL-3.0-or-later
"""Training schedule: image resolution, harmonics, losses, densification, learning rates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .. import limits
from ..settings import TrainingSettings

POSITION_RATE = (1.6e-4, 1.6e-6)
"""First and last learning rate of the means per scene radius (docs/method.md, section 1.4)."""

RATES = {
    "sh_dc": 2.5e-3,
    "sh_rest": 1.25e-4,
    "opacity_logits": 0.05,
    "log_scales": 5e-3,
    "quats": 1e-3,
    "orientation": 0.025,
}
"""Learning rates of docs/method.md, section 1.4, for :data:`REFERENCE_ITERATIONS` iterations."""

REFERENCE_ITERATIONS = 30_000

RATE_POWERS = {
    "means": 0.5,
    "opacity_logits": 0.5,
    "log_scales": 1.0,
    "quats": 1.0,
    "sh_dc": 1.0,
    "sh_rest": 2.0,
    "orientation": 0.0,
}
"""Exponent of :attr:`Schedule.short_run_factor` for each rate."""

PYRAMID = ((4, 0.0), (2, 0.1), (1, 0.3))
"""Divisor of the image size, and the fraction of the iterations from which it is used."""

REFINING_FROM = 0.7
"""Point in the decay of the means' rate at which a training of finished Gaussians starts."""

SMALLEST_SIDE_PX = 96
"""Smallest long side of a pyramid level; a finer level is used below it."""

POSES_FROM = 0.05
"""Fraction of the iterations from which camera poses are refined: before, colours still change
more than a pixel's shift would change them."""

POSES_DECIDED_AT = 0.35
"""Fraction of the iterations at which poses that hardly moved go back to those given: the larger
part of the motion is done, and the Gaussians can follow."""

FIRST_BUDGET = 5000
"""Smallest budget of Gaussians."""

PRUNE_AT = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
"""Fractions of the iterations at which Gaussians of little contribution are pruned: during growth,
so that others take their place, and twice after it, when an iteration costs most."""

RESET_EVERY = 3000
"""Iterations between opacity resets (docs/method.md, section 4.1); runs too short to recover have
none."""

FILTER_EVERY = 100
"""Iterations between two computations of the 3D filter."""


@dataclass(frozen=True)
class Schedule:
    """Schedule of one training run. Milestones in the settings are fractions of the iterations.

    Parameters
    ----------
    long_side_px : int
        Long side of the largest training image.
    finest : int
        Divisor of the finest level of the pyramid.
    refines : bool
        Whether the Gaussians come from another training: then the finest level, all harmonics
        and late learning rates apply from the start.
    budget_share : float
        Of the settings' largest number of Gaussians.
    """

    settings: TrainingSettings
    long_side_px: int
    finest: int = 1
    refines: bool = False
    budget_share: float = 1.0

    @property
    def most_gaussians(self) -> int:
        """Largest number of Gaussians of this training."""
        return max(1, round(self.budget_share * self.settings.max_gaussians))

    @property
    def total(self) -> int:
        """All iterations, including the extra ones after the end of the schedule."""
        return self.settings.iterations + self.settings.extra_iterations

    def _share(self, iteration: int) -> float:
        return iteration / self.settings.iterations

    @property
    def short_run_factor(self) -> float:
        """Base of the factors by which short runs raise the learning rates; at least 1.

        Measured on two photo sets (600 iterations, 240 px) the published rates alone cost 5 to 6 dB
        on held-out photos.
        """
        longer = REFERENCE_ITERATIONS / self.settings.iterations
        return float(max(1.0, longer) ** self.settings.short_run_power)

    def _at(self, share: float) -> int:
        return round(share * self.settings.iterations)

    def divisor(self, iteration: int) -> int:
        """Return the divisor of the image size."""
        chosen = self.finest
        if self.refines or self.settings.coarse_to_fine == "off":
            return chosen
        for divisor, start in PYRAMID:
            if self._share(iteration) >= start:
                chosen = max(divisor, self.finest)
        while chosen > self.finest and self.long_side_px / chosen < SMALLEST_SIDE_PX:
            chosen //= 2
        return chosen

    def coarser(self, divisor: int) -> int:
        """Return the divisor of the next coarser level, or this one if that is too small."""
        return 2 * divisor if self.long_side_px / (2 * divisor) >= SMALLEST_SIDE_PX else divisor

    def sh_degree(self, iteration: int) -> int:
        """Return the degree of the harmonics, where they are on."""
        share = 1.0 if self.refines else min(1.0, self._share(iteration))
        return min(self.settings.sh_degree, int(share / self.settings.degree_every + 1e-9))

    def uses_depth(self, iteration: int) -> bool:
        """Tell whether the depth-normal loss is on."""
        return iteration >= self._at(self.settings.depth_from)

    def prior_weight(self, iteration: int) -> float:
        """Return the weight of the depths that stereo confirmed; they count with the depth loss."""
        return self.settings.lambda_depth_prior if self.uses_depth(iteration) else 0.0

    def opacity_weight(self, iteration: int) -> float:
        """Return the weight of the opacity prior; it counts with the depth loss."""
        return self.settings.lambda_opacity if self.uses_depth(iteration) else 0.0

    def refines_poses(self, iteration: int) -> bool:
        """Tell whether this iteration moves its camera: not before colours have settled."""
        return not self.refines and iteration >= self._at(POSES_FROM)

    def decides_poses(self, iteration: int) -> bool:
        """Tell whether the photos decide about camera poses after this iteration."""
        return not self.refines and iteration == max(1, self._at(POSES_DECIDED_AT))

    def compares_views(self, iteration: int) -> bool:
        """Tell whether the multi-view terms are evaluated in this iteration."""
        begin, end = self._at(self.settings.depth_from), self._at(self.settings.multi_view_until)
        return begin <= iteration < end and iteration % self.settings.multi_view_every == 0

    def is_oriented(self, iteration: int) -> bool:
        """Tell whether the orientation is trained."""
        return self.settings.wrapping == "on" and iteration >= self._at(self.settings.orient_from)

    def starts_orientation(self, iteration: int) -> bool:
        """Tell whether this is the first iteration that trains the orientation."""
        return self.settings.wrapping == "on" and iteration == self._at(self.settings.orient_from)

    def gathers_statistics(self, iteration: int) -> bool:
        """Tell whether this iteration collects statistics for density control."""
        return self.controls_density and iteration < self._at(self.settings.densify_until)

    def densifies(self, iteration: int) -> bool:
        """Tell whether density control runs after this iteration."""
        begin, end = self._at(self.settings.densify_from), self._at(self.settings.densify_until)
        due = begin < iteration <= end and iteration % self.settings.densify_every == 0
        return self.controls_density and due

    @property
    def controls_density(self) -> bool:
        """Whether Gaussians are added, kept small and removed."""
        return self.settings.growth != "off"

    def prunes(self, iteration: int) -> bool:
        """Tell whether Gaussians of little contribution are pruned after this iteration."""
        wanted = self.controls_density and self.settings.prune_share > 0.0
        return wanted and iteration in {self._at(x) for x in PRUNE_AT}

    def growth_limit(self) -> int:
        """Return the final limit of density control on the number of Gaussians.

        A part of :attr:`most_gaussians` is reserved for the wrapping rounds.
        """
        growth = (1.0 + self.settings.wrap_share) ** self.settings.wrap_rounds
        return max(1, math.floor(self.most_gaussians / growth))

    def budget(self, iteration: int) -> int:
        """Return the limit on the number of Gaussians after this iteration.

        It grows linearly as the image size grows: a coarse image cannot tell where many Gaussians
        are needed, and those added early cost time in all later iterations (DashGaussian schedules
        both together; Taming 3DGS grows along a planned budget).
        """
        share = min(1.0, self._share(iteration) / max(self.settings.densify_until, 1e-9))
        limit = self.growth_limit()
        return min(limit, max(FIRST_BUDGET, math.floor(share * limit)))

    def resets_opacity(self, iteration: int) -> bool:
        """Tell whether opacities are reset after this iteration."""
        until = self._at(self.settings.densify_until)
        return (
            self.controls_density
            and iteration % RESET_EVERY == 0
            and 0 < iteration <= until - RESET_EVERY
        )

    def wraps(self, iteration: int) -> bool:
        """Tell whether a wrapping round runs after this iteration."""
        s = self.settings
        shares = np.linspace(s.wrap_from, s.wrap_until, s.wrap_rounds)
        return iteration > 0 and iteration in {self._at(float(share)) for share in shares}

    def refilters(self, iteration: int) -> bool:
        """Tell whether the 3D filter is recomputed after this iteration."""
        return iteration % FILTER_EVERY == 0

    def rates(self, iteration: int, factor: float = 1.0) -> dict[str, np.ndarray]:
        """Return the learning rate of each column of each tensor.

        Parameters
        ----------
        factor : float
            Factor on all rates (lowered after a restart).
        """
        growth = {name: self.short_run_factor**power for name, power in RATE_POWERS.items()}
        first, last = POSITION_RATE
        share = min(1.0, self._share(iteration))
        if self.refines:
            share = REFINING_FROM + (1.0 - REFINING_FROM) * share
        position = growth["means"] * limits.SCENE_RADIUS * first * (last / first) ** share
        coefficients = (self.settings.sh_degree + 1) ** 2
        rate = {name: value * growth[name] for name, value in RATES.items()}
        sh = np.full((coefficients, 3), rate["sh_rest"])
        sh[0] = rate["sh_dc"]
        columns = {
            "means": np.full(3, position),
            "log_scales": np.full(3, rate["log_scales"]),
            "quats": np.full(4, rate["quats"]),
            "opacity_logits": np.full(1, rate["opacity_logits"]),
            "sh": sh.reshape(-1),
        }
        if self.is_oriented(iteration):
            columns["orientation"] = np.full(4, rate["orientation"])
        return {name: (factor * column).astype(np.float32) for name, column in columns.items()}
