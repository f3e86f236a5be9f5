# SPDX-License-Identifier: GPL-3.0-or-later
"""The record of how a scene got its metres, as it goes with results and exports."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..similarity import Similarity
from .geodesy import GeoPoint, utm_of

VERSION = 1
GPS, MARKERS, CONTROL_POINTS = "gps", "markers", "control points"
"""Sources of metres."""
GEOGRAPHIC_CRS = "EPSG:4979"
"""WGS 84 with heights, of the origin."""
ORTHONORMAL = 1e-6
"""Tolerance of a rotation that was read from a file."""
MOST_LISTED = 50
"""Names of outliers that a record lists."""
FAR_IN_SIZES = 1000.0
"""Farther than this many scene units from the origin, single precision shows in Blender."""


@dataclass(frozen=True)
class RealUnits:
    """A metric frame of a scene.

    ``metric_from_world`` leads there from the input's cameras. Where ``applied``, results are
    written in the metric frame.
    """

    sources: tuple[str, ...]
    """Of :data:`GPS`, :data:`MARKERS`, :data:`CONTROL_POINTS`; the first one decides the frame."""
    metric_from_world: Similarity
    applied: bool
    z_up: bool
    """Whether the metric frame's z points up; with markers alone its axes are those of the input.
    """
    scale_error: float
    """Relative standard deviation of the scale."""
    origin: GeoPoint | None = None
    """Place of the metric frame's origin, whose x is east, y north and z up."""
    details: dict[str, Any] = field(default_factory=dict)
    """What was measured, with residuals, as JSON values, by source."""

    def to_json(self) -> dict[str, Any]:
        """Return the entry ``georeference`` of ``scene.json`` (docs/file-formats.md)."""
        metric, world = self.metric_from_world, Similarity()
        frame = "axes of the input, in metres"
        if self.origin is not None:
            frame = "local east-north-up about the origin"
        elif self.z_up:
            frame = "local coordinates of the control points"
        return {
            "version": VERSION,
            "sources": list(self.sources),
            "unit": "metre",
            "frame": frame,
            "z_up": self.z_up,
            "applied": self.applied,
            "origin": None if self.origin is None else self.origin.to_json(),
            "crs": None if self.origin is None else GEOGRAPHIC_CRS,
            "utm": None if self.origin is None else utm_of(self.origin),
            "metric_from_world": (world if self.applied else metric).to_json(),
            "world_from_input": (metric if self.applied else world).to_json(),
            "scale_error": self.scale_error,
            **self.details,
        }


def metric_from_world(record: Any) -> Similarity | None:
    """Return ``metric_from_world`` of an entry ``georeference``; None where it holds none.

    Entries that were changed by others may hold anything.
    """
    try:
        found = Similarity.from_json(record["metric_from_world"])
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    if not (found.scale > 0.0 and np.isfinite(found.matrix()).all()):
        return None
    turned = found.rotation @ found.rotation.T
    proper = np.abs(turned - np.eye(3)).max() < ORTHONORMAL and np.linalg.det(found.rotation) > 0.0
    return found if proper else None


def blender_start(record: Any, world_from_scene: Similarity) -> Similarity | None:
    """Return where Blender first places a scene that has metres, or None to leave it as trained.

    Where z is up in the metric frame, the scene is placed in that frame, far coordinates less whole
    metres; else it keeps its own axes and origin, in metres.

    Parameters
    ----------
    record : object
        The entry ``georeference``, perhaps None.
    world_from_scene : Similarity
    """
    metric = metric_from_world(record)
    if metric is None or not record.get("applied"):
        return None
    placed = metric.after(world_from_scene)
    if not record.get("z_up"):
        return Similarity(placed.scale)
    far = float(np.abs(placed.translation).max()) > FAR_IN_SIZES * placed.scale
    offset = np.round(placed.translation) if far else np.zeros(3)
    return Similarity(placed.scale, placed.rotation, placed.translation - offset)


def listed(names: list[str]) -> list[str]:
    """Return the names that a record holds: at most :data:`MOST_LISTED`."""
    return sorted(names)[:MOST_LISTED]


def rounded(value: float, digits: int = 4) -> float | None:
    """Return a measured number with few significant digits, None where it is not finite."""
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None
