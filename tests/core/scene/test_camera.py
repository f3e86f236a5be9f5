# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras: points and pixels, undistortion, Brown's polynomial with k4 and skew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageOps

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.photos.formats import read_photo_header
from gaussian_wrapping_addon.core.photos.photo_file import apply_orientation, read_mask, read_photo
from gaussian_wrapping_addon.core.readers.lenses import (
    SkewedBrown,
    pinhole_of,
    project,
    sampling_map,
)
from gaussian_wrapping_addon.core.readers.source_model import SKEWED_BROWN, Brown, LensCamera
from gaussian_wrapping_addon.core.resampling import sample_bicubic
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.scenes import look_at

CAMERA = look_at((2.2, 1.0, 0.8), width=33, height=17)


def test_rays_at_the_centres_of_pixels_are_those_of_the_image() -> None:
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    pixels = np.stack([columns.ravel(), rows.ravel()], 1) + 0.5
    assert np.array_equal(CAMERA.rays_at(pixels), CAMERA.rays().reshape(-1, 3))


def test_points_on_rays_are_shown_where_the_rays_begin() -> None:
    pixels = np.random.default_rng(0).uniform((0.0, 0.0), (33.0, 17.0), (200, 2))
    depth = np.linspace(0.5, 4.0, 200)
    points = (CAMERA.rays_at(pixels) * depth[:, None]) @ CAMERA.rotation + CAMERA.center
    indices, row, column, found = CAMERA.shown(points)
    assert np.array_equal(indices, np.arange(200))
    assert np.array_equal(np.stack([column, row], 1), np.floor(pixels))
    assert np.allclose(found, depth, rtol=1e-12)


def test_points_outside_the_image_and_behind_the_camera_are_not_shown() -> None:
    pixels = np.array([[-0.1, 5.0], [5.0, -0.1], [33.1, 5.0], [5.0, 17.1], [5.0, 5.0], [6.5, 2.5]])
    depth = np.array([1.0, 1.0, 1.0, 1.0, -1.0, 1.0])
    points = (CAMERA.rays_at(pixels) * depth[:, None]) @ CAMERA.rotation + CAMERA.center
    indices, row, column, _ = CAMERA.shown(points)
    assert (indices.tolist(), row.tolist(), column.tolist()) == ([5], [2], [6])
    assert all(len(part) == 0 for part in CAMERA.shown(np.zeros((0, 3))))


@pytest.mark.parametrize(
    "change",
    [
        {"width": 0}, {"width": 64.0}, {"height": True}, {"height": 10**9}, {"fx": 0.0},
        {"fy": float("nan")}, {"cx": 10**400}, {"cy": "left"}, {"name": 5}, {"lens": "wide"},
        {"cam_from_world": [1.0, 2.0]}, {"cam_from_world": [[10**400] * 4] * 3},
        {"cam_from_world": [[float("inf")] * 4] * 3},
    ],
)  # fmt: skip
def test_values_that_no_camera_has_are_refused(change: dict[str, Any]) -> None:
    camera = Camera("a.png", 64, 48, 60.0, 61.0, 32.0, 24.0, np.eye(3, 4))
    values = camera.to_json()
    assert np.array_equal(Camera.from_json(values).cam_from_world, camera.cam_from_world)
    with pytest.raises((KeyError, TypeError, ValueError)):
        Camera.from_json({**values, **change})


CAMERAS = {
    "barrel": LensCamera("SIMPLE_RADIAL", 200, 150, (180.0, 102.0, 74.0, -0.15)),
    "opencv": LensCamera("OPENCV", 120, 200, (140, 141, 61, 99, 0.06, -0.08, 1e-3, -2e-3)),
    "fisheye": LensCamera("OPENCV_FISHEYE", 200, 160, (120, 120, 100, 80, 0.02, 0.0, 0.0, 0.0)),
    "skewed": Brown(-0.2, 0.06, -0.01, 0.002, p1=0.003, p2=-0.002, skew=0.8).lens(
        120, 90, (100.0, 103.0), (60.0, 45.0)
    ),
}


