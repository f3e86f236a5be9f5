# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos and masks: no images, far too large, of unusual kinds, of other sizes than cameras."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from tests.hostile.case import Build, Case, Group, Needs, Variant, Way
from tests.hostile.inputs import (
    COUNT,
    colmap,
    every_photo,
    file,
    link,
    photo,
    pipe,
    plain,
    steps,
    unreadable,
)

_IMAGE = "set/images/p00.png"
_PHOTOS = "tests/core/photos/test_formats.py"
_HARD = "tests/core/jobs/test_hard_photos.py"
_EXPORT = "Export it again as JPEG or PNG, or remove it"
_DROPPED = (
    rf"1 photos cannot be read and are not used.*First: p00\.png is not a readable photo.*{_EXPORT}"
)
_NOT_FOUND = r"1 of 6 photos were not found, such as p00\.png"
_NO_FILE = r"1 photos cannot be read .*p00\.png is not a file.*Remove the name or restore"


def _written(data: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(data) and None


def _jpeg(path: Path) -> None:
    plain(64, 48, format="JPEG")(path)


def _cut_jpeg(path: Path) -> None:
    _jpeg(path)
    path.write_bytes(path.read_bytes()[:900])


def _moving_webp(path: Path) -> None:
    pixels = np.random.default_rng(1).integers(0, 255, (2, 48, 64, 3)).astype(np.uint8)
    frames = [Image.fromarray(frame) for frame in pixels]
    frames[0].save(path, format="WEBP", save_all=True, append_images=frames[1:], lossless=True)


def _bad(name: str, save: Callable[[Path], None], says: str = _DROPPED, code: int = 0) -> Variant:
    return Variant(name, photo("p00.png", save), code, says)


def _loaded(name: str, build: Build, says: str, code: int = 0, **more: object) -> Variant:
    return Variant(f"{name}, loaded", build, code, says, way=Way.LOADING, writes=("out",), **more)  # type: ignore[arg-type]


def _exif_cut(path: Path) -> None:
    """Save a photo whose EXIF entries are cut, of which Pillow would warn."""
    exif = Image.Exif()
    exif[0x010F], exif[0x920A], exif[0xA405] = "Maker", 35.0, 50
    plain(64, 48, format="JPEG", exif=exif.tobytes()[:40])(path)


def _tiff_cut(path: Path) -> None:
    plain(64, 48, format="TIFF")(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 30])


_HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(200)
_FILES = Case(
    25,
    "Photos that are none",
    (
        _bad("0 bytes", _written(b"")),
        _bad("text", _written(b"no photo at all, but some text\n" * 9)),
        _bad("HEIC", _written(_HEIC)),
        _bad("a ZIP", _written(b"PK\x03\x04" + bytes(200))),
        Variant(
            "a folder",
            photo("p00.png", lambda path: path.mkdir()),
            0,
            _NOT_FOUND,
        ),
        Variant(
            "a link that leads nowhere",
            steps(colmap(), link(_IMAGE, "gone.png")),
            0,
            _NO_FILE,
            needs=Needs.POSIX,
        ),
        Variant("a named pipe", steps(colmap(), pipe(_IMAGE)), 0, _NO_FILE, needs=Needs.POSIX),
        Variant(
            "a device",
            steps(colmap(), link(_IMAGE, "/dev/zero")),
            0,
            _NO_FILE,
            needs=Needs.POSIX,
        ),
        Variant(
            "that may not be read",
            steps(colmap(), unreadable(_IMAGE)),
            0,
            r"1 photos cannot be read .*p00\.png cannot be read: Permission denied.*Check its perm",
            needs=Needs.USER,
        ),
        _bad("cut JPEG, header whole", _cut_jpeg, "6 photos: 6 of 64 x 48"),
        _loaded(
            "cut JPEG",
            photo("p00.png", _cut_jpeg),
            r"1 photos cannot be read and are not used: p00\.png cannot be decoded",
        ),
        _bad("cut EXIF entries", _exif_cut, "6 photos: 6 of 64 x 48"),
        _bad("cut TIFF", _tiff_cut, "6 photos: |1 photos cannot be read .*Export it again as JPEG"),
        _loaded("cut EXIF entries", photo("p00.png", _exif_cut), "6 photos and"),
        _loaded("moving WebP", photo("p00.png", _moving_webp), "6 photos and"),
        Variant(
            "more than a fifth",
            every_photo(_written(b"text")),
            3,
            rf"6 of 6 photos cannot be read\. First: p00\.png is not a readable photo.*{_EXPORT}",
        ),
        Variant(
            "a folder of RAW photos that are cut",
            steps(*(file(f"set/IMG_{i}.CR2", b"II*\0") for i in range(4))),
            3,
            rf"4 of 4 photos cannot be read\. First: IMG_0\.CR2 is not a readable photo.*{_EXPORT}",
        ),
    ),
)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _png(width: int, height: int, body: bytes = b"") -> bytes:
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", head)
        + _chunk(b"IDAT", zlib.compress(body, 9))
        + _chunk(b"IEND", b"")
    )


