# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera files of other programs: broken, hostile, or without their photos."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from tests.core.readers import writers
from tests.core.readers.model_writers import HEIGHT, WIDTH, ring_poses
from tests.core.readers.writers import Shots
from tests.hostile.case import Build, Variant
from tests.hostile.inputs import COUNT, changed, file, remove, steps, transforms

_NAMES = tuple(f"p{i:02d}.png" for i in range(COUNT))
_GOOD = f"{COUNT} photos: {COUNT} of {WIDTH} x {HEIGHT}"
_AGAIN = "Export the cameras again"
_XML_AGAIN = "Export the file again"
_TABLE = "#name,x,y,alt,heading,pitch,roll,f,px,py\np00.png,1,2,3,0,0,0,35,0,0\n"


def _cameras(write: Callable[[Path, Shots], Path], lens: dict[str, float], at: str = "") -> Build:
    """Return the build of six photos with a camera file beside them, below the folder ``at``."""

    def build(folder: Path) -> None:
        steps(transforms(), remove("set/transforms.json"))(folder)
        target = folder / "set" / at
        target.mkdir(exist_ok=True)
        write(target, Shots(_NAMES, ring_poses(COUNT), WIDTH, HEIGHT, lens))

    return build


_CSV = _cameras(writers.write_realityscan_csv, {"f": 30.0})
_XMP = _cameras(writers.write_realityscan_xmp, {"f": 30.0}, "images")
_METASHAPE = _cameras(writers.write_metashape, {"f": 60.0})
_MESHROOM = _cameras(writers.write_meshroom, {"f": 34.0})
_OPENSFM = _cameras(writers.write_opensfm, {"focal_x": 0.94, "focal_y": 0.94})


def _replaced(build: Build, name: str, old: str, new: str) -> Build:
    def change(data: bytes) -> bytes:
        assert old.encode() in data
        return data.replace(old.encode(), new.encode(), 1)

    return steps(build, changed(f"set/{name}", change))


def _grown(build: Build, name: str) -> Build:
    def grow(folder: Path) -> None:
        with (folder / "set" / name).open("r+b") as stream:
            stream.truncate(300 * 2**20)  # a sparse file

    return steps(build, grow)


_LAUGHS = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "ha"}">' for i in range(9))
_BOMB = f'<?xml version="1.0"?><!DOCTYPE d [{_LAUGHS}]><document><chunk label="&e8;"/></document>'
_ELSEWHERE = (
    '<!DOCTYPE d [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    '<document><chunk label="&x;"/></document>'
)
_SHOT = {"rotation": [0, 0, 0], "translation": [0, 0, 0], "camera": "c"}

VARIANTS = (
    Variant(
        "a CSV without its photos",
        file("set.csv", _TABLE),
        3,
        r"None of the 1 photos that the RealityScan CSV names was found.*Looked for p00\.png in",
        ("check", "set.csv"),
    ),
    Variant(
        "a CSV of one row beside photos",
        steps(transforms(), remove("set/transforms.json"), file("set/poses.csv", _TABLE)),
        3,
        "Only 1 photo is usable; at least 3.*Add photos",
    ),
    Variant("a good CSV", _CSV, 0, _GOOD),
    Variant(
        "NaN in a CSV", _replaced(_CSV, "cameras.csv", "30.0", "nan"), 3,
        rf"cameras\.csv, line 2, f: the number is not finite.*{_AGAIN}",
    ),
    Variant(
        "a CSV with an open quote", _replaced(_CSV, "cameras.csv", "30.0", '"30'), 3,
        rf"cameras\.csv, line \d+: not CSV.*{_AGAIN}",
    ),
    Variant(
        "a CSV of other columns", _replaced(_CSV, "cameras.csv", "heading", "omega"), 3,
        r"cameras\.csv, line 1: columns are missing: heading.*Export",
    ),
    Variant("good XMP files", _XMP, 0, _GOOD),
    Variant(
        "entities in an XMP file",
        _replaced(_XMP, "images/p01.xmp", "<x:", f"<!DOCTYPE d [{_LAUGHS}]><x:"), 3,
        rf"p01\.xmp, line 1: document types and entities are not read.*{_XML_AGAIN}",
    ),
    Variant(
        "an XMP file that mirrors",
        steps(
            _XMP,
            changed(
                "set/images/p02.xmp",
                lambda data: data.split(b"<xcr:Rotation>")[0]
                + b"<xcr:Rotation>1 0 0 0 1 0 0 0 -1</xcr:Rotation>"
                + data.split(b"</xcr:Rotation>")[1],
            ),
        ), 3,
        rf"p02\.xmp, xcr:Rotation: the matrix mirrors.*{_AGAIN}",
    ),
    Variant("a good cameras.xml", _METASHAPE, 0, _GOOD),
    Variant(
        "a cameras.xml with a billion laughs", file("cameras.xml", _BOMB), 3,
        rf"cameras\.xml, line 1: document types and entities are not read.*{_XML_AGAIN}",
        ("check", "cameras.xml"),
    ),
    Variant(
        "a cameras.xml that names another file", file("cameras.xml", _ELSEWHERE), 3,
        rf"cameras\.xml, line 1: document types and entities are not read.*{_XML_AGAIN}",
        ("check", "cameras.xml"),
    ),
    Variant(
        "a cameras.xml of 300 MB", _grown(_METASHAPE, "cameras.xml"), 3,
        r"cameras\.xml, whole file: more than \d+ bytes are too many.*Check that",
    ),
    Variant(
        "a cameras.xml cut in the middle",
        steps(_METASHAPE, changed("set/cameras.xml", lambda data: data[:1500])), 3,
        rf"cameras\.xml, line \d+: not XML.*{_XML_AGAIN}",
    ),
    Variant("a good cameras.sfm", _MESHROOM, 0, _GOOD),
    Variant(
        "a cameras.sfm whose paths lead upwards",
        _replaced(_MESHROOM, "cameras.sfm", '"p00.png"', '"../../../etc/passwd"'), 0,
        "1 of 6 photos were not found, such as passwd",
    ),
    Variant(
        "a cameras.sfm with 10⁹ as a photo's width",
        _replaced(_MESHROOM, "cameras.sfm", '"sensorWidth"', '"width": "1000000000", "x"'), 3,
        rf"cameras\.sfm, intrinsics\[0\]: image size 1000000000 x 48 is out of range.*{_AGAIN}",
    ),
    Variant("a good reconstruction.json", _OPENSFM, 0, _GOOD),
    Variant(
        "a reconstruction.json of a list of numbers", file("reconstruction.json", "[1, 2]"), 3,
        rf"reconstruction\.json, top level: a list of reconstructions was expected.*{_AGAIN}",
        ("check", "reconstruction.json"),
    ),
    Variant(
        "a reconstruction.json whose camera is missing",
        file("reconstruction.json", json.dumps([{"shots": {"a.jpg": _SHOT}, "cameras": {}}])), 3,
        rf"reconstruction\.json, \[0\]\.shots\['a\.jpg'\]\.camera: it is not among.*{_AGAIN}",
        ("check", "reconstruction.json"),
    ),
    Variant(
        "a shots.geojson without cameras.json",
        file("shots.geojson", json.dumps({"features": [{"properties": {"filename": "a.jpg"}}]})), 3,
        r"cameras\.json, which holds the lenses of shots\.geojson, is missing.*Put it beside",
        ("check", "shots.geojson"),
    ),
)  # fmt: skip
