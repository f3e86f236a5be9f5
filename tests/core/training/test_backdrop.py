# SPDX-License-Identifier: GPL-3.0-or-later
"""A sphere behind everything, in the photos' colours, where no photo sees through."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians, gaussians_at
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.start import LEAST_REACH
from gaussian_wrapping_addon.core.training.trainer import with_backdrop
from tests.synthetic import look_at

WIDTH, HEIGHT = 72, 48
WALL_X, HALF_SIDE = 6.0, 4.0
COLOR = np.array([0.7, 0.5, 0.2])
DEGREE = 1


def camera(at: tuple[float, ...], to: tuple[float, ...], focal_px: float = 90.0) -> Camera:
    return look_at(np.array(at), np.array(to), "view", WIDTH, HEIGHT, focal_px)


AT_WALL = [camera((0, y, 0.3), (WALL_X, y, 0.0)) for y in (-1.0, 0.0, 1.0)]
PAST_WALL = camera((0, 6.0, 0.0), (WALL_X, 6.0, 0.1))
"""In a direction in which the others see the wall, from a place beyond its border."""
INTO_NOTHING = camera((0, 0, 0), (-WALL_X, 0.0, 0.1))


class Photos:
    """The cameras of a photo source; the photos themselves are not needed."""

    def __init__(self, cameras: list[Camera]) -> None:
        self.cameras = cameras

    def camera(self, index: int, divisor: int = 1) -> Camera:
        assert divisor == 1  # small enough
        return self.cameras[index]


def wall() -> OrientedGaussians:
    """Return two opaque layers of flat Gaussians of one colour."""
    across = np.arange(-HALF_SIDE, HALF_SIDE, 0.2)
    y, z, x = (axis.reshape(-1) for axis in np.meshgrid(across, across, [WALL_X, WALL_X + 0.1]))
    points, count = np.stack([x, y, z], 1), len(x)
    return gaussians_at(
        points, np.tile(COLOR, (count, 1)), np.full(count, 0.16), DEGREE,
        normals=np.tile([-1.0, 0, 0], (count, 1)), flatness=0.1, opacities=0.95,
    )  # fmt: skip


def backed(cameras: list[Camera]) -> OrientedGaussians:
    return with_backdrop(wall(), Photos(cameras), range(len(cameras)), threads=1)


def rendered(gaussians: OrientedGaussians, view: Camera) -> np.ndarray:
    raw, options = RawArrays.from_gaussians(gaussians), RenderOptions(depth=False, threads=1)
    return ViewRenderer().render(raw, view, options).color.copy()


def test_beyond_the_border_lie_the_colours_of_the_wall() -> None:
    middle = np.s_[16:32, 24:48]
    assert np.abs(rendered(wall(), PAST_WALL)[middle]).max() < 0.01
    found = rendered(backed(AT_WALL), PAST_WALL)[middle]
    np.testing.assert_allclose(found, np.broadcast_to(COLOR, found.shape), atol=0.08)


def test_training_views_stay_as_they_are() -> None:
    before, after = wall(), backed(AT_WALL)
    for view in AT_WALL:
        change = np.abs(rendered(after, view) - rendered(before, view))
        assert change.max() < 0.5 / 255


def test_the_trained_gaussians_come_first_unchanged() -> None:
    before, after = wall(), backed(AT_WALL)
    assert len(after) > len(before)
    assert after.sh_degree == DEGREE
    for (name, old), (_, new) in zip(before.tensors(), after.tensors(), strict=True):
        assert (new[: len(old)] == old).all(), name
    assert (after.means[len(before) :].norm(dim=1) > 0.99 * LEAST_REACH).all()


def test_where_a_photo_sees_through_it_stays_open() -> None:
    after = backed([*AT_WALL, INTO_NOTHING])
    assert rendered(after, INTO_NOTHING)[20:28, 32:40].max() < 0.02
    # Without this photo, the same directions are unknown and filled.
    assert rendered(backed(AT_WALL), INTO_NOTHING)[20:28, 32:40].min() > 0.1


def test_photos_of_nothing_give_no_colours() -> None:
    for cameras in ([], [INTO_NOTHING]):
        assert len(backed(cameras)) == len(wall())


def test_it_can_be_cancelled() -> None:
    def check() -> None:
        raise Cancelled()

    with pytest.raises(Cancelled):
        with_backdrop(wall(), Photos(AT_WALL), range(3), threads=1, check=check)
