# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarity from the cameras' frame to control points: triangulate, fit, name what is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import DatasetError
from ..camera import Camera
from ..frames.similarity_fit import umeyama
from ..similarity import Similarity
from .control_file import ControlFile
from .geodesy import GeoPoint
from .real_units import rounded
from .robust_fit import RobustFit, refined_similarity, robust_similarity
from .triangulation import triangulate

PIXEL_THRESHOLD_PX = 10.0
"""Clicks further from the point that most photos agree about are wrong; people hit a mark within a
few pixels of a large photo."""
PIXEL_NOISE_PX = 0.5
MIN_POINTS = 3
MIN_ROBUST_POINTS = 4
"""With fewer, a wrong one cannot be told from the others."""
LARGEST_ERROR_SHARE = 0.1
"""Of the points' extent: a point that is further off is wrong in any case."""
NOISE_SHARE = 2e-4
"""Of the points' extent: least error to reckon with, of clicks and cameras."""
MAX_TILT_DEG = 5.0
"""Points nearer to one line leave the up direction open."""


@dataclass(frozen=True)
class ControlFit:
    """Cameras fitted to control points."""

    metric_from_world: Similarity
    origin: GeoPoint | None
    """None: the points' coordinates are local."""
    fit: RobustFit
    details: dict[str, Any]


@dataclass(frozen=True)
class Observations:
    """A control point in the photos that were placed."""

    name: str
    position: np.ndarray
    """(3,) in the file's coordinates."""
    cameras: tuple[int, ...]
    pixels: np.ndarray
    """(n, 2) in the pinhole images of these cameras."""


def observations(
    content: ControlFile, pixels: Mapping[tuple[str, int], tuple[int, np.ndarray]]
) -> list[Observations]:
    """Gather the observations of each point.

    Parameters
    ----------
    pixels : mapping
        Camera and pinhole pixel of each observation whose photo was placed, by the point's name
        and the index of the observation.
    """
    out = []
    for point in content.points:
        keys = [(point.name, i) for i in range(len(point.photos))]
        found = [pixels[key] for key in keys if key in pixels]
        places = np.array([pixel for _, pixel in found]).reshape(-1, 2)
        out.append(Observations(point.name, point.position, tuple(c for c, _ in found), places))
    return out


def fit_control_points(
    content: ControlFile, cameras: Sequence[Camera], seen: Sequence[Observations]
) -> ControlFit:
    """Triangulate the points and fit a similarity.

    Raises
    ------
    DatasetError
        Fewer than three points are seen well, they lie on one line, or they disagree.
    """
    names, known, found, errors_px, skipped = [], [], [], [], []
    for point in seen:
        place = triangulate(
            [cameras[i] for i in point.cameras],
            point.pixels,
            threshold_px=PIXEL_THRESHOLD_PX,
            noise_px=PIXEL_NOISE_PX,
        )
        if place is None:
            skipped.append(point.name)
            continue
        names.append(point.name)
        known.append(point.position)
        found.append(place.position)
        errors_px.append(float(np.sqrt((place.residuals_px[place.used] ** 2).mean())))
    if len(names) < MIN_POINTS:
        listed = f" Not usable: {', '.join(skipped[:5])}." if skipped else ""
        raise DatasetError(
            f"{len(names)} control points are seen in two placed photos or more; {MIN_POINTS} are "
            f"needed.{listed}",
            "Mark each point in two photos from different places.",
        )
    target, origin = content.system.to_metric(np.array(known))
    source = np.array(found)
    extent = float(np.linalg.norm(np.ptp(target, axis=0)))
    noise = NOISE_SHARE * extent
    if len(names) < MIN_ROBUST_POINTS:
        umeyama(source, target, with_scale=True)  # refuses points on one line
        fit = refined_similarity(source, target, np.ones(len(names), bool), noise=noise)
    else:
        fit = robust_similarity(
            source, target, largest_error=LARGEST_ERROR_SHARE * extent, noise=noise
        )
    if fit.tilt_error_deg > MAX_TILT_DEG:
        raise DatasetError(
            f"The control points lie almost on one line: the up direction would be uncertain by "
            f"{fit.tilt_error_deg:.2g} degrees.",
            "Add a point well to the side.",
        )
    points = [
        {
            "name": name,
            "residual_m": rounded(float(fit.residuals[i])),
            "error_px": rounded(errors_px[i]),
            "used": bool(fit.used[i]),
        }
        for i, name in enumerate(names)
    ]
    details = {
        "control_points": {
            "system": content.system.name,
            "used": int(fit.used.sum()),
            "left_out": [n for n, good in zip(names, fit.used, strict=True) if not good],
            "not_seen": skipped,
            "median_m": rounded(fit.median),
            "max_m": rounded(float(fit.residuals.max())),
            "tilt_error_deg": rounded(fit.tilt_error_deg),
            "points": points,
        }
    }
    return ControlFit(fit.target_from_source, origin, fit, details)
