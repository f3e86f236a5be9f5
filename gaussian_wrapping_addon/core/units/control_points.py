# SPDX-License-Identifier: GPL-3.0-or-later
"""Control points: known places and the pixels that show them."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, ParseError
from ..scene.camera import Camera
from ..scene.placement import umeyama
from .georeference import (
    GeoPoint,
    RobustFit,
    enu_from_geographic,
    geographic_from_utm,
    refined_similarity,
    robust_similarity,
    rounded,
    utm_epsg,
)

# -- Triangulate a point that several posed photos show, some of them perhaps wrongly -------------

MIN_ANGLE_DEG = 1.5
"""Between two rays: at one degree, a pixel of error moves the point by 50 pixels along them."""
MAX_PAIRS = 300
"""Pairs of photos that are tried; of more, evenly many are left out."""
_ROUNDS = 12


@dataclass(frozen=True)
class TriangulatedPoint:
    """A point and how well the photos agree about it."""

    position: np.ndarray
    """(3,) float64, frame of the cameras."""
    covariance: np.ndarray
    """(3, 3) float64, from the stated error of a pixel position or the residuals, the larger."""
    used: np.ndarray
    """(n,) bool, observations that agree."""
    residuals_px: np.ndarray
    """(n,) distances of all observations."""


def triangulate(
    cameras: Sequence[Camera], pixels: np.ndarray, *, threshold_px: float, noise_px: float
) -> TriangulatedPoint | None:
    """Find the point that most observations agree with, then minimise their squared distances.

    Parameters
    ----------
    cameras : sequence of n Camera
    pixels : (n, 2) float64
        Where each camera shows the point.
    threshold_px : float
        Observations further away are wrong.
    noise_px : float
        Smallest error of an observation to reckon with.

    Returns
    -------
    TriangulatedPoint or None
        None if no two photos agree whose rays meet under :data:`MIN_ANGLE_DEG`.
    """
    pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
    centers = np.array([c.center for c in cameras]).reshape(-1, 3)
    rays = np.array(
        [c.rays_at(p[None])[0] @ c.rotation for c, p in zip(cameras, pixels, strict=True)]
    ).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    best: tuple[int, float, np.ndarray, np.ndarray] | None = None
    pairs = list(itertools.combinations(range(len(cameras)), 2))
    for i, j in pairs[:: max(1, math.ceil(len(pairs) / MAX_PAIRS))]:
        if np.linalg.norm(np.cross(rays[i], rays[j])) < math.sin(math.radians(MIN_ANGLE_DEG)):
            continue
        point = _nearest(centers[[i, j]], rays[[i, j]])
        distances = _distances(cameras, pixels, point)
        used = distances <= threshold_px
        cost = float(np.minimum(distances, threshold_px).sum())
        if used.sum() >= 2 and (best is None or (-used.sum(), cost) < (-best[0], best[1])):
            best = int(used.sum()), cost, point, used
    if best is None:
        return None
    point, used = best[2], best[3]
    for _ in range(3):
        try:
            point, covariance = _least_squares(cameras, pixels, used, point, noise_px)
        except np.linalg.LinAlgError:  # the rays do not hold it along one direction
            return None
        distances = _distances(cameras, pixels, point)
        within = distances <= threshold_px
        if within.sum() < 2 or (within == used).all():
            break
        used = within
    if not np.isfinite(point).all() or not np.isfinite(covariance).all():
        return None
    return TriangulatedPoint(point, covariance, used, distances)


def _nearest(centers: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the point nearest to (k, 3) unit rays."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # (k, 3, 3)
    return np.linalg.solve(across.sum(0), np.einsum("kij,kj->i", across, centers))


def _distances(cameras: Sequence[Camera], pixels: np.ndarray, point: np.ndarray) -> np.ndarray:
    out = np.full(len(cameras), np.inf)
    for i, camera in enumerate(cameras):
        shown, depth = camera.project(point[None])
        if depth[0] > 0.0:
            out[i] = np.linalg.norm(shown[0] - pixels[i])
    return out


def _least_squares(
    cameras: Sequence[Camera],
    pixels: np.ndarray,
    used: np.ndarray,
    point: np.ndarray,
    noise_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the point of least squared pixel distances, and its covariance."""
    chosen = np.flatnonzero(used)
    rotations = np.array([cameras[i].rotation for i in chosen])  # (k, 3, 3)
    translations = np.array([cameras[i].cam_from_world[:, 3] for i in chosen])
    focal = np.array([(cameras[i].fx, cameras[i].fy) for i in chosen])
    middle = np.array([(cameras[i].cx, cameras[i].cy) for i in chosen])
    normal, squared = np.eye(3), 0.0
    for _ in range(_ROUNDS):
        local = np.einsum("kij,j->ki", rotations, point) + translations
        depth = local[:, 2:]
        slopes = local[:, :2] / depth
        errors = focal * slopes + middle - pixels[chosen]  # (k, 2)
        # d(f x / z) = f / z (dx - x / z dz)
        turned = rotations[:, :2] - slopes[:, :, None] * rotations[:, 2:]  # (k, 2, 3)
        jacobian = (focal / depth)[:, :, None] * turned
        normal = np.einsum("kij,kil->jl", jacobian, jacobian)
        step = np.linalg.solve(normal, np.einsum("kij,ki->j", jacobian, errors))
        point = point - step
        squared = float((errors**2).sum())
        if np.linalg.norm(step) <= 1e-12 * (1.0 + np.linalg.norm(point)):
            break
    variance = max(squared / max(2 * len(chosen) - 3, 1), noise_px**2)
    return point, variance * np.linalg.inv(normal)


