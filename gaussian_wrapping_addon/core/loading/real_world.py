# SPDX-License-Identifier: GPL-3.0-or-later
"""Find the metres of prepared views: control points, GPS of photos, printed markers."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, ParseError
from ..photos.exif import read_gps_exif
from ..photos.finder import PhotoIndex
from ..photos.photo_file import stored_pixels
from ..progress import Progress, ReportWarning
from ..readers.lenses import pinhole_pixels
from ..scene.camera import Camera, Similarity
from ..settings.job import marker_spec
from ..units.control_points import (
    ControlFile,
    ControlFit,
    Observations,
    fit_control_points,
    read_control_file,
)
from ..units.georeference import (
    CONTROL_POINTS,
    ENOUGH,
    GOOD,
    GPS,
    MARKERS,
    Georeference,
    RealUnits,
    check_positions,
    georeference,
)
from ..units.markers import MARKERS_EXTRA, MarkerScale, find_markers, scale_from_markers
from ..worker.environment import load_extra
from .source_kind import SourceKind
from .views import PreparedView

_logger = logging.getLogger(__name__)

MIN_CONTRADICTION = 0.01
"""Scales that differ by less than a percent do not contradict each other for any use."""
CONTRADICTION_SIGMAS = 3.0


@dataclass(frozen=True)
class UnitsRequest:
    """What is known about the size and place of a scene."""

    georeference: str = "auto"
    """``"auto"``: by GPS where the input has no cameras of its own and GPS is good; ``"on"``: by
    GPS, or the input is refused; ``"off"``."""
    markers: str = ""
    """As the setting: dictionary and side of printed markers."""
    control_points: str = ""
    """Path of a file."""

    def checked(self) -> ControlFile | None:
        """Return the control points, read; raises before any work where something is missing.

        Raises UsageError, DatasetError, ParseError: the markers are none, the file of control
        points is wrong; WorkerError: markers are asked for, and OpenCV is not installed.
        """
        if marker_spec(self.markers) is not None:
            load_extra(MARKERS_EXTRA, "--markers")
        return read_control_file(Path(self.control_points)) if self.control_points else None

    def check_gps(self, photos: Sequence[Path]) -> None:
        """Raise where GPS alone is to place the scene, and too few photos have a position.

        Before cameras are solved, which takes minutes. Whether the positions determine the scene
        is known afterwards.

        Raises DatasetError.
        """
        if self.georeference != "on" or self.control_points:
            return
        found = [read_gps_exif(path) for path in photos]
        try:
            check_positions([position for position in found if position is not None], len(photos))
        except DatasetError as error:
            raise _not_placed(error) from None


BY_GPS_IF_GOOD = UnitsRequest()


def find_real_units(
    request: UnitsRequest,
    content: ControlFile | None,
    views: Sequence[PreparedView],
    kind: SourceKind,
    work_folder: Path,
    progress: Progress,
    warnings: list[ReportWarning],
    *,
    threads: int = 0,
) -> tuple[RealUnits | None, str]:
    """Return the metric frame of the views' world, and why GPS is not used though there is some.

    ``content`` is what :meth:`UnitsRequest.checked` has read. Control points decide before GPS,
    markers decide the scale unless there are control points. What contradicts is added to
    ``warnings``.

    Raises DatasetError, ParseError: what was asked for cannot be had: no usable marker, a wrong
    file, or GPS that does not determine the frame with ``georeference`` ``"on"``.
    """
    spec = marker_spec(request.markers)
    if content is None and spec is None and request.georeference == "off":
        return None, ""
    cameras = [camera_of(view) for view in views]
    control, gps, markers, note = None, None, None, ""
    if content is not None:
        control = _control(content, request.control_points, views, cameras, kind, warnings)
    positions = {}
    if request.georeference != "off":
        found = ((view.name, read_gps_exif(view.source_path)) for view in views)
        positions = {name: position for name, position in found if position is not None}
    if positions or request.georeference == "on":
        try:
            needs = ENOUGH if request.georeference == "on" else GOOD
            gps = georeference(cameras, positions, needs)
        except DatasetError as error:
            if request.georeference == "on" and control is None:
                raise _not_placed(error) from None
            note = error.message
    if gps is not None and gps.doubt:
        text = f"GPS places the scene badly: {gps.doubt}"
        hint = "Check scale and up; give a measured length, markers or control points."
        warnings.append(ReportWarning("georeference-uncertain", text, hint))
    if spec is not None:
        photos = [view.photo_path for view in views]
        seen = find_markers(spec, photos, work_folder, progress, threads=threads)
        markers = scale_from_markers(spec, cameras, seen)
    own_frame = kind.kind == "photos" or request.georeference == "on"
    units = _combined(control, gps, markers, own_frame, warnings)
    if units is not None:
        _logger.info("metres from %s: %s", ", ".join(units.sources), units.details)
    return units, note


def _not_placed(error: DatasetError) -> DatasetError:
    return DatasetError(
        f"GPS does not place the scene: {error.message}",
        f"{error.hint} Or leave --set georeference out.".strip(),
    )


def camera_of(view: PreparedView) -> Camera:
    """Return the pinhole camera of a view, world frame."""
    size, (fx, fy, cx, cy) = (view.pinhole.width, view.pinhole.height), view.pinhole.params
    return Camera(view.name, *size, fx, fy, cx, cy, view.cam_from_world)


def moved_views(views: Sequence[PreparedView], target_from_world: Similarity) -> list[PreparedView]:
    """Return the views in another world frame."""
    return [
        dataclasses.replace(v, cam_from_world=camera_of(v).moved(target_from_world).cam_from_world)
        for v in views
    ]


def _combined(
    control: ControlFit | None,
    gps: Georeference | None,
    markers: MarkerScale | None,
    own_frame: bool,
    warnings: list[ReportWarning],
) -> RealUnits | None:
    """Return one metric frame of what was measured.

    ``own_frame`` tells whether GPS may replace the input's axes.
    """
    details: dict[str, Any] = {}
    for part in (control, gps, markers):
        details |= {} if part is None else part.details
    scales = {
        CONTROL_POINTS: control and (control.fit.target_from_source.scale, control.fit.scale_error),
        GPS: gps and (gps.enu_from_world.scale, gps.scale_error),
        MARKERS: markers and (markers.metres_per_unit, markers.error),
    }
    known = {name: found for name, found in scales.items() if found}
    _warn_of_contradictions(known, warnings)
    sources = tuple(known)
    if control is not None:
        placed, error = control.fit.target_from_source, control.fit.scale_error
        return RealUnits(sources, placed, True, True, error, control.origin, details)
    if gps is not None and (own_frame or markers is None):
        error = gps.scale_error
        if markers is not None:
            gps, error = gps.with_scale(markers.metres_per_unit), markers.error
            details |= gps.details
        return RealUnits(sources, gps.enu_from_world, own_frame, True, error, gps.origin, details)
    if markers is not None:
        sources = (MARKERS, *(name for name in known if name != MARKERS))
        placed = Similarity(markers.metres_per_unit)
        return RealUnits(sources, placed, True, False, markers.error, details=details)
    return None


def _warn_of_contradictions(
    known: dict[str, tuple[float, float]], warnings: list[ReportWarning]
) -> None:
    for (first, (a, error_a)), (second, (b, error_b)) in itertools.combinations(known.items(), 2):
        apart = abs(math.log(a / b))
        if apart > max(CONTRADICTION_SIGMAS * math.hypot(error_a, error_b), MIN_CONTRADICTION):
            text = (
                f"The scale by {second} is {100 * (b / a - 1):+.2g} % off that by {first}, "
                "more than their errors explain."
            )
            hint = "Check the size of the markers, the coordinates, and their unit (metres)."
            warnings.append(ReportWarning("scales-contradict", text, hint))


def _control(
    content: ControlFile,
    file: str,
    views: Sequence[PreparedView],
    cameras: Sequence[Camera],
    kind: SourceKind,
    warnings: list[ReportWarning],
) -> ControlFit:
    index = PhotoIndex(kind.photo_roots)
    of_path = {view.source_path: i for i, view in enumerate(views)}
    seen: list[Observations] = []
    for point in content.points:
        numbers: list[int] = []
        places: list[np.ndarray] = []
        for photo, pixel, line in zip(point.photos, point.pixels, point.lines, strict=True):
            match = index.find(photo)
            if match is None:
                raise ParseError(
                    file, f"line {line}", f"there is no photo {photo[:80]}.",
                    "Give the photo's name as in the folder of the photos.",
                )  # fmt: skip
            if match.path not in of_path:
                continue  # not placed
            number = of_path[match.path]
            place = _in_pinhole(views[number], pixel)
            if place is None:
                raise ParseError(
                    file, f"line {line}", f"the pixel lies outside of {photo[:80]}.",
                    "Give pixels of the upright photo, from its upper left corner.",
                )  # fmt: skip
            numbers.append(number)
            places.append(place)
        pixels = np.array(places).reshape(-1, 2)
        seen.append(Observations(point.name, point.position, tuple(numbers), pixels))
    fit = fit_control_points(content, cameras, seen)
    found = fit.details["control_points"]
    if found["left_out"]:
        text = f"{len(found['left_out'])} control points disagree with the others: " + ", ".join(
            f"{p['name']} by {p['residual_m']:g} m" for p in found["points"] if not p["used"]
        )
        hint = "Check their coordinates and where they were marked in the photos."
        warnings.append(ReportWarning("control-points-wrong", text + ".", hint))
    if found["not_seen"]:
        text = (
            f"{len(found['not_seen'])} control points are not used, since no two placed photos "
            f"agree about them: {', '.join(found['not_seen'][:5])}."
        )
        hint = "Mark each in two photos from different places."
        warnings.append(ReportWarning("control-points-not-seen", text, hint))
    return fit


def _in_pinhole(view: PreparedView, pixel: np.ndarray) -> np.ndarray | None:
    """Return where a view shows a pixel of its upright photo, None if that has no such pixel."""
    lens, orientation = view.lens, view.stored_orientation
    width, height = lens.width, lens.height
    if orientation in (5, 6, 7, 8):
        width, height = height, width
    if not (0.0 <= pixel[0] <= width and 0.0 <= pixel[1] <= height):
        return None
    stored = stored_pixels(pixel[None], orientation, width, height)
    place = pinhole_pixels(lens, view.pinhole, stored)[0]
    return place if np.isfinite(place).all() else None
