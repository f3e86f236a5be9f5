# SPDX-License-Identifier: GPL-3.0-or-later
"""Hard cases 4 and 12 of the kernels: Gaussians around the camera, and unusual cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.poses import look_at_pose

from .comparisons import images_of, judge, leaves
from .first_principles import IMAGES
from .scenes import coloured, front_camera, isotropic, look_at, one_gaussian, random_gaussians

DIGITS = 60


# -- item 4: around the camera ---------------------------------------------------------------------


def test_item_04_camera_inside_gaussians() -> None:
    gaussians = coloured(
        isotropic(
            [(0.0, -3.4, 0.0), (0.3, -2.0, 0.2), (0.0, 5.0, 0.0)], [1.5, 2.5, 30.0], [0.3, 0.6, 0.7]
        )
    )
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-5, gradient=1e-5)
    assert verdict.found["alpha"].min() > 0.8


@pytest.mark.parametrize("scales", [(0.3, 2.0, 0.3), (2.0, 0.3, 2.0), (3.0, 3.0, 0.1)])
def test_item_04_camera_inside_an_anisotropic_one(scales: tuple[float, float, float]) -> None:
    gaussians = one_gaussian(scales, 0.95, (0.1, -3.5, 0.05), 0.6, 0)
    verdict = judge(gaussians, front_camera(), digits=DIGITS)
    verdict.assert_within(blended=1e-6, depth=2e-5, gradient=1e-5, depth_gradient=1e-3)
    assert verdict.found["alpha"].max() > 0.3


def test_item_04_gaussians_across_the_near_plane() -> None:
    # Depths 0.3, 0.21 and 0.19 with near 0.2: two are rendered, whole; the third is not at all.
    gaussians = coloured(
        isotropic(
            [(0.1, -3.7, 0.0), (0.0, -3.79, 0.05), (0.0, -3.81, 0.0)],
            [0.3, 0.1, 0.3],
            [0.5, 0.7, 0.9],
        )
    )
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=2e-5, gradient=1e-5, depth_gradient=1e-3)
    alone = judge(gaussians.select(torch.tensor([0, 1])), front_camera(4, 3), gradients=False)
    for name in IMAGES:
        np.testing.assert_array_equal(alone.found[name], verdict.found[name])


def test_item_04_a_peak_behind_the_camera_of_a_slanted_ray() -> None:
    # Centre in front of the near plane, maximum along the outer rays at negative depth.
    gaussians = one_gaussian((3.0, 3.0, 0.05), 0.9, (0.0, -3.6, 0.3), 0.9, 0)
    gaussians = OrientedGaussians(
        **{
            name: torch.cat([value, other])
            for (name, value), (_, other) in zip(
                gaussians.tensors(),
                coloured(isotropic([(0.0, 0.0, 0.0)], [1.0], [0.9]), 3).tensors(),
                strict=True,
            )
        }
    )
    verdict = judge(gaussians, front_camera(6, 5, focal=3.0), digits=DIGITS, gradient_digits=0)
    verdict.assert_within(blended=2e-6, depth=2e-5, gradient=5e-5, depth_gradient=1e-3)
    assert verdict.found["alpha"].max() > 0.5


def test_item_04_larger_than_the_scene() -> None:
    gaussians = coloured(
        isotropic([(0.0, 3.0, 0.0), (20.0, 400.0, 30.0)], [50.0, 500.0], [0.3, 0.9])
    )
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, gradient=1e-5)
    assert verdict.found["alpha"].min() > 0.85


def test_item_04_behind_the_camera_is_nothing() -> None:
    gaussians = coloured(isotropic([(0.0, -5.0, 0.0), (0.3, -4.1, 0.0)], [3.0, 0.5], [0.9, 0.9]))
    verdict = judge(gaussians, front_camera())
    verdict.assert_within(blended=1e-8)
    assert not verdict.found["alpha"].any()


# -- item 12: cameras ------------------------------------------------------------------------------


def cloud(count: int = 40, spread: float = 0.8) -> OrientedGaussians:
    return random_gaussians(count, 17, spread=spread, opacity=(0.3, 0.97))


@pytest.mark.parametrize(
    ("width", "height"), [(1, 1), (37, 1), (1, 23), (17, 16), (16, 16), (33, 47), (15, 31)]
)
def test_item_12_any_image_size(width: int, height: int) -> None:
    camera = look_at((2.2, 1.0, 0.8), width=width, height=height, focal=20.0)
    verdict = judge(cloud(), camera)
    verdict.assert_within(blended=1e-6, depth=1e-5)
    assert verdict.found["alpha"].max() > 0.5


def test_item_12_a_crop_is_the_same_image() -> None:
    whole = look_at((2.2, 1.0, 0.8), width=45, height=38, focal=60.0)
    gaussians = leaves(cloud(), torch.float32)
    with torch.no_grad():
        full = images_of(render(gaussians, whole, RenderOptions()))
        for left, top, width, height in [(0, 0, 16, 16), (7, 5, 30, 21), (44, 37, 1, 1)]:
            camera = replace(
                whole, width=width, height=height, cx=whole.cx - left, cy=whole.cy - top
            )
            part = images_of(render(gaussians, camera, RenderOptions()))
            for name in IMAGES:
                np.testing.assert_allclose(
                    part[name],
                    full[name][top : top + height, left : left + width],
                    atol=1e-6 if name != "depth" else 3e-5,
                    err_msg=name,
                )


@pytest.mark.parametrize(("cx", "cy"), [(-400.0, 300.0), (-4000.0, 30.0), (60.0, 5e4)])
def test_item_12_principal_point_far_off_the_image(cx: float, cy: float) -> None:
    # The camera looks past the scene; the image is a crop far from its axis.
    focal = 2000.0
    direction = np.array([(12.0 - cx) / focal, (10.0 - cy) / focal, 1.0])
    pose = look_at_pose((3.0, 0.5, 0.4))
    forward = pose[:, :3].T @ (direction / np.linalg.norm(direction))
    # Move the eye so that the oblique ray through the image's centre meets the origin.
    eye = -3.0 * forward
    pose = np.concatenate([pose[:, :3], -(pose[:, :3] @ eye)[:, None]], 1)
    near = 0.02
    camera = Camera("shifted", 24, 20, focal, focal, cx, cy, pose)
    gaussians = random_gaussians(30, 5, spread=0.02, scale=(0.002, 0.01), opacity=(0.3, 0.97))
    gaussians = gaussians.replaced(filter_3d=torch.zeros(30).double())
    verdict = judge(gaussians, camera, near_z=near)
    verdict.assert_within(blended=1e-5, depth=1e-5, gradient=1e-4, depth_gradient=2e-3)
    assert verdict.found["alpha"].max() > 0.5
    assert verdict.depth_count > 20


def test_item_12_120_degrees_wide() -> None:
    focal = 18.5 / math.tan(math.radians(60.0))
    camera = replace(front_camera(37, 21, distance=1.0), fx=focal, fy=focal)
    verdict = judge(cloud(60, 3.0), camera)
    verdict.assert_within(blended=3e-6, depth=1e-5, depth_count=5)


def test_item_12_very_different_focal_lengths() -> None:
    camera = replace(look_at((2.2, 1.0, 0.8), width=40, height=30, focal=30.0), fy=300.0)
    verdict = judge(cloud(), camera)
    verdict.assert_within(blended=3e-6, depth=1e-5)


def test_item_12_identical_cameras_render_identically() -> None:
    camera = look_at((2.2, 1.0, 0.8))
    results = []
    for _ in range(2):
        leaf = leaves(cloud(), torch.float32)
        view = render(leaf, replace(camera), RenderOptions())
        sum(getattr(view, name).square().sum() for name in IMAGES).backward()
        results.append([*images_of(view).values(), leaf.means.grad.numpy()])
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("eye", [(0.0, 0.0, 3.0), (0.0, 0.0, -3.0), (3.0, 0.0, 0.0)])
def test_item_12_along_the_axes_of_the_harmonics(eye: tuple[float, float, float]) -> None:
    # Directions at the poles of the harmonics, exactly: their gradient has no seam there.
    means = [(0.0, 0.0, 0.0), (0.2, 0.0, 0.1)]
    gaussians = isotropic(means, [0.3, 0.4], [0.7, 0.8])
    random = np.random.default_rng(8)
    gaussians = gaussians.replaced(sh=torch.from_numpy(random.normal(size=(2, 16, 3)) * 0.2))
    verdict = judge(gaussians, look_at(eye, width=6, height=5, focal=12.0))
    verdict.assert_within(blended=5e-7, depth=1e-5)
