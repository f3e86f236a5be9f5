# SPDX-License-Identifier: GPL-3.0-or-later
"""The colour field against dense least squares and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.evaluation.color_field import (
    CORNERS,
    RATIO,
    ColorFieldSettings,
    Contraction,
    Level,
    Samples,
    fit_color_field,
    pack,
)
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.poses import look_at_pose

HOME = Contraction(np.zeros(3), 1.0)


def directions_of(count: int, seed: int) -> np.ndarray:
    drawn = np.random.default_rng(seed).normal(size=(count, 3))
    return (drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).astype(np.float32)


def samples_of(points: np.ndarray, directions: np.ndarray, colors: np.ndarray, footprint: float):
    sizes = np.full(len(points), footprint, np.float32)
    return Samples(points, directions, sizes, colors.astype(np.float32))


def harmonics(d: np.ndarray) -> np.ndarray:
    """Degree 0 to 2, whose mean squares over all directions are 1."""
    x, y, z = d.astype(float).T
    return np.stack(
        [
            np.ones_like(x), 3**0.5 * x, 3**0.5 * y, 3**0.5 * z, 15**0.5 * x * y,
            15**0.5 * y * z, 5**0.5 / 2 * (3 * z * z - 1), 15**0.5 * x * z,
            15**0.5 / 2 * (x * x - y * y),
        ],
        1,
    )  # fmt: skip


def hats(points: np.ndarray, cell: float) -> dict[tuple[int, int, int], np.ndarray]:
    """Trilinear weights of all vertices of a lattice from (-2, -2, -2), by their indices."""
    scaled = (points + 2.0) / cell
    low = np.floor(scaled).astype(int)
    found: dict[tuple[int, int, int], np.ndarray] = {}
    for s, (base, place) in enumerate(zip(low, scaled - low, strict=True)):
        for corner in CORNERS:
            weight = np.prod(np.where(corner, place, 1 - place))
            key = tuple((base + corner).tolist())
            found.setdefault(key, np.zeros(len(points)))[s] += weight
    return found


def test_it_is_the_regularised_least_squares_solution() -> None:
    """Every coefficient enters the colours, so that colours at other points settle them all."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.4, 0.4, (300, 3))
    points[:, 2] *= 0.1
    seen, colors = directions_of(300, 1), rng.random((300, 3))
    settings = ColorFieldSettings(iterations=3000, fine_ridge=0.3, mean_ridge=0.05, view_ridge=0.7)
    cell = 0.125
    field = fit_color_field(samples_of(points, seen, colors, cell), HOME, settings, Progress())
    assert field.cell == pytest.approx(cell)

    fine, coarse = hats(points, cell), hats(points, RATIO * cell)
    columns = list(fine.values())
    weights = [0.3] * len(columns)
    for hat in coarse.values():
        for h, values in enumerate(harmonics(seen).T):
            columns.append(hat * values)
            weights.append(0.05 if h == 0 else 0.7)
    matrix = np.stack(columns, 1)
    normal = matrix.T @ matrix + np.diag(weights)
    mean = colors.mean(axis=0)
    expected = np.linalg.solve(normal, matrix.T @ (colors - mean))
    fitted = field.colors(points, seen)
    wanted = (matrix @ expected + mean).clip(0, 1)
    assert np.abs(fitted - wanted).max() < 2e-3
    assert np.abs(fitted - wanted).mean() < 2e-4
    assert (len(field.fine), len(field.coarse)) == (len(fine), len(coarse))


