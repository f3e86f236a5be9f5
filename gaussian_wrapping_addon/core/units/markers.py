# SPDX-License-Identifier: GPL-3.0-or-later
"""Printed markers of known size, found in a helper process."""

from __future__ import annotations

import math
import shutil
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, ParseError
from ..files import read_json, write_json
from ..photos.photo_file import read_photo
from ..progress import Progress
from ..scene.camera import Camera
from ..scene.placement import fit_similarity
from ..settings.job import MarkerSpec
from ..worker.environment import load_extra
from ..worker.helper_process import emit, run_helper
from .control_points import triangulate
from .georeference import listed, rounded

# -- Corners of a printed marker to hundredths of a pixel: intersections of lines fitted to its
#    edges
#
# A corner is rounded by the lens and the pixels, which moves it inwards; edges are not
# (docs/method.md, section 13.3).

MIN_MODULE_PX = 2.5
"""Size of a bit of the marker below which the profile across an edge would reach the bits."""
_END_SHARE = 0.12
"""Share of an edge at either end that its line is not fitted to: corners are rounded there."""
_MAX_HALF_WIDTH_PX = 5.0
_MODULE_SHARE = 0.7
"""Of the black border, which is one module wide, that a profile reaches into."""
_STEP_PX = 0.25
_MIN_CONTRAST = 20.0
"""Levels of 255 between the two sides of an edge."""
_MIN_GOOD_SHARE = 0.5
"""Of the profiles of an edge that have to show it."""
_ROUNDS = 3
_MAX_MOVE_PX = 2.5
"""A corner that moves further was not the marker's."""


def refined_corners(grey: np.ndarray, corners: np.ndarray, modules: int) -> np.ndarray | None:
    """Return the marker's corners as intersections of its edges.

    Parameters
    ----------
    grey : (h, w) uint8
    corners : (4, 2) float64
        Corners to a pixel or so, around the marker; the first pixel's centre is (0.5, 0.5).
    modules : int
        Bits of the marker along a side, the black border included.

    Returns
    -------
    (4, 2) float64 or None
        None if the marker is too small in the photo, or an edge is not clear.
    """
    corners = np.asarray(corners, np.float64)
    module = float(np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1).min()) / modules
    if module < MIN_MODULE_PX:
        return None
    half = min(_MODULE_SHARE * module, _MAX_HALF_WIDTH_PX)
    found = corners
    for _ in range(_ROUNDS):
        lines = [_edge_line(grey, found, k, half) for k in range(4)]
        crossings = [_crossing(lines[k - 1], lines[k]) for k in range(4)]
        if any(c is None for c in crossings):
            return None
        found = np.array(crossings, np.float64)
        if np.linalg.norm(found - corners, axis=1).max() > _MAX_MOVE_PX:
            return None
    return found


