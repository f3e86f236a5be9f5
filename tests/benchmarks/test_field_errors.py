# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth and vacancy errors against surfaces that are known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from benchmarks.field_errors import depth_errors, rendered_depths, vacancy_errors
from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.field.field_scenes import camera_at, unit_sphere
from tests.poses import look_at_pose

ALPHA, SIGMA = 0.9, 0.4


RADIUS = SIGMA * math.sqrt(2.0 * math.log(2.0 * ALPHA))


"""One round Gaussian's isosurface is a sphere of this radius from everywhere.

See docs/method.md, section 10.3.
"""


THRESHOLDS = (0.005, 0.02)


def ball() -> OrientedGaussians:
    return OrientedGaussians(
        means=torch.zeros(1, 3),
        log_scales=torch.full((1, 3), math.log(SIGMA)),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logits=torch.tensor([math.log(ALPHA / (1.0 - ALPHA))]),
        sh=torch.zeros(1, 1, 3),
        orientation=torch.zeros(1, 4),
        filter_3d=torch.zeros(1),
    )


def sphere(radius: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(5, radius)


def cameras() -> list:
    return [camera_at(3.0 * direction) for direction in unit_sphere(6)]


def isosurface(views: list):
    return rendered_depths(ball(), views, 1)


def test_the_right_surface_has_no_error() -> None:
    mesh = sphere(RADIUS)
    depth = depth_errors(isosurface(cameras()), mesh.vertices, mesh.faces, THRESHOLDS)
    assert depth.pixels > 10_000
    # Depth needs T <= 0.45 behind the ray's peak, which rays near the silhouette do not reach: the
    # discs q_min < 2 ln(alpha / 0.55) and q_min < 2 ln(2 alpha) differ by this ratio of areas.
    valid = math.log(ALPHA / (1.0 - limits.DEPTH_VALID_TRANSMITTANCE)) / math.log(2 * ALPHA)
    assert depth.found == pytest.approx(valid, abs=0.01)
    assert depth.median < 2e-4  # the facets lie up to 3e-4 of the radius below the sphere
    assert depth.within[1] == depth.found
    field = VacancyField(ball().arrays(), cameras())
    points = unit_sphere(500)
    vacancy = vacancy_errors(field, RADIUS * points, points, THRESHOLDS)
    assert vacancy.found == 1.0
    assert vacancy.median < 1e-4
    assert vacancy.within == (1.0, 1.0)


@pytest.mark.parametrize("offset", [0.01, -0.01])
def test_a_known_offset_is_measured_with_its_sign(offset: float) -> None:
    """Judged against a sphere that is ``offset`` smaller, the isosurface lies outside by it."""
    mesh = sphere(RADIUS - offset)
    depth = depth_errors(isosurface(cameras()), mesh.vertices, mesh.faces, THRESHOLDS)
    assert 0.0099 < depth.median < 0.015  # along slanted rays the gap is longer than the normal
    assert depth.within[0] == 0.0
    assert depth.within[1] > 0.5
    field = VacancyField(ball().arrays(), cameras())
    points = unit_sphere(500)
    vacancy = vacancy_errors(field, (RADIUS - offset) * points, points, THRESHOLDS)
    assert vacancy.median_offset == pytest.approx(offset, abs=1e-4)
    assert vacancy.within == (0.0, 1.0)


def test_depth_is_compared_along_the_ray_far_off_the_axis() -> None:
    """Hits of two spheres in closed form, where a unit of z is 1.1 to 1.5 units of the ray."""
    eye, offset = np.array([0.2, -3.0, 0.3]), 0.01
    camera = Camera("wide", 420, 300, 260.0, 265.0, 203.0, 148.0, look_at_pose(eye, (2.2, 0, 0.9)))
    x, y = np.meshgrid(np.arange(420) + 0.5, np.arange(300) + 0.5)
    rays = np.stack([(x - 203.0) / 260.0, (y - 148.0) / 265.0, np.ones_like(x)], -1)
    stretch = np.linalg.norm(rays, axis=-1)
    along = (rays / stretch[..., None]) @ camera.cam_from_world[:, 3]  # to the nearest approach
    missed_sq = eye @ eye - along**2  # (h, w) squared distance of the ray from the middle
    shown = missed_sq < (RADIUS - offset) ** 2
    # See above: the ray's peak has to leave T <= 0.45 behind it.
    limit = SIGMA**2 * 2.0 * math.log(ALPHA / (1.0 - limits.DEPTH_VALID_TRANSMITTANCE))
    valid = missed_sq < limit
    assert 1.1 < stretch[valid].min() < 1.3 < stretch[valid].max() < 1.5
    reach = [np.sqrt(radius**2 - missed_sq[valid]) for radius in (RADIUS, RADIUS - offset)]
    gaps = reach[0] - reach[1]  # along the ray, from the outer sphere to the inner one
    mesh = trimesh.creation.icosphere(6, RADIUS - offset)
    depth = depth_errors(isosurface([camera]), mesh.vertices, mesh.faces, (float(np.median(gaps)),))
    assert depth.pixels == pytest.approx(shown.sum(), rel=2e-3)
    assert depth.found == pytest.approx(valid.sum() / shown.sum(), abs=3e-3)
    assert depth.median == pytest.approx(np.median(gaps), rel=5e-3)
    assert depth.percentile_95 == pytest.approx(np.percentile(gaps, 95), rel=2e-2)


def test_what_is_missing_is_counted_as_missing() -> None:
    far = sphere(RADIUS)
    far.apply_translation([0.0, 0.0, 2.0 * RADIUS])
    depth = depth_errors(isosurface(cameras()[2:4]), far.vertices, far.faces, THRESHOLDS)
    assert depth.found < 0.9
    field = VacancyField(ball().arrays(), cameras())
    points = unit_sphere(100)
    vacancy = vacancy_errors(field, 3.0 * RADIUS * points, points, THRESHOLDS)
    assert vacancy.found == 0.0
    assert vacancy.within == (0.0, 0.0)


def test_nothing_to_compare_is_refused() -> None:
    mesh = sphere(RADIUS)
    behind = np.add(mesh.vertices, [0.0, 0.0, 1e4])
    with pytest.raises(UsageError, match="No pixel"):
        depth_errors(isosurface(cameras()[:1]), behind, mesh.faces, THRESHOLDS)
    with pytest.raises(UsageError, match="no sample"):
        vacancy_errors(
            VacancyField(ball().arrays(), cameras()), np.zeros((0, 3)), np.zeros((0, 3)), THRESHOLDS
        )
