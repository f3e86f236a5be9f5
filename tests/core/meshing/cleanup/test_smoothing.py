# SPDX-License-Identifier: GPL-3.0-or-later
"""Smoothing lowers noise and preserves volume, closedness, caps and thin parts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.meshing.clean_up import smooth
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.meshing.closed_shapes import Mesh, ball, joined, noisy, ring, slab, wire


def smoothed(mesh: Mesh, steps: int, region: Region | None = None) -> np.ndarray:
    return smooth(*mesh, steps, Progress(), region=region)


def test_noise_on_a_ball_goes_and_the_ball_stays() -> None:
    mesh = noisy(ball(4), 0.01)
    after = smoothed(mesh, 10)
    errors = [np.abs(np.linalg.norm(points, axis=1) - 1).std() for points in (mesh[0], after)]
    assert errors[1] < 0.4 * errors[0]
    assert np.linalg.norm(after, axis=1).mean() == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("steps", [1, 10, 40])
@pytest.mark.parametrize(
    "make", [lambda: noisy(ring(), 0.01), wire, lambda: slab((1, 1, 0.005), 0.1),
             lambda: joined(ball(2), (wire()[0] + 3, wire()[1])), lambda: ball(0)],
)  # fmt: skip
def test_every_part_keeps_its_volume_and_the_mesh_stays_good(
    make: Callable[[], Mesh], steps: int
) -> None:
    mesh = make()
    before, after = validate_manifold(*mesh), validate_manifold(smoothed(mesh, steps), mesh[1])
    assert after.good, after.defects()
    for first, second in zip(before.parts, after.parts, strict=True):
        assert second.genus == first.genus
        assert second.volume == pytest.approx(first.volume, rel=0.0101)


def test_a_part_too_coarse_for_the_filter_stays_as_it_was() -> None:
    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    flat = tetrahedron * [1, 1, 1e-3]
    after = smoothed((flat, faces), 30)
    check = validate_manifold(after, faces)
    assert check.good
    assert check.volume == pytest.approx(validate_manifold(flat, faces).volume, rel=0.0101)


def test_caps_stay_in_their_planes_and_the_mesh_in_its_region() -> None:
    vertices, faces = slab((1, 1, 1), 0.15)
    region = Region.box("cut", [-1.5, -1.5, -1.5], [1.0, 1.0, 1.0])
    on_cap = np.abs(vertices - 1.0) < 1e-12  # (v, 3)
    free = ~on_cap.any(1)
    vertices = vertices.copy()
    vertices[free] += 0.01 * np.random.default_rng(0).normal(size=(free.sum(), 3))
    vertices[free] = np.minimum(vertices[free], 0.999)
    after = smoothed((vertices, faces), 8, region)
    assert (np.abs(after - 1.0)[on_cap] < 1e-12).all()
    assert region.contains(after, 1e-12).all()
    corner = on_cap.all(1)
    np.testing.assert_array_equal(after[corner], vertices[corner])
    assert (after[free] != vertices[free]).any(1).mean() > 0.9
    assert validate_manifold(after, faces).good


def test_a_boundary_stays_where_it_is() -> None:
    vertices, faces = noisy(ball(3), 0.01)
    faces = faces[(ball(3)[0][faces][:, :, 2] <= 0.0).all(1)]
    used, index = np.unique(faces, return_inverse=True)
    vertices, rim = vertices[used], np.abs(ball(3)[0][used][:, 2]) < 1e-9
    after = smoothed((vertices, index.reshape(-1, 3)), 5)
    np.testing.assert_array_equal(after[rim], vertices[rim])
    assert (after[~rim] != vertices[~rim]).any()


@pytest.mark.parametrize(("scale", "shift"), [(2.0**-10, 0.0), (2.0**13, 0.0), (1.0, 2.0**22)])
def test_neither_scale_nor_place_changes_the_result(scale: float, shift: float) -> None:
    vertices, faces = noisy(ring(60, 20), 0.01)
    vertices = np.round(vertices * 2**20) / 2**20
    here = smoothed((vertices, faces), 5)
    there = (smoothed((vertices * scale + shift, faces), 5) - shift) / scale
    assert np.abs(here - there).max() < 1e-7


def test_no_steps_and_no_faces_change_nothing_and_it_can_be_cancelled() -> None:
    mesh = ball(1)
    np.testing.assert_array_equal(smoothed(mesh, 0), mesh[0])
    assert len(smoothed((np.zeros((0, 3)), np.zeros((0, 3), int)), 3)) == 0
    with pytest.raises(Cancelled):
        smooth(*mesh, 3, Progress(is_cancelled=lambda: True))
