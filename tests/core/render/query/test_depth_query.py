# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth at sub-pixel positions against the definition from Sigma, mu and rays."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.render.area_lists import sort_positions
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.query_autograd import query_depth
from tests.core.render.query_scenes import SCENES, Oracle, assert_depths, random_positions, scene
from tests.core.render.scenes import isotropic, look_at


@pytest.mark.parametrize("name", SCENES)
def test_depth_is_the_definition_at_any_position(name: str) -> None:
    gaussians, camera = scene(name)
    positions = random_positions(camera, 3000)
    found = query_depth(gaussians, camera, torch.from_numpy(positions)).numpy()
    assert_depths(found, Oracle(gaussians, camera).depth(positions))


def test_depth_is_the_definition_beside_the_edges_of_tiles() -> None:
    gaussians, camera = scene("thin", seed=9)
    random = np.random.default_rng(2)
    edges = random.choice([0.0, 16.0, 32.0, 48.0], 2500) + random.choice([-0.01, 0.0, 0.3], 2500)
    along = random.uniform(0.0, 40.0, 2500)
    positions = np.stack([edges, along], 1)
    positions[::2] = np.minimum(positions[::2, ::-1], [50.0, 40.0])
    positions = positions.astype(np.float32)
    found = query_depth(gaussians, camera, torch.from_numpy(positions)).numpy()
    assert_depths(found, Oracle(gaussians, camera).depth(positions))


@pytest.mark.parametrize("name", SCENES)
def test_pixel_centres_equal_the_image(name: str) -> None:
    gaussians, camera = scene(name, seed=5)
    image = render(gaussians, camera, RenderOptions()).depth.numpy().reshape(-1)
    y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    positions = torch.from_numpy(np.stack([x.reshape(-1), y.reshape(-1)], 1))
    found = query_depth(gaussians, camera, positions).numpy()
    assert np.array_equal(found > 0, image > 0)
    both = image > 0
    error = np.abs(found - image)[both] / image[both]
    # Where T is nearly flat at the crossing, rounding of either is magnified.
    assert (error < 2e-6).mean() > 0.995
    assert error.max() < 5e-5


def test_a_gaussian_between_pixel_centres_is_found() -> None:
    # At (8, 8), the corner of four pixels, and a tenth of a pixel wide.
    gaussians = isotropic([(0.0, 0.0, 0.0)], [0.01], [0.9], torch.float32)
    pose = look_at((0.0, -4.0, 0.0)).cam_from_world
    camera = Camera("front", 16, 16, 40.0, 40.0, 8.0, 8.0, pose)
    assert not render(gaussians, camera).depth.any()
    positions = torch.tensor([[8.0, 8.0], [8.05, 7.97], [8.5, 8.5]])
    depth = query_depth(gaussians, camera, positions).numpy()
    wanted = 4.0 - 0.01 * math.sqrt(2.0 * math.log(1.8))
    assert depth[0] == pytest.approx(wanted, rel=1e-6)
    np.testing.assert_allclose(depth, Oracle(gaussians, camera).depth(positions.numpy()), 2e-6)


@pytest.mark.parametrize("alpha", [0.56, 0.8, 0.95])
def test_first_gaussian_alone_has_its_closed_form(alpha: float) -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0)], [0.2], [alpha], torch.float32)
    pose = look_at((0.0, -4.0, 0.0)).cam_from_world
    camera = Camera("front", 20, 20, 40.0, 40.0, 10.3, 9.6, pose)
    depth = float(query_depth(gaussians, camera, torch.tensor([[10.3, 9.6]])))
    assert depth == pytest.approx(4.0 - 0.2 * math.sqrt(2.0 * math.log(2.0 * alpha)), rel=1e-6)


def test_plateau_at_half_and_limits_of_validity() -> None:
    pose = look_at((0.0, -4.0, 0.0)).cam_from_world
    camera = Camera("front", 20, 20, 40.0, 40.0, 10.3, 9.6, pose)
    middle = torch.tensor([[10.3, 9.6]])

    def depth(sigmas: list[float], opacities: list[float], limit: float = 0.45) -> float:
        means = [(0.0, 3.0 * i, 0.0) for i in range(len(sigmas))]
        gaussians = isotropic(means, sigmas, opacities, torch.float32)
        options = RenderOptions(depth_valid_transmittance=limit)
        return float(query_depth(gaussians, camera, middle, options))

    # The first layer lets exactly half through, up to rounding; the second is 3 units behind.
    assert 4.0 - 1e-3 < depth([0.05, 0.05], [0.5, 0.9]) < 7.0 - 0.05
    assert depth([0.3], [0.53]) == 0.0
    assert depth([0.3], [0.53], limit=0.5) > 3.0
    assert depth([0.3], [0.4], limit=1.0) == 0.0
    # Less than half of the light reaches the camera's own place.
    assert depth([9.0], [0.95]) == 0.0


def test_few_positions_and_many_are_answered_alike() -> None:
    # Many positions are sorted into smaller cells, with lists of their own.
    gaussians, camera = scene("generic")
    many = random_positions(camera, 6000)
    tiles = 4 * 3
    assert sort_positions(many, 50, 40).shift == 2
    assert sort_positions(many[:tiles], 50, 40).shift == 0
    whole = query_depth(gaussians, camera, torch.from_numpy(many)).numpy()
    parts = [
        query_depth(gaussians, camera, torch.from_numpy(many[i : i + 30])).numpy()
        for i in range(0, 600, 30)
    ]
    np.testing.assert_allclose(np.concatenate(parts), whole[:600], rtol=5e-6)
