# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps of the placement: exact results for known cases, errors for degenerate input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import ParseError, UsageError
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.placement import (
    check_scale,
    ground_step,
    origin_step,
    plane_through,
    read_placement,
    scale_step,
    similarity_of_matrix,
    turn_to_z,
    write_placement,
)

NOTHING = np.zeros((0, 3))


def some_similarity(seed: int) -> Similarity:
    random = np.random.default_rng(seed)
    return Similarity(
        float(10 ** random.uniform(-3, 3)),
        Rotation.random(random_state=seed).as_matrix(),
        random.normal(size=3),
    )


def test_after_is_one_then_the_other() -> None:
    first, second = some_similarity(1), some_similarity(2)
    points = np.random.default_rng(3).normal(size=(10, 3))
    expected = second.points(first.points(points))
    np.testing.assert_allclose(second.after(first).points(points), expected, rtol=1e-12)
    back = first.inverse().after(first).matrix()
    np.testing.assert_allclose(back, np.eye(4), atol=1e-12)


@pytest.mark.parametrize("size", [1e-3, 1e4])
@pytest.mark.parametrize("length", [1e-3, 250.0])
def test_scale_step_gives_the_length_and_keeps_the_origin(size: float, length: float) -> None:
    points = size * np.random.default_rng(4).normal(size=(2, 3))
    step = scale_step(points, length)
    placed = step.points(points)
    assert np.linalg.norm(placed[1] - placed[0]) == pytest.approx(length, rel=1e-14)
    np.testing.assert_array_equal(step.points(np.zeros((1, 3))), np.zeros((1, 3)))
    np.testing.assert_array_equal(step.rotation, np.eye(3))
    assert scale_step(placed, length).scale == pytest.approx(1.0, abs=1e-14), "made again"


@pytest.mark.parametrize(
    ("points", "length", "text"),
    [
        ([[0, 0, 0]], 1.0, "One point is picked"),
        (NOTHING, 1.0, "No point"),
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], 1.0, "3 are picked"),
        ([[1, 2, 3], [1, 2, 3]], 1.0, "coincide"),
        ([[1e5, 0, 0], [1e5 + 1e-3, 0, 0]], 1.0, "coincide"),
        ([[0, 0, 0], [1, 0, 0]], -2.0, "not a distance"),
        ([[0, 0, 0], [1, 0, 0]], np.nan, "not a distance"),
        ([[0, 0, 0], [np.nan, 0, 0]], 1.0, "not finite"),
    ],
)
def test_scale_step_refuses(points: object, length: float, text: str) -> None:
    with pytest.raises(UsageError, match=text) as caught:
        scale_step(np.array(points, float), length)
    assert caught.value.hint


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("size", "away"), [(1e-3, 0.0), (1e4, 0.0), (1.0, 1e3)])
@pytest.mark.parametrize("count", [3, 20])
def test_three_points_become_the_ground(seed: int, size: float, away: float, count: int) -> None:
    random = np.random.default_rng(seed)
    flat = np.concatenate([random.uniform(-1, 1, (count, 2)), np.zeros((count, 1))], 1)
    above = np.concatenate([random.normal(size=(9, 2)), random.uniform(0.5, 3, (9, 1))], 1)
    move = Similarity(size, Rotation.random(random_state=seed).as_matrix(), np.full(3, away))
    points, cameras = move.points(flat), move.points(above)
    step = ground_step(plane_through(points, cameras))
    rounding = 1e-12 * max(size, away)
    np.testing.assert_allclose(step.points(points)[:, 2], 0.0, atol=rounding)
    np.testing.assert_allclose(step.points(cameras)[:, 2], size * above[:, 2], atol=10 * rounding)
    assert np.linalg.det(step.rotation) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(step.points(points).mean(0)[:2], points.mean(0)[:2], atol=rounding)
    again = ground_step(plane_through(step.points(points), step.points(cameras)))
    np.testing.assert_allclose(again.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(again.translation, 0.0, atol=1e-8 * max(size, away))


def test_the_side_of_a_plane_without_cameras_is_the_one_nearer_to_z() -> None:
    points = np.array([[0, 0, 1], [1, 0, 1.2], [0, 1, 0.9]], float)
    for order in ([0, 1, 2], [2, 1, 0]):
        assert plane_through(points[order], NOTHING).normal[2] > 0.9
    split = np.array([[0, 0, 5], [0, 0, -3.0]]) + points.mean(0)
    assert plane_through(points, split - split.mean(0) + points.mean(0)).normal[2] > 0.9
    assert plane_through(points, np.array([[0, 0, -8.0]])).normal[2] < -0.9


@pytest.mark.parametrize(
    ("points", "text"),
    [
        (NOTHING, "No point"),
        ([[0, 0, 0], [1, 0, 0]], "2 are picked"),
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], "one line"),
        ([[0, 0, 0], [1, 1, 1], [2, 2, 2.001]], "one line"),
        ([[3, 0, 0]] * 3, "coincide"),
        ([[0, 0, 0], [1, 0, 0], [0, np.inf, 0]], "not finite"),
    ],
)
def test_plane_refuses(points: object, text: str) -> None:
    with pytest.raises(UsageError, match=text) as caught:
        plane_through(np.array(points, float), NOTHING)
    assert caught.value.hint


