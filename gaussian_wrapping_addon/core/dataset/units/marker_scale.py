# SPDX-License-Identifier: GPL-3.0-or-later
"""Scale of a scene from markers of known size: detect, triangulate their corners, compare sides."""

from __future__ import annotations

import math
import shutil
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DatasetError, ParseError
from ...files import read_json, write_json
from ...processes.helper_process import run_helper
from ...progress import Progress
from ...settings.markers import MarkerSpec
from ..camera import Camera
from ..frames.similarity_fit import fit_similarity
from .marker_helper import RESULT, TASK
from .real_units import listed, rounded
from .triangulation import triangulate

CORNER_THRESHOLD_PX = 3.0
"""Corners further from their common point are of another marker, or the photo's pose is wrong."""
CORNER_NOISE_PX = 0.05
"""Error of a corner from fitted edges, on a print that is flat and sharp."""
MAX_SHAPE_ERROR = 0.05
"""Deviation of the triangulated corners from a square, over its side: beyond, the marker is bent,
or two of the same number were printed."""
MAX_SIZE_ERROR = 0.03
"""A marker whose size differs by more from the median of all is left out, unless its own error
explains it."""
_HELPER = "dataset.units.marker_helper"
_SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Corners in OpenCV's order, seen from the front, of side 1."""


@dataclass(frozen=True)
class SeenMarker:
    """A marker in one photo."""

    photo: int
    """Index of its camera."""
    corners_px: np.ndarray
    """(4, 2) float64."""


@dataclass(frozen=True)
class MarkerScale:
    """The scale that markers give."""

    metres_per_unit: float
    error: float
    """Relative standard deviation."""
    details: dict[str, Any]


def find_markers(
    spec: MarkerSpec, photos: Sequence[Path], work_folder: Path, progress: Progress, *, threads: int
) -> dict[int, list[SeenMarker]]:
    """Find markers in photos, by their numbers.

    A number that a photo shows twice is left out there.

    Raises
    ------
    DatasetError
        A photo cannot be read.
    WorkerError
        OpenCV is not installed, or it crashed.
    """
    folder = work_folder / "markers"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    task = {
        "dictionary": spec.dictionary,
        "threads": max(threads, 1),
        "photos": [str(path) for path in photos],
    }
    try:
        write_json(folder / TASK, task)
        run_helper(_HELPER, folder, progress)
        found = read_json(folder / RESULT)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    out: dict[int, list[SeenMarker]] = defaultdict(list)
    try:
        for index, markers in enumerate(found):
            counts = Counter(int(m["number"]) for m in markers)
            for marker in markers:
                if counts[int(marker["number"])] == 1:
                    corners = np.asarray(marker["corners_px"], np.float64).reshape(4, 2)
                    out[int(marker["number"])].append(SeenMarker(index, corners))
    except (KeyError, TypeError, ValueError) as error:
        raise ParseError(folder / RESULT, "markers", f"not as expected ({error}).") from None
    return dict(out)


def scale_from_markers(
    spec: MarkerSpec, cameras: Sequence[Camera], seen: dict[int, list[SeenMarker]]
) -> MarkerScale:
    """Compare the triangulated sides of markers with their known side.

    Parameters
    ----------
    cameras : sequence of Camera
        Pinhole cameras of the photos that the markers were found in.
    seen : dict
        As :func:`find_markers` returns.

    Raises
    ------
    DatasetError
        No marker was found, or none in two photos that show it well.
    """
    hint = (
        f"Check the dictionary ({spec.dictionary}), that markers are sharp and at least 30 pixels "
        "wide, have a white margin, and that two photos or more show each."
    )
    if not seen:
        raise DatasetError(f"No {spec.dictionary} marker was found in the photos.", hint)
    sizes, errors, numbers, bad = [], [], [], []
    observations = 0
    for number, views in sorted(seen.items()):
        size = _measured_side(cameras, views)
        if size is None:
            bad.append(number)
            continue
        sizes.append(size[0])
        errors.append(size[1])
        numbers.append(number)
        observations += size[2]
    if not sizes:
        raise DatasetError(
            f"{len(seen)} markers were found, but no two photos agree about one of them.", hint
        )
    side, error = np.array(sizes), np.array(errors)
    middle = float(np.median(side))
    apart = np.abs(side / middle - 1.0)
    good = apart <= np.maximum(MAX_SIZE_ERROR, 3.0 * error / middle)
    if not good.any():
        raise DatasetError(
            f"The markers differ in size by {100 * float(np.ptp(side)) / middle:.2g} %.",
            "Print all of them in the same size.",
        )
    other = [n for n, ok in zip(numbers, good, strict=True) if not ok]
    weights = 1.0 / error[good] ** 2
    # Least squares of known = scale * measured.
    scale = spec.side_m * float((weights * side[good]).sum() / (weights * side[good] ** 2).sum())
    formal = 1.0 / math.sqrt(float((weights * side[good] ** 2).sum()))
    ratios = scale * side[good] / spec.side_m
    count = int(good.sum())
    scatter = 0.0
    if count > 1:
        share = weights / weights.sum()
        scatter = math.sqrt(float((share * (ratios - 1.0) ** 2).sum()) / (count - 1))
    relative = max(formal, scatter)
    details = {
        "markers": {
            "dictionary": spec.dictionary,
            "side_m": spec.side_m,
            "found": len(seen),
            "used": count,
            "observations": observations,
            "not_measured": [str(n) for n in bad][:50],
            "left_out": listed([str(n) for n in other]),
            "scale_error": rounded(relative),
            "largest_deviation": rounded(float(np.abs(ratios - 1.0).max())),
        }
    }
    return MarkerScale(scale, relative, details)


def _measured_side(
    cameras: Sequence[Camera], views: Sequence[SeenMarker]
) -> tuple[float, float, int] | None:
    """Return side and its standard deviation, units of the cameras, and the number of photos.

    None unless two photos, and most of all, agree about all four corners, and these are a square.
    """
    corners, covariances, agreeing = [], [], len(views)
    chosen = [cameras[v.photo] for v in views]
    for k in range(4):
        pixels = np.array([v.corners_px[k] for v in views])
        point = triangulate(
            chosen, pixels, threshold_px=CORNER_THRESHOLD_PX, noise_px=CORNER_NOISE_PX
        )
        if point is None:
            return None
        corners.append(point.position)
        covariances.append(point.covariance)
        agreeing = min(agreeing, int(point.used.sum()))
    if 2 * agreeing <= len(views):
        return None  # as many photos show another marker of this number
    found = np.array(corners)
    fit = fit_similarity(_SQUARE, found, True)
    shape = float(np.linalg.norm(fit.points(_SQUARE) - found, axis=1).max())
    if not fit.scale > 0.0 or shape > MAX_SHAPE_ERROR * fit.scale:
        return None
    # The side is linear in the corners along the fitted square's arms; they sum to |arm|^2 = 2.
    arms = fit.directions(_SQUARE)
    variance = sum(float(a @ c @ a) for a, c in zip(arms, covariances, strict=True))
    total = float((_SQUARE**2).sum())
    return fit.scale, math.sqrt(variance) / total, agreeing
