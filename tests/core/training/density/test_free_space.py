# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians that photos see through, by depths in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthPrior
from gaussian_wrapping_addon.core.stereo.plane_evidence import (
    AGREEING_SHARE,
    MOST_ASKED,
    THROUGH_SHARE,
)
from gaussian_wrapping_addon.core.training.density import contradicted
from tests.synthetic import look_at

FLOOR_Z = -2.0
COUNT = 6


def cameras(count: int = COUNT) -> list[Camera]:
    """Return cameras around the axis of z, above a floor."""
    angles = 2.0 * np.pi * np.arange(count) / count
    return [
        look_at(
            np.array([3.0 * np.cos(a), 3.0 * np.sin(a), 3.0]), np.zeros(3), f"{k}", 80, 60, 70.0
        )
        for k, a in enumerate(angles)
    ]


def floor_depth(camera: Camera) -> np.ndarray:
    """Return the (h, w) z-depth of the floor; of a plane that every ray of these cameras meets."""
    along = (camera.rays() @ camera.rotation)[..., 2]
    depth = (FLOOR_Z - camera.center[2]) / along
    return np.where(depth > 0, depth, 0.0).astype(np.float32)


def priors(free: int) -> dict[int, DepthPrior]:
    """Return priors of which the first ones see the floor; no depth is known."""
    found = {}
    for view, camera in enumerate(cameras()):
        known, nothing = (np.zeros((60, 80), np.float32) for _ in range(2))
        seen = floor_depth(camera) if view < free else nothing
        found[view] = DepthPrior(camera, nothing, nothing, known, seen)
    return found


INSIDE = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, -1.0]])
"""Points that all cameras see before the floor."""


def test_what_stands_before_the_floor_in_enough_photos_is_contradicted() -> None:
    assert contradicted(INSIDE, priors(free=COUNT), 2).all()
    assert contradicted(INSIDE, priors(free=2), 2).all()
    assert not contradicted(INSIDE, priors(free=1), 2).any()
    assert not contradicted(INSIDE, priors(free=0), 2).any()
    assert not contradicted(INSIDE, priors(free=2), 3).any()


def test_what_lies_on_the_floor_or_behind_it_is_not() -> None:
    points = np.array([[0.1, 0.2, FLOOR_Z], [0.1, 0.2, FLOOR_Z - 0.5]])
    assert not contradicted(points, priors(free=COUNT), 1).any()


def test_the_margin_is_that_of_the_depth() -> None:
    camera = cameras()[0]
    given = {0: priors(free=1)[0]}
    ray = (camera.rays() @ camera.rotation)[30, 40]
    whole = float(floor_depth(camera)[30, 40])
    for share, expected in ((1.0 + 0.5 * THROUGH_SHARE, False), (1.0 + 2.0 * THROUGH_SHARE, True)):
        point = camera.center + ray * whole / share
        assert contradicted(point[None], given, 1).tolist() == [expected]


def test_depths_that_agree_outvote_those_that_see_through() -> None:
    """Confirmed depths at the point itself, in as many photos or more."""
    point = INSIDE[:1]
    found = priors(free=3)
    assert contradicted(point, found, 2).all()
    for view, prior in found.items():
        pixels, depth = prior.camera.project(point)
        column, row = pixels[0].astype(int)
        prior.known[row, column] = depth[0] * (1.0 + 0.5 * AGREEING_SHARE)
        assert contradicted(point, found, 2).all() == (view + 1 < 3)


def test_what_may_be_the_sky_is_left() -> None:
    found = {0: priors(free=1)[0]}
    found[0].free[...] = 1e6
    axis = -found[0].camera.center / np.linalg.norm(found[0].camera.center)
    points = np.array([[0.9], [1.1]]) * limits.FAR_RADIUS * axis
    assert contradicted(points, found, 1).tolist() == [True, False]


@pytest.mark.parametrize("point", [[0.0, 0.0, 50.0], [np.nan] * 3])
def test_what_no_photo_shows_is_left(point: list[float]) -> None:
    assert not contradicted(np.array([point]), priors(free=COUNT), 1).any()


def test_of_many_photos_a_regular_choice_is_asked() -> None:
    one = priors(free=1)[0]
    asked: list[int] = []

    class Counting(dict[int, DepthPrior]):
        def __getitem__(self, view: int) -> DepthPrior:
            asked.append(view)
            return one

    contradicted(INSIDE, Counting.fromkeys(range(200), one), 1)
    assert len(asked) == MOST_ASKED
    assert asked[0] == 0
    assert asked[-1] == 199
