# SPDX-License-Identifier: GPL-3.0-or-later
"""Solutions held against their matches, joined and mended, and what is said of them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.camera_places import Tracks, hall_tracks, write_database
from gaussian_wrapping_addon.core.evaluation.alignment import pose_errors
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.poses.checks import (
    SOLUTION_NAME,
    PairEvidence,
    Side,
    Verdict,
    agreeing_matches,
    check_solution,
    findings,
    photos_in_parts,
    with_findings,
)
from gaussian_wrapping_addon.core.poses.solver_helper import (
    joined,
    most_alike,
    near_in_tree,
    pair_likeness,
    place_at_once,
    place_one_by_one,
)
from gaussian_wrapping_addon.core.readers.source_model import SourceModel
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.synthetic import look_at

FOCAL_PX = 500.0
POINTS = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3))


def _side(angle: float, *, has_points: bool, pixels_px: float = 0.0, turned: float = 0.0) -> Side:
    """Return a camera on a circle, its pose pitched after the photo was taken."""
    center = 5.0 * np.array([np.cos(angle), np.sin(angle), 0.3])
    camera = look_at(center, np.zeros(3), "x", 640, 480, FOCAL_PX)
    pixels, _ = camera.project(POINTS)
    rays = (pixels - [320.0, 240.0]) / FOCAL_PX
    rays += np.random.default_rng(int(angle * 10)).normal(0.0, pixels_px / FOCAL_PX, rays.shape)
    turn = np.array(
        [[1, 0, 0], [0, np.cos(turned), -np.sin(turned)], [0, np.sin(turned), np.cos(turned)]]
    )
    points = POINTS if has_points else np.full(POINTS.shape, np.nan)
    return Side(turn @ camera.cam_from_world, rays, points, FOCAL_PX)


@pytest.mark.parametrize("has_points", [True, False])
def test_exact_cameras_agree_with_noisy_matches(has_points: bool) -> None:
    first = _side(0.0, has_points=has_points, pixels_px=0.7)
    second = _side(0.4, has_points=has_points, pixels_px=0.7)
    assert agreeing_matches(first, second).all()


@pytest.mark.parametrize("has_points", [True, False])
def test_a_turned_camera_contradicts(has_points: bool) -> None:
    first = _side(0.0, has_points=has_points)
    second = _side(0.4, has_points=False, turned=np.radians(20.0))
    assert agreeing_matches(first, second).mean() < 0.2


def test_what_lies_behind_a_camera_contradicts() -> None:
    """Mirrored through its centre, a photo has all points on the same lines, but behind it."""
    first, second = _side(0.0, has_points=False), _side(0.4, has_points=False)
    flipped = np.diag([-1.0, -1.0, 1.0]) @ second.pose * -1.0 * [[-1], [-1], [1]]
    behind = Side(flipped, second.rays, second.points, FOCAL_PX)
    assert not agreeing_matches(first, behind).any()
    turned = np.diag([-1.0, 1.0, -1.0]) @ second.pose  # by half a turn about its vertical
    behind = Side(turned, second.rays, second.points, FOCAL_PX)
    assert not agreeing_matches(_side(0.0, has_points=True), behind).any()


def _verdict(*rows: tuple[str, str, int, int]) -> Verdict:
    return Verdict(tuple(PairEvidence(*row) for row in rows))


def test_strong_pairs_decide() -> None:
    chain = [(f"{i:02d}", f"{i + 1:02d}", 400, 390) for i in range(10)]
    right = _verdict(*chain, *[(f"{i:02d}", f"{i + 5:02d}", 60, 0) for i in range(6)])
    assert right.contradicting == ()  # weak: 60 of 400
    assert not right.is_doubtful
    wrong = _verdict(*chain, *[(f"{i:02d}", f"{i + 5:02d}", 300, 10) for i in range(6)])
    assert wrong.is_doubtful
    assert wrong.contradicting_share == pytest.approx(1800 / 5800)
    assert [pair.first for pair in wrong.contradicting] == ["00", "01", "02", "03", "04", "05"]


def test_parts_are_linked_by_agreeing_pairs_only() -> None:
    found = _verdict(
        ("a", "b", 100, 90), ("b", "c", 100, 20), ("c", "d", 100, 95), ("d", "e", 40, 25)
    )
    assert found.parts(["a", "b", "c", "d", "e"]) == [["a", "b"], ["c", "d"], ["e"]]
    values = found.to_json(["a", "b", "c", "d", "e"])
    assert values["contradicting_pairs"] == 1
    assert values["strongest"] == [["b", "c", 100, 20]]


PHOTOS = 24


pytest.importorskip("pycolmap")


def _hall(folder: Path, repeats: int) -> tuple[Path, Tracks]:
    tracks = hall_tracks(PHOTOS, 150, repeats=repeats, seed=0)
    (folder / "images").mkdir()
    write_database(folder / "database.db", tracks, seed=0)
    return folder / "database.db", tracks


def _degrees(model: Any, tracks: Tracks) -> np.ndarray:
    cameras = [
        Camera(image.name, 2, 2, 1.0, 1.0, 1.0, 1.0, np.asarray(image.cam_from_world().matrix()))
        for image in (model.image(number) for number in sorted(model.reg_image_ids()))
    ]
    return pose_errors(cameras, tracks.cameras).rotation_degrees


def test_right_cameras_are_not_doubted_by_either_mapper(tmp_path: Path) -> None:
    database, tracks = _hall(tmp_path, repeats=1)
    for place in (place_one_by_one, place_at_once):
        model = place(database, tmp_path, 0, PHOTOS)[0]
        assert model.num_reg_images() == PHOTOS
        assert _degrees(model, tracks).max() < 0.5
        verdict = check_solution(database, model)
        assert not verdict.contradicting
        assert not verdict.is_doubtful
        assert len(verdict.parts([camera.name for camera in tracks.cameras])) == 1


def test_walls_that_repeat_are_noticed(tmp_path: Path) -> None:
    database, tracks = _hall(tmp_path, repeats=4)
    model = place_one_by_one(database, tmp_path, 0, PHOTOS)[0]
    assert np.median(_degrees(model, tracks)) > 10.0  # what the check must notice
    assert check_solution(database, model).is_doubtful


def test_parts_with_common_photos_are_joined(tmp_path: Path) -> None:
    database, tracks = _hall(tmp_path, repeats=1)
    parts = []
    for left_out in (range(16, PHOTOS), range(10)):
        model = place_one_by_one(database, tmp_path, 0, PHOTOS)[0]
        names = {tracks.cameras[k].name for k in left_out}
        for number in sorted(model.reg_image_ids()):
            if model.image(number).name in names:
                model.deregister_frame(model.image(number).frame_id)
        parts.append(model)
    whole, added = joined(database, tmp_path, 0, parts)
    assert added == PHOTOS - 16
    assert whole.num_reg_images() == PHOTOS
    assert _degrees(whole, tracks).max() < 0.5
    assert not check_solution(database, whole).is_doubtful
    assert joined(database, tmp_path, 0, parts[:1]) == (parts[0], 0)


def test_true_neighbours_are_more_alike_than_walls_that_repeat(tmp_path: Path) -> None:
    database, _ = _hall(tmp_path, repeats=4)
    alike = pair_likeness(database)
    assert all(0.0 < value <= 1.0 for value in alike.values())
    kept = near_in_tree(alike)
    assert len(kept) < len(alike) / 2
    numbers = sorted({number for pair in alike for number in pair})
    assert {number for pair in kept for number in pair} == set(numbers)
    closest = most_alike(alike)
    of_first = sorted((p for p in alike if numbers[0] in p), key=lambda p: -alike[p])[:3]
    assert set(of_first) <= closest


NAMES = {f"{k:06d}.jpg": f"walk/{k}.JPG" for k in range(20)}
RIGHT: dict[str, Any] = {
    "pairs": 40, "strong_pairs": 30, "contradicting_pairs": 0, "contradicting_share": 0.0,
    "strongest": [], "parts": [sorted(NAMES)], "apart": [], "is_doubtful": False,
    "is_mended": False,
    "pairs_matched": 190, "mapper": "incremental", "joined": 0, "median_share": 1.0,
}  # fmt: skip


def test_evidence_is_named() -> None:
    assert findings(RIGHT, NAMES) == []
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
