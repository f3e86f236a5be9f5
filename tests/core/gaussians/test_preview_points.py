# SPDX-License-Identifier: GPL-3.0-or-later
"""Points of a running training: which, in which colours; files that are no points."""

from __future__ import annotations

import io

import numpy as np
import pytest

from gaussian_wrapping_addon.core.gaussians.preview_points import (
    MAX_POINTS_BYTES,
    MOST_POINTS,
    POINT,
    parse_points,
    points_file,
    preview_points,
)

RED = (1.0, 0.0, 0.0)


def harmonics(colors: object) -> np.ndarray:
    """Return coefficients whose constant part gives these colours, and others that must not."""
    colors = np.atleast_2d(np.asarray(colors, np.float32))
    sh = np.full((len(colors), 4, 3), 7.0, np.float32)
    sh[:, 0] = (colors - 0.5) * 2.0 * np.sqrt(np.pi)
    return sh


def test_positions_and_colours_go_through_the_file() -> None:
    means = np.array([[1.0, 2.0, 3.0], [-4.0, 5.5, 6.25]], np.float32)
    sh = harmonics([RED, (0.2, 0.4, 2.0)])
    positions, colors = parse_points(points_file(preview_points(means, np.zeros(2), sh)))
    assert (positions == means).all()
    np.testing.assert_allclose(colors, [(1, 0, 0, 1), (0.2, 0.4, 1, 1)], atol=0.5 / 255)


def test_faint_and_lost_gaussians_are_left_out() -> None:
    means = np.arange(12.0).reshape(4, 3)
    means[3, 1] = np.nan
    logits = np.log(np.array([0.09, 0.11, 0.9, 0.9]) / (1 - np.array([0.09, 0.11, 0.9, 0.9])))
    points = preview_points(means, logits, harmonics([RED] * 4))
    assert points["position"].tolist() == means[1:3].tolist()


def test_many_are_thinned_evenly_and_fit_into_the_limit() -> None:
    count = 4 * MOST_POINTS
    means = np.arange(count, dtype=np.float64)[:, None] * np.ones(3)
    points = preview_points(means, np.full(count, 5.0), np.zeros((count, 1, 3)))
    assert len(points) == MOST_POINTS
    steps = np.diff(points["position"][:, 0])
    assert (steps.min(), steps.max()) == (3.0, 5.0) or np.abs(steps - 4).max() <= 1
    assert points["position"][[0, -1], 0].tolist() == [0.0, count - 1.0]
    assert len(points_file(points)) <= MAX_POINTS_BYTES


def test_none_are_no_error() -> None:
    positions, colors = parse_points(
        points_file(preview_points(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 1, 3))))
    )
    assert positions.shape == (0, 3)
    assert colors.shape == (0, 4)


def saved(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=array.dtype == object)
    return stream.getvalue()


LOST = np.zeros(3, POINT)
LOST["position"][1, 2] = np.inf


@pytest.mark.parametrize(
    "data",
    [
        b"", b"PK", saved(np.zeros((3, 6))), saved(np.zeros((2, 2), POINT)), saved(LOST),
        saved(np.zeros(MOST_POINTS + 1, POINT)), saved(np.array([{}], object)),
        saved(np.zeros(100, POINT))[:-5],
    ],
)  # fmt: skip
def test_other_files_are_refused(data: bytes) -> None:
    with pytest.raises((ValueError, EOFError)):
        parse_points(data)
