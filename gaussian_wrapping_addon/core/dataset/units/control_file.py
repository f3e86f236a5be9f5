# SPDX-License-Identifier: GPL-3.0-or-later
"""Read control points: known places, and where photos show them (docs/file-formats.md).

The first line names the coordinates, each further one is a place seen in a photo.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import DatasetError, ParseError
from .geodesy import GeoPoint, enu_from_geographic, geographic_from_utm

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

    @property
    def is_local(self) -> bool:
        """Whether coordinates are metres in a frame of their own, z up."""
        return self.name == LOCAL

    def to_metric(self, places: np.ndarray) -> tuple[np.ndarray, GeoPoint | None]:
        """Return (n, 3) metric coordinates and the place of their origin, None if local.

        Geographic and UTM coordinates become metres east, north and up of the median place.
        """
        if self.is_local:
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

    Raises
    ------
    DatasetError
        The file does not exist or is too large.
    ParseError
        Names the line that is wrong.
    """
    try:
        with path.open("rb") as stream:
            raw = stream.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise DatasetError(
            f"Control points {path} cannot be read: {error.strerror or error}.",
            "Put the file back and resume the job, or start anew without control points.",
        ) from None
    if len(raw) > MAX_FILE_BYTES:
        raise DatasetError(f"{path} is larger than {MAX_FILE_BYTES >> 20} MiB.", _HINT)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ParseError(path, "whole file", "not UTF-8 text.", _HINT) from None
    return parse_control_file(text, path)


def parse_control_file(text: str, path: Path) -> ControlFile:
    """Parse the text of a file of control points; ``path`` is for messages.

    Raises
    ------
    ParseError
        Names the line that is wrong.
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
            return CoordinateSystem(f"EPSG:{code}", code % 100, code // 100 == 326)
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
    return CoordinateSystem(f"EPSG:{(32600 if north else 32700) + zone}", zone, north)


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
            raise ParseError(
                path, f"line {line}", f"{name} has other coordinates than in line {entries[0][3]}."
            )
        if photo in photos:
            raise ParseError(
                path, f"line {line}", f"{name} is in {photo} already, in line {photos[photo]}."
            )
        photos[photo] = line
    return ControlPoint(
        name,
        first,
        tuple(photos),
        np.array([pixel for _, _, pixel, _ in entries]),
        tuple(photos.values()),
    )