_HUGE = _png(50_000, 50_000, bytes(4_000_000))
_TOO_LARGE = r"p00\.png has 50000 x 50000 pixels; the limit is 100000000"
_BOMBS = Case(
    26,
    "A small file that says 50,000 × 50,000 pixels",
    (
        _bad("one of them", _written(_HUGE), rf"1 photos cannot be read .*{_TOO_LARGE}"),
        Variant(
            "all", every_photo(_written(_HUGE)), 3, rf"6 of 6 photos cannot be read.*{_TOO_LARGE}"
        ),
        _loaded(
            "one of them",
            photo("p00.png", _written(_HUGE)),
            rf"1 photos cannot be read and are not used: {_TOO_LARGE}",
        ),
        _bad("2³¹ pixels wide", _written(_png(2**31 - 1, 48)), "1 photos cannot be read .*pixels"),
        _loaded(
            "pixels that are missing",
            photo("p00.png", _written(_png(64, 48, b"\0" * 99))),
            r"1 photos cannot be read and are not used: p00\.png cannot be decoded",
        ),
    ),
)


def _mode(mode: str, suffix: str = "PNG", **options: object) -> Callable[[Path], None]:
    def save(path: Path) -> None:
        pixels = np.random.default_rng(2).integers(0, 255, (48, 64, 3)).astype(np.uint8)
        Image.fromarray(pixels).convert(mode).save(path, format=suffix, **options)

    return save


def _sixteen_bits(path: Path) -> None:
    pixels = np.random.default_rng(2).integers(0, 65535, (48, 64)).astype(np.uint16)
    Image.fromarray(pixels).save(path, format="PNG")


_KINDS = Case(
    27,
    "Photos of unusual kinds",
    (
        _loaded("grey", every_photo(_mode("L")), "6 photos and"),
        _loaded("CMYK JPEG", every_photo(_mode("CMYK", "JPEG")), "6 photos and"),
        _loaded("grey of 16 bits", every_photo(_sixteen_bits), "6 photos and"),
        _loaded("palette", every_photo(_mode("P")), "6 photos and"),
        _loaded("alpha", every_photo(_mode("RGBA")), "6 photos and"),
        _loaded("1 bit", every_photo(_mode("1")), "6 photos and"),
        _loaded(
            "a colour profile that is broken",
            every_photo(_mode("RGB", icc_profile=b"no profile")),
            "6 photos and",
        ),
        _bad("1 × 1", plain(1, 1), r"1 photos cannot be read .*p00\.png is 1 x 1 pixels.*larger"),
        _bad(
            "20,000 × 10",
            plain(20_000, 10),
            r"1 photos cannot be read .*p00\.png is 20000 x 10 pixels.*larger",
        ),
    ),
    (f"{_HARD}::test_it_ends_in_a_closed_mesh", f"{_PHOTOS}::test_all_formats_of_photos_are_read"),
)

