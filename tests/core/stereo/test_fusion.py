# SPDX-License-Identifier: GPL-3.0-or-later
"""Points fused from exact and from estimated depth maps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gaussian_wrapping_addon.core.stereo.depth_maps import fuse, lifted, merged
from tests.core.stereo.ball_scene import (
    arc_cameras,
    ball_maps,
    exact_map,
    surface_distance,
    true_normals,
)
from tests.synthetic import trace

EXACT = [exact_map(camera) for camera in arc_cameras()[:4]]


@pytest.mark.parametrize("wanted", [500, 2000, 8000])
def test_there_are_about_as_many_points_as_wanted_on_the_surfaces(wanted: int) -> None:
    found = fuse(EXACT, wanted)
    assert 0.7 * wanted < len(found) <= wanted
    distance = surface_distance(found.positions)
    assert np.median(distance) < 1e-4
    assert np.percentile(distance, 95) < 0.05
    assert (distance < 0.5 * found.sizes + 1e-6).mean() > 0.98


def test_a_wall_at_one_distance_gives_as_many_points_too() -> None:
    shape = EXACT[0].depth.shape
    normal = np.broadcast_to(-EXACT[0].camera.forward.astype(np.float32), (*shape, 3))
    wall = dataclasses.replace(EXACT[0], depth=np.full(shape, 4.0, np.float32), normal=normal)
    for wanted in (300, 500, 700, 1000):
        assert 0.7 * wanted < len(fuse([wall], wanted)) <= wanted


def test_estimated_depths_give_points_near_the_surfaces() -> None:
    found = fuse(ball_maps(), 3000)
    inner = np.linalg.norm(found.positions, axis=1) < 4.0  # ball and floor before the arc
    distance = surface_distance(found.positions[inner])
    assert inner.sum() > 500
    assert np.median(distance) < 0.02
    assert np.percentile(distance, 90) < 0.3


def test_normals_and_colours_are_those_of_the_pixels() -> None:
    found = fuse(EXACT, 6000)
    cosine = (found.normals * true_normals(found.positions)).sum(1)
    assert np.percentile(cosine, 5) > 0.98
    nearest = EXACT[1].camera.center
    towards = ((nearest - found.positions) * found.normals).sum(1)
    assert (towards > 0).mean() > 0.95
    near = np.linalg.norm(found.positions, axis=1) < 3.0
    eye = np.array([0.0, 0.0, 3.5])
    up = near & (found.positions[:, 2] > 0.5)  # of the ball, seen from above
    truth = 255 * trace(eye, found.positions[up] - eye)
    assert up.sum() > 50
    assert np.median(np.abs(found.colors[up] - truth)) < 6.0


def test_points_of_like_normal_are_averaged_and_outliers_left_out() -> None:
    flat = exact_map(arc_cameras()[0])
    random = np.random.default_rng(0)
    noisy = dataclasses.replace(
        flat, depth=(flat.depth * (1 + 0.003 * random.normal(size=flat.depth.shape))).astype("f4")
    )
    single, fused = lifted([noisy], [noisy.confidence]), fuse([noisy], 700)
    before = np.median(surface_distance(single.positions))
    assert np.median(surface_distance(fused.positions)) < 0.75 * before
    assert len(single) == flat.depth.size


def test_pixels_without_confidence_give_no_points() -> None:
    confidence = np.zeros_like(EXACT[0].confidence)
    nothing = dataclasses.replace(EXACT[0], confidence=confidence)
    assert len(fuse([nothing], 100)) == 0
    assert len(fuse([], 100)) == 0
    confidence = confidence.copy()
    confidence[3, 4] = 0.5
    one = fuse([dataclasses.replace(EXACT[0], confidence=confidence)], 100)
    assert one.positions.shape == (1, 3)
    pixel, depth = EXACT[0].camera.project(one.positions)
    assert pixel[0] == pytest.approx([4.5, 3.5], abs=1e-3)
    assert depth[0] == pytest.approx(EXACT[0].depth[3, 4], rel=1e-6)
    assert len(merged(one, 5)) == 1
