# SPDX-License-Identifier: GPL-3.0-or-later
"""Region files and resolutions, which are refused before a worker starts."""

from __future__ import annotations

import math
from typing import Any

from gaussian_wrapping_addon.core import limits
from tests.hostile.case import Build, Case, Group, Needs, Variant
from tests.hostile.inputs import (
    CUBE,
    colmap,
    file,
    folder_of,
    json_file,
    link,
    nothing,
    pipe,
    region,
    steps,
    unreadable,
)

_REGION = "tests/core/regions/test_region.py"
_AGAIN = "Export the region again"
_WORDS = ("wrap", "set", "--region", "box.json", "--out", "out", "--no-blend")
_READ = "set holds no photos"
"""What is said next where the region is good: the set of these cases is empty."""


def _given(name: str, build: Build, says: str, code: int = 3, **more: Any) -> Variant:
    return Variant(name, steps(folder_of("set"), build), code, says, _WORDS, **more)


def _bad(name: str, place: str, says: str, **changes: Any) -> Variant:
    return _given(name, json_file("box.json", region(**changes)), rf"box\.json, {place}: {says}")


_AGAIN_RSBOX = "Export the reconstruction region again"
_RSBOX = (
    '<ReconstructionRegion yawPitchRoll="0 0 0" widthHeightDepth="{}">'
    '<CentreEuclid centre="0 0 0"/></ReconstructionRegion>'
)


def _box(name: str, text: str, says: str) -> Variant:
    words = tuple("box.rsbox" if word == "box.json" else word for word in _WORDS)
    return Variant(name, steps(folder_of("set"), file("box.rsbox", text)), 3, says, words)


_FLAT = [[x, y, 0.0] for x, y, _ in CUBE]
_FILES = Case(
    35,
    "Region files",
    (
        _bad(
            "another class", "class_name", "is not 'Gaussian.*Choose a region file", class_name="x"
        ),
        _bad("version 2", "version", f"'2' is not known; 1 is.*{_AGAIN}", version=2),
        _bad("version true", "version", f"'True' is not known; 1 is.*{_AGAIN}", version=True),
        _bad(
            "three corners",
            "vertices",
            ".*needs at least four corners.*Draw a box",
            vertices=CUBE[:3],
        ),
        _bad("no corners", "vertices", f"is missing or not a list.*{_AGAIN}", vertices=None),
        _bad("flat", "vertices", ".*is flat: .*Give it some height", vertices=_FLAT),
        _bad(
            "a line",
            "vertices",
            ".*is flat: .*Give it some height",
            vertices=[[x, x, x] for x in range(9)],
        ),
        _bad("one point", "vertices", ".*is flat: .*Give it some height", vertices=[[1, 1, 1]] * 9),
        _bad(
            "corners of two numbers", r"vertices\[0\]", f"is not three.*{_AGAIN}", vertices=[[0, 0]]
        ),
        _bad("words", r"vertices\[8\]", f"is not three.*{_AGAIN}", vertices=[*CUBE, [0, 0, "1"]]),
        _bad("1e300", r"vertices\[8\]", f"is not three.*{_AGAIN}", vertices=[*CUBE, [0, 0, 1e300]]),
        _bad(
            "an integer of 400 digits",
            r"vertices\[8\]",
            f"is not three.*{_AGAIN}",
            vertices=[*CUBE, [0, 0, 10**400]],
        ),
        _bad("NaN", "whole file", "NaN is not a number", vertices=[*CUBE, [0, 0, math.nan]]),
        _bad(
            "10,001 corners",
            "vertices",
            f"holds 10001 corners; the limit is {limits.MAX_REGION_VERTICES}.*Use a simpler body",
            vertices=[[0, 0, 0]] * 10_001,
        ),
        _given("a list", json_file("box.json", [region()]), rf"box\.json, top level: .*{_AGAIN}"),
        _given("empty", file("box.json"), r"box\.json, line 1: not JSON.*Export"),
        _given(
            "nested 10⁵ deep", file("box.json", "[" * 100_000), r"box\.json, whole file: nested"
        ),
        _given("no file", nothing, r"Region file box\.json does not exist.*Check the path"),
        _given("a folder", folder_of("box.json"), r"box\.json is a folder.*Give a file in it"),
        _given(
            "a named pipe",
            pipe("box.json"),
            r"Region file box\.json does not exist.*Check the path",
            needs=Needs.POSIX,
        ),
        _given(
            "/dev/zero",
            link("box.json", "/dev/zero"),
            r"Region file box\.json does not exist.*Check the path",
            needs=Needs.POSIX,
        ),
        _given(
            "that may not be read",
            steps(json_file("box.json", region()), unreadable("box.json")),
            r"box\.json, whole file: cannot be read: Permission denied\. Check its permissions",
            needs=Needs.USER,
        ),
        _given("no simplices", json_file("box.json", region()), _READ),
        _given(
            "simplices out of range",
            json_file("box.json", region(hull_simplices=[[0, 1, 99]])),
            _READ,
        ),
        _given(
            "a name of control characters",
            json_file("box.json", region(blender_object_name="a\n\x1b[2J\0b")),
            _READ,
        ),
        _box("a RealityScan box", _RSBOX.format("1 2 3"), _READ),
        _box(
            "a RealityScan box that is flat",
            _RSBOX.format("1 0 3"),
            rf"box\.rsbox, widthHeightDepth: a side is not above 0.*{_AGAIN_RSBOX}",
        ),
        _box(
            "a RealityScan box with entities",
            '<!DOCTYPE a [<!ENTITY b "bbbb">]>' + _RSBOX.format("&b; 2 3"),
            rf"box\.rsbox, whole file: DOCTYPE is not allowed.*{_AGAIN_RSBOX}",
        ),
        _box(
            "a RealityScan box of 70 kB",
            _RSBOX.format("1 2 3") + " " * 70_000,
            r"box\.rsbox, whole file: more than 65536 bytes.*Check that it is the right file",
        ),
        Variant(
            "two of one name",
            steps(
                folder_of("set"), json_file("box.json", region()), json_file("b/box.json", region())
            ),
            2,
            "Two regions have the same name, Cube. Give each region its own name",
            (*_WORDS[:4], "b/box.json", *_WORDS[4:]),
        ),
    ),
    (
        f"{_REGION}::test_bad_files_are_refused_with_their_place",
        "tests/core/regions/test_rsbox.py::test_bad_files_are_refused_by_name",
        "tests/core/regions/test_rsbox.py::test_other_encodings_hide_nothing",
    ),
)


