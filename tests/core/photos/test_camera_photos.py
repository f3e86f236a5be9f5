# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos as cameras and phones write them: HEIC, AVIF, RAW, 16 bits, any orientation."""

from __future__ import annotations

import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from gaussian_wrapping_addon.core.errors import DatasetError, MissingExtraError
from gaussian_wrapping_addon.core.photos import finder, formats
from gaussian_wrapping_addon.core.photos.exif import read_lens_exif
from gaussian_wrapping_addon.core.photos.formats import read_photo_header
from gaussian_wrapping_addon.core.photos.photo_file import (
    apply_orientation,
    photo_header,
    read_mask,
    read_photo,
)
from gaussian_wrapping_addon.core.worker import environment
from tests.core.photos.camera_files import tiff, write_dng

pillow_heif = pytest.importorskip("pillow_heif")


pytest.importorskip("rawpy")


HEIC_ERROR = 6
"""Levels of 255 that the codec may be away from flat colours."""


def quarters(height: int = 64, width: int = 96) -> np.ndarray:
    """Four flat quarters of four colours: every orientation gives another picture."""
    pixels = np.full((height, width, 3), 60, np.uint8)
    pixels[: height // 2, : width // 2] = (220, 40, 40)
    pixels[: height // 2, width // 2 :] = (40, 220, 40)
    pixels[height // 2 :, : width // 2] = (40, 40, 220)
    return pixels


def exif_of(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif[0x010F], exif[0x0110] = "Maker", "Phone 7"
    exif.get_ifd(0x8769)[0xA405] = 26
    return exif


def write_modern(path: Path, pixels: np.ndarray, orientation: int = 1, **options: object) -> Path:
    """Write HEIC or AVIF without loss of colour resolution."""
    pillow_heif.register_heif_opener()
    fine = {"chroma": 444} if path.suffix == ".heic" else {"subsampling": "4:4:4"}
    exif = exif_of(orientation).tobytes()
    Image.fromarray(pixels).save(path, quality=95, exif=exif, **fine, **options)
    return path


def worst(a: np.ndarray, b: np.ndarray) -> int:
    """Largest difference, apart from the edges between the quarters, which the codec blurs."""
    assert a.shape == b.shape
    y, x = (np.abs(np.arange(n) - n // 2 + 0.5) > 4 for n in a.shape[:2])
    return int(np.abs(a.astype(int) - b)[np.ix_(y, x)].max())


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["heic", "avif"])
def test_modern_formats_come_upright_once(tmp_path: Path, suffix: str, orientation: int) -> None:
    path = write_modern(tmp_path / f"a.{suffix}", quarters(), orientation)
    wanted = apply_orientation(quarters(), orientation)
    header = photo_header(path)
    assert header.upright_size == (wanted.shape[1], wanted.shape[0])
    photo = read_photo(path)
    assert worst(photo.color, wanted) <= HEIC_ERROR
    assert not photo.plain, "Blender does not read it: a copy is written"
    stored = read_photo(path, upright=False).color
    assert worst(apply_orientation(stored, header.orientation), wanted) <= HEIC_ERROR
    assert stored.shape[:2] == (header.height, header.width)


@pytest.mark.parametrize("orientation", [1, 6])
def test_the_exif_of_heic_does_not_turn_it_again(tmp_path: Path, orientation: int) -> None:
    """Phones write both the rotation of HEIF and that of EXIF: only the first counts."""
    pillow_heif.register_heif_opener()
    exif = exif_of(orientation)
    exif[0x0113] = 6  # pillow-heif would drop the orientation itself
    path = tmp_path / "a.heic"
    Image.fromarray(quarters()).save(path, quality=95, chroma=444, exif=exif.tobytes())
    data = path.read_bytes()
    assert data.count(b"\x01\x13\0\x03\0\0\0\x01\0\x06") == 1
    path.write_bytes(data.replace(b"\x01\x13\0\x03", b"\x01\x12\0\x03"))
    wanted = apply_orientation(quarters(), orientation)
    header = photo_header(path)
    assert header.upright_size == (wanted.shape[1], wanted.shape[0])
    assert worst(read_photo(path).color, wanted) <= HEIC_ERROR


def test_heic_is_known_by_its_content(tmp_path: Path) -> None:
    renamed = write_modern(tmp_path / "a.heic", quarters()).rename(tmp_path / "a.jpg")
    assert formats.photo_kind(renamed) == "heif"
    assert worst(read_photo(renamed).color, quarters()) <= HEIC_ERROR


def test_colours_of_a_display_become_srgb(tmp_path: Path) -> None:
    """A profile with red and green exchanged shows that it is applied; sRGB changes nothing."""
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    swapped = srgb.replace(b"rXYZ", b"xxxx", 1).replace(b"gXYZ", b"rXYZ", 1)
    swapped = swapped.replace(b"xxxx", b"gXYZ", 1)
    for profile, order in ((srgb, [0, 1, 2]), (swapped, [1, 0, 2]), (b"no profile", [0, 1, 2])):
        path = write_modern(tmp_path / "a.heic", quarters(), icc_profile=profile)
        wanted = HEIC_ERROR * (2 if profile == swapped else 1)
        assert worst(read_photo(path).color, quarters()[..., order]) <= wanted


def test_heic_masks_and_transparency(tmp_path: Path) -> None:
    pillow_heif.register_heif_opener()
    mask = np.zeros((64, 96), np.uint8)
    mask[:, 48:] = 255
    Image.fromarray(mask).save(tmp_path / "m.heic", quality=95)
    found = read_mask(tmp_path / "m.heic") >= 128
    assert (found[:, :44] == 0).all()
    assert found[:, 52:].all()
    Image.fromarray(np.dstack([quarters(), mask])).save(tmp_path / "a.heic", quality=95)
    photo = read_photo(tmp_path / "a.heic")
    assert (photo.alpha[:, :44] < 9).all()
    assert (photo.alpha[:, 52:] > 246).all()


def to_srgb(linear: np.ndarray) -> np.ndarray:
    low = linear <= 0.0031308
    return np.rint(255 * np.where(low, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))


def linear_quarters(scale: float = 1.0) -> np.ndarray:
    return (quarters() / 255.0) ** 2.2 * scale


@pytest.mark.parametrize("orientation", range(1, 9))
def test_raw_comes_upright(tmp_path: Path, orientation: int) -> None:
    path = write_dng(tmp_path / "a.dng", linear_quarters(), orientation=orientation)
    wanted = apply_orientation(to_srgb(linear_quarters()), orientation)
    header = photo_header(path)
    assert header.orientation == 1
    assert (header.width, header.height) == (wanted.shape[1], wanted.shape[0])
    photo = read_photo(path)
    assert worst(photo.color, wanted) <= 1
    assert not photo.plain
    half = read_photo(path, enough_px=48).color
    assert half.shape[:2] == (wanted.shape[0] // 2, wanted.shape[1] // 2)
    assert worst(half, wanted[::2, ::2]) <= 1
    assert read_photo(path, enough_px=49).color.shape == wanted.shape


def test_raw_has_the_white_balance_and_the_exposure_of_the_camera(tmp_path: Path) -> None:
    """One and two stops less light give one and two stops less, whatever else is in the photo."""
    made = [(linear_quarters(0.5**stops), (1.0, 1.0, 1.0)) for stops in range(5)]
    made += [(linear_quarters(0.8), neutral) for neutral in ((0.5, 1.0, 0.7), (0.9, 1.0, 0.35))]
    made.append((np.full((64, 96, 3), 0.85), (1.0, 1.0, 1.0)))  # almost white
    for number, (linear, neutral) in enumerate(made):
        path = write_dng(tmp_path / f"{number}.dng", linear, neutral=neutral)
        assert worst(read_photo(path).color, to_srgb(linear)) <= 1


def test_lenses_of_raw_and_heic(tmp_path: Path) -> None:
    path = write_dng(tmp_path / "a.dng", linear_quarters())
    lens = read_lens_exif(path, 96, 64)
    assert lens.key == ("Maker", "Model 1", "Lens 24", "24.0", "36.0")
    diagonal = np.hypot(96, 64) / np.hypot(36, 24)
    assert lens.focal_px == pytest.approx(36 * diagonal)
    heic = read_lens_exif(write_modern(tmp_path / "a.heic", quarters(), 6), 64, 96)
    assert heic.key[:2] == ("Maker", "Phone 7")
    assert heic.focal_px == pytest.approx(26 * diagonal)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", ["tif", "png"])
def test_sixteen_bits_are_scaled_without_wrapping(tmp_path: Path, kind: str, channels: int) -> None:
    values = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    pixels = values if channels == 1 else np.dstack([values, values[::-1], values.T])
    path = tmp_path / f"a.{kind}"
    if kind == "tif":
        path.write_bytes(tiff(pixels))
    elif channels == 1:
        Image.fromarray(pixels).save(path)
    else:
        path.write_bytes(png_of_16_bits(pixels))
    color = read_photo(path).color.astype(float)
    exact = pixels.reshape(256, 256, channels) / 257.0
    assert np.abs(color - exact).max() <= 1.0
    rows = color[..., 0].ravel()
    assert (np.diff(rows) >= 0).all(), "wrapped"
    assert (rows[0], rows[-1]) == (0, 255)


def png_of_16_bits(pixels: np.ndarray) -> bytes:
    """Return a PNG of 16-bit colours, which Pillow reads but does not write."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        size, check = struct.pack(">I", len(body)), struct.pack(">I", zlib.crc32(kind + body))
        return size + kind + body + check

    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    head = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )  # fmt: skip


@pytest.mark.parametrize("suffix", ["heic", "avif", "dng"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.95])
def test_damaged_files_are_named(tmp_path: Path, suffix: str, share: float) -> None:
    path = tmp_path / f"a.{suffix}"
    if suffix == "dng":
        write_dng(path, linear_quarters())
    else:
        write_modern(path, quarters())
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DatasetError, match=r"a\.(heic|avif|dng)"):
        read_photo(path)


def test_random_bytes_named_as_photos(tmp_path: Path) -> None:
    for seed in range(20):
        noise = np.random.default_rng(seed).bytes(5000)
        for suffix, head in (("cr2", b"II*\0"), ("heic", b"\0\0\0\x18ftypheic"), ("cr3", b"")):
            path = tmp_path / f"a{seed}.{suffix}"
            path.write_bytes(head + noise)
            with pytest.raises(DatasetError, match=path.name):
                read_photo(path)
            assert read_lens_exif(path, 96, 64).focal_px is None


def test_of_copies_of_a_photo_one_is_taken(tmp_path: Path) -> None:
    names = [
        "a.JPG", "a.nef", "b.heic", "b.DNG", "c.dng", "d.png", "d.jpg", "d.raf", "e.arw",
        "sub/e.jpg", "f.jpg", "F.CR2", "g.jpg", "g_mask.png", "g.cr3",
    ]  # fmt: skip
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    left_out = {p.relative_to(tmp_path).as_posix() for p in finder.list_second_copies(tmp_path)}
    assert left_out == {"a.nef", "b.DNG", "d.raf", "F.CR2", "g.cr3"}
    taken = {p.relative_to(tmp_path).as_posix() for p in finder.list_photos(tmp_path)}
    assert taken == set(names) - left_out - {"g_mask.png"}
    (tmp_path / "a.heic").write_bytes(b"x")
    (tmp_path / "a.heic.png").write_bytes(b"x")
    assert finder.find_mask([tmp_path], "a.heic") == tmp_path / "a.heic.png"


@pytest.fixture
def no_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker without the packages."""

    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(environment.importlib, "import_module", missing)


def test_without_the_packages_the_files_are_named_at_once(tmp_path: Path, no_extras: None) -> None:
    photos = [write_modern(tmp_path / f"{k}.heic", quarters()) for k in range(5)]
    photos.append(write_dng(tmp_path / "r.dng", linear_quarters()))
    Image.fromarray(quarters()).save(tmp_path / "p.jpg")
    formats.require_extras([tmp_path / "p.jpg", tmp_path / "missing.jpg"])
    begun_s = time.monotonic()
    with pytest.raises(MissingExtraError) as caught:
        formats.require_extras(photos)
    assert time.monotonic() - begun_s < 1
    assert caught.value.extras == ("heif", "raw")
    assert "0.heic, 1.heic, 2.heic and 2 others: " in caught.value.message
    assert "r.dng: " in caught.value.message
    assert "--add heif" in caught.value.hint
    assert "Add Camera RAW" in caught.value.hint
    for path in (photos[0], photos[-1]):
        assert read_photo_header(path) is None, "the check in Blender goes on"
        with pytest.raises(MissingExtraError, match=path.name):
            read_photo(path)


def test_a_jpeg_needs_no_package(tmp_path: Path, no_extras: None) -> None:
    for name in ("a.jpg", "b.heic", "c.dng"):
        Image.fromarray(quarters()).save(tmp_path / name, "JPEG", quality=97)
        assert worst(read_photo(tmp_path / name).color, quarters()) <= HEIC_ERROR
