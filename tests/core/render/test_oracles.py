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
from tests.core.render.scenes import isotropic, look_at

EYES = [(2.0, 0.6, 0.9), (-0.3, -2.2, 1.4)]


def surface_points(gaussians: OrientedGaussians, camera: Camera) -> np.ndarray:
    """World points of all pixels with a depth, (p, 3)."""
    depth = render_reference(gaussians, camera, RenderOptions()).depth.numpy()
    local = (camera.rays() * depth[..., None])[depth > 0]
    return (local - camera.cam_from_world[:, 3]) @ camera.rotation


@pytest.mark.parametrize("alpha", [0.6, 0.95, 0.98])
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
    if alpha == 0.95:
        assert radius.mean() / sigma == pytest.approx(1.1330, abs=5e-5)  # the paper's number


@pytest.mark.parametrize(
    ("front", "wanted"),
    [
        # T behind the first is 1 - 0.3, so the second must reach G = 1 - 0.5 / 0.7.
        (0.3, 4.0 - 0.1 * math.sqrt(2.0 * math.log(0.9 / (1.0 - 0.5 / 0.7)))),
        # The far one is 20 sigma away: it adds exp(-200) to the crossing of the near one.
        (0.8, 2.0 - 0.1 * math.sqrt(2.0 * math.log(1.6))),
    ],
)
def test_two_in_a_row(front: float, wanted: float) -> None:
    camera = Camera("axis", 1, 1, 50.0, 50.0, 0.5, 0.5, np.eye(3, 4))
    gaussians = isotropic([(0.0, 0.0, 2.0), (0.0, 0.0, 4.0)], [0.1, 0.1], [front, 0.9])
    depth = float(render_reference(gaussians, camera, RenderOptions()).depth)
    assert depth == pytest.approx(wanted, abs=1e-12)