# -- Read control points: known places, and where photos show them (docs/file-formats.md) ---------
#
# The first line names the coordinates, each further one is a place seen in a photo.

LOCAL = "local"
"""Name of coordinates in metres in a frame of their own."""
MAX_FILE_BYTES = 16 << 20
MAX_OBSERVATIONS = 100_000
MAX_COORDINATE = 1e9
"""Metres, or degrees: no place on earth has larger coordinates in any system."""
SAME_PLACE = 1e-9
"""Share of the coordinates by which lines of one point may differ."""
_HINT = (
    "Begin with EPSG:4326 (longitude latitude height), a UTM zone such as EPSG:32633, or LOCAL "
    "(metres, z up); then give lines of: x y z pixel_x pixel_y photo [name]."
)


@dataclass(frozen=True)
class CoordinateSystem:
    """What the coordinates of a file are."""

    name: str
    """As results say it: ``"local"`` or ``"EPSG:..."``."""
    utm_zone: int = 0
    """0: not UTM."""
    north: bool = True

    def to_metric(self, places: np.ndarray) -> tuple[np.ndarray, GeoPoint | None]:
        """Return (n, 3) metric coordinates and the place of their origin, None if local.

        Geographic and UTM coordinates become metres east, north and up of the median place.
        """
        if self.name == LOCAL:
            return places, None
        if self.utm_zone:
            geographic = geographic_from_utm(places, self.utm_zone, self.north)
        else:
            geographic = places[:, [1, 0, 2]]
        latitude, longitude, height = (float(v) for v in np.median(geographic, axis=0))
        origin = GeoPoint(latitude, longitude, height)
        return enu_from_geographic(geographic, origin), origin


@dataclass(frozen=True)
class ControlPoint:
    """A known place and where photos show it."""

    name: str
    position: np.ndarray
    """(3,) float64, in the file's coordinates."""
    photos: tuple[str, ...]
    pixels: np.ndarray
    """(n, 2) float64 in the upright photo, from the upper left corner of its first pixel."""
    lines: tuple[int, ...]
    """Of the file, from 1."""


@dataclass(frozen=True)
class ControlFile:
    """Content of a file of control points."""

    system: CoordinateSystem
    points: tuple[ControlPoint, ...]


def read_control_file(path: Path) -> ControlFile:
    """Read a file of control points.

    Raises DatasetError: the file does not exist or is too large; ParseError, which names the line
    that is wrong.
    """
    try:
        with path.open("rb") as stream:
            raw = stream.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        text = f"Control points {path} cannot be read: {error.strerror or error}."
        hint = "Put the file back and resume the job, or start anew without control points."
        raise DatasetError(text, hint) from None
    if len(raw) > MAX_FILE_BYTES:
        raise DatasetError(f"{path} is larger than {MAX_FILE_BYTES >> 20} MiB.", _HINT)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ParseError(path, "whole file", "not UTF-8 text.", _HINT) from None
    return parse_control_file(text, path)


def parse_control_file(text: str, path: Path) -> ControlFile:
    """Parse the text of a file of control points; ``path`` is for messages.

    Raises ParseError, which names the line that is wrong.
    """
    system: CoordinateSystem | None = None
    seen: dict[str, list[tuple[np.ndarray, str, tuple[float, float], int]]] = {}
    observations = 0
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if system is None:
            system = _system(line.strip(), path, number)
            continue
        place, pixel, photo, name = _observation(line, path, number)
        observations += 1
        if observations > MAX_OBSERVATIONS:
            raise ParseError(path, f"line {number}", f"more than {MAX_OBSERVATIONS} observations.")
        seen.setdefault(name, []).append((place, photo, pixel, number))
    if system is None:
        raise ParseError(path, "whole file", "empty.", _HINT)
    return ControlFile(system, tuple(_point(name, entries, path) for name, entries in seen.items()))


