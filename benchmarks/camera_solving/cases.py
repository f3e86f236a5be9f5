# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs of the pose solver: which photos, and what is known of their cameras."""

from __future__ import annotations

import datetime
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.frames.similarity_fit import umeyama
from gaussian_wrapping_addon.core.dataset.photos.gps_exif import read_gps_exif
from gaussian_wrapping_addon.core.dataset.photos.photo_finder import list_photos
from gaussian_wrapping_addon.core.dataset.poses.pose_solver import solve_poses
from gaussian_wrapping_addon.core.dataset.readers.source_model import SourceModel
from gaussian_wrapping_addon.core.evaluation.alignment.pose_error import pose_errors
from gaussian_wrapping_addon.core.machine import processor_name
from gaussian_wrapping_addon.core.processes.peak_memory import largest_helper_bytes
from gaussian_wrapping_addon.core.progress import Progress

from .places import PLACES, ensure_photos

_EARTH_M = 6_371_000.0


@dataclass(frozen=True)
class Case:
    """Photos of a place made here, or of a folder."""

    name: str
    count: int = 0
    """Photos of a place; 0 for all of a folder."""
    first: int = 0
    """Only so many of them are used, the first by name; 0 for all."""

    @property
    def identity(self) -> str:
        """Name of its record."""
        parts = [self.name, *(str(n) for n in (self.count, self.first) if n)]
        return "-".join(parts)


CASES = (
    Case("town", 400),
    Case("town", 400, first=176),
    Case("hall", 64),
    Case("odm_caliterra"),
    Case("odm_brighton_beach"),
    Case("fox"),
)


def run(case: Case, data: Path | None, threads: int, tell: Callable[[str], None]) -> dict[str, Any]:
    """Solve the cameras of a case and return its record.

    Parameters
    ----------
    data : Path or None
        Folder of the real photo sets.
    """
    if case.name in PLACES:
        exact = PLACES[case.name](case.count).cameras
        photos = ensure_photos(case.name, case.count, threads=threads) / "images"
    else:
        assert data is not None
        exact, photos = (), data / case.name / "images"
    paths = list_photos(photos)[: case.first or None]
    messages: list[str] = []

    def listen(event: Any) -> None:
        kind = event.message.split(",")[0].split(" photo ")[0]
        if not messages or messages[-1] != kind:
            messages.append(kind)
            tell(event.message)

    begun_s, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        model = solve_poses(
            photos, paths, [], Path(folder), Progress("cameras", listen), threads=threads
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    record = {
        "case": case.identity,
        "date": datetime.date.today().isoformat(),
        "processor": processor_name(),
        "threads": threads,
        "seconds": time.monotonic() - begun_s,
        "processor_seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "peak_bytes": largest_helper_bytes(),
        "photos": len(paths),
        "placed": len(model.photos),
        "facts": model.facts,
        "warnings": [warning.to_json() for warning in model.warnings],
    }
    if exact:
        errors = pose_errors(_cameras(model), exact[: len(paths)]).to_json()
        record["errors"] = {k: errors[k] for k in errors if k not in ("transform", "missing")}
    else:
        record["gps"] = gps_errors(model, photos)
    return record


def _cameras(model: SourceModel) -> list[Camera]:
    # Errors are of poses: any lens will do.
    return [Camera(p.name, 2, 2, 1.0, 1.0, 1.0, 1.0, p.cam_from_world) for p in model.photos]


def gps_errors(model: SourceModel, photos: Path) -> dict[str, float] | None:
    """Return distances of camera centres from their GPS after a similarity, metres."""
    places, centers = [], []
    for camera in _cameras(model):
        position = read_gps_exif(photos / camera.name)
        if position is not None and position.altitude_m is not None:
            places.append([position.longitude_deg, position.latitude_deg, position.altitude_m])
            centers.append(camera.center)
    if len(places) < 3:
        return None
    angles = np.array(places)
    middle = angles.mean(0)
    metres = np.radians(angles - middle) * _EARTH_M
    metres[:, 0] *= np.cos(np.radians(middle[1]))
    metres[:, 2] = angles[:, 2] - middle[2]
    found = umeyama(np.array(centers), metres, with_scale=True)
    apart = found.points(np.array(centers)) - metres
    return {
        "photos": len(places),
        "median_m": float(np.median(np.linalg.norm(apart, axis=1))),
        "median_over_ground_m": float(np.median(np.linalg.norm(apart[:, :2], axis=1))),
    }
