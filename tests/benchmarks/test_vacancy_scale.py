# SPDX-License-Identifier: GPL-3.0-or-later
"""The timing of the vacancy field, on a small task."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from benchmarks.vacancy_scale import cameras_around, main, measure


def test_small_task_agrees_with_the_definition() -> None:
    figures = measure(300, 3, 2000, sample=40, threads=1)
    assert (figures.gaussians, figures.cameras, figures.points) == (300, 3, 2000)
    assert figures.sample == 40
    assert 0.0 <= figures.error_median <= figures.error_max < 0.02
    assert figures.same_side_share == 1.0
    assert figures.undecided_share > 0.1
    assert figures.seconds == figures.prepare_s + figures.values_s > 0.0


def test_cameras_look_at_the_origin() -> None:
    for camera in cameras_around(7):
        pixels, depth = camera.project(np.zeros((1, 3)))
        np.testing.assert_allclose(pixels[0], [270.0, 480.0], atol=1e-9)
        assert depth[0] == pytest.approx(np.linalg.norm(camera.center))
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.rotation) == pytest.approx(1.0)


def test_command_logs_one_line(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        main(["--gaussians", "50", "--cameras", "2", "--points", "300", "--sample", "4"])
    assert len(caplog.messages) == 1
    assert "values_s" in caplog.messages[0]
