# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training gives back."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from ..gaussians.model import OrientedGaussians
from ..report_warning import ReportWarning
from .selection.model_selection import ModelSelection


@dataclass(frozen=True)
class HeldOutMetrics:
    """How well one photo that was never trained on is reproduced."""

    name: str
    psnr: float
    """dB, at the finest training size."""
    ssim: float
    lpips: float | None = None
    """``None`` where it was not measured."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; ``lpips`` only where it was measured."""
        values = dataclasses.asdict(self)
        if self.lpips is None:
            del values["lpips"]
        return values


@dataclass(frozen=True)
class TrainingResult:
    """Trained Gaussians and what was measured of them."""

    gaussians: OrientedGaussians
    iterations: int
    history: tuple[dict[str, float], ...]
    """Loss, PSNR of the trained photos and number of Gaussians along the way."""
    held_out: tuple[HeldOutMetrics, ...]
    seconds: float
    warnings: tuple[ReportWarning, ...]
    lpips_note: str = ""
    """Why the held-out photos have no LPIPS."""
    model_selection: ModelSelection = field(default_factory=ModelSelection)
    """What was decided for the scene."""
    exposure_fitted: bool = False
    """Held-out photos were measured in their own exposure, fitted crosswise on their halves."""

    @property
    def held_out_psnr(self) -> float:
        """Mean over the held-out photos, dB; NaN without any."""
        return _mean([figure.psnr for figure in self.held_out])

    @property
    def held_out_ssim(self) -> float:
        """Mean over the held-out photos; NaN without any."""
        return _mean([figure.ssim for figure in self.held_out])

    @property
    def held_out_lpips(self) -> float:
        """Mean over the held-out photos where it was measured; NaN without any."""
        return _mean([figure.lpips for figure in self.held_out if figure.lpips is not None])

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values for the report; the Gaussians are only counted."""
        values: dict[str, Any] = {
            "gaussians": len(self.gaussians),
            "iterations": self.iterations,
            "seconds_training": round(self.seconds, 3),
            "held_out": [figure.to_json() for figure in self.held_out],
            "history": [dict(entry) for entry in self.history],
            "warnings": [warning.to_json() for warning in self.warnings],
            "decisions": self.model_selection.to_json(),
            "held_out_exposure_fitted": self.exposure_fitted,
            "sh_degree": self.gaussians.sh_degree,
        }
        if self.held_out:
            values["held_out_psnr"] = self.held_out_psnr
            values["held_out_ssim"] = self.held_out_ssim
            if not math.isnan(self.held_out_lpips):
                values["held_out_lpips"] = self.held_out_lpips
            elif self.lpips_note:
                values["lpips_note"] = self.lpips_note
        return values


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan
