# SPDX-License-Identifier: GPL-3.0-or-later
"""Markers as a setting: what is read, and what is wrong with the rest."""

from __future__ import annotations

import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.settings.job import (
    MARKER_DICTIONARIES,
    MarkerSpec,
    are_markers,
    checked_markers,
    marker_spec,
)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", None),
        ("4x4_50:0.05", MarkerSpec("4x4_50", 0.05)),
        (" DICT_APRILTAG_36h11 : 1.5e-1 ", MarkerSpec("apriltag_36h11", 0.15)),
        ("aruco_original:1000", MarkerSpec("aruco_original", 1000.0)),
    ],
)
def test_markers(text: str, wanted: MarkerSpec | None) -> None:
    assert marker_spec(text) == wanted
    kept = checked_markers(text)
    assert marker_spec(kept) == wanted
    assert checked_markers(kept) == kept


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("4x4_50", "have no size.*DICTIONARY:SIZE"),
        ("4x4_51:0.05", "no marker dictionary '4x4_51'. Use one of 4x4_50,"),
        ("4x4_50:0", "marker size '0' is not a length"),
        ("4x4_50:5cm", "'5cm' is not.*in metres"),
        ("4x4_50:nan", "'nan' is not"),
        ("4x4_50:1001", "up to 1000 m"),
        ("4x4_50:", "'' is not"),
    ],
)
def test_what_are_no_markers(text: str, words: str) -> None:
    assert not are_markers(text)
    with pytest.raises(UsageError, match=words):
        checked_markers(text)


def test_opencv_has_every_dictionary() -> None:
    cv2 = pytest.importorskip("cv2")
    theirs = {n.lower().removeprefix("dict_") for n in dir(cv2.aruco) if n.startswith("DICT_")}
    assert set(MARKER_DICTIONARIES) == theirs
