# SPDX-License-Identifier: GPL-3.0-or-later
"""COLMAP models that are whole but hold unusable cameras, poses, names or references."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.core.readers.model_writers import HEIGHT, WIDTH, Model
from tests.hostile.case import Case, Group, Needs, Variant, Way
from tests.hostile.inputs import colmap, link, renamed, steps

_GOOD = [60.0, 60.0, 32.0, 24.0]
_READER = "tests/core/readers/test_colmap.py"
_SOLVE = "Solve the cameras again"


def _camera(
    params: list[float], kind: str | int = "PINHOLE", size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Callable[[Model], None]:
    def change(model: Model) -> None:
        model.cameras = [(1, kind, *size, params)]

    return change


def _bad_camera(name: str, says: str, *arguments: Any, text: bool = False) -> Variant:
    place = r"cameras\.txt, line 2" if text else r"cameras\.bin, byte 8, camera 1"
    return Variant(name, colmap(_camera(*arguments), text=text), 3, f"{place}: {says}")


_MODELS = Case(
    6,
    "Camera models that are not known",
    (
        _bad_camera("number 99", "camera model number 99 is not supported.*Convert", _GOOD, 99),
        _bad_camera("number −1", "camera model number -1 is not supported.*Convert", _GOOD, -1),
        _bad_camera(
            "EQUIRECTANGULAR",
            "camera model EQUIRECTANGULAR is not supported.*Convert the photos to perspective",
            _GOOD,
            17,
        ),
        _bad_camera(
            "MAGIC_LENS in text",
            "camera model MAGIC_LENS is not supported.*Convert",
            _GOOD,
            "MAGIC_LENS",
            text=True,
        ),
    ),
)

_PARAMETERS = Case(
    7,
    "Another number of parameters than the camera model has",
    (
        _bad_camera("3 of 4, text", "PINHOLE has 4 parameters, not 3.*", _GOOD[:3], text=True),
        _bad_camera("6 of 4, text", "PINHOLE has 4 parameters, not 6.*", [*_GOOD, 1, 1], text=True),
        Variant(
            "3 of 4, binary",
            colmap(_camera(_GOOD[:3])),
            3,
            r"cameras\.bin, byte \d+: the file ends inside camera 1.*Export the model again",
        ),
    ),
)

_LENSES = Case(
    8,
    "Focal lengths, sizes and centres that no camera has",
    (
        _bad_camera(
            "focal length of 0", f"focal length .* px is out of range.*{_SOLVE}", [0.0, *_GOOD[1:]]
        ),
        _bad_camera(
            "negative focal length",
            f"focal length .* px is out of range.*{_SOLVE}",
            [-60.0, *_GOOD[1:]],
        ),
        _bad_camera("focal length NaN", f".*finite.*{_SOLVE}", [60.0, float("nan"), *_GOOD[2:]]),
        _bad_camera(
            "focal length 1e300",
            f"focal length .* px is out of range.*{_SOLVE}",
            [1e300, *_GOOD[1:]],
        ),
        _bad_camera("width of 0", f"image size 0 x 48 .*{_SOLVE}", _GOOD, "PINHOLE", (0, 48)),
        _bad_camera("width of 10⁷", f"image size .*{_SOLVE}", _GOOD, "PINHOLE", (10**7, 48)),
        _bad_camera("principal point at 1e9", f".*principal point.*{_SOLVE}", [60.0, 60, 1e9, 24]),
    ),
    (f"{_READER}::test_unusable_cameras_are_refused_by_name",),
)


def _each(change: Callable[[Any], None]) -> Callable[[Model], None]:
    def apply(model: Model) -> None:
        for image in model.images:
            change(image)

    return apply


def _first(**values: Any) -> Callable[[Model], None]:
    def apply(model: Model) -> None:
        for name, value in values.items():
            setattr(model.images[0], name, value)

    return apply


def _scaled(image: Any) -> None:
    image.quaternion = image.quaternion * 7.0


def _zero(image: Any) -> None:
    image.quaternion = np.zeros(4)


_DROPPED = r"warning: 1 images were left out for a pose that is not finite.*p00\.png"
_QUATERNIONS = Case(
    9,
    "Quaternions of 0, of NaN, not normalised",
    (
        Variant("one is 0", colmap(_first(quaternion=np.zeros(4))), 0, _DROPPED),
        Variant("one is NaN", colmap(_first(quaternion=np.full(4, np.nan))), 0, _DROPPED),
        Variant(
            "all are 0",
            colmap(_each(_zero)),
            3,
            r"None of the 6 images of images\.bin is usable.*Solve the cameras again",
        ),
        Variant("not normalised", colmap(_each(_scaled)), 0, "6 posed photos"),
        Variant(
            "not normalised, loaded",
            colmap(_each(_scaled)),
            0,
            "6 photos and .* points are ready",
            way=Way.LOADING,
            writes=("out",),
        ),
    ),
)


def _vast(model: Model) -> None:
    model.images[0].translation = np.full(3, 1e308)


def _all_vast(model: Model) -> None:
    for image in model.images:
        image.translation = image.translation * 1e200


def _far(model: Model) -> None:
    model.images[0].translation = np.array([1e6, 0.0, 0.0])


_PLACES = Case(
    10,
    "Cameras that are nowhere or far away",
    (
        Variant("translation Inf", colmap(_first(translation=np.full(3, np.inf))), 0, _DROPPED),
        Variant("one 1e308 away", colmap(_vast, count=8), 0, "1 cameras are far away from all"),
        Variant(
            "all 1e200 away",
            colmap(_all_vast),
            3,
            r"The cameras lie farther than 1e\+100 units from the origin.*Solve the cameras again",
        ),
        Variant("one 10⁶ units away", colmap(_far, count=8), 0, "1 cameras are far away from all"),
        Variant(
            "one 10⁶ units away, loaded",
            colmap(_far, count=8),
            0,
            r"1 cameras are far away from all others and were left out: p00\.png.*Check the poses",
            way=Way.LOADING,
            writes=("out",),
        ),
    ),
)

_UNSAFE = "1 images were left out for an unsafe name"
_BAD_NAMES = {
    "../../../etc/passwd": "up and away",
    "/etc/passwd": "from the root",
    "../beside/album/photo.jpg": "of somebody's photo",
    "C:\\x.png": "with a drive",
    "\\\\srv\\x": "of another computer",
    "CON.png": "of a device of Windows",
    ".": "of a dot",
    "": "of nothing",
    "a/../../b.png": "up in the middle",
    "n" * 4000: "of 4000 characters",
}


def _named(name: str | bytes) -> Callable[[Model], None]:
    return _first(name=name)


_NAMES = Case(
    11,
    "Names that lead out of the folder",
    (
        *(
            Variant(f"a name {what}", colmap(_named(name)), 0, f"warning: {_UNSAFE}")
            for name, what in _BAD_NAMES.items()
        ),
        Variant(
            "a name with a NUL",
            colmap(_named("a\0b")),
            3,
            r"images\.bin, byte \d+: .*Export the model again",
        ),
        Variant(
            "a photo that is a link to what is none",
            steps(colmap(), link("set/images/p00.png", "../../../beside/album/photo.jpg")),
            0,
            r"1 photos cannot be read and are not used. First: p00\.png .*Export it again",
            needs=Needs.POSIX,
            reads_beside=True,
        ),
    ),
)

_ODD = "a b'c\"%20 (1) ü😀.png"


def _odd(stored: str, written: str | bytes) -> Any:
    return steps(colmap(_named(written)), renamed("set/images/p00.png", f"set/images/{stored}"))


_ODD_NAMES = Case(
    12,
    "Names with spaces, quotes, other alphabets, other separators",
    (
        Variant("spaces, quotes, %, emoji", _odd(_ODD, _ODD), 0, "6 photos: 6 of 64 x 48"),
        Variant(
            "decomposed letters, composed on the disk",
            _odd("Würfel.png", unicodedata.normalize("NFD", "Würfel.png")),
            0,
            "6 photos: 6 of 64 x 48",
        ),
        Variant("back-slashes", _odd("a/b.png", "a\\b.png"), 0, "6 photos: 6 of 64 x 48"),
        Variant(
            "bytes that are no UTF-8",
            colmap(_named(b"\xff\xfe.png")),
            0,
            r"warning: 1 of 6 photos were not found, such as \\udcff\\udcfe\.png",
        ),
    ),
)


def _same_image(model: Model) -> None:
    model.images[1].image_id = model.images[0].image_id


def _same_name(model: Model) -> None:
    model.images[1].name = model.images[0].name


def _other_camera(model: Model) -> None:
    model.cameras.append((1, "PINHOLE", WIDTH, HEIGHT, [70.0, 60.0, 32.0, 24.0]))


_REFERENCES = Case(
    13,
    "Numbers used twice, cameras that are missing",
    (
        Variant(
            "an image number twice",
            colmap(_same_image),
            0,
            r"1 images were left out for a number or name that was used before.*p01\.png",
        ),
        Variant(
            "a name twice",
            colmap(_same_name),
            0,
            r"1 images were left out for a number or name that was used before.*p00\.png",
        ),
        Variant(
            "a camera number twice",
            colmap(_other_camera),
            3,
            r"cameras\.bin, byte \d+, camera 1: camera 1 is defined twice.*Export",
        ),
        Variant(
            "a camera that is missing",
            colmap(_first(camera_id=7)),
            0,
            r"1 images were left out for a camera that is not in the model.*p00\.png",
        ),
        Variant(
            "no camera at all",
            colmap(lambda model: model.cameras.clear()),
            3,
            r"None of the 6 images of images\.bin is usable.*not in the model.*Solve the cameras",
        ),
    ),
)

GROUP = Group(
    "COLMAP, values",
    (_MODELS, _PARAMETERS, _LENSES, _QUATERNIONS, _PLACES, _NAMES, _ODD_NAMES, _REFERENCES),
)
