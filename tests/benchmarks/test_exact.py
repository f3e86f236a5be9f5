# SPDX-License-Identifier: GPL-3.0-or-later
"""The float64 side of the error tables: images, depth, gradients by tiles, and hard scenes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from benchmarks.exact import as_float64, exact_images, exact_tiles
from benchmarks.exact_gradients import IMAGES, TRAINED, exact_gradients, linear_loss
from benchmarks.hard_scenes import HardScene, hard_scenes
from benchmarks.scene_errors import gradient_error, leaves, scene_errors
from gaussian_wrapping_addon.core.render.reference.reference import render_reference
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types.options import RenderOptions
from tests.core.render.scenes import look_at, random_gaussians

SCENES = hard_scenes()


@pytest.mark.parametrize("scene", SCENES, ids=[scene.name for scene in SCENES])
def test_first_principles_equal_the_definition_on_hard_scenes(scene: HardScene) -> None:
    with torch.no_grad():
        wanted = render_reference(as_float64(scene.gaussians), scene.camera, scene.options)
    found = exact_images(scene.gaussians, scene.camera, scene.options)
    for name in IMAGES[:4]:
        difference = getattr(found, name) - getattr(wanted, name).numpy()
        assert np.abs(difference).max() < 1e-9, name
    depth = wanted.depth.numpy()
    assert np.array_equal(found.depth > 0, depth > 0)
    assert np.allclose(found.depth, depth, rtol=1e-9, atol=0)


def test_hard_scenes_cover_the_cases_and_see_something() -> None:
    assert {scene.case for scene in SCENES} == {1, 2, 3, 4, 5, 7}
    assert len({scene.name for scene in SCENES}) == len(SCENES)
    for scene in SCENES:
        found = exact_images(scene.gaussians, scene.camera, scene.options)
        assert found.alpha.max() > 0.1, scene.name


def test_gradients_by_tiles_equal_those_of_the_whole_image() -> None:
    gaussians = random_gaussians(40, seed=3, opacity=(0.3, 0.95))
    camera, options = look_at((2.2, 1.0, 0.8), width=37, height=21), RenderOptions()
    tiles = exact_tiles(gaussians, camera, options)
    generator = torch.Generator().manual_seed(1)
    leaf = leaves(gaussians, torch.float64)
    out = render_reference(leaf, camera, options)
    weights = {
        name: torch.randn(getattr(out, name).shape, generator=generator, dtype=torch.float64)
        for name in IMAGES
    }
    linear_loss(out, weights).backward()
    (found,) = exact_gradients(gaussians, camera, options, [weights], tiles)
    for name in TRAINED:
        wanted = getattr(leaf, name).grad
        assert wanted.norm() > 0
        assert (found[name] - wanted).norm() < 1e-10 * wanted.norm(), name


def test_errors_show_what_is_wrong() -> None:
    gaussians = random_gaussians(30, seed=5, dtype=torch.float32, opacity=(0.3, 0.95))
    camera, options = look_at((2.2, 1.0, 0.8), width=24, height=20), RenderOptions()
    good = scene_errors("scene", gaussians, camera, options, render)
    assert good.image_max < 3e-6
    assert good.depth_valid > 50
    assert good.depth_differs == 0
    assert all(e.l2 < 1e-4 for e in good.gradients["images"].values())

    def wrong(scene, camera, options):  # type: ignore[no-untyped-def]
        out = render(scene.replaced(means=scene.means * 1.001), camera, options)
        return dataclasses.replace(out, depth=out.depth * 1.01)

    bad = scene_errors("scene", gaussians, camera, options, wrong)
    assert bad.image_max > 1e-4
    assert bad.image_off > 50
    assert bad.depth_within < 0.1
    assert bad.gradients["images, all pixels"]["means"].l2 > 5e-4


def test_gradient_error_tells_zero_from_wrong() -> None:
    exact = torch.tensor([3.0, 4.0], dtype=torch.float64)
    error = gradient_error(exact + torch.tensor([0.0, 0.5]), exact)
    assert error.l2 == pytest.approx(0.1)
    assert error.largest == pytest.approx(0.125)
    nothing = torch.zeros(2, dtype=torch.float64)
    assert np.isnan(gradient_error(nothing, nothing).l2)
    assert np.isinf(gradient_error(exact, nothing).l2)
