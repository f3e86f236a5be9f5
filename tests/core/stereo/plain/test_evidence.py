# SPDX-License-Identifier: GPL-3.0-or-later
"""What other photos say about points on a plane."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.stereo.plane_evidence import NEARER, UNLIKE, packed
from tests.core.stereo.plain.plain_room import WALL, cameras, depth_map, depth_maps, traced


def wall_pixels(view: int) -> tuple[np.ndarray, np.ndarray]:
    depth, part, _ = traced(cameras()[view])
    row, column = np.nonzero(part == WALL)
    return np.stack([column, row], 1).astype(float)[::7], 1.0 / depth[row, column][::7]


def test_the_true_plane_is_not_contradicted_and_others_are() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    for view in range(len(cameras())):
        pixels, inverse = wall_pixels(view)
        true = photos.votes(view, pixels, inverse)
        assert true.like > 0.97
        assert true.through < 0.005
        near = photos.votes(view, pixels, inverse / 0.6)
        assert near.like < true.like - 0.1
        assert near.through > 0.015


def test_planes_behind_the_camera_are_not_voted_for() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    pixels, inverse = wall_pixels(0)
    votes = photos.votes(0, pixels, -inverse)
    assert (votes.like, votes.through) == (0.0, 1.0)


def test_counts_tell_hidden_points_and_other_colours() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    pixels, inverse = wall_pixels(2)
    behind = photos.counts(2, pixels, inverse * 0.5).sum(0)
    assert behind[NEARER] > 0
    near = photos.counts(2, pixels, inverse / 0.5).sum(0)
    assert near[UNLIKE] > 0.05 * near.sum()


def test_a_photo_is_not_asked_about_itself() -> None:
    photos = packed(depth_maps()[:2], np.random.default_rng(0))
    pixels, inverse = wall_pixels(0)
    assert photos.counts(0, pixels, inverse).sum(1).max() <= 1


def test_gains_are_taken_out() -> None:
    gains = np.linspace(0.8, 1.1, len(cameras()))
    changed = [depth_map(camera, gain) for camera, gain in zip(cameras(), gains, strict=True)]
    levels = []
    for maps in (depth_maps(), changed):
        photos = packed(maps, np.random.default_rng(0))
        parts = [traced(camera)[1] for camera in cameras()]
        levels.append([photos.images[v][p == WALL].mean() for v, p in enumerate(parts)])
    assert np.std(levels[1]) < 0.02 * np.mean(levels[1])
    assert np.std([m.color[traced(m.camera)[1] == WALL].mean() for m in changed]) > 10


def test_known_depths_can_be_exchanged() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    nothing = photos.with_depths(np.zeros_like(photos.depths))
    pixels, inverse = wall_pixels(0)
    assert nothing.votes(0, pixels, inverse).through == 0.0
    assert nothing.images is photos.images
