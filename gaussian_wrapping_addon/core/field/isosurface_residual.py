# SPDX-License-Identifier: GPL-3.0-or-later
"""Residuals of vertices with respect to the isosurface, in vacancy."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import tolerances


def isosurface_residuals(vacancy: Any, points: np.ndarray) -> dict[str, Any]:
    """Measure ``|v - 0.5|`` at points that should lie on the isosurface; empty without points.

    The keys ``level_error_*`` are those of reports.

    Parameters
    ----------
    vacancy : VacancyField
        Or any object with ``vacancy(points)``.
    points : (n, 3) float64
        Scene frame.
    """
    if len(points) == 0:
        return {}
    away = np.abs(vacancy.vacancy(points).filled.astype(np.float64) - tolerances.ISO_LEVEL)
    return {
        "level_error_mean": float(away.mean()),
        "level_error_median": float(np.median(away)),
        "level_error_p95": float(np.quantile(away, 0.95)),
        "level_error_p99": float(np.quantile(away, 0.99)),
        "level_error_max": float(away.max()),
    }
