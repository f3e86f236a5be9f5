# SPDX-License-Identifier: GPL-3.0-or-later
"""Control points give the frame; wrong ones are named."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.units.control_points import (
    ControlFile,
    CoordinateSystem,
    Observations,
    fit_control_points,
)
from tests.core.dataset.units.test_triangulation import ring

LOCAL = ControlFile(CoordinateSystem("local"), ())
MARKS = np.array(
    [
        [0.0, 0, 0],
        [1, 0, 0.1],
        [0.2, 0.9, -0.2],
        [-0.8, 0.3, 0.5],
        [0.5, -0.6, 0.4],
        [-0.4, -0.7, 0],
    ]
)


def turn() -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


TRUTH = Similarity(12.5, turn(), np.array([500.0, -20.0, 3.0]))


def seen(cameras: list[Camera], marks: np.ndarray, places: np.ndarray) -> list[Observations]:
    return [
        Observations(
            f"m{i}",
            place,
            tuple(range(len(cameras))),
            np.array([c.project(mark[None])[0][0] for c in cameras]),
        )
        for i, (mark, place) in enumerate(zip(marks, places, strict=True))
    ]


@pytest.mark.parametrize("count", [3, 6])
def test_exact_points_give_the_exact_frame(count: int) -> None:
    cameras = ring(5)
    marks = MARKS[:count]
    found = fit_control_points(LOCAL, cameras, seen(cameras, marks, TRUTH.points(marks)))
    np.testing.assert_allclose(
        found.metric_from_world.matrix(), TRUTH.matrix(), rtol=1e-9, atol=1e-9
    )
    assert found.origin is None
    assert found.details["control_points"]["used"] == count


def test_a_wrong_point_is_named_with_its_error() -> None:
    cameras = ring(5)
    places = TRUTH.points(MARKS)
    places[2] += [0.0, 1.5, 0.0]
    found = fit_control_points(LOCAL, cameras, seen(cameras, MARKS, places))
    np.testing.assert_allclose(found.metric_from_world.matrix(), TRUTH.matrix(), atol=1e-6)
    details = found.details["control_points"]
    assert details["left_out"] == ["m2"]
    assert details["points"][2] == {
        "name": "m2",
        "residual_m": 1.5,
        "error_px": details["points"][2]["error_px"],
        "used": False,
    }
    assert details["points"][0]["residual_m"] < 1e-6


def test_points_seen_once_are_listed() -> None:
    cameras = ring(5)
    points = seen(cameras, MARKS, TRUTH.points(MARKS))
    points[1] = Observations("m1", points[1].position, (0,), points[1].pixels[:1])
    points[4] = Observations("m4", points[4].position, (), np.zeros((0, 2)))
    found = fit_control_points(LOCAL, cameras, points)
    assert found.details["control_points"]["not_seen"] == ["m1", "m4"]
    assert found.details["control_points"]["used"] == 4


def test_too_few_or_on_a_line() -> None:
    cameras = ring(5)
    with pytest.raises(DatasetError, match="2 control points are seen in two placed photos"):
        fit_control_points(LOCAL, cameras, seen(cameras, MARKS[:2], TRUTH.points(MARKS[:2])))
    line = np.array([[0.0, 0, 0], [0.5, 0.1, 0], [-0.5, -0.1, 0], [0.25, 0.05, 0]])
    for count in (3, 4):
        with pytest.raises(DatasetError, match="one line"):
            fit_control_points(
                LOCAL, cameras, seen(cameras, line[:count], TRUTH.points(line[:count]))
            )
    nearly = line + np.array([[0, 0, 0], [0, 0, 1.5e-3], [0, 0, 0], [0, 0, -1.5e-3]])
    with pytest.raises(DatasetError, match="almost on one line"):
        fit_control_points(LOCAL, cameras, seen(cameras, nearly, TRUTH.points(nearly)))


def test_points_that_do_not_belong_together() -> None:
    cameras = ring(5)
    places = np.random.default_rng(3).normal(size=(6, 3)) * 50
    with pytest.raises(DatasetError, match="agree"):
        fit_control_points(LOCAL, cameras, seen(cameras, MARKS, places))
