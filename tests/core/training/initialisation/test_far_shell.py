# SPDX-License-Identifier: GPL-3.0-or-later
"""Points on a far sphere where photos show a sky that nothing explains."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.depth_maps import CELL_PX, DepthMap
from gaussian_wrapping_addon.core.training.start import LEAST_REACH, REACH_FACTOR, far_shell
from tests.synthetic import look_at

WIDTH, HEIGHT = 96, 64
NO_POINTS = np.zeros((0, 3))


def sky_color(directions: np.ndarray) -> np.ndarray:
    """Return (..., 3) grey levels of unit directions: smooth, different to all sides."""
    return 128 + 100 * directions


def sky_map(camera: Camera) -> DepthMap:
    """Return the map of a photo of nothing but sky."""
    shape = (HEIGHT, WIDTH)
    rays = camera.rays() @ camera.rotation
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return DepthMap(
        camera=camera,
        depth=np.full(shape, 3.0, np.float32),
        normal=np.zeros((*shape, 3), np.float32),
        confidence=np.zeros(shape, np.float32),
        agreeing=np.zeros(shape, np.uint8),
        cost=np.ones(shape, np.float32),
        color=np.round(sky_color(rays)).astype(np.uint8),
        mask=None,
    )


def cameras() -> list[Camera]:
    places = np.array([[0.0, 0, 0], [0.3, 0.2, 0], [-0.2, 0.1, 0.1]])
    targets = np.array([[5.0, 0, 2], [5.0, 1, 2], [0, 5.0, 3]])
    return [
        look_at(p, t, str(i), WIDTH, HEIGHT, 90.0)
        for i, (p, t) in enumerate(zip(places, targets, strict=True))
    ]


MAPS = [sky_map(camera) for camera in cameras()]


def test_the_sky_lands_on_the_sphere_in_its_colours() -> None:
    shell, radius = far_shell(MAPS, NO_POINTS, 1000)
    assert radius == LEAST_REACH
    assert 100 < len(shell) <= 3 * (WIDTH // CELL_PX) * (HEIGHT // CELL_PX)
    assert np.linalg.norm(shell.positions, axis=1) == pytest.approx(radius)
    assert shell.normals == pytest.approx(-shell.positions / radius)
    assert np.abs(shell.colors - sky_color(shell.positions / radius)).max() < 6
    seen = np.zeros(len(shell), bool)
    for camera in cameras():
        pixels, depth = camera.project(shell.positions)
        size = np.array([WIDTH, HEIGHT])
        seen |= (depth > 0) & (pixels > 0).all(1) & (pixels < size).all(1)
    assert seen.all()
    gap = np.linalg.norm(shell.positions[:, None] - shell.positions[None], axis=2)
    np.fill_diagonal(gap, np.inf)
    assert np.median(gap.min(1)) == pytest.approx(shell.sizes[0], rel=0.5)


def test_one_photo_gives_each_cell_its_direction() -> None:
    shell, radius = far_shell(MAPS[:1], NO_POINTS, 10_000)
    pixels, _ = cameras()[0].project(shell.positions)
    middles = (np.floor(pixels / CELL_PX) + 0.5) * CELL_PX
    assert np.median(np.abs(pixels - middles)) < 0.5
    assert radius > 0


def test_the_sphere_is_far_behind_all_points() -> None:
    points = np.random.default_rng(0).normal(size=(500, 3))
    points *= 40.0 / np.linalg.norm(points, axis=1, keepdims=True)
    shell, radius = far_shell(MAPS, points, 1000)
    assert radius == pytest.approx(REACH_FACTOR * 40.0)
    assert np.linalg.norm(shell.positions, axis=1) == pytest.approx(radius)


def test_points_cover_their_cells() -> None:
    camera = cameras()[0]
    left = camera.rays()[4::8, 4 : WIDTH // 2 : 8].reshape(-1, 3) * 3.0
    points = camera.center + left @ camera.rotation
    shell, _ = far_shell(MAPS[:1], points, 1000)
    assert len(shell) > 20
    assert camera.project(shell.positions)[0][:, 0].min() > WIDTH / 2
    behind = camera.center - left @ camera.rotation
    assert len(far_shell(MAPS[:1], behind, 1000)[0]) > 1.5 * len(shell)


def test_explained_and_masked_pixels_give_nothing() -> None:
    shape = (HEIGHT, WIDTH)
    for change in (
        {"agreeing": np.ones(shape, np.uint8)},
        {"cost": np.full(shape, 0.3, np.float32)},
        {"mask": np.zeros(shape, bool)},
    ):
        maps = [dataclasses.replace(m, **change) for m in MAPS]
        shell, radius = far_shell(maps, NO_POINTS, 1000)
        assert len(shell) == 0
        assert shell.positions.shape == shell.normals.shape == shell.colors.shape == (0, 3)
        assert radius == LEAST_REACH


@pytest.mark.parametrize("wanted", [0, 1, 7, 40])
def test_there_are_no_more_than_wanted(wanted: int) -> None:
    shell, _ = far_shell(MAPS, NO_POINTS, wanted)
    assert min(1, wanted) <= len(shell) <= wanted
    assert np.isfinite(shell.positions).all()


def test_photos_smaller_than_a_cell_have_no_open_cells() -> None:
    camera = cameras()[0].resized(7, 5)
    small = dataclasses.replace(
        MAPS[0], camera=camera,
        **{
            name: getattr(MAPS[0], name)[:5, :7]
            for name in ("depth", "normal", "confidence", "agreeing", "cost", "color")
        },
    )  # fmt: skip
    assert len(far_shell([small], NO_POINTS, 100)[0]) == 0
