# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings about solved cameras name evidence and photos."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.poses.checks import (
    SOLUTION_NAME,
    findings,
    photos_in_parts,
    with_findings,
)
from gaussian_wrapping_addon.core.readers.source_model import SourceModel

NAMES = {f"{k:06d}.jpg": f"walk/{k}.JPG" for k in range(20)}
RIGHT: dict[str, Any] = {
    "pairs": 40, "strong_pairs": 30, "contradicting_pairs": 0, "contradicting_share": 0.0,
    "strongest": [], "parts": [sorted(NAMES)], "apart": [], "is_doubtful": False,
    "is_mended": False,
    "pairs_matched": 190, "mapper": "incremental", "joined": 0, "median_share": 1.0,
}  # fmt: skip


def test_right_cameras_have_no_warning() -> None:
    assert findings(RIGHT, NAMES) == []


def test_evidence_is_named() -> None:
    found = {
        **RIGHT, "contradicting_pairs": 4, "contradicting_share": 0.217, "is_doubtful": True,
        "strongest": [["000001.jpg", "000007.jpg", 300, 12]], "is_mended": True,
        "parts": [["000000.jpg"] * 9, ["000003.jpg", "000004.jpg", "000005.jpg"], ["000009.jpg"]],
        "apart": [["000010.jpg", "000011.jpg"]],
    }  # fmt: skip
    warnings = {warning.code: warning.text for warning in findings(found, NAMES)}
    assert list(warnings) == [
        "cameras-contradicted", "cameras-mended", "cameras-weakly-linked", "cameras-in-parts",
    ]  # fmt: skip
    contradicted = warnings["cameras-contradicted"]
    assert "4 of 30 strong pairs" in contradicted
    assert "22 %" in contradicted
    assert "walk/1.JPG and walk/7.JPG (12 of 300 matches fit)" in contradicted
    assert "3 placed photos" in warnings["cameras-weakly-linked"]
    assert "walk/3.JPG, walk/4.JPG, walk/5.JPG" in warnings["cameras-weakly-linked"]
    assert "walk/10.JPG, walk/11.JPG" in warnings["cameras-in-parts"]


def test_warnings_are_logged_and_facts_added(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_json(tmp_path / SOLUTION_NAME, {**RIGHT, "apart": [["000010.jpg"]]})
    with caplog.at_level(logging.WARNING):
        model = with_findings(SourceModel("photos", ()), tmp_path, NAMES)
    assert [warning.code for warning in model.warnings] == ["cameras-in-parts"]
    assert "walk/10.JPG" in caplog.text
    assert photos_in_parts(tmp_path) == {"000010.jpg"}
    assert model.facts["pairs_verified"] == 40
    assert model.facts["mapper"] == "incremental"