def _edge_line(
    grey: np.ndarray, corners: np.ndarray, k: int, half: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return point and unit normal of the line along the edge from corner k to the next."""
    start, end = corners[k], corners[(k + 1) % 4]
    along = end - start
    length = float(np.linalg.norm(along))
    if length < 4.0:
        return None
    along = along / length
    normal = np.array([along[1], -along[0]])
    if (corners.mean(0) - start) @ normal > 0.0:
        normal = -normal  # outwards: from black to white
    count = int(np.clip(length, 8, 96))
    shares = np.linspace(_END_SHARE, 1.0 - _END_SHARE, count)
    base = start + shares[:, None] * (length * along)  # (n, 2)
    steps = np.arange(-half, half + 0.5 * _STEP_PX, _STEP_PX)
    places = base[:, None] + steps[None, :, None] * normal  # (n, s, 2)
    levels = _sampled(grey, places)
    if levels is None:
        return None
    rise = np.maximum(np.diff(levels, axis=1), 0.0)
    between = 0.5 * (steps[1:] + steps[:-1])
    total = rise.sum(1)
    good = (levels[:, -1] - levels[:, 0]) >= _MIN_CONTRAST
    if good.mean() < _MIN_GOOD_SHARE:
        return None
    # Slopes of noise count as well: only those near the steepest place belong to the edge.
    offset = (rise * between).sum(1) / np.maximum(total, 1e-9)
    return _line((base + offset[:, None] * normal)[good])


def _sampled(grey: np.ndarray, places: np.ndarray) -> np.ndarray | None:
    """Return bilinear samples at (..., 2) places, None if one lies outside."""
    x, y = places[..., 0] - 0.5, places[..., 1] - 0.5
    height, width = grey.shape
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    if left.min() < 0 or top.min() < 0 or left.max() >= width - 1 or top.max() >= height - 1:
        return None
    fx, fy = x - left, y - top
    a, b = grey[top, left].astype(np.float64), grey[top, left + 1]
    c, d = grey[top + 1, left], grey[top + 1, left + 1]
    return (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)


def _line(points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return point and normal of the line of least squares, without points far off it."""
    used = np.ones(len(points), bool)
    for _ in range(3):
        if used.sum() < 4:
            return None
        middle = points[used].mean(0)
        _, _, axes = np.linalg.svd(points[used] - middle, full_matrices=False)
        away = np.abs((points - middle) @ axes[1])
        used = away <= max(3.0 * 1.4826 * float(np.median(away)), 0.02)
    return middle, axes[1]


def _crossing(
    first: tuple[np.ndarray, np.ndarray] | None, second: tuple[np.ndarray, np.ndarray] | None
) -> np.ndarray | None:
    if first is None or second is None:
        return None
    normals = np.stack([first[1], second[1]])
    if abs(np.linalg.det(normals)) < 0.1:  # edges of a marker seen flat from the side
        return None
    return np.linalg.solve(normals, [first[1] @ first[0], second[1] @ second[0]])


# -- Helper process: find printed markers in photos with OpenCV -----------------------------------
#
# In: ``task.json`` with the dictionary and paths of photos. Out: ``markers.json``, for each photo
# the numbers and corners of its markers. Photos are decoded by our own reader.

TASK, RESULT = "task.json", "markers.json"
MARKERS_EXTRA = "markers"
BORDER_BITS = 1
"""Width of the black border of a printed marker, in bits."""
MAX_MARKERS_A_PHOTO = 1000


def main(folder: Path) -> None:
    """Detect the markers of every photo of the task."""
    cv2 = load_extra(MARKERS_EXTRA, "--markers")
    task = read_json(folder / TASK)
    cv2.setNumThreads(int(task["threads"]))
    dictionary = cv2.aruco.getPredefinedDictionary(_number(cv2, str(task["dictionary"])))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    modules = int(dictionary.markerSize) + 2 * BORDER_BITS
    found: list[list[dict[str, Any]]] = []
    photos = task["photos"]
    for i, path in enumerate(photos):
        red, green, blue = np.moveaxis(read_photo(Path(path)).color.astype(np.uint16), 2, 0)
        grey = np.ascontiguousarray(((77 * red + 150 * green + 29 * blue) >> 8).astype(np.uint8))
        corners, numbers, _ = detector.detectMarkers(grey)
        found.append(_markers(grey, corners, numbers, modules))
        emit(fraction=(i + 1) / len(photos), message=f"markers of photo {i + 1} of {len(photos)}")
    write_json(folder / RESULT, found)


def _number(cv2: Any, name: str) -> int:
    """Return OpenCV's number of a dictionary, whatever case its name is in."""
    wanted = f"dict_{name}"
    return next(getattr(cv2.aruco, n) for n in dir(cv2.aruco) if n.lower() == wanted)


def _markers(grey: np.ndarray, corners: Any, numbers: Any, modules: int) -> list[dict[str, Any]]:
    out = []
    for number, quad in zip(np.ravel(numbers if numbers is not None else []), corners, strict=True):
        # OpenCV's first pixel has its centre at (0, 0).
        rough = np.asarray(quad, np.float64).reshape(4, 2) + 0.5
        exact = refined_corners(grey, rough, modules)
        corners_px = (rough if exact is None else exact).tolist()
        out.append({"number": int(number), "corners_px": corners_px, "refined": exact is not None})
    return out[:MAX_MARKERS_A_PHOTO]


# -- Scale of a scene from markers of known size: detect, triangulate their corners, compare sides

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
_HELPER = "units.markers"
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

    Raises DatasetError: a photo cannot be read; WorkerError: OpenCV is not installed, or it
    crashed.
    """
    folder = work_folder / "markers"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    task = {
        "dictionary": spec.dictionary, "threads": max(threads, 1),
        "photos": [str(path) for path in photos],
    }  # fmt: skip
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
    sizes = {n: _measured_side(cameras, views) for n, views in sorted(seen.items())}
    bad = [n for n, size in sizes.items() if size is None]
    known = {n: size for n, size in sizes.items() if size is not None}
    if not known:
        text = f"{len(seen)} markers were found, but no two photos agree about one of them."
        raise DatasetError(text, hint)
    observations = sum(size[2] for size in known.values())
    side, error = (np.array([size[k] for size in known.values()]) for k in (0, 1))
    middle = float(np.median(side))
    apart = np.abs(side / middle - 1.0)
    good = apart <= np.maximum(MAX_SIZE_ERROR, 3.0 * error / middle)
    if not good.any():
        text = f"The markers differ in size by {100 * float(np.ptp(side)) / middle:.2g} %."
        raise DatasetError(text, "Print all of them in the same size.")
    other = [n for n, ok in zip(known, good, strict=True) if not ok]
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
            "dictionary": spec.dictionary, "side_m": spec.side_m, "found": len(seen),
            "used": count, "observations": observations,
            "not_measured": [str(n) for n in bad][:50],
            "left_out": listed([str(n) for n in other]),
            "scale_error": rounded(relative),
            "largest_deviation": rounded(float(np.abs(ratios - 1.0).max())),
        }
    }  # fmt: skip
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
    return fit.scale, math.sqrt(variance) / float((_SQUARE**2).sum()), agreeing
