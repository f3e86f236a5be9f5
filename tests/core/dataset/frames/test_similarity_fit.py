# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarities are recovered exactly, and with outliers."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.placement import umeyama, umeyama_ransac


def rotation_about(axis: list[float], degrees: float) -> np.ndarray:
    a = np.array(axis) / np.linalg.norm(axis)
    k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


TRUE = Similarity(3.7, rotation_about([1, 2, -1], 131.0), np.array([5.0, -2.0, 0.3]))


def assert_same(found: Similarity, true: Similarity, tolerance: float) -> None:
    assert abs(found.scale / true.scale - 1) < tolerance
    np.testing.assert_allclose(found.rotation, true.rotation, atol=tolerance)
    size = max(1.0, float(np.abs(true.translation).max()))
    np.testing.assert_allclose(found.translation, true.translation, atol=tolerance * size)


def test_umeyama_is_exact() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert_same(umeyama(points, TRUE.points(points), with_scale=True), TRUE, 1e-13)
    rigid = Similarity(1.0, TRUE.rotation, TRUE.translation)
    assert_same(umeyama(points, rigid.points(points), with_scale=False), rigid, 1e-13)


def test_three_points_in_a_plane_are_enough() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    assert_same(umeyama(points, TRUE.points(points), with_scale=True), TRUE, 1e-13)


def test_huge_coordinates_keep_their_digits() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3)) + np.array([4e6, -7e6, 3e5])
    target = TRUE.points(points)
    found = umeyama(points, target, with_scale=True)
    # 3.7 x 7e6 has a rounding of 4e-9.
    assert np.abs(found.points(points) - target).max() < 2e-7
    np.testing.assert_allclose(found.rotation, TRUE.rotation, atol=1e-9)


def test_a_mirror_image_gets_the_best_proper_rotation() -> None:
    points = np.random.default_rng(2).normal(size=(30, 3)) * [3.0, 2.0, 0.1]
    found = umeyama(points, points * [1, 1, -1], with_scale=False)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0, abs=1e-12)
    # The thin direction cannot be mirrored, the other two are met: almost the identity.
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=0.02)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.eye(3)[:2], "2 pairs"),
        (np.outer(np.arange(5.0), [1.0, 2.0, 3.0]), "on one line"),
        (np.outer(np.arange(5.0), [1.0, 2.0, 3.0]) + 1e7, "on one line"),
        (np.ones((5, 3)), "in one place"),
        (np.full((4, 3), np.nan), "not all finite"),
    ],
)
def test_degenerate_pairs_are_refused(points: np.ndarray, words: str) -> None:
    for call in (
        lambda: umeyama(points, points, with_scale=True),
        lambda: umeyama_ransac(
            points, points, threshold=1.0, iterations=10, seed=0, with_scale=True
        ),
    ):
        with pytest.raises(DatasetError, match=words):
            call()


def test_ransac_survives_forty_percent_of_outliers() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(100, 3)) + np.array([1e5, 0, 0])
    target = TRUE.points(points)
    wrong = rng.permutation(100)[:40]
    target[wrong] += rng.normal(size=(40, 3)) * 5 + 3
    found = umeyama_ransac(
        points, target, threshold=0.05, iterations=100_000, seed=0, with_scale=True
    )
    assert set(np.flatnonzero(~found.inliers)) == set(wrong)
    assert np.abs(found.transform.points(points) - TRUE.points(points)).max() < 1e-8
    again = umeyama_ransac(
        points, target, threshold=0.05, iterations=100_000, seed=0, with_scale=True
    )
    assert (again.transform.matrix() == found.transform.matrix()).all()


def test_pairs_that_do_not_belong_together_are_refused() -> None:
    rng = np.random.default_rng(4)
    with pytest.raises(DatasetError, match="do not correspond"):
        umeyama_ransac(
            rng.normal(size=(20, 3)), rng.normal(size=(20, 3)) * 9,
            threshold=1e-6, iterations=500, seed=0, with_scale=True,
        )  # fmt: skip