_USE = "Use the photos that the cameras were solved with"
_SIZES = Case(
    28,
    "Photos of another size than their cameras",
    (
        _bad("half", plain(32, 24), "5 of 64 x 48, 1 of 32 x 24"),
        _bad("twice", plain(128, 96), "5 of 64 x 48, 1 of 128 x 96"),
        _bad("turned", plain(48, 64), r"p00\.png .*48 x 64.*rotated by 90 degrees.*", 3),
        _bad("square", plain(64, 64), rf"p00\.png is 64 x 64 .*its camera 64 x 48.*{_USE}", 3),
    ),
)


def _mask(pixels: Callable[[], np.ndarray]) -> Callable[[Path], None]:
    def save(path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels()).save(path, format="PNG")

    return save


def _half(width: int = 64, height: int = 48) -> np.ndarray:
    mask = np.zeros((height, width), np.uint8)
    mask[:, : width // 2] = 255
    return mask


def _masks(pattern: str, pixels: Callable[[], np.ndarray], count: int = COUNT) -> Build:
    def build(folder: Path) -> None:
        colmap()(folder)
        for number in range(count):
            _mask(pixels)(folder / "set" / "masks" / pattern.format(number=number))

    return build


def _black() -> np.ndarray:
    return np.zeros((48, 64), np.uint8)


_MASKS = Case(
    29,
    "Masks",
    (
        Variant("for some", _masks("p{number:02d}.png", _half, 2), 0, "2 of 6 photos have a mask"),
        Variant(
            "x.png.png", _masks("p{number:02d}.png.png", _half), 0, "6 of 6 photos have a mask"
        ),
        _loaded(
            "of another size",
            _masks("p{number:02d}.png", lambda: _half(50, 50)),
            r"6 masks were not used: Mask p00\.png is 50 x 50 pixels, its photo 64 x 48",
        ),
        _loaded("of half the size", _masks("p{number:02d}.png", lambda: _half(32, 24)), "6 photos"),
        _loaded(
            "in colours",
            _masks("p{number:02d}.png", lambda: np.repeat(_half()[..., None], 3, 2)),
            "6 photos and",
        ),
        _loaded(
            "no image",
            steps(_masks("p{number:02d}.png", _half), file("set/masks/p00.png", b"text")),
            r"1 masks were not used: Mask p00\.png is not a readable photo",
        ),
        _loaded("white", _masks("p{number:02d}.png", lambda: _black() + 255), "6 photos and"),
        _loaded(
            "one black",
            _masks("p{number:02d}.png", _black, 1),
            r"1 photos are masked altogether and are not used: p00\.png.*White or opaque is kept",
        ),
        _loaded(
            "all black",
            _masks("p{number:02d}.png", _black),
            "Only 0 photos are usable.*6 photos are masked altogether.*White or opaque is kept",
            3,
        ),
    ),
)

_FOLDERS = Case(
    30,
    "Photo folders that are read-only, disappear or change",
    (
        Variant(
            "read-only",
            colmap(),
            0,
            "6 photos: 6 of 64 x 48",
            closed="set",
            needs=Needs.CLOSED_FOLDER,
        ),
        _loaded("read-only", colmap(), "6 photos and", closed="set", needs=Needs.CLOSED_FOLDER),
        Variant(
            "results inside of it",
            colmap(),
            2,
            r"set/out lies inside the photos' folder\. Choose a folder outside of it",
            ("wrap", "set", "--out", "set/out", "--no-blend"),
        ),
    ),
    (
        "tests/core/jobs/test_changed_photos.py::test_a_mesh_is_of_the_training_as_it_is",
        "tests/core/jobs/test_changed_photos.py::test_photos_that_are_the_same_say_nothing",
    ),
)

GROUP = Group("Photos and masks", (_FILES, _BOMBS, _KINDS, _SIZES, _MASKS, _FOLDERS))
