# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth surfaces known in closed form (docs/method.md, section 10.3)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import render_reference
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.scenes import isotropic, look_at, random_gaussians

EYES = [(2.0, 0.6, 0.9), (-0.3, -2.2, 1.4)]


def surface_points(gaussians: OrientedGaussians, camera: Camera) -> np.ndarray:
    """World points of all pixels with a depth, (p, 3)."""
    depth = render_reference(gaussians, camera, RenderOptions()).depth.numpy()
    local = (camera.rays() * depth[..., None])[depth > 0]
    return (local - camera.cam_from_world[:, 3]) @ camera.rotation


@pytest.mark.parametrize("alpha", [0.6, 0.8, 0.95, 0.98])
@pytest.mark.parametrize("eye", EYES)
def test_round_gaussian_is_a_sphere_from_anywhere(
    alpha: float, eye: tuple[float, float, float]
) -> None:
    center, sigma = (0.1, -0.05, 0.07), 0.3
    points = surface_points(isotropic([center], [sigma], [alpha]), look_at(eye, focal=60.0))
    radius = np.linalg.norm(points - center, axis=1)
    assert len(points) > 20
    wanted = sigma * math.sqrt(2.0 * math.log(2.0 * alpha))
    assert np.abs(radius - wanted).max() < 1e-9


def test_paper_number_at_095() -> None:
    points = surface_points(isotropic([(0.0, 0.0, 0.0)], [0.25], [0.95]), look_at(EYES[0]))
    assert np.linalg.norm(points, axis=1).mean() / 0.25 == pytest.approx(1.1330, abs=5e-5)


@pytest.mark.parametrize("eye", EYES)
def test_anisotropic_gaussian_is_its_own_level_ellipsoid(eye: tuple[float, float, float]) -> None:
    gaussians = random_gaussians(1, 3, spread=0.1, scale=(0.02, 0.4), opacity=(0.9, 0.9))
    points = surface_points(gaussians, look_at(eye, focal=250.0))
    arrays = gaussians.arrays()
    white = ((points - arrays.means[0]) @ arrays.rotations[0]) / arrays.scales[0]
    wanted = 2.0 * math.log(2.0) + 2.0 * arrays.log_opacities[0]
    assert len(points) > 20
    np.testing.assert_allclose((white * white).sum(1), wanted, atol=1e-9)


def test_silhouette_is_where_the_final_transmittance_passes_the_limit() -> None:
    sigma, alpha, limit = 0.3, 0.95, 0.45
    camera = look_at(EYES[0], focal=120.0, width=60, height=60)
    gaussians = isotropic([(0.0, 0.0, 0.0)], [sigma], [alpha])
    depth = render_reference(gaussians, camera, RenderOptions()).depth.numpy()
    rays = camera.rays()
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    center = camera.to_camera(np.zeros((1, 3)))[0]
    miss = np.linalg.norm(np.cross(rays, center), axis=2) / sigma
    np.testing.assert_array_equal(depth > 0, alpha * np.exp(-0.5 * miss**2) >= 1.0 - limit)


def test_two_in_a_row_and_the_front_one_is_faint() -> None:
    # T behind the first is 1 - a1 = 0.7, so the second must reach G = 1 - 0.5 / 0.7.
    camera = Camera("axis", 1, 1, 50.0, 50.0, 0.5, 0.5, np.eye(3, 4))
    first, second, sigma = 0.3, 0.9, 0.1
    gaussians = isotropic([(0.0, 0.0, 2.0), (0.0, 0.0, 4.0)], [sigma, sigma], [first, second])
    depth = float(render_reference(gaussians, camera, RenderOptions()).depth)
    level = 1.0 - 0.5 / (1.0 - first)
    wanted = 4.0 - sigma * math.sqrt(2.0 * math.log(second / level))
    assert depth == pytest.approx(wanted, abs=1e-12)


def test_two_in_a_row_and_the_front_one_is_dense() -> None:
    camera = Camera("axis", 1, 1, 50.0, 50.0, 0.5, 0.5, np.eye(3, 4))
    gaussians = isotropic([(0.0, 0.0, 2.0), (0.0, 0.0, 4.0)], [0.1, 0.1], [0.8, 0.9])
    depth = float(render_reference(gaussians, camera, RenderOptions()).depth)
    # The far one is 20 sigma away: it adds exp(-200) to the crossing of the near one.
    assert depth == pytest.approx(2.0 - 0.1 * math.sqrt(2.0 * math.log(1.6)), abs=1e-12)


def test_no_surface_below_half() -> None:
    for alpha in (0.2, 0.5, 0.549):
        points = surface_points(isotropic([(0.0, 0.0, 0.0)], [0.3], [alpha]), look_at(EYES[0]))
        assert len(points) == 0, alpha


def test_camera_inside_an_opaque_cloud_has_no_depth() -> None:
    # The near plane lets the mean through, but less than half of the light reaches t = 0.
    camera = Camera("axis", 3, 3, 5.0, 5.0, 1.5, 1.5, np.eye(3, 4))
    gaussians = isotropic([(0.0, 0.0, 0.5)], [2.0], [0.95])
    view = render_reference(gaussians, camera, RenderOptions())
    assert (view.alpha > 0.9).all()
    assert not view.depth.any()
