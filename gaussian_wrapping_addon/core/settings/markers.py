# SPDX-License-Identifier: GPL-3.0-or-later
"""Printed markers as a setting: dictionary and side, such as ``4x4_50:0.05``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..errors import UsageError

MARKER_DICTIONARIES = (
    "4x4_50", "4x4_100", "4x4_250", "4x4_1000", "5x5_50", "5x5_100", "5x5_250", "5x5_1000",
    "6x6_50", "6x6_100", "6x6_250", "6x6_1000", "7x7_50", "7x7_100", "7x7_250", "7x7_1000",
    "aruco_original", "aruco_mip_36h12",
    "apriltag_16h5", "apriltag_25h9", "apriltag_36h10", "apriltag_36h11",
)  # fmt: skip
"""Names of marker dictionaries: OpenCV's without ``DICT_``, in small letters."""
MAX_SIDE_M = 1000.0
MARKERS_WANTED = "DICTIONARY:SIZE, such as 4x4_50:0.05, the size in metres"


@dataclass(frozen=True)
class MarkerSpec:
    """Which markers were printed."""

    dictionary: str
    """A name of :data:`MARKER_DICTIONARIES`."""
    side_m: float
    """Side of the black square, metres."""


def marker_spec(text: str) -> MarkerSpec | None:
    """Read the setting; None of an empty text.

    Raises
    ------
    UsageError
        The dictionary is unknown, or the size is no length greater than 0.
    """
    if not text:
        return None
    name, colon, size = text.strip().rpartition(":")
    if not colon:
        raise UsageError(f"Markers {text!r} have no size.", f"Give {MARKERS_WANTED}.")
    dictionary = name.strip().lower().removeprefix("dict_")
    if dictionary not in MARKER_DICTIONARIES:
        raise UsageError(
            f"There is no marker dictionary {name!r}.",
            f"Use one of {', '.join(MARKER_DICTIONARIES)}.",
        )
    try:
        side = float(size)
    except ValueError:
        side = math.nan
    if not 0.0 < side <= MAX_SIDE_M:
        raise UsageError(
            f"The marker size {size.strip()!r} is not a length of up to {MAX_SIDE_M:g} m.",
            "Give the side of the black square in metres, such as 0.05.",
        )
    return MarkerSpec(dictionary, side)


def checked_markers(text: str) -> str:
    """Return the option as it is kept, or raise as :func:`marker_spec` does."""
    spec = marker_spec(text)
    return "" if spec is None else f"{spec.dictionary}:{spec.side_m!r}"


def are_markers(text: str) -> bool:
    """Tell whether :func:`marker_spec` reads a text."""
    try:
        marker_spec(text)
    except UsageError:
        return False
    return True
