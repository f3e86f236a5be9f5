# SPDX-License-Identifier: GPL-3.0-or-later
"""DTU Chamfer distance: plates at known distances, the mask, the plane and the thinning."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gaussian_wrapping_addon.core.errors import MeshingError, ResourceError, UsageError
from gaussian_wrapping_addon.core.evaluation.dtu_chamfer import (
    DtuScore,
    ObservationMask,
    dtu_chamfer,
    resample_mesh,
    thin_by_distance,
)
from gaussian_wrapping_addon.core.evaluation.surface_scores import sample_uniformly
from tests.core.evaluation.surface_scenes import ball

GROUND = np.array([0.0, 0.0, 1.0, 50.0])
"""Above z = -50."""


def plate(height: float = 0.0, half: float = 10.0, step: float = 0.5) -> np.ndarray:
    line = np.arange(-half, half + step / 2, step)
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], 1)


def everywhere(half: float = 100.0, resolution: float = 4.0) -> ObservationMask:
    side = int(2 * half / resolution) + 1
    return ObservationMask(
        np.ones((side,) * 3, bool), np.full(3, -half), np.full(3, half), resolution
    )


def score(points: np.ndarray, truth: np.ndarray, mask: ObservationMask | None = None, **options):
    options = {"plane": GROUND, "density": 0.2, **options}
    return dtu_chamfer(points, truth, mask or everywhere(), **options)


def test_the_truth_itself_has_no_distance() -> None:
    for points in (plate(), plate() + np.array([3e5, 4e6, 0.0])):
        middle = points.mean(0)
        mask = ObservationMask(np.ones((51,) * 3, bool), middle - 100, middle + 100, 4.0)
        result = dtu_chamfer(points, points, mask, GROUND)
        assert (result.accuracy, result.completeness, result.overall) == (0.0, 0.0, 0.0)
        assert result.accuracy_count == result.completeness_count == len(points)


def test_plates_are_their_height_apart() -> None:
    result = score(plate(1.5), plate())
    assert result == DtuScore(1.5, 1.5, 1.5, 1681, 1681, 0.0, 0.0)
    # A wider prediction is inaccurate beyond the truth's edge, a narrower one incomplete.
    wide = score(plate(1.5, half=15.0), plate())
    assert wide.completeness == 1.5
    assert wide.accuracy > 2.0
    narrow = score(plate(1.5, half=5.0), plate())
    assert narrow.accuracy == 1.5
    assert narrow.completeness > 2.0
    assert narrow.overall == (narrow.accuracy + narrow.completeness) / 2


def test_dense_errors_weigh_no_more_than_sparse_ones() -> None:
    rng = np.random.default_rng(0)
    heap = np.array([0.0, 0.0, 5.0]) + rng.uniform(-0.05, 0.05, (50_000, 3))
    crowd = np.concatenate([plate(0.0), heap])
    result = score(crowd, plate())
    assert result.accuracy_count == 1681 + 1
    assert result.accuracy == pytest.approx(5.0 / 1682, rel=0.03)
    raw = score(crowd, plate(), density=0.0)
    assert raw.accuracy == pytest.approx(5.0 * 50_000 / 51_681, rel=0.01)


def test_unobserved_points_count_for_completeness_only() -> None:
    mask = everywhere()
    mask.volume[: mask.volume.shape[0] // 2] = False  # voxels with x < -2
    points = plate(2.0)
    points[points[:, 0] < -2.0, 2] = 7.0
    result = score(points, plate(), mask)
    assert result.accuracy == 2.0
    assert result.accuracy_count == (points[:, 0] >= -2.0).sum()
    assert result.completeness > 2.5
    mask.volume[:] = False
    blind = score(points, plate(), mask)
    assert (blind.accuracy, blind.accuracy_count) == (math.inf, 0)
    assert blind.completeness == result.completeness


def test_voxels_reach_half_a_step_around_their_centres() -> None:
    volume = np.zeros((3, 4, 5), bool)
    volume[0, 0, 0] = volume[2, 3, 4] = True
    corner, end = np.array([10.0, 20, 30]), np.array([14.0, 26, 38])
    mask = ObservationMask(volume, corner, end, 2.0)
    near = [corner, corner - 0.99, corner + 0.99, end + 0.99, end - 0.99]
    far = [corner - 1.01, corner + 1.01, end + 1.01, end - 1.01, corner - 1e30, end + 1e30]
    points = np.stack([*near, *far])
    assert mask.observed(points).tolist() == [True] * 5 + [False] * 6
    within = [True] * 5 + [False, True, False, True, False, False]
    assert mask.within(points, 1.0).tolist() == within


def test_points_far_outside_of_the_box_do_not_count() -> None:
    mask = everywhere(half=20.0)
    truth = np.concatenate([plate(), plate() + np.array([90.0, 0, 0])])
    points = np.concatenate([plate(1.0), plate(1.0) + np.array([90.0, 0, 0])])
    near = score(points, truth, mask, patch=100.0)
    assert (near.completeness, near.completeness_dropped) == (1.0, 0.0)
    assert near.accuracy_count == 1681  # the mask's volume ends at 22
    cut = score(points, truth, mask, patch=50.0)
    assert cut.completeness_dropped == pytest.approx(0.5)
    # What lies beyond is not numbered either, however far it is.
    gross = score(np.concatenate([points, [[1e12, 0, 0]]]), truth, mask, patch=50.0)
    assert gross == cut


def test_truth_below_the_ground_is_not_asked_for() -> None:
    truth = np.concatenate([plate(0.0), plate(-10.0)])
    points = plate(0.0)
    ground = np.array([0.0, 0.0, 2.0, 10.0])  # above z = -5; its scale does not matter
    assert score(points, truth, plane=ground).completeness == 0.0
    assert score(points, truth, plane=GROUND).completeness == pytest.approx(5.0)
    # The plane does not excuse what the prediction has below it.
    below = score(np.concatenate([points, plate(-13.0)]), truth, plane=ground)
    assert below.accuracy == pytest.approx(1.5)
    with pytest.raises(UsageError, match="above the ground"):
        score(points, truth, plane=np.array([0.0, 0.0, 1.0, -1.0]))


def test_large_distances_are_dropped_and_told() -> None:
    points = np.concatenate([plate(1.0), plate(25.0)])
    result = score(points, plate())
    assert result.accuracy == 1.0
    assert result.accuracy_dropped == 0.5
    assert result.accuracy_count == 1681
    assert result.completeness_dropped == 0.0
    kept = score(points, plate(), max_distance=26.0)
    assert kept.accuracy == 13.0
    # The bound itself is dropped.
    edge = score(plate(20.0), plate())
    assert (edge.accuracy, edge.accuracy_dropped) == (math.inf, 1.0)


def test_nothing_is_infinitely_far_and_never_nan() -> None:
    result = score(np.zeros((0, 3)), plate())
    assert result.accuracy == result.completeness == result.overall == math.inf
    assert (result.accuracy_count, result.completeness_dropped) == (0, 1.0)
    values = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert values["overall"] is None


def test_thinning_keeps_its_distance_and_covers() -> None:
    points = np.random.default_rng(0).uniform(0, 3, (4000, 3))
    thin = thin_by_distance(points, 0.3, seed=0)
    assert len(cKDTree(thin).query_pairs(0.3 * (1 - 1e-12))) == 0
    assert cKDTree(thin).query(points)[0].max() < 0.3
    assert (thin == thin_by_distance(points, 0.3, seed=0)).all()
    assert not np.array_equal(thin, thin_by_distance(points, 0.3, seed=1))
    with pytest.raises(UsageError, match="larger density"):
        thin_by_distance(points, 1e-7, seed=0)


def test_resampling_leaves_no_gap_and_no_excess() -> None:
    rng = np.random.default_rng(1)
    corners = rng.normal(size=(40, 3, 3)) * rng.uniform(0.01, 3, (40, 1, 1))
    corners[20:, 2] = corners[20:, 0] + 0.02 * (corners[20:, 2] - corners[20:, 1])  # needles
    corners[38, :] = corners[38, 0]
    corners[39, 2] = (corners[39, 0] + corners[39, 1]) / 2
    vertices, faces = corners.reshape(-1, 3), np.arange(120).reshape(-1, 3)
    density = 0.05
    points = resample_mesh(vertices, faces, density)
    on_it = sample_uniformly(vertices, faces, 100_000, seed=0).points
    assert cKDTree(points).query(on_it)[0].max() <= density * (1 + 1e-9)
    assert cKDTree(points).query(vertices)[0].max() < 1e-12
    edges = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2).sum()
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(doubled, axis=1).sum() / 2
    assert len(points) < 1.2 * area / density**2 + 3 * edges / density + 40 * 6
    again = resample_mesh(vertices[::-1], (119 - faces), density)
    assert np.array_equal(points, again)


def test_what_cannot_be_measured_is_refused() -> None:
    assert resample_mesh(np.zeros((0, 3)), np.zeros((0, 3), int), 0.2).shape == (0, 3)
    vertices, faces = ball(1)
    for density in (0.0, -1.0, math.nan):
        with pytest.raises(UsageError):
            resample_mesh(vertices, faces, density)
    with pytest.raises(MeshingError, match="not finite"):
        resample_mesh(vertices * math.nan, faces, 0.2)
    for scale in (1e5, 1e150):
        with pytest.raises(ResourceError, match="too many points"):
            resample_mesh(vertices * scale, faces, 0.2)
    for options in (
        {"density": -1.0}, {"max_distance": 0.0}, {"patch": math.nan}, {"plane": np.zeros(3)},
    ):  # fmt: skip
        with pytest.raises(UsageError):
            score(plate(), plate(), **options)
    for points, truth in ((plate() * math.nan, plate()), (plate(), plate() + math.inf)):
        with pytest.raises(UsageError, match="not finite"):
            score(points, truth)
    cube = np.ones((2, 2, 2), bool)
    for volume, high, resolution in (
        (cube[0], np.ones(3), 1.0),
        (cube.astype(float), np.ones(3), 1.0),
        (cube, np.zeros(3), 1.0),
        (cube, np.ones(3), 0.0),
        (cube, np.full(3, math.nan), 1.0),
    ):
        with pytest.raises(UsageError, match="observation mask"):
            ObservationMask(volume, np.zeros(3), high, resolution)