def _system(text: str, path: Path, line: int) -> CoordinateSystem:
    words = text.lower()
    if words == LOCAL:
        return CoordinateSystem(LOCAL)
    epsg = re.fullmatch(r"epsg:\s*(\d{1,6})", words)
    if epsg:
        code = int(epsg[1])
        if code in (4326, 4979):
            return CoordinateSystem(f"EPSG:{code}")
        if 1 <= code % 100 <= 60 and code // 100 in (326, 327):
            return _utm(code % 100, code // 100 == 326)
        raise ParseError(path, f"line {line}", f"EPSG:{code} is not known here.", _HINT)
    if words.startswith("+proj="):
        if re.match(r"\+proj=(longlat|latlong|lonlat)\b", words):
            return CoordinateSystem("EPSG:4326")
        zone = re.search(r"\+zone=(\d{1,2})\b", words)
        if re.match(r"\+proj=utm\b", words) and zone and 1 <= int(zone[1]) <= 60:
            return _utm(int(zone[1]), "+south" not in words)
    utm = re.fullmatch(r"wgs\s?84\s+utm\s+(\d{1,2})\s*([ns])", words)
    if utm and 1 <= int(utm[1]) <= 60:
        return _utm(int(utm[1]), utm[2] == "n")
    raise ParseError(path, f"line {line}", f"{text[:60]!r} is no known system.", _HINT)


def _utm(zone: int, north: bool) -> CoordinateSystem:
    return CoordinateSystem(f"EPSG:{utm_epsg(zone, north)}", zone, north)


def _observation(
    text: str, path: Path, line: int
) -> tuple[np.ndarray, tuple[float, float], str, str]:
    """Return place, pixel, photo and name of a line."""
    # With tabs, names may hold spaces.
    words = [w.strip() for w in text.split("\t")] if "\t" in text.strip() else text.split()
    words = [w for w in words if w]
    if len(words) < 6:
        raise ParseError(path, f"line {line}", f"{len(words)} entries, 6 are needed.", _HINT)
    numbers = []
    for word in words[:5]:
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not abs(value) <= MAX_COORDINATE:
            raise ParseError(path, f"line {line}", f"{word[:40]!r} is not a coordinate.", _HINT)
        numbers.append(value)
    place = np.array(numbers[:3])
    name = words[6] if len(words) > 6 else " ".join(words[:3])
    return place, (numbers[3], numbers[4]), words[5].replace("\\", "/"), name


def _point(
    name: str, entries: list[tuple[np.ndarray, str, tuple[float, float], int]], path: Path
) -> ControlPoint:
    first = entries[0][0]
    photos: dict[str, int] = {}
    for place, photo, _, line in entries:
        if np.abs(place - first).max() > SAME_PLACE * max(1.0, float(np.abs(first).max())):
            text = f"{name} has other coordinates than in line {entries[0][3]}."
            raise ParseError(path, f"line {line}", text)
        if photo in photos:
            text = f"{name} is in {photo} already, in line {photos[photo]}."
            raise ParseError(path, f"line {line}", text)
        photos[photo] = line
    pixels = np.array([pixel for _, _, pixel, _ in entries])
    return ControlPoint(name, first, tuple(photos), pixels, tuple(photos.values()))


# -- Similarity from the cameras' frame to control points: triangulate, fit, name what is wrong

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

    origin: GeoPoint | None
    """None: the points' coordinates are local."""
    fit: RobustFit
    """Whose target is the metric frame."""
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


def fit_control_points(
    content: ControlFile, cameras: Sequence[Camera], seen: Sequence[Observations]
) -> ControlFit:
    """Triangulate the points and fit a similarity.

    Raises DatasetError: fewer than three points are seen well, they lie on one line, or they
    disagree.
    """
    names, known, found, errors_px, skipped = [], [], [], [], []
    for point in seen:
        place = triangulate(
            [cameras[i] for i in point.cameras], point.pixels, threshold_px=PIXEL_THRESHOLD_PX,
            noise_px=PIXEL_NOISE_PX,
        )  # fmt: skip
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
    told = zip(names, fit.residuals.tolist(), errors_px, fit.used.tolist(), strict=True)
    points = [
        {"name": n, "residual_m": rounded(apart), "error_px": rounded(error_px), "used": used}
        for n, apart, error_px, used in told
    ]
    details = {
        "control_points": {
            "system": content.system.name, "used": int(fit.used.sum()),
            "left_out": [n for n, good in zip(names, fit.used, strict=True) if not good],
            "not_seen": skipped, "median_m": rounded(float(np.median(fit.residuals))),
            "max_m": rounded(float(fit.residuals.max())),
            "tilt_error_deg": rounded(fit.tilt_error_deg), "points": points,
        }
    }  # fmt: skip
    return ControlFit(origin, fit, details)
