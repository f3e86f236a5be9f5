# SPDX-License-Identifier: GPL-3.0-or-later
"""COLMAP's binary files: missing, cut, with impossible counts, or with more than a model."""

from __future__ import annotations

import struct
from collections.abc import Callable

from tests.core.readers.model_writers import Model
from tests.hostile.case import Case, Group, Needs, Variant, Way
from tests.hostile.inputs import (
    changed,
    colmap,
    file,
    folder_of,
    link,
    nothing,
    pipe,
    steps,
    transforms,
    unreadable,
)

_WANTED = "Give a folder of photos"
_READER = "tests/core/readers/test_colmap.py"
_AGAIN = "Export the model again, or solve the cameras from the photos"

_NO_SET = Case(
    1,
    "No data set",
    (
        Variant("nothing of that name", nothing, 3, rf"set does not exist\. {_WANTED}"),
        Variant("an empty folder", folder_of("set"), 3, rf"set holds no photos\. {_WANTED}"),
        Variant(
            "a text file",
            file("set", "hello"),
            3,
            rf"set is a file, but not a transforms\.json\. {_WANTED}",
        ),
        Variant(
            "a folder of other files",
            steps(file("set/a.txt", "a"), file("set/b/c.blend", "c")),
            3,
            rf"set holds no photos\. {_WANTED}",
        ),
        Variant(
            "a device",
            nothing,
            3,
            rf"zero is neither a file nor a folder\. {_WANTED}",
            ("check", "/dev/zero"),
            needs=Needs.POSIX,
        ),
        Variant(
            "a named pipe",
            pipe("set"),
            3,
            rf"set is neither a file nor a folder\. {_WANTED}",
            needs=Needs.POSIX,
        ),
        Variant(
            "a folder that may not be read",
            steps(colmap(), unreadable("set")),
            3,
            r"set cannot be read: Permission denied\. Check the path and its permissions",
            needs=Needs.USER,
        ),
        Variant(
            "a model that may not be read",
            steps(colmap(), unreadable("set/sparse/0/images.bin")),
            3,
            r"images\.bin, whole file: cannot be read: Permission denied.*Export the model",
            needs=Needs.USER,
        ),
        Variant(
            "a transforms.json that may not be read",
            steps(transforms(), unreadable("set/transforms.json")),
            3,
            r"transforms\.json, whole file: cannot be read: Permission denied\. Check its perm",
            needs=Needs.USER,
        ),
        Variant(
            "a link that leads nowhere",
            link("set", "gone"),
            3,
            rf"gone does not exist\. {_WANTED}",
            needs=Needs.POSIX,
        ),
        Variant(
            "the whole disk",
            nothing,
            2,
            "'/' cannot be the source of a job.*Give the folder of the photos",
            ("wrap", "/", "--out", "out", "--no-blend"),
            needs=Needs.POSIX,
        ),
    ),
)


def _cut(name: str, size: Callable[[int], int], says: str, what: str) -> Variant:
    path = f"set/sparse/0/{name}"
    build = steps(colmap(), changed(path, lambda data: data[: size(len(data))]))
    return Variant(f"{name}, {what}", build, 3, says)


_CUT = Case(
    2,
    "COLMAP binary files cut",
    (
        _cut("cameras.bin", lambda _: 0, rf"cameras\.bin, byte 0: .* {_AGAIN}", "0 bytes"),
        _cut("cameras.bin", lambda _: 7, rf"cameras\.bin, byte 0: .* {_AGAIN}", "7 bytes"),
        _cut("cameras.bin", lambda size: size - 1, rf"cameras\.bin, byte .*{_AGAIN}", "end lost"),
        _cut("images.bin", lambda _: 0, rf"images\.bin, byte 0: .* {_AGAIN}", "0 bytes"),
        _cut("images.bin", lambda size: size // 2, rf"images\.bin, byte \d+: .*{_AGAIN}", "half"),
        _cut("points3D.bin", lambda _: 0, rf"points3D\.bin, byte 0: .* {_AGAIN}", "0 bytes"),
        _cut("points3D.bin", lambda size: size // 2, r"points3D\.bin, byte \d+: .*Export", "half"),
    ),
    (
        f"{_READER}::test_cut_at_every_byte_is_refused",
        f"{_READER}::test_every_flipped_byte_ends_quickly",
    ),
)


def _without_points(model: Model) -> None:
    for image in model.images:
        image.points2d = []


def _inside_name(data: bytes) -> bytes:
    """Cut the last name, and say that the two images that are left are all."""
    return data[: data.index(b"p05.png") + 3]


_NAME = Case(
    3,
    "images.bin cut inside a name, where the native reader never ends",
    (
        Variant(
            "cut inside p05.png",
            steps(colmap(_without_points), changed("set/sparse/0/images.bin", _inside_name)),
            3,
            rf"images\.bin, byte \d+: an image name does not end.* {_AGAIN}",
            way=Way.PROCESS,
        ),
    ),
)

_COUNTS = {
    "cameras": ("cameras", 0),
    "images": ("images", 0),
    "points3D": ("points", 0),
    "2D points": ("images", 8 + 64 + len("p00.png") + 1),
    "observations": ("points", 8 + 43),
}


def _with_count(what: str, count: int) -> Variant:
    stem, at = _COUNTS[what]
    name = "points3D.bin" if stem == "points" else f"{stem}.bin"

    def change(data: bytes) -> bytes:
        return data[:at] + struct.pack("<Q", count) + data[at + 8 :]

    build = steps(colmap(), changed(f"set/sparse/0/{name}", change))
    says = rf"{name}, byte {at}: {count} .*are announced, but only \d+ bytes follow\. {_AGAIN}"
    power = {2**64 - 1: "2⁶⁴ − 1", 2**63: "2⁶³", 2**31: "2³¹"}[count]
    return Variant(f"{power} {what}", build, 3, says)


_IMPOSSIBLE = Case(
    4,
    "Counts that no file holds",
    tuple(_with_count(what, count) for what in _COUNTS for count in (2**64 - 1, 2**63, 2**31)),
    (f"{_READER}::test_counts_are_bounded_by_the_file",),
)

_TRAILING = Case(
    5,
    "Bytes behind the last record",
    tuple(
        Variant(
            name,
            steps(colmap(), changed(f"set/sparse/0/{name}", lambda data: data + b"garbage")),
            0,
            rf"warning: {name} has 7 bytes after its last record; they were ignored",
        )
        for name in ("cameras.bin", "images.bin", "points3D.bin")
    ),
)

GROUP = Group("COLMAP, binary", (_NO_SET, _CUT, _NAME, _IMPOSSIBLE, _TRAILING))
