# SPDX-License-Identifier: GPL-3.0-or-later
"""The benchmark of camera solving: its photos, figures and page."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.camera_places import hall, render, town
from benchmarks.camera_solving import page, recall
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.synthetic import look_at


def _at_wall(quarter: int) -> Camera:
    """Return a camera in the middle of the hall that sees one wall and nothing else."""
    turn = np.pi / 2 * quarter
    ahead = np.array([np.cos(turn), np.sin(turn), 0.0])
    center = np.array([0.0, 0.0, 2.5])
    return look_at(center, center + ahead, "wall", 40, 24, 60.0)


def test_walls_of_the_hall_look_the_same() -> None:
    boxes = hall(4).boxes
    first = render(boxes, _at_wall(0)).astype(int)
    assert first.std() > 10.0
    for quarter in (1, 2, 3):
        other = render(boxes, _at_wall(quarter)).astype(int)
        # Light differs with the wall by one number for all its pixels that no bound cuts.
        apart = (other - first)[(first > 30) & (first < 225) & (other > 0) & (other < 255)]
        assert apart.size > 0.7 * first.size
        assert (np.abs(apart - np.median(apart)) <= 1).mean() > 0.98


def test_walls_of_the_town_do_not() -> None:
    place = town(30)
    assert len({camera.name for camera in place.cameras}) == 30
    assert len(np.unique(place.boxes.face_looks)) == place.boxes.face_looks.size
    # Nobody stands in a house.
    lower, upper = place.boxes.lower[1:], place.boxes.upper[1:]
    for camera in town(400).cameras:
        assert not ((camera.center > lower) & (camera.center < upper)).all(1).any()


def test_photos_do_not_depend_on_threads() -> None:
    boxes, camera = hall(4).boxes, _at_wall(1)
    np.testing.assert_array_equal(render(boxes, camera), render(boxes, camera, threads=2))


def test_recall_of_pairs() -> None:
    count = 30
    place = np.arange(count)
    apart = np.abs(place[:, None] - place[None])
    verified = {(i, i + s): 400 - 100 * s for i in range(count) for s in (1, 2) if i + s < count}
    rows = recall(-apart.astype(float), verified)["rows"]
    assert [row["nearest"] for row in rows] == [5, 10, 20]
    for row in rows:
        assert row["recall"] == row["recall_of_matches"] == row["recall_of_strongest"] == 1.0
    assert rows[0]["precision"] == pytest.approx(len(verified) / rows[0]["pairs"])


def test_the_page_has_what_records_say() -> None:
    run: dict[str, Any] = {
        "photos": 400, "placed": 397, "threads": 2, "machine": "A processor", "seconds": 812.4,
        "processor_seconds": 1204.6, "peak_bytes": 3 << 30, "date": "2026-11-26T10:00",
        "code": {"commit": "0123456789"},
        "facts": {"mapper": "global", "pairs_matched": 5120, "pairs_contradicting_cameras": 2},
        "warnings": [{"code": "photos-not-placed", "text": "", "hint": ""}],
        "errors": {"rotation_degrees_median": 0.0432, "center_share_median": 0.0012},
    }  # fmt: skip
    text = "\n".join(page({"town-400": run}))
    row = next(line for line in text.split("\n") if line.startswith("| town-400"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells == [
        "town-400", "397 / 400", "global", "5120", "1205", "812", "3.00", "0.043", "0.12", "", "",
        "2", "photos-not-placed", "2026-11-26", "0123456789",
    ]  # fmt: skip
    assert "Walls that repeat" not in text
