# SPDX-License-Identifier: GPL-3.0-or-later
"""Matches against poses: exact cameras agree, moved ones do not."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.poses.checks import PairEvidence, Side, Verdict, agreeing_matches
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


def test_a_match_behind_the_cameras_contradicts() -> None:
    """Mirrored through its centre, a photo has all points on the same lines, but behind it."""
    first, second = _side(0.0, has_points=False), _side(0.4, has_points=False)
    flip = np.diag([-1.0, -1.0, 1.0])
    behind = Side(flip @ second.pose * -1.0 * [[-1], [-1], [1]], second.rays, second.points, 500.0)
    assert not agreeing_matches(first, behind).any()


def test_a_point_behind_the_other_camera_contradicts() -> None:
    first, second = _side(0.0, has_points=True), _side(0.4, has_points=False)
    turned = np.diag([-1.0, 1.0, -1.0]) @ second.pose  # by half a turn about its vertical
    assert not agreeing_matches(first, Side(turned, second.rays, second.points, FOCAL_PX)).any()


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
