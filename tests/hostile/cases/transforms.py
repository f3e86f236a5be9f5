# SPDX-License-Identifier: GPL-3.0-or-later
"""transforms.json: no JSON, no poses, no intrinsics, names that lead elsewhere; other tables."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core import limits
from tests.hostile.case import Build, Case, Group, Variant
from tests.hostile.cases import programs
from tests.hostile.inputs import (
    file,
    steps,
    transforms,
    transforms_text,
    transforms_values,
)

_NAME = r"transforms\.json, "
_AGAIN = "Export the file again"
_GOOD = "6 photos: 6 of 64 x 48"


def _large(folder: Path) -> None:
    transforms()(folder)
    with (folder / "set" / "transforms.json").open("r+b") as stream:
        stream.truncate(70 * 2**20)  # a sparse file


def _twice_the_key(values: dict[str, Any]) -> str:
    return json.dumps(values)[:-1] + ', "w": 64}'


_LONG_NUMBER = "9" * 5000
_JSON = Case(
    19,
    "transforms.json that is none",
    (
        Variant("words", transforms_text("no json"), 3, f"{_NAME}line 1: not JSON.*{_AGAIN}"),
        Variant("empty", transforms_text(""), 3, f"{_NAME}line 1: not JSON.*{_AGAIN}"),
        Variant("a list", transforms_text("[]"), 3, f"{_NAME}top level: an object.*{_AGAIN}"),
        Variant("a number", transforms_text("3"), 3, f"{_NAME}top level: an object.*{_AGAIN}"),
        Variant(
            "cut in the middle",
            transforms_text(json.dumps(transforms_values())[:300]),
            3,
            f"{_NAME}line 1: not JSON.*{_AGAIN}",
        ),
        Variant(
            "70 MB",
            _large,
            3,
            f"{_NAME}whole file: more than {limits.MAX_JSON_BYTES} bytes are too many.*Check that",
        ),
        Variant(
            "nested 10⁵ deep",
            transforms_text("[" * 100_000),
            3,
            f"{_NAME}whole file: nested too deeply.*{_AGAIN}",
        ),
        Variant(
            "nested deeper than is read",
            transforms(lambda values: {**values, "more": _nested(40)}),
            3,
            f"{_NAME}whole file: nested too deeply.*{_AGAIN}",
        ),
        Variant(
            "the same key twice",
            transforms_text(_twice_the_key(transforms_values())),
            0,
            _GOOD,
        ),
        Variant(
            "NaN",
            transforms(lambda values: {**values, "fl_x": math.nan}),
            3,
            f"{_NAME}whole file: NaN is not a number.*{_AGAIN}",
        ),
        Variant(
            "an integer of 5000 digits",
            transforms_text(f'{{"w": {_LONG_NUMBER}, "frames": [1]}}'),
            3,
            f"{_NAME}whole file: a number has thousands of digits.*{_AGAIN}",
        ),
        Variant(
            "no UTF-8",
            steps(transforms(), file("set/transforms.json", b'{"frames": "\xfc"}')),
            3,
            f"{_NAME}byte 12: not UTF-8 text.*Save it as UTF-8",
        ),
    ),
    ("tests/core/test_files.py::test_bad_json_is_refused_with_the_file_named",),
)


def _nested(depth: int) -> Any:
    values: Any = 1
    for _ in range(depth):
        values = [values]
    return values


def _matrix(number: int, change: Callable[[np.ndarray], Any]) -> Build:
    def apply(values: dict[str, Any]) -> None:
        frame = values["frames"][number]
        found = change(np.array(frame["transform_matrix"]))
        frame["transform_matrix"] = found.tolist() if isinstance(found, np.ndarray) else found

    return transforms(apply)


def _bad_matrix(name: str, change: Callable[[np.ndarray], Any], says: str) -> Variant:
    place = r"frames\[2\]\.transform_matrix"
    return Variant(name, _matrix(2, change), 3, f"{_NAME}{place}: {says}")


def _last_row(matrix: np.ndarray) -> np.ndarray:
    matrix[3, 0] = 1.0
    return matrix


_NUMBERS = rf"4 x 4 \(or 3 x 4\) finite numbers were expected.*{_AGAIN}"
_MATRICES = Case(
    20,
    "Matrices that are no poses",
    (
        Variant("3 x 4", _matrix(2, lambda m: m[:3]), 0, _GOOD),
        Variant(
            "with a scale",
            _matrix(2, lambda m: m @ np.diag([2.5, 2.5, 2.5, 1.0])),
            0,
            "warning: 1 matrices held a scale, which was removed",
        ),
        _bad_matrix("4 x 3", lambda m: m[:, :3], _NUMBERS),
        _bad_matrix("strings", lambda m: [["a"] * 4] * 4, _NUMBERS),
        _bad_matrix("missing", lambda m: None, _NUMBERS),
        _bad_matrix("a number", lambda m: 5, _NUMBERS),
        _bad_matrix("other last row", _last_row, f"the last row must be 0 0 0 1.*{_AGAIN}"),
        _bad_matrix(
            "a mirror", lambda m: m @ np.diag([1.0, 1.0, -1.0, 1.0]), "the matrix mirrors.*Export"
        ),
        _bad_matrix(
            "a shear", lambda m: m + 0.5 * np.eye(4, k=1), f"the matrix is not a rotation.*{_AGAIN}"
        ),
        _bad_matrix(
            "1e200",
            lambda m: m * [[1e200], [1e200], [1e200], [1]],
            f"the matrix is not a rotation.*{_AGAIN}",
        ),
        _bad_matrix(
            "1e-320",
            lambda m: m * [[1e-320], [1e-320], [1e-320], [1]],
            f"the matrix has no rotation.*{_AGAIN}",
        ),
        _bad_matrix(
            "zeros",
            lambda m: 0 * m + np.diag([0, 0, 0, 1.0]),
            f"the matrix has no rotation.*{_AGAIN}",
        ),
    ),
)


def _path(name: Any) -> Build:
    def apply(values: dict[str, Any]) -> None:
        values["frames"][0]["file_path"] = name

    return transforms(apply)


def _paths(pattern: Callable[[str], str]) -> Build:
    def apply(values: dict[str, Any]) -> None:
        for frame in values["frames"]:
            frame["file_path"] = pattern(frame["file_path"])

    return transforms(apply)


_LEFT_OUT = "1 frames were left out because their file_path is too long or leads outside"
_MISSING = r"1 of 6 photos were not found, such as "
_PATHS = Case(
    21,
    "file_path that is no name of a photo in the folder",
    (
        Variant("absolute", _path("/etc/passwd"), 0, f"{_LEFT_OUT} the folder: '/etc/passwd'"),
        Variant("up", _path("../secret.png"), 0, rf"{_LEFT_OUT} the folder: '\.\./secret\.png'"),
        Variant(
            "somebody's photo",
            _path("../../beside/album/photo.jpg"),
            0,
            f"{_LEFT_OUT} the folder: ",
        ),
        Variant("a URL", _path("https://example.org/a.png"), 0, f"{_LEFT_OUT} the folder: 'https"),
        Variant("without extension", _paths(lambda name: name[:-4]), 0, _GOOD),
        Variant("a folder", _path("images"), 0, f"{_MISSING}images"),
        Variant("itself", _path("transforms.json"), 0, "1 photos cannot be read .*transforms"),
        Variant("a number", _path(5), 3, rf"{_NAME}frames\[0\]\.file_path: a file name.*{_AGAIN}"),
        Variant(
            "missing", _path(None), 3, rf"{_NAME}frames\[0\]\.file_path: a file name.*{_AGAIN}"
        ),
        Variant(
            "all of them absolute",
            _paths(lambda name: f"/{name}"),
            3,
            rf"None of the 6 frames of transforms\.json is usable.*{_AGAIN}",
        ),
        Variant("with a NUL", _path("a\0.png"), 0, f"{_LEFT_OUT} the folder: "),
    ),
)


def _without(*names: str, **more: Any) -> Build:
    def apply(values: dict[str, Any]) -> None:
        for name in names:
            del values[name]
        values.update(more)

    return transforms(apply)


_FOCAL = rf"{_NAME}frames\[0\]: no focal length: neither fl_x nor a camera_angle_x.*Add fl_x"
_INTRINSICS = Case(
    22,
    "Intrinsics that are missing or of other photos",
    (
        Variant("none anywhere", _without("fl_x", "fl_y"), 3, _FOCAL),
        Variant("an angle of π", _without("fl_x", "fl_y", camera_angle_x=math.pi), 3, _FOCAL),
        Variant("an angle below 0", _without("fl_x", "fl_y", camera_angle_x=-1.0), 3, _FOCAL),
        Variant(
            "an angle without size",
            _without("fl_x", "fl_y", "w", "h", "cx", "cy", camera_angle_x=0.9),
            0,
            _GOOD,
        ),
        Variant("no size", _without("w", "h"), 3, rf"{_NAME}frames\[0\]: w and h are missing.*Add"),
        Variant("a size of 0", _without(w=0), 3, rf"{_NAME}frames\[0\]: image size 0.*{_AGAIN}"),
        Variant("a focal length of 0", _without(fl_x=0.0, fl_y=0.0), 3, rf"{_NAME}frames\[0\]: "),
        Variant(
            "text", _without(fl_x="60"), 3, rf"{_NAME}frames\[0\]\.fl_x: a number was.*{_AGAIN}"
        ),
        Variant(
            "another shape than the photos",
            _without(w=64, h=64),
            3,
            r"p00\.png is 64 x 48 pixels, its camera 64 x 64.*",
        ),
        Variant("twice the photos' size", _without(w=128, h=96, cx=64.0, cy=48.0), 0, _GOOD),
        Variant(
            "EQUIRECTANGULAR of ordinary photos",
            _without(camera_model="EQUIRECTANGULAR"),
            3,
            r"p00\.png is 64 x 48 pixels; a panorama is twice as wide as high.*Export the photos",
        ),
        Variant(
            "an unknown model",
            _without(camera_model="OMNI"),
            3,
            rf"{_NAME}frames\[0\]\.camera_model: OMNI is not supported.*Use one of",
        ),
    ),
)


def _twice(values: dict[str, Any]) -> None:
    values["frames"].append(values["frames"][0])


_FRAMES = Case(
    23,
    "Frames that are repeated, none, or of a test alone",
    (
        Variant("one twice", transforms(_twice), 0, "1 frames repeat a photo and were left out"),
        Variant(
            "none",
            transforms(lambda values: {**values, "frames": []}),
            3,
            f"{_NAME}frames: a list of at least one frame was expected.*{_AGAIN}",
        ),
        Variant(
            "no frames",
            transforms(lambda values: {"w": 64}),
            3,
            f"{_NAME}frames: a list of at least one frame was expected.*{_AGAIN}",
        ),
        Variant(
            "numbers",
            transforms(lambda values: {**values, "frames": [5]}),
            3,
            rf"{_NAME}frames\[0\]: an object was expected.*{_AGAIN}",
        ),
        Variant(
            "only those of a test",
            transforms(name="transforms_test.json"),
            0,
            "The input has no camera poses; they will be solved from the photos",
        ),
        Variant("only those to train", transforms(name="transforms_train.json"), 0, _GOOD),
        Variant("two of them", transforms(count=2), 3, "Only 2 photos are usable; at least 3.*Add"),
    ),
)

_TABLES = Case(
    24,
    "Poses in files of other programs",
    (
        *programs.VARIANTS,
        Variant(
            "a cameras.json",
            file("cameras.json", "[]"),
            3,
            rf"cameras\.json, top level: an object was expected.*{_AGAIN}",
            ("check", "cameras.json"),
        ),
    ),
)

GROUP = Group(
    "transforms.json and other poses",
    (
        _JSON,
        _MATRICES,
        _PATHS,
        _INTRINSICS,
        _FRAMES,
        _TABLES,
    ),
)
