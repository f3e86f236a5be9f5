# SPDX-License-Identifier: GPL-3.0-or-later
"""Trainings for the regions that the user drew."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.backend import OVERLAP_PX, Window
from gaussian_wrapping_addon.core.training.cpu_backend import CpuBackend
from gaussian_wrapping_addon.core.training.focus import MOST_SHOWN, WHOLE_SHARE, Focus
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.training.small_scene import PhotosInMemory, sphere_scene
from tests.core.training.test_trainer import SETTINGS, assert_same
from tests.synthetic import look_at


def _camera(center: list[float], target: list[float]) -> Camera:
    return look_at(np.array(center), np.array(target), "photo", 200, 150, 160.0)


def _box(middle: list[float], side: float) -> Region:
    center = np.array(middle)
    return Region.box("box", center - side / 2, center + side / 2)


@pytest.mark.parametrize("seed", range(4))
def test_what_a_photo_shows_of_a_region(seed: int) -> None:
    """Its pixels are those that look through the region; the rectangle holds them, little more."""
    random = np.random.default_rng(seed)
    body = Region("body", random.normal(size=(12, 3)) * [0.5, 0.1, 0.3])
    focus, steps = Focus([body]), np.linspace(limits.NEAR_Z, 6.0, 3000)
    for distance in (3.0, 0.6, 0.2):  # far away, around the near plane, from within
        away = random.normal(size=3)
        center = distance * away / np.linalg.norm(away)
        camera = _camera(center.tolist(), (0.3 * random.normal(size=3)).tolist())
        shown, boxes = focus.shown(camera), focus.rectangles(camera)
        at = random.integers([camera.height, camera.width], size=(200, 2))  # (200, 2) row, column
        rays = camera.rays()[at[:, 0], at[:, 1]] @ camera.rotation
        places = camera.center + rays[:, None] * steps[:, None]  # (200, 3000, 3)
        within = body.distance(places.reshape(-1, 3)).reshape(200, -1).min(1)
        sure = np.abs(within) > 0.01
        assert sure.sum() > 100
        assert (shown[at[:, 0], at[:, 1]] == (within < 0.0))[sure].all()
        if not shown.any():
            assert not boxes
            continue
        (box,) = boxes
        rows, columns = np.nonzero(shown)
        assert box.top <= rows.min()
        assert box.left <= columns.min()
        assert rows.max() < box.top + box.height
        assert columns.max() < box.left + box.width
        if box != Window(0, 0, camera.width, camera.height):
            border = OVERLAP_PX + 5
            assert box.top >= rows.min() - border
            assert box.left >= columns.min() - border
            assert box.top + box.height <= rows.max() + 1 + border
            assert box.left + box.width <= columns.max() + 1 + border


def test_a_photo_that_shows_no_region_has_no_rectangle() -> None:
    box = _box([0, 0, 0], 0.2)
    assert Focus([box]).rectangles(_camera([0, 0, -1], [0, 0, -2])) == []  # behind the camera
    assert Focus([box]).rectangles(_camera([0, 0, -1], [3, 0, -1])) == []  # beside the photo
    assert len(Focus([box]).rectangles(_camera([0, 0, -1], [0, 0, 0]))) == 1


def test_a_photo_filled_by_regions_is_used_whole() -> None:
    camera = _camera([0, 0, -1], [0, 0, 0])
    whole = [Window(0, 0, camera.width, camera.height)]
    assert Focus([_box([0, 0, 0], 3.0)]).rectangles(camera) == whole
    halves = [_box([-0.35, 0, 0], 0.55), _box([0.35, 0, 0], 0.55)]
    apart = [Focus([half]).rectangles(camera)[0] for half in halves]
    assert all(box.width * box.height < WHOLE_SHARE * 200 * 150 for box in apart)
    assert Focus(halves).rectangles(camera) == whole


def test_what_regions_cover_is_a_share_of_the_pixels() -> None:
    cameras = [_camera([0, 0, -1], [0, 0, 0]), _camera([0, 0, 1], [0, 0, 0])]
    # Seen from 1 m with a focal length of 160 pixels: 64 of 200 x 150 pixels squared.
    sheet = Region.box("sheet", np.array([-0.2, -0.2, -0.001]), np.array([0.2, 0.2, 0.001]))
    assert Focus([sheet]).share_of(cameras) == pytest.approx(64**2 / (200 * 150), abs=0.02)
    assert Focus([_box([0, 0, 0], 3.0)]).share_of(cameras) == 1.0


class _Watched(CpuBackend):
    """Notes what iterations are trained on."""

    def __init__(self) -> None:
        super().__init__(2)
        self.seen: list[tuple[int, int, Window | None]] = []

    def shown(self, photos, view, divisor, window):  # type: ignore[no-untyped-def]
        self.seen.append((view, divisor, window))
        return super().shown(photos, view, divisor, window)


def test_most_iterations_see_the_region_at_full_size_and_the_others_all_at_half(
    tmp_path: Path,
) -> None:
    small, few = sphere_scene(views=9, size_px=20)
    views = [
        dataclasses.replace(view, camera=view.camera.resized(200, 200)) for view in small.views
    ]
    scene = dataclasses.replace(small, views=views)
    photos = PhotosInMemory(scene, [p.repeat(10, 0).repeat(10, 1) for p in few.photos])
    focus = Focus([_box([0.0, 0.0, 0.15], 0.1)])
    settings = dataclasses.replace(
        SETTINGS, iterations=60, max_image_px=200, coarse_to_fine="off", multi_view="off",
        dense_start="off",
    )  # fmt: skip
    backend = _Watched()
    result = train(
        scene,
        photos,
        settings,
        tmp_path,
        Progress(),
        seed=1,
        threads=2,
        focus=focus,
        backend=backend,
    )
    assert result.iterations == 60
    assert all(figure.region_psnr is not None for figure in result.held_out)
    assert result.to_json()["held_out_region_psnr"] == result.region_psnr != result.held_out_psnr
    parts = [(view, window) for view, divisor, window in backend.seen if divisor == 1]
    assert {divisor for _, divisor, _ in backend.seen} == {1, 2}
    assert 0.6 * 60 < len(parts) < 0.95 * 60
    for view, window in parts:
        assert [window] == focus.rectangles(photos.camera(view, 1))


def test_regions_that_fill_the_photos_are_trained_for_as_if_there_were_none(tmp_path: Path) -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    settings = dataclasses.replace(SETTINGS, multi_view="off", dense_start="off")
    focus = Focus([_box([0.0, 0.0, 0.0], 9.0)])
    assert focus.share_of([photos.camera(view, 1) for view in range(9)]) > MOST_SHOWN
    for name in ("found", "plain"):
        (tmp_path / name).mkdir()
    found, plain = (
        train(scene, photos, settings, tmp_path / name, Progress(), seed=1, threads=2, focus=given)
        for name, given in (("found", focus), ("plain", None))
    )
    assert_same(found.gaussians, plain.gaussians)
    assert found.region_psnr == pytest.approx(found.held_out_psnr)