def test_colours_and_gloss_come_back_at_places_between_the_samples() -> None:
    rng = np.random.default_rng(0)

    def plane(count: int) -> np.ndarray:
        return np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.zeros(count)])

    def look(points: np.ndarray, seen: np.ndarray) -> np.ndarray:
        matte = 0.5 + 0.2 * np.sin(points[:, :1] * [4.0, 5.0, 6.0])
        return matte + 0.1 * seen[:, 2:].astype(float) * seen[:, :1]

    points, seen = plane(60_000), directions_of(60_000, 1)
    samples = samples_of(points, seen, look(points, seen), 0.01)
    others, from_there = plane(5000) * 0.98, directions_of(5000, 2)
    errors = []
    for settings in (ColorFieldSettings(), ColorFieldSettings(view_ridge=1e9)):
        field = fit_color_field(samples, HOME, settings, Progress())
        error = field.colors(others, from_there) - look(others, from_there)
        errors.append(np.sqrt((error**2).mean()))
    assert errors[0] < 0.01
    assert errors[1] > 0.02


def test_the_result_does_not_depend_on_threads() -> None:
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (5000, 3))
    samples = samples_of(points, directions_of(5000, 1), np.abs(points), 0.02)
    one, many = (
        fit_color_field(samples, HOME, ColorFieldSettings(), Progress(), threads=n) for n in (1, 3)
    )
    assert np.array_equal(one.fine, many.fine)
    assert np.array_equal(one.coarse, many.coarse)
    assert np.array_equal(
        one.colors(points, samples.directions), many.colors(points, samples.directions, threads=3)
    )


def test_far_from_every_sample_it_has_their_mean_colour() -> None:
    points = np.random.default_rng(0).uniform(0.2, 0.3, (500, 3))
    colors = np.random.default_rng(1).random((500, 3))
    field = fit_color_field(
        samples_of(points, directions_of(500, 1), colors, 0.01), HOME, ColorFieldSettings(),
        Progress(),
    )  # fmt: skip
    far = field.colors(np.array([[-0.7, 0.1, 0.0]]), directions_of(1, 2))
    assert far[0] == pytest.approx(colors.mean(axis=0), abs=1e-6)


def test_vertices_are_shared_by_neighbouring_cells() -> None:
    indices = np.array([[5, 5, 5], [5, 5, 6], [9, 1, 2]])
    keys = pack(indices)
    order = np.argsort(keys)
    level = Level.of_cells(keys[order], indices[order])
    others = np.array([[5, 5, 7], [5, 6, 5], [6, 6, 6], [5, 5, 8], [5, 5, 6]])
    found = level.find(pack(others), others)
    # Two share a face with cells of the lattice, one an edge, one nothing, one is among them.
    assert (found >= 0).sum(axis=1).tolist() == [4, 4, 2, 0, 8]
    at = found[found >= 0]
    assert np.array_equal(level.vertices[at], pack(others[:, None] + CORNERS)[found >= 0])


def test_contraction_keeps_the_inside_and_the_footprint() -> None:
    center = np.array([5e5, 4e6, 100.0])
    cameras = [
        Camera("c", 40, 30, 40.0, 40.0, 20.0, 15.0, look_at_pose(center + offset, center))
        for offset in ([20.0, 0, 0], [-20.0, 0, 0], [0, 20.0, 0], [0, -20.0, 0])
    ]
    found = Contraction.of_cameras(cameras, 20.0)
    assert found.center == pytest.approx(center)
    assert found.radius == pytest.approx(20.0)
    offsets = np.array([[3.0, 4, 5], [40.0, 0, 0], [0, 0, 2e9]])
    mapped = found.points(center + offsets)
    assert mapped[0] == pytest.approx(offsets[0] / 20.0)
    assert mapped[1] == pytest.approx([1.5, 0, 0])
    assert mapped[2] == pytest.approx([0, 0, 2.0])
    # Across the direction to the centre, by finite differences.
    step = np.array([0, 1e-2, 0])
    across = np.linalg.norm(found.points(center + offsets[:2] + step) - mapped[:2], axis=1)
    assert found.scales(center + offsets[:2]) == pytest.approx(across / 1e-2, rel=1e-4)
    # Cameras in one place still have an inside.
    assert Contraction.of_cameras(cameras[:1], 20.0).radius == pytest.approx(2.0)
