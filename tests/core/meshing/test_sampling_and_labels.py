# SPDX-License-Identifier: GPL-3.0-or-later
"""Sampling of triangles, thinning, pivots, and the minimum cut against exhaustive search."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gaussian_wrapping_addon.core.mesh.sampling import sample_triangles, thin
from gaussian_wrapping_addon.core.meshing.classification import regularised
from gaussian_wrapping_addon.core.meshing.pivots import representative_gaussians
from tests.core.field.field_scenes import random_arrays


def test_samples_are_uniform_over_triangles() -> None:
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5.0]])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    rng = np.random.default_rng(0)
    points, face = sample_triangles(vertices, faces, 200_000, rng)
    assert (face == 0).mean() == pytest.approx(0.75, abs=1e-4)
    local = points[face == 0] / [3, 1, 1]
    # Uniform on the unit right triangle: mean 1/3, variance 1/18, covariance -1/36.
    np.testing.assert_allclose(local[:, :2].mean(0), 1 / 3, atol=2e-3)
    covariance = np.cov(local[:, :2].T)
    np.testing.assert_allclose(covariance, [[1 / 18, -1 / 36], [-1 / 36, 1 / 18]], atol=6e-4)
    _, weighted = sample_triangles(vertices, faces, 10_000, rng, np.array([1.0, 3.0]))
    assert (weighted == 0).mean() == pytest.approx(0.5, abs=1e-3)


def test_thinning_keeps_a_maximal_set_a_radius_apart() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(size=(6000, 3)) * [1, 1, 0.05]
    normals = np.zeros((6000, 3))
    kept = thin(points, normals, np.full(6000, 0.06), rng.random(6000))
    tree = cKDTree(points[kept])
    assert tree.query(points[kept], k=2)[0][:, 1].min() >= 0.06
    assert tree.query(points)[0].max() < 0.06
    assert thin(points[:0], normals[:0], np.zeros(0), np.zeros(0)).shape == (0,)
    points[:, 2] = 0.0
    kept = thin(points, normals, np.where(points[:, 0] < 0.5, 0.02, 0.08), rng.random(6000))
    left, right = (kept[side].sum() for side in (points[:, 0] < 0.48, points[:, 0] > 0.52))
    assert 9 < left / right < 20  # areas of the discs differ by 16


def test_thinning_obeys_priority_and_keeps_both_sides_of_a_wall() -> None:
    points = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0, -0.02], [0, 0, -0.0001]])
    normals = np.array([[0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, -1.0]])
    radii = np.full(4, 0.1)
    assert thin(points, normals, radii, np.array([0, 1, 2, 3.0])).tolist() == [1, 0, 1, 0]
    assert thin(points, normals, radii, np.array([1, 0, 3, 2.0])).tolist() == [0, 1, 0, 1]


def test_representatives_are_few_and_cover_space() -> None:
    arrays = random_arrays(5000, 4)
    index = representative_gaussians(arrays, np.arange(5000), 800)
    assert 300 < len(index) <= 800
    far = cKDTree(arrays.means[index]).query(arrays.means)[0]
    assert np.quantile(far, 0.99) < 1.0
    np.testing.assert_array_equal(
        representative_gaussians(arrays, np.arange(700), 800), np.arange(700)
    )


def energy(
    label: np.ndarray, start: np.ndarray, vacancy: np.ndarray, links: np.ndarray, areas: np.ndarray
) -> float:
    """The energy that ``regularised`` promises to minimise, over all tetrahedra."""
    theirs = np.where(links >= 0, label[links], False)
    total = 0.0
    for i in range(len(label)):
        for k in range(4):
            if links[i, k] < 0:
                total += areas[i, k] * label[i]
            elif links[i, k] > i:
                total += areas[i, k] * (theirs[i, k] != label[i])
        if label[i] != start[i]:
            total += 2 * abs(vacancy[i] - 0.5) * areas[i].mean()
    return total


@pytest.mark.parametrize("seed", range(6))
def test_minimum_cut_is_the_best_of_all_labels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 14
    links = np.full((count, 4), -1)
    areas = rng.uniform(0.2, 1.0, (count, 4))
    slots = [(i, k) for i in range(count) for k in range(4)]
    rng.shuffle(slots)
    for (i, k), (j, m) in itertools.pairwise(slots[:44]):
        if i != j and links[i, k] < 0 and links[j, m] < 0 and j not in links[i]:
            links[i, k], links[j, m] = j, i
            areas[j, m] = areas[i, k]
    vacancy = rng.random(count)
    start = vacancy < 0.5
    free = np.zeros(count, bool)
    free[:10] = True
    best = regularised(start, vacancy, free, links, areas)
    np.testing.assert_array_equal(best[~free], start[~free])
    energies = []
    for bits in itertools.product([False, True], repeat=10):
        label = start.copy()
        label[:10] = bits
        energies.append(energy(label, start, vacancy, links, areas))
    assert energy(best, start, vacancy, links, areas) == pytest.approx(min(energies), abs=2e-2)
