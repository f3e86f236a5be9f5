# SPDX-License-Identifier: GPL-3.0-or-later
"""Images are opened in formats of photos only, whatever their names say; GPS; files are closed."""

from __future__ import annotations

import ast
import json
import os
import struct
import sys
import threading
import warnings
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image
from PIL.TiffImagePlugin import IFDRational

from gaussian_wrapping_addon.core.errors import DatasetError, ParseError
from gaussian_wrapping_addon.core.evaluation.layouts import read_mesh
from gaussian_wrapping_addon.core.jobs.commands import export_files
from gaussian_wrapping_addon.core.photos.exif import gps_of_tags, read_gps_exif, read_lens_exif
from gaussian_wrapping_addon.core.photos.formats import (
    IMAGE_FORMATS,
    read_photo_header,
    without_warnings,
)
from gaussian_wrapping_addon.core.photos.photo_file import read_mask, read_photo

pytestmark = pytest.mark.skipif(os.name == "nt", reason="Ghostscript is stood for by a script")
PACKAGE = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon"
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n(x) run\nshowpage\n%%EOF\n"


@pytest.fixture
def ghostscript(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a Ghostscript on the path; the file returned exists once it was started."""
    started = tmp_path / "started"
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "gs").write_text(f"#!/bin/sh\n: > '{started}'\n")
    (tmp_path / "bin" / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=os.pathsep)
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    return started


def test_the_fixture_would_see_ghostscript(tmp_path: Path, ghostscript: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(EPS)
    with (
        pytest.raises(OSError, match=r"identify|open|No such"),
        Image.open(tmp_path / "a.jpg") as image,
    ):
        image.load()
    assert ghostscript.exists()


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif"])
def test_postscript_named_as_a_photo_starts_nothing(
    tmp_path: Path, name: str, ghostscript: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(EPS)
    for read in (read_photo_header, read_photo, read_mask):
        with pytest.raises(DatasetError, match=name):
            read(path)
    for image in (export_files._image, export_files._png):
        with pytest.raises(ParseError, match=name):
            image(path)
    read_lens_exif(path, 8, 8)
    assert not ghostscript.exists()


@pytest.mark.parametrize("format", IMAGE_FORMATS)
def test_all_formats_of_photos_are_read(tmp_path: Path, format: str) -> None:
    path = tmp_path / "a.jpg"  # the content counts
    first, second = (Image.new("RGB", (12, 9), (value,) * 3) for value in (200, 50))
    # Telephones and stereo cameras write several pictures into one file.
    more = {"save_all": True, "append_images": [second]} if format == "MPO" else {}
    first.save(path, format=format, **more)
    assert abs(int(read_photo(path).color.mean()) - 200) < 3


@pytest.mark.parametrize("format", ["GIF", "PPM", "TGA"])
def test_other_formats_are_refused_by_name(tmp_path: Path, format: str) -> None:
    path = tmp_path / "a.jpg"
    Image.new("RGB", (8, 8)).save(path, format=format)
    with pytest.raises(DatasetError, match=r"a\.jpg"):
        read_photo(path)


def glb_with_texture(texture: bytes) -> bytes:
    """Return a triangle with UVs and an embedded texture."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    uvs = np.zeros((3, 2), np.float32).tobytes()
    faces = np.array([0, 1, 2, 0], np.uint16).tobytes()
    body, views = b"", []
    for part in (points, uvs, faces, texture):
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(part)})
        body += part + b"\0" * (-len(part) % 4)
    values = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0}, {"mesh": 0}],
        "meshes": [
            {"primitives": [
                {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
            ]}
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
    }  # fmt: skip
    text = json.dumps(values).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def test_the_texture_of_a_mesh_to_evaluate_starts_nothing(
    tmp_path: Path, ghostscript: Path
) -> None:
    (tmp_path / "a.glb").write_bytes(glb_with_texture(EPS))
    with pytest.raises(ParseError, match=r"a\.glb.*Ghostscript"):
        read_mesh(tmp_path / "a.glb")  # trimesh cannot leave its textures out
    head = "ply\nformat ascii 1.0\ncomment TextureFile a.eps\nelement vertex 3\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "s", "t"))
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(head + "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n")
    (tmp_path / "a.eps").write_bytes(EPS)
    assert len(read_mesh(tmp_path / "a.ply")[1]) == 1
    assert not ghostscript.exists()
    assert not EpsImagePlugin.has_ghostscript(), "a later look at the texture would start it"


def test_pillow_opens_files_in_one_place_only() -> None:
    places = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if "Image.open" in (text := path.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr == "open"
        and getattr(node.func.value, "id", "") in ("Image", "PIL")
    }
    assert places == {"core/photos/formats.py"}


def test_threads_that_overlap_hear_no_warning_and_restore_the_filters() -> None:
    """The one that entered first leaves first, as two threads that read photos may."""
    first_entered, first_left, second_entered = (threading.Event() for _ in range(3))

    def first() -> None:
        with without_warnings():
            first_entered.set()
            second_entered.wait(10)
        first_left.set()

    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        before = list(warnings.filters)
        thread = threading.Thread(target=first)
        thread.start()
        assert first_entered.wait(10)
        with without_warnings():
            second_entered.set()
            assert first_left.wait(10)
            warnings.warn("of a cut entry", stacklevel=1)
        thread.join()
        after = list(warnings.filters)
        warnings.warn("heard again", stacklevel=1)
    assert [str(one.message) for one in heard] == ["heard again"]
    assert after == before


NORTH_EAST = {1: "N", 2: (47.0, 30.0, 36.0), 3: "E", 4: (8.0, 45.0, 0.0)}


def test_a_photo_keeps_its_position(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    exif = Image.Exif()
    exif[0x8825] = {
        1: "S", 2: (33.0, 51.0, 25.2), 3: "W", 4: (70.0, 30.0, 0.0), 5: b"\x01",
        6: Fraction(125, 10), 11: Fraction(18, 10), 18: "WGS-84", 31: Fraction(42, 10),
    }  # fmt: skip
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    found = read_gps_exif(path)
    place = (found.latitude_deg, found.longitude_deg)
    assert place == pytest.approx((-33.857, -70.5))
    assert (found.altitude_m, found.altitude_reference) == (-12.5, "sea level")
    assert (found.dop, found.error_m) == (1.8, 4.2)
    short = gps_of_tags({1: b"N\0", 2: (47.51,), 3: "e", 4: (8.0, 45.0)})
    assert (short.latitude_deg, short.longitude_deg) == (47.51, 8.75)
    Image.new("RGB", (8, 8)).save(tmp_path / "plain.png")
    (tmp_path / "b.jpg").write_bytes(b"no photo")
    for name in ("plain.png", "b.jpg", "missing.jpg"):
        assert read_gps_exif(tmp_path / name) is None


@pytest.mark.parametrize(
    ("changes", "altitude", "reference"),
    [
        ({}, None, "sea level"),
        ({6: 10.0}, 10.0, "sea level"),
        ({6: 10.0, 5: b"\x00"}, 10.0, "sea level"),
        ({6: 10.0, 5: 2}, 10.0, "ellipsoid"),
        ({6: 10.0, 5: b"\x03"}, -10.0, "ellipsoid"),
        ({6: 10.0, 5: b"\x09"}, 10.0, "sea level"),
        ({6: IFDRational(1, 0)}, None, "sea level"),
        ({6: 1e9}, None, "sea level"),
        ({6: "high"}, None, "sea level"),
    ],
)
def test_altitudes(changes: dict[int, Any], altitude: float | None, reference: str) -> None:
    found = gps_of_tags({**NORTH_EAST, **changes})
    assert (found.altitude_m, found.altitude_reference) == (altitude, reference)


@pytest.mark.parametrize(
    "changes",
    [
        {1: None}, {1: "X"}, {3: ""}, {2: (91.0, 0.0, 0.0)}, {4: (180.0, 1.0, 0.0)},
        {2: (47.0, -3.0, 0.0)}, {2: (IFDRational(0, 0), 0.0, 0.0)}, {2: ()}, {2: (1, 2, 3, 4)},
        {4: "8"*5}, {2: None}, {9: "V"}, {2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)},
        {2: (float("nan"), 0.0, 0.0)}, {4: (float("inf"),)},
    ],
)  # fmt: skip
def test_what_is_no_position(changes: dict[int, Any]) -> None:
    assert gps_of_tags({**NORTH_EAST, **changes}) is None


PIXELS = np.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=np.uint8)


def open_files(folder: Path) -> list[str]:
    """Return the files of a folder that this process holds open."""
    names = []
    for entry in Path("/proc/self/fd").iterdir():
        try:
            names.append(os.readlink(entry))
        except OSError:  # the listing's own
            continue
    return [name for name in names if name.startswith(str(folder))]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc, which Linux has")
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("read", [read_photo, read_mask])
def test_no_file_stays_open(tmp_path: Path, suffix: str, read: object) -> None:
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(PIXELS).save(path)
    kept = read(path)  # type: ignore[operator]
    assert open_files(tmp_path) == []
    if suffix == "png" and read is read_photo:
        np.testing.assert_array_equal(kept.color, PIXELS)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DatasetError) as caught:
        read(path)  # type: ignore[operator]
    # The traceback, which the exception holds, holds what was opened.
    assert open_files(tmp_path) == []
    assert "a." in str(caught.value)
