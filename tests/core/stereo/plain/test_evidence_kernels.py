# SPDX-License-Identifier: GPL-3.0-or-later
"""Points looked up in other photos, against numpy."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.stereo.plane_evidence import (
    AGREEING_SHARE,
    ALIKE_LEVELS,
    THROUGH_SHARE,
    correlate,
    count_votes,
    packed,
)
from tests.core.stereo.plain.plain_room import cameras, depth_maps


def looked_up(photos, other: int, points: np.ndarray):
    pixels, depth = cameras()[other].project(points)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < photos.sizes[other]).all(1)
    column, row = pixels[inside].astype(int).T
    return inside, depth[inside], photos.depths[other][row, column], (row, column)


def test_votes_are_those_of_numpy() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    random = np.random.default_rng(1)
    points = random.uniform((-2, 0.5, 0), (2, 3.2, 2.4), (3000, 3))
    colors = (random.integers(120, 160, (3000, 1)) * [1.0, 0.97, 0.93]).astype(np.uint8)
    expected = np.zeros((3000, 5), int)
    others = np.array([0, 2, 3, 5])
    for other in others[1:]:  # 0 is the points' own photo
        inside, depth, known, at = looked_up(photos, other, points)
        ratio = np.where(known > 0, known / depth, 1.0)
        difference = np.abs(photos.images[other][at].astype(int) - colors[inside]).max(-1)
        agree = (known > 0) & (np.abs(ratio - 1) < AGREEING_SHARE)
        rows = [
            agree,
            (known == 0) & (difference < ALIKE_LEVELS),
            ~agree & (ratio > 1 + THROUGH_SHARE),
            (known == 0) & (difference >= ALIKE_LEVELS),
            ~agree & (ratio < 1 - THROUGH_SHARE),
        ]
        expected[inside] += np.stack(rows, 1)
    counts = np.zeros((3000, 5), np.int32)
    count_votes(
        points, colors, 0, others, photos.projections, photos.sizes, photos.depths, photos.images,
        AGREEING_SHARE, counts,
    )  # fmt: skip
    assert expected.sum(0).min() > 20
    assert np.array_equal(counts, expected)


def test_correlation_is_one_for_the_same_texture_and_ignores_what_is_not_plain() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    random = np.random.default_rng(2)
    points = random.uniform((-1, 2.5, 0.5), (1, 3.0, 1.8), (500, 3))
    row, column = np.mgrid[: photos.depths.shape[1], : photos.depths.shape[2]]
    texture = np.sin(0.2 * column + 0.1 * row).astype(np.float32)
    textures = np.stack([texture] * len(cameras()))
    pixels = cameras()[4].project(points)[0] - 0.5
    values = np.sin(0.2 * pixels[:, 0] + 0.1 * pixels[:, 1]).astype(np.float32)
    rest = (photos.projections, photos.sizes)
    total, count = correlate(points, values, np.array([4]), *rest, textures, 4.0)
    assert count > 300
    assert total / count > 0.999
    opposite, _ = correlate(points, -values, np.array([4]), *rest, textures, 4.0)
    assert abs(opposite + total) < 1e-6 * count
    textures[4] = np.nan
    assert correlate(points, values, np.array([4]), *rest, textures, 4.0) == (0.0, 0)
