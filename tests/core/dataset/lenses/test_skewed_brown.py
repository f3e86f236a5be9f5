# SPDX-License-Identifier: GPL-3.0-or-later
"""Brown's polynomial with k4 and skew: against pycolmap where it has the model, and inverted."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.readers.lenses import (
    SkewedBrown,
    pinhole_of,
    project,
    sampling_map,
)
from gaussian_wrapping_addon.core.readers.source_model import SKEWED_BROWN, Brown, LensCamera

BENT = Brown(-0.2, 0.06, -0.01, 0.002, p1=0.003, p2=-0.002, skew=0.8)


def rays() -> np.ndarray:
    """Return (n, 3) rays over the whole photo of a lens of 100 pixels focal length."""
    x, y = np.meshgrid(np.linspace(-0.55, 0.55, 23), np.linspace(-0.45, 0.45, 19))
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)


def test_agrees_with_pycolmap_without_k4_and_skew() -> None:
    pytest.importorskip("pycolmap")
    focal, center = (100.0, 103.0), (60.0, 45.0)
    full = Brown(-0.2, 0.06, -0.01, p1=0.003, p2=-0.002).lens(120, 90, focal, center)
    assert full.model == "FULL_OPENCV"
    own = LensCamera(
        SKEWED_BROWN, 120, 90, (*focal, *center, 0.0, -0.2, 0.06, -0.01, 0.0, 0.003, -0.002)
    )
    np.testing.assert_allclose(project(own, rays()), project(full, rays()), rtol=0, atol=1e-11)


def test_every_pixel_leads_back_to_its_ray() -> None:
    camera = BENT.lens(120, 90, (100.0, 103.0), (60.0, 45.0))
    assert camera.model == SKEWED_BROWN
    lens = SkewedBrown(camera)
    back = lens.cam_from_img(lens.img_from_cam(rays()))
    np.testing.assert_allclose(back, rays()[:, :2], rtol=0, atol=1e-12)


def test_pixels_that_no_ray_reaches_are_not_a_number() -> None:
    camera = Brown(-0.4, k4=1e-3).lens(120, 90, (20.0, 20.0), (60.0, 45.0))
    slopes = SkewedBrown(camera).cam_from_img(np.array([[60.0, 45.0], [119.0, 45.0]]))
    np.testing.assert_allclose(slopes[0], 0.0, atol=1e-15)
    assert np.isnan(slopes[1]).all()


def test_resized_photos_and_undistortion() -> None:
    camera = BENT.lens(120, 90, (100.0, 103.0), (60.0, 45.0))
    half = camera.resized(60, 45)
    np.testing.assert_allclose(project(half, rays()), 0.5 * project(camera, rays()), atol=1e-12)
    pinhole = pinhole_of(camera)
    assert (pinhole.width, pinhole.height) > (100, 80)
    pixels = sampling_map(camera, pinhole)
    assert pixels.reshape(-1, 2).min() >= 0
    assert (pixels.reshape(-1, 2).max(0) <= [120, 90]).all()
