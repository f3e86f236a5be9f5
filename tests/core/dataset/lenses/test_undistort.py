# SPDX-License-Identifier: GPL-3.0-or-later
"""Undistortion: straight lines, no black border, exact sampling; photo decoding and headers."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.photos.formats import read_photo_header
from gaussian_wrapping_addon.core.photos.photo_file import apply_orientation, read_mask, read_photo
from gaussian_wrapping_addon.core.readers.lenses import pinhole_of, sampling_map
from gaussian_wrapping_addon.core.readers.source_model import LensCamera
from gaussian_wrapping_addon.core.resampling import sample_bicubic

CAMERAS = {
    "barrel": LensCamera("SIMPLE_RADIAL", 200, 150, (180.0, 102.0, 74.0, -0.15)),
    "pincushion": LensCamera("RADIAL", 200, 150, (180.0, 98.0, 76.0, 0.15, 0.02)),
    "opencv": LensCamera("OPENCV", 120, 200, (140, 141, 61, 99, 0.06, -0.08, 1e-3, -2e-3)),
    "fisheye": LensCamera("OPENCV_FISHEYE", 200, 160, (120, 120, 100, 80, 0.02, 0.0, 0.0, 0.0)),
    "full": LensCamera(
        "FULL_OPENCV", 200, 150, (180, 180, 100, 75, 0.1, 0.02, 0, 0, 0.01, 0.05, 0, 0)
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


def test_map_is_the_lens_formula() -> None:
    camera = CAMERAS["opencv"]
    pinhole = pinhole_of(camera)
    where = sampling_map(camera, pinhole)
    fx, fy, cx, cy = pinhole.params
    columns, rows = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    u, v = opencv_pixel(camera, (columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy)
    np.testing.assert_allclose(where[..., 0], u, atol=2e-5)
    np.testing.assert_allclose(where[..., 1], v, atol=2e-5)


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
        with pytest.raises(DatasetError, match=name):
            read_photo(tmp_path / name)
    (tmp_path / "folder.jpg").mkdir()
    (tmp_path / "link.jpg").symlink_to(tmp_path / "nowhere.jpg")
    for name in ("folder.jpg", "link.jpg"):
        with pytest.raises(DatasetError, match=name):
            read_photo(tmp_path / name)


def test_bomb_is_refused_on_its_header(tmp_path: Path) -> None:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    path = tmp_path / "bomb.png"
    size = struct.pack(">IIBBBBB", 50_000, 40_000, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(50_001 * 100))
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    )
    with pytest.raises(DatasetError, match="50000 x 40000 pixels; the limit"):
        read_photo(path)
