# SPDX-License-Identifier: GPL-3.0-or-later
"""Distances between photos by their GPS positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..photos.gps_exif import GpsPosition

EARTH_RADIUS_M = 6_371_000.0
MIN_POSITIONS = 3
SAME_PLACE_M = 0.5
"""Where all positions are this near to each other, they do not tell photos apart."""


def gps_distances(positions: Sequence[GpsPosition | None]) -> np.ndarray | None:
    """Return (n, n) distances over ground in metres, infinite for photos without a position.

    Heights are left out: cameras measure them worst, and what they see lies on the ground. None
    where fewer than three photos have a position, or all have the same.
    """
    known = [p for p in positions if p is not None]
    if len(known) < MIN_POSITIONS:
        return None
    angles = np.radians(
        [[np.nan] * 2 if p is None else [p.latitude_deg, p.longitude_deg] for p in positions]
    )
    latitude, longitude = angles[:, 0], angles[:, 1]
    east = longitude[:, None] - longitude[None]
    # Across the date line the short way round counts.
    east = (east + np.pi) % (2 * np.pi) - np.pi
    north = latitude[:, None] - latitude[None]
    middle = 0.5 * (latitude[:, None] + latitude[None])
    metres = EARTH_RADIUS_M * np.hypot(north, east * np.cos(middle))
    metres = np.where(np.isfinite(metres), metres, np.inf)
    return metres if float(metres[np.isfinite(metres)].max()) > SAME_PLACE_M else None
