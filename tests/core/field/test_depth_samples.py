# SPDX-License-Identifier: GPL-3.0-or-later
"""Samples of depth maps, and pairs of points across the isosurface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.field.samples import (
    DepthSamples,
    bracket_pairs,
    sample_depth_maps,
    thin_evenly,
)
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.cuda.device_renderer import DeviceRenderer, device_renderer
from tests.core.device_kernels import DEVICES, kernels_of
from tests.core.field.field_scenes import cameras_around
from tests.core.render.scenes import isotropic
from tests.core.training.small_scene import sphere_gaussians

SIGMA, ALPHA = 0.4, 0.95
RADIUS = SIGMA * np.sqrt(2 * np.log(2 * ALPHA))


def one_ball() -> OrientedGaussians:
    """Return one round Gaussian; its isosurface is a sphere (docs/method.md, section 10.3)."""
    return isotropic([(0.0, 0.0, 0.0)], [SIGMA], [ALPHA], torch.float32)


def everywhere(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), bool)


def sampled(
    count: int, kept: Callable[[np.ndarray], np.ndarray] = everywhere, **options: int
) -> DepthSamples:
    """Return samples of the ball from so many sides."""
    cameras = cameras_around(count)
    return sample_depth_maps(one_ball(), cameras, kept, Progress(), threads=1, **options)


def test_sightings_of_a_round_gaussian_lie_on_its_sphere_all_around() -> None:
    found = sampled(12)
    distance = np.linalg.norm(found.points, axis=1)
    # At the outline a ray only grazes it; the final transmittance decides there.
    assert np.abs(distance - RADIUS).max() < 0.02 * RADIUS
    assert np.median(np.abs(distance - RADIUS)) < 1e-4 * RADIUS
    facing = [(found.points @ c.center).max() / 4.0 for c in cameras_around(40)]
    assert min(facing) > 0.98 * RADIUS
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=1), 1.0)
    assert ((found.points * found.directions).sum(1) < 0).mean() > 0.99  # from outside


def test_only_what_lies_in_the_volume_is_kept() -> None:
    found = sampled(6, lambda points: points[:, 2] > 0.1)
    assert len(found) > 100
    assert (found.points[:, 2] > 0.1).all()
    nothing = sampled(3, lambda points: np.zeros(len(points), bool))
    assert len(nothing) == 0
    assert len(bracket_pairs(nothing, everywhere)[0]) == 0


def test_the_number_is_bounded_and_what_is_left_is_even() -> None:
    found = sampled(8, most=500)
    assert 150 < len(found) <= 500
    near = np.linalg.norm(found.points[:, None] - cameras_around(60)[7].center * 0.11, axis=2)
    assert near.min() < 0.2


def test_thinning_keeps_both_sides_and_the_sharpest() -> None:
    points = np.zeros((4, 3))
    directions = np.array([[1.0, 0, 0], [1.0, 0, 0], [-1.0, -1e-3, 0], [-1.0, -1e-3, 0]])
    some = DepthSamples(points, directions, np.array([2.0, 1.0, 3.0, 4.0]))
    assert thin_evenly(some, 10).footprints.tolist() == [1.0, 3.0]


def test_pairs_stand_on_both_sides_and_disagreement_is_left_out() -> None:
    found = sampled(8)
    is_empty = lambda p: np.linalg.norm(p, axis=1) > RADIUS  # noqa: E731
    outer, inner = bracket_pairs(found, is_empty)
    assert len(outer) == len(inner) > 0.8 * len(found)
    assert is_empty(outer).mean() > 0.99
    assert not is_empty(inner).any()
    outer, inner = bracket_pairs(found, everywhere)
    assert len(outer) == len(inner) == 0


def test_cancelling_stops_before_the_next_view() -> None:
    seen = []
    progress = Progress("mesh", seen.append, lambda: len(seen) >= 2)
    with pytest.raises(Cancelled):
        sample_depth_maps(one_ball(), cameras_around(30), everywhere, progress, threads=1)
    assert len(seen) <= 3


@pytest.mark.parametrize("device", DEVICES)
def test_a_device_gives_the_samples_of_the_processor(
    device: str, request: pytest.FixtureRequest
) -> None:
    """Of 6 views: the same pixels have a depth; rounding moves at most 1 in 1000 by over 1e-5."""
    kernels = kernels_of(device, request)
    if device == "cuda":
        renderer = device_renderer("cuda:0")
    else:
        renderer = DeviceRenderer(kernels, torch.device("cpu"), lambda: 1 << 28)
    cameras = [camera.resized(120, 90) for camera in cameras_around(6)]
    gaussians = sphere_gaussians(opacity=0.9)
    views: list[list[np.ndarray]] = []
    samples = []
    for where in (None, renderer):
        views.append([])

        def noted(points: np.ndarray, into: list[np.ndarray] = views[-1]) -> np.ndarray:
            into.append(points)
            return everywhere(points)

        samples.append(
            sample_depth_maps(gaussians, cameras, noted, Progress(), threads=1, renderer=where)
        )
    far, moved = 0, 0
    for camera, wanted, found in zip(cameras, *views, strict=True):
        assert len(found) == len(wanted) > 500
        depth = np.linalg.norm(wanted - camera.center, axis=1)
        away = np.linalg.norm(found - wanted, axis=1) / depth
        far, moved = far + len(wanted), moved + int((away > 1e-5).sum())
    assert moved <= 1e-3 * far
    # A sample on the edge of a cell may fall into its neighbour: the thinned ones are nearly those.
    assert len(samples[1]) == pytest.approx(len(samples[0]), rel=0.01)
    reach = cKDTree(samples[0].points).query(samples[1].points)[0]
    assert (reach <= 1e-5 * np.linalg.norm(cameras[0].center)).mean() > 0.99
