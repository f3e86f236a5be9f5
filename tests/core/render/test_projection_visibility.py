# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians that the projection hides: faint, behind, off-screen, sub-pixel, not finite."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.render.reference import reference_projection

from .projections import AXIS, CAMERA, OPTIONS, project, single
from .scenes import isotropic, random_gaussians


@pytest.mark.parametrize(
    ("logit", "seen"), [(20.0, True), (800.0, True), (-20.0, False), (-5.6, False), (-5.5, True)]
)
def test_extreme_opacities(logit: float, seen: bool) -> None:
    screen = project(single(opacity_logits=logit), AXIS)
    assert screen.visible[0] == seen
    if seen:
        assert screen.params[0, 11] == np.float32(1.0 / (1.0 + np.exp(-logit)))


def test_filter_dims_and_widens() -> None:
    screen = project(single(filter_3d=0.1, log_scales=[np.log(0.1)] * 3), AXIS)
    assert screen.params[0, 11] == pytest.approx(0.8 * 2.0**-1.5, rel=1e-6)
    assert screen.params[0, 22] == pytest.approx(0.1 * 2.0**0.5, rel=1e-6)
    # A vanishing scale leaves nothing of the opacity and is not visible.
    assert not project(single(filter_3d=0.1, log_scales=[-400.0] * 3), AXIS).visible[0]


@pytest.mark.parametrize(
    "name", ["means", "log_scales", "quats", "opacity_logits", "sh", "orientation", "filter_3d"]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_hide_the_gaussian(name: str, value: float) -> None:
    gaussians = isotropic([(0.1, -0.2, 3.0), (0.2, 0.1, 3.0)], [0.1, 0.1], [0.8, 0.8])
    broken = getattr(gaussians, name).clone()
    broken[0] = value
    screen = project(gaussians.replaced(**{name: broken}), AXIS)
    if name == "opacity_logits" and value == np.inf:
        assert screen.params[0, 11] == 1.0  # an opaque limit that is well defined
    else:
        assert not screen.visible[0]
        assert not screen.params[0].any()
    assert screen.visible[1]
    assert np.isfinite(screen.params).all()


def test_around_and_behind_the_camera() -> None:
    near = {"log_scales": [0.0] * 3}
    around = project(single(means=[0.0, 0.0, 0.5], **near), AXIS)
    assert around.visible[0]
    np.testing.assert_array_equal(around.boxes[0], [0.0, 0.0, 64.0, 48.0])
    assert np.isinf(around.skews[0])
    for z in (0.2, 0.0, -1.0):
        assert not project(single(means=[0.0, 0.0, z], **near), AXIS).visible[0]
    # Bounded as soon as the ellipsoid at 1/255 clears the camera plane.
    reach = np.sqrt(2.0 * np.log(255.0 * 0.8))
    assert np.isinf(project(single(means=[0.0, 0.0, 0.999 * reach], **near), AXIS).skews[0])
    assert np.isfinite(project(single(means=[0.0, 0.0, 1.001 * reach], **near), AXIS).skews[0])


@pytest.mark.parametrize("seed", range(4))
def test_culling_leaves_out_only_what_is_not_seen(seed: int) -> None:
    """Exactly those are visible whose box, by the reference's columns, holds a pixel centre."""
    gaussians = random_gaussians(3000, seed, spread=4.0, scale=(0.003, 1.5), filter_size=0.05)
    # Also around the limit of what is too faint.
    gaussians.opacity_logits[::3] = torch.linspace(-6.0, -5.0, 1000, dtype=torch.float64)
    camera = dataclasses.replace(CAMERA, cx=-7.0 if seed == 1 else CAMERA.cx)
    screen = project(gaussians, camera)
    reference = reference_projection(gaussians, camera, OPTIONS)
    opacity = torch.exp(gaussians.log_opacities())
    local = gaussians.means @ torch.from_numpy(camera.rotation).T
    local += torch.from_numpy(camera.cam_from_world[:, 3])
    axes = torch.from_numpy(camera.rotation) @ gaussians.rotations()
    scaled = axes * gaussians.scales()[:, None]
    covariance = scaled @ scaled.transpose(1, 2)
    # Dual conic of the ellipsoid at 1/255 as a plane sees it: K (m m^T - threshold Sigma) K^T.
    threshold = 2.0 * torch.log(opacity * 255.0)[:, None, None]
    dual = local[:, :, None] * local[:, None] - threshold * covariance
    lens = torch.tensor(
        [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]],
        dtype=torch.float64,
    )
    dual = (lens @ dual @ lens.T).numpy()
    usable = reference.usable.numpy()
    bounded = usable & (dual[:, 2, 2] > 0.0)
    assert (usable & ~bounded).sum() > 10
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = dual[:, [0, 1], 2] / dual[:, 2:, 2]
        half = np.sqrt(middle**2 - dual[:, [0, 1], [0, 1]] / dual[:, 2:, 2])
        first = np.maximum(np.ceil(middle - half - 0.5), 0.0)
        last = np.minimum(np.floor(middle + half - 0.5), [camera.width - 1.0, camera.height - 1.0])
        wanted = usable & (~bounded | (first <= last).all(1))
    np.testing.assert_array_equal(screen.visible, wanted)
    assert 100 < wanted.sum() < 2500


def test_off_the_image_or_between_pixel_centres_is_not_visible() -> None:
    assert not project(single(means=[9.0, 0.0, 3.0]), AXIS).visible[0]
    tiny = {"log_scales": [np.log(1e-5)] * 3}
    on_center = project(single(means=[0.0, 0.0, 3.0], **tiny), AXIS)
    assert on_center.visible[0]
    between = dataclasses.replace(AXIS, cx=32.0)
    assert not project(single(means=[0.0, 0.0, 3.0], **tiny), between).visible[0]