def test_turn_to_z_is_the_shortest_turn_for_any_direction() -> None:
    directions = np.random.default_rng(6).normal(size=(300, 3))
    directions[:50] = [0, 0, -1] + 1e-9 * directions[:50]
    directions[50:100] = [0, 0, 1] + 1e-9 * directions[50:100]
    directions[100] = [0, 0, -1]
    directions[101] = [1, 0, 0]
    for direction in directions / np.linalg.norm(directions, axis=1, keepdims=True):
        rotation = turn_to_z(direction)
        np.testing.assert_allclose(rotation @ direction, [0, 0, 1], atol=1e-14)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(rotation) > 0
        if direction[2] >= 0:
            # cos of the turn's angle is the direction's z: no shorter turn exists.
            assert 0.5 * (np.trace(rotation) - 1) == pytest.approx(direction[2], abs=1e-14)


def test_origin_step() -> None:
    point = np.array([1.0, -2.0, 5e5])
    np.testing.assert_array_equal(origin_step(point).points(point[None]), np.zeros((1, 3)))
    with pytest.raises(UsageError):
        origin_step(np.array([0, np.nan, 0]))


def test_similarity_of_a_matrix() -> None:
    for seed in range(10):
        expected = some_similarity(seed)
        rough = expected.matrix().astype(np.float32).astype(np.float64)
        found = similarity_of_matrix(rough, "x")
        assert found.scale == pytest.approx(expected.scale, rel=1e-6)
        np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-6)
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize(
    ("linear", "text"),
    [
        (np.diag([1.0, 1.0, 2.0]), "scaled differently"),
        (np.zeros((3, 3)), "scaled differently"),
        (np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "scaled differently"),
        (np.diag([-1.0, 1.0, 1.0]), "mirrored"),
        (np.diag([np.nan, 1.0, 1.0]), "not finite"),
    ],
)
def test_a_matrix_that_is_no_similarity_is_refused(linear: np.ndarray, text: str) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    with pytest.raises(UsageError, match=text) as caught:
        similarity_of_matrix(matrix, "frame")
    assert caught.value.hint


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e12, np.nan, np.inf])
def test_scales_out_of_reach_are_refused(scale: float) -> None:
    with pytest.raises(UsageError, match="scaled by"):
        check_scale(Similarity(scale))


def test_placement_file_is_exact_and_belongs_to_its_frame(tmp_path: Path) -> None:
    placement, world = some_similarity(7), some_similarity(8)
    path = tmp_path / "placement.json"
    write_placement(path, placement, world)
    again = read_placement(path, world)
    assert again is not None
    assert again.to_json() == placement.to_json(), "to the last bit"
    assert read_placement(path, some_similarity(9)) is None
    with pytest.raises(UsageError, match="cannot be written"):
        write_placement(tmp_path / "none" / "placement.json", placement, world)


@pytest.mark.parametrize(
    "change",
    [
        {"version": 2},
        {"blender_from_scene": None},
        {"blender_from_scene": {**Similarity().to_json(), "scale": -1.0}},
        {"blender_from_scene": {**Similarity().to_json(), "scale": 10**400}},
        {"blender_from_scene": {**Similarity().to_json(), "translation": [1, 2]}},
        {"blender_from_scene": {**Similarity().to_json(), "rotation": np.eye(3)[::-1].tolist()}},
        {"blender_from_scene": {**Similarity().to_json(), "rotation": (2 * np.eye(3)).tolist()}},
        {"world_from_scene": []},
    ],
)
def test_broken_placement_files_are_refused(tmp_path: Path, change: dict) -> None:
    path = tmp_path / "placement.json"
    write_placement(path, Similarity(), Similarity())
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    for text in (path.read_text(), path.read_text()[:20]):
        path.write_text(text)
        with pytest.raises(ParseError, match=r"placement\.json") as caught:
            read_placement(path, Similarity())
        assert "Delete the file" in caught.value.hint