def _length(option: str, value: str, says: str) -> Variant:
    words = ("wrap", "set", f"{option}={value}", "--out", "out", "--no-blend")
    return Variant(f"{option} {value}", colmap(), 2, says, words)


_EDGE = "--edge-length is out of range. Give a positive length of at least 1e-30"
_RESOLUTIONS = "tests/core/jobs/test_resolution_cases.py"
_LENGTHS = Case(
    37,
    "Resolutions that no mesh has",
    (
        *(_length("--edge-length", value, _EDGE) for value in ("-1", "nan", "inf", "1e-320")),
        _length(
            "--edge-length",
            "five",
            "argument --edge-length: invalid float value: 'five'; give a positive",
        ),
        _length("--points", "-1", "--points is out of range. Give "),
        _length("--points", "1000000000000", "--points is out of range. Give "),
        _length("--faces", "-5", "--faces is out of range. Give "),
        _length("--texture-size", "16384", "--texture-size is out of range. Give "),
        _length("--texture-size", "big", "--texture-size.*big"),
        _length("--max-gaussians", "0", "--max-gaussians is out of range. Give "),
        _length("--iterations", "-1", "--iterations is out of range. Give "),
        _length("--threads", "-1", "--threads is out of range. Give "),
        _length("--seed", str(2**64), "--seed is out of range. Give "),
    ),
    (
        f"{_RESOLUTIONS}::test_impossible_lengths_are_refused_and_nothing_is_left",
        f"{_RESOLUTIONS}::test_impossible_lengths_are_refused_before_the_training",
        f"{_RESOLUTIONS}::test_a_length_beyond_the_region_is_clamped_and_said",
        f"{_RESOLUTIONS}::test_no_length_is_the_automatic_one",
        "tests/blender/test_region_resolution.py::test_impossible_lengths_are_refused",
    ),
)

GROUP = Group("Regions and resolutions", (_FILES, _LENGTHS))
