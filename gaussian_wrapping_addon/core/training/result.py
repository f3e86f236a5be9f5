# SPDX-License-Identifier: GPL-3.0-or-later
"""Result of a training: Gaussians, history, held-out metrics, model selection."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..gaussians.model import OrientedGaussians
from ..report_warning import ReportWarning
from .selection.model_selection import ModelSelection


@dataclass(frozen=True)
class HeldOutMetrics:
    """Image metrics of one held-out photo."""

    name: str
    psnr: float
    """dB, at the finest training size."""
    ssim: float
    lpips: float | None = None
    """``None`` if not measured."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; ``lpips`` only if measured."""
        values = dataclasses.asdict(self)
        if self.lpips is None:
            del values["lpips"]
        return values


@dataclass(frozen=True)
class TrainingResult:
    """Trained Gaussians and their metrics."""

    gaussians: OrientedGaussians
    iterations: int
    history: tuple[dict[str, float], ...]
    """Loss, PSNR of the training photos and number of Gaussians over the iterations."""
    held_out: tuple[HeldOutMetrics, ...]
    seconds: float
    warnings: tuple[ReportWarning, ...]
    lpips_note: str = ""
    """Reason why the held-out photos have no LPIPS."""
    model_selection: ModelSelection = field(default_factory=ModelSelection)
    """Decisions on the model (the report's key ``decisions``)."""
    exposure_fitted: bool = False
    """Whether held-out photos were measured after an exposure fitted crosswise on their halves."""
    poses: np.ndarray | None = None
    """(views, 3, 4) refined ``cam_from_world`` of all views, or ``None`` where those given hold."""
    device: str = "cpu"
    """Where the last iterations ran: not the device asked for if that failed."""

    @property
    def held_out_psnr(self) -> float:
        """Mean PSNR of the held-out photos, dB; NaN without any."""
        return _mean([figure.psnr for figure in self.held_out])

    @property
    def held_out_ssim(self) -> float:
        """Mean SSIM of the held-out photos; NaN without any."""
        return _mean([figure.ssim for figure in self.held_out])

    @property
    def held_out_lpips(self) -> float:
        """Mean LPIPS of the held-out photos that have one; NaN without any."""
        return _mean([figure.lpips for figure in self.held_out if figure.lpips is not None])

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values for the report; of the Gaussians only their number."""
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