def opencv_pixel(camera: LensCamera, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The OPENCV lens formula by hand: radial k1 k2, tangential p1 p2."""
    fx, fy, cx, cy, k1, k2, p1, p2 = camera.params
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    return fx * u + cx, fy * v + cy


@pytest.mark.parametrize("name", CAMERAS)
def test_no_border_and_most_of_the_view(name: str) -> None:
    camera = CAMERAS[name]
    pinhole = pinhole_of(camera)
    where = sampling_map(camera, pinhole)
    low, high = where.min((0, 1)), where.max((0, 1))
    assert (low >= 0.0).all()
    assert (high <= [camera.width, camera.height]).all()
    # The rectangle touches the photo's border in both directions: nothing more could be kept.
    assert (low < 1.5).all()
    assert (high > np.array([camera.width, camera.height]) - 1.5).all()
    assert pinhole.focal[0] == pytest.approx(camera.focal[0], rel=0.05)


def test_distorted_checkerboard_becomes_straight() -> None:
    """Draw a board through the lens; the undistorted photo must equal the board drawn straight."""
    camera = LensCamera("OPENCV", 240, 180, (220, 220, 118, 92, -0.12, 0.03, 1e-3, 5e-4))
    fine = 5

    def board(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 127.5 + 100 * np.sin(22 * x) * np.sin(19 * y)

    columns, rows = np.meshgrid(
        np.linspace(-0.7, 0.7, 240 * fine), np.linspace(-0.55, 0.55, 180 * fine)
    )
    u, v = opencv_pixel(camera, columns, rows)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    index = v[inside].astype(int) * camera.width + u[inside].astype(int)
    size = camera.width * camera.height
    total = np.bincount(index, board(columns, rows)[inside], size)
    count = np.bincount(index, minlength=size)
    assert count.min() > 0
    photo = np.rint(total / count).astype(np.uint8).reshape(camera.height, camera.width, 1)
    pinhole = pinhole_of(camera)
    straight = sample_bicubic(photo, sampling_map(camera, pinhole), threads=2)[..., 0]
    fx, fy, cx, cy = pinhole.params
    x = (np.arange(pinhole.width) + 0.5 - cx) / fx
    y = (np.arange(pinhole.height) + 0.5 - cy) / fy
    error = straight - board(*np.meshgrid(x, y))
    # A shift by half a pixel would give an error of 5 here.
    assert np.sqrt((error[3:-3, 3:-3] ** 2).mean()) < 1.2


def test_folding_distortion_never_gives_a_folded_picture() -> None:
    camera = LensCamera("SIMPLE_RADIAL", 200, 150, (100.0, 100.0, 75.0, -0.6))
    pinhole = pinhole_of(camera)
    where = sampling_map(camera, pinhole)
    assert (np.diff(where[..., 0], axis=1) > 0).all()
    assert (np.diff(where[..., 1], axis=0) > 0).all()
    with pytest.raises(DatasetError, match="several rays"):
        pinhole_of(LensCamera("SIMPLE_RADIAL", 200, 150, (100.0, 100.0, 75.0, -900.0)))


def test_bicubic_reproduces_pixels_and_quadratics() -> None:
    rows, columns = np.mgrid[0:20, 0:30]
    photo = (0.2 * columns**2 + 3 * rows).astype(np.uint8)[..., None]
    grid = np.stack([columns + 0.5, rows + 0.5], 2).astype(np.float32)
    np.testing.assert_array_equal(sample_bicubic(photo, grid), photo)
    ramp = np.repeat((8 * columns).astype(np.uint8)[..., None], 3, 2)
    half = sample_bicubic(ramp, grid[:, 2:-3] + np.float32([0.5, 0.0]), threads=2)
    np.testing.assert_array_equal(half[..., 1], 8 * columns[:, 2:-3] + 4)
    outside = sample_bicubic(photo, np.full((1, 1, 2), -50, np.float32))
    assert outside[0, 0, 0] == photo[0, 0, 0]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_as_pillow_does(tmp_path: Path, orientation: int) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 255, (6, 9, 3)).astype(np.uint8)
    for suffix in ("png", "jpg", "tif"):
        path = tmp_path / f"a.{suffix}"
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(pixels).save(path, exif=exif)
        with Image.open(path) as image:
            expected = np.asarray(ImageOps.exif_transpose(image))
        np.testing.assert_array_equal(read_photo(path).color, expected)
        header = read_photo_header(path)
        assert header is not None
        assert header.upright_size == expected.shape[1::-1]
        if suffix != "tif":  # Pillow turns TIFF upright itself
            assert (header.width, header.height, header.orientation) == (9, 6, orientation)
            assert read_photo(path).plain == (orientation == 1)
    np.testing.assert_array_equal(apply_orientation(pixels, 1), pixels)


def test_every_pixel_format_gives_the_right_colours(tmp_path: Path) -> None:
    red = np.zeros((20, 30, 3), np.uint8)
    red[...] = [200, 40, 80]
    path = tmp_path / "x.png"

    def color_of(image: Image.Image, name: str = "x.png", **options: object) -> list[int]:
        image.save(tmp_path / name, **options)
        return read_photo(tmp_path / name).color[10, 15].tolist()

    photo = Image.fromarray(red)
    assert color_of(photo) == [200, 40, 80]
    assert color_of(photo.convert("P", palette=Image.Palette.ADAPTIVE)) == [200, 40, 80]
    assert color_of(Image.fromarray(red[..., 0])) == [200, 200, 200]
    assert color_of(Image.fromarray(red[..., 0].astype(np.uint16) * 257)) == [200, 200, 200]
    cmyk = color_of(photo.convert("CMYK"), "x.jpg", quality=95)
    assert np.abs(np.array(cmyk) - [200, 40, 80]).max() <= 4
    bits = Image.fromarray(red[..., 0] > 100)
    assert color_of(bits) == [255, 255, 255]
    alpha = np.full((20, 30), 255, np.uint8)
    alpha[:, :10] = 0
    Image.fromarray(np.dstack([red, alpha])).save(path)
    read = read_photo(path)
    assert read.color[10, 15].tolist() == [200, 40, 80]
    assert read.alpha is not None
    np.testing.assert_array_equal(read.alpha, alpha)
    np.testing.assert_array_equal(read_mask(path) > 0, alpha > 0)
    Image.fromarray(np.dstack([red, np.full_like(alpha, 255)])).save(path)
    assert read_photo(path).alpha is None


def test_broken_photos_name_the_file(tmp_path: Path) -> None:
    photo = Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8))
    photo.save(tmp_path / "whole.jpg")
    data = (tmp_path / "whole.jpg").read_bytes()
    photo.save(tmp_path / "whole.png")
    cases = {
        "empty.jpg": b"",
        "text.jpg": b"this is no photo, only its name says so",
        "cut.jpg": data[: len(data) // 2],
        "header.jpg": data[:100],
        "cut.png": (tmp_path / "whole.png").read_bytes()[:300],
    }
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder.jpg").mkdir()
    (tmp_path / "link.jpg").symlink_to(tmp_path / "nowhere.jpg")
    for name in (*cases, "folder.jpg", "link.jpg"):
        with pytest.raises(DatasetError, match=name):
            read_photo(tmp_path / name)


def rays() -> np.ndarray:
    """Return (n, 3) rays over the whole photo of a lens of 100 pixels focal length."""
    x, y = np.meshgrid(np.linspace(-0.55, 0.55, 23), np.linspace(-0.45, 0.45, 19))
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)


def test_agrees_with_pycolmap_without_k4_and_skew() -> None:
    pytest.importorskip("pycolmap")
    focal, center = (100.0, 103.0), (60.0, 45.0)
    full = Brown(-0.2, 0.06, -0.01, p1=0.003, p2=-0.002).lens(120, 90, focal, center)
    assert full.model == "FULL_OPENCV"
    own = LensCamera(
        SKEWED_BROWN, 120, 90, (*focal, *center, 0.0, -0.2, 0.06, -0.01, 0.0, 0.003, -0.002)
    )
    np.testing.assert_allclose(project(own, rays()), project(full, rays()), rtol=0, atol=1e-11)


def test_every_pixel_leads_back_to_its_ray() -> None:
    camera = CAMERAS["skewed"]
    assert camera.model == SKEWED_BROWN
    lens = SkewedBrown(camera)
    back = lens.cam_from_img(lens.img_from_cam(rays()))
    np.testing.assert_allclose(back, rays()[:, :2], rtol=0, atol=1e-12)
    half = camera.resized(60, 45)
    np.testing.assert_allclose(project(half, rays()), 0.5 * project(camera, rays()), atol=1e-12)


def test_pixels_that_no_ray_reaches_are_not_a_number() -> None:
    camera = Brown(-0.4, k4=1e-3).lens(120, 90, (20.0, 20.0), (60.0, 45.0))
    slopes = SkewedBrown(camera).cam_from_img(np.array([[60.0, 45.0], [119.0, 45.0]]))
    np.testing.assert_allclose(slopes[0], 0.0, atol=1e-15)
    assert np.isnan(slopes[1]).all()
