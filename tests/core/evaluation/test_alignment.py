# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarities are recovered from a surface without known pairs."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.evaluation.alignment import icp, pose_errors, refine_as_tanks
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from tests.core.evaluation.written_layouts import rotation_about

TRUE = Similarity(3.7, rotation_about([1, 2, -1], 131.0), np.array([5.0, -2.0, 0.3]))


def bumpy_sphere(count: int) -> np.ndarray:
    """Return points of a surface without symmetry."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (1 + 5**0.5) * i
    d = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], 1)
    radius = 1 + 0.15 * np.sin(3 * d[:, 0]) + 0.1 * np.cos(4 * d[:, 1] + 1) + 0.2 * d[:, 2] ** 3
    return d * radius[:, None]


@pytest.mark.parametrize("with_scale", [False, True])
def test_icp_converges_on_a_perturbed_surface(with_scale: bool) -> None:
    target = bumpy_sphere(4000) + np.array([2e5, 0, 1e5])
    scale = 1.02 if with_scale else 1.0
    nudge = Similarity(scale, rotation_about([0, 1, 1], 4.0), np.array([0.03, -0.02, 0.04]))
    center = target.mean(0)
    # source = what the nudge (about the centre) maps to the target.
    source = nudge.inverse().points(target - center) + center
    found, many = (
        icp(
            source, target, Similarity(), max_distance=0.5, iterations=300, with_scale=with_scale,
            threads=threads,
        )
        for threads in (1, 2)
    )  # fmt: skip
    assert found.converged
    assert found.fitness == 1.0
    assert np.linalg.norm(found.transform.points(source) - target, axis=1).max() < 1e-6
    assert found.rmse < 1e-6
    assert with_scale or found.transform.scale == pytest.approx(1.0, abs=1e-12)
    assert (many.transform.matrix() == found.transform.matrix()).all()


def test_icp_leaves_far_points_out_and_refuses_what_it_cannot_pair() -> None:
    target = bumpy_sphere(2000)
    source = np.concatenate([target + np.array([0.02, 0, 0]), target[:500] + np.array([9.0, 0, 0])])
    found = icp(source, target, Similarity(), max_distance=0.3, iterations=200, with_scale=False)
    assert found.fitness == 2000 / 2500
    np.testing.assert_allclose(found.transform.translation, [-0.02, 0, 0], atol=1e-6)
    for source, words in (
        (target + 50.0, "initial alignment is wrong"),
        (target[:2], "at least 3 source points"),
    ):
        with pytest.raises(DatasetError, match=words):
            icp(source, target, Similarity(), max_distance=0.1, with_scale=True)


def test_the_three_stages_find_a_surface_that_is_sampled_elsewhere() -> None:
    target, other = bumpy_sphere(20_000), bumpy_sphere(17_001)
    nudge = Similarity(1.01, rotation_about([1, 0, 1], 2.0), np.array([0.02, 0.03, -0.01]))
    source = nudge.inverse().points(other)
    source = np.concatenate([source, source[:300] + 4.0])  # debris outside of the crop
    found = refine_as_tanks(
        source, target, Similarity(), 0.05, inside=lambda p: np.linalg.norm(p, axis=1) < 2.0
    )
    assert len(found.stages) == 3
    assert found.stages[-1].fitness == 1.0
    # The surfaces are met to a tenth of the threshold, though no two samples coincide.
    assert np.abs(found.transform.points(source[:17_001]) - other).max() < 0.1 * 0.05


def camera(name: str, rotation: np.ndarray, center: np.ndarray) -> Camera:
    pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
    return Camera(name, 40, 30, 50.0, 50.0, 20.0, 15.0, pose)


def test_pose_errors_have_their_closed_form() -> None:
    rng = np.random.default_rng(5)
    # Centres in the corners of a cube: their spread is the half diagonal, sqrt(3).
    centers = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    turns = [rotation_about(list(rng.normal(size=3)), 360 * rng.random()) for _ in centers]
    true = [camera(f"{i}.png", r, c) for i, (r, c) in enumerate(zip(turns, centers, strict=True))]
    exact = pose_errors([c.moved(TRUE) for c in reversed(true)], true)
    assert exact.names == tuple(f"{i}.png" for i in range(8))
    assert exact.spread == pytest.approx(3**0.5)
    assert exact.center_shares.max() < 1e-13
    assert exact.rotation_degrees.max() < 1e-6
    # Growing by a share is undone by the scale; turning every camera in place is not.
    turned = [
        camera(f"{i}.png", rotation_about([0, 0, 1], 0.5 * (i + 1)) @ r, 1.5 * c)
        for i, (r, c) in enumerate(zip(turns, centers, strict=True))
    ]
    found = pose_errors([c.moved(TRUE) for c in turned], true)
    assert found.center_shares.max() < 1e-13
    np.testing.assert_allclose(found.rotation_degrees, 0.5 * np.arange(1, 9), atol=1e-9)
    assert found.to_json()["rotation_degrees_median"] == pytest.approx(2.25)
    # A twist that no rotation takes up; the scale shrinks to 3 / (3 + e^2), which is closed form.
    shifts = 0.1 * np.array([np.prod(c) * np.array([1.0, 0, 0]) for c in centers])
    moved = [
        camera(f"{i}.png", r, c + s)
        for i, (r, c, s) in enumerate(zip(turns, centers, shifts, strict=True))
    ]
    found = pose_errors(moved, [*true, camera("more.png", np.eye(3), np.zeros(3))])
    expected = np.linalg.norm(3 / 3.01 * (centers + shifts) - centers, axis=1) / 3**0.5
    np.testing.assert_allclose(found.center_shares, expected, rtol=1e-10)
    assert 0.055 < expected.min() < expected.max() < 0.06
    assert found.missing == ("more.png",)


def test_pose_errors_need_common_names() -> None:
    some = [camera(f"{i}.png", np.eye(3), np.eye(3)[i]) for i in range(3)]
    with pytest.raises(DatasetError, match="2 of 2 true cameras"):
        pose_errors(some, some[:2])
    with pytest.raises(DatasetError, match="Two solved cameras"):
        pose_errors([*some, some[0]], some)
