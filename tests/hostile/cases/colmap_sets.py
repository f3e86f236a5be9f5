# SPDX-License-Identifier: GPL-3.0-or-later
"""COLMAP text files, and projects as a whole: which model, which photos, where the cameras are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.scene.camera import quaternion_from_rotation
from tests.core.readers.model_writers import Model, ring_model, write_binary, write_text
from tests.hostile.case import Build, Case, Group, Variant, Way
from tests.hostile.inputs import (
    COUNT,
    POINTS,
    changed,
    colmap,
    file,
    folder_of,
    remove,
    renamed,
    steps,
)
from tests.poses import look_at_pose

_READER = "tests/core/readers/test_colmap.py"
_SPARSE = "set/sparse/0"
_GOOD = "6 photos: 6 of 64 x 48"


def _text(name: str, old: str, new: str, code: int, says: str, stem: str = "cameras") -> Variant:
    change = changed(
        f"{_SPARSE}/{stem}.txt", lambda data: data.replace(old.encode(), new.encode(), 1)
    )
    return Variant(name, steps(colmap(text=True), change), code, says)


def _commented(data: bytes) -> bytes:
    lines = data.split(b"\n")
    lines.insert(3, b"# a comment in the middle")
    lines[1] = lines[1].replace(b" ", b"\t", 3)
    return b"\n".join(lines)


_CAMERA_LINE = r"cameras\.txt, line 2:"
_TEXT = Case(
    14,
    "COLMAP text files of other programs",
    (
        Variant(
            "without the lines of 2D points",
            colmap(text=True, second_lines=False),
            0,
            "lacks the line of 2D points of 5 images",
        ),
        Variant("CRLF", colmap(text=True, end="\r\n"), 0, _GOOD),
        Variant(
            "byte order mark",
            steps(
                colmap(text=True),
                changed(f"{_SPARSE}/images.txt", lambda data: b"\xef\xbb\xbf" + data),
            ),
            0,
            _GOOD,
        ),
        Variant(
            "tabs, and a comment in the middle",
            steps(colmap(text=True), changed(f"{_SPARSE}/images.txt", _commented)),
            0,
            _GOOD,
        ),
        _text("-nan(ind)", "60.0", "-nan(ind)", 3, rf"{_CAMERA_LINE} .*not a finite number"),
        _text("decimal comma", "60.0", "60,0", 3, rf"{_CAMERA_LINE} .*Write decimals with a point"),
        _text("1e5 as a number", "1 PIN", "1e5 PIN", 3, "not in the model.*Solve the cameras"),
        _text("words for numbers", "64", "sixty", 3, rf"{_CAMERA_LINE} 'sixty' is not a number"),
        _text("half a pixel", "64", "64.5", 3, rf"{_CAMERA_LINE} .*not a whole number"),
        _text(
            "an infinite colour",
            " 20 30 ",
            " 20 inf ",
            3,
            r"points3D\.txt, line 2: 'inf' is not a whole number \(colour\)\. Export",
            "points3D",
        ),
        Variant(
            "a line of 2 MB",
            steps(
                colmap(text=True),
                changed(f"{_SPARSE}/images.txt", lambda data: data + b"7 " * 2**20),
            ),
            0,
            r"1 images were left out for an unsafe name: '7 7 7",
        ),
        Variant(
            "binary content",
            steps(colmap(text=True), file(f"{_SPARSE}/images.txt", bytes(range(256)) * 40)),
            3,
            r"images\.txt, .*Export",
        ),
        Variant(
            "no image at all",
            steps(colmap(text=True), file(f"{_SPARSE}/images.txt", "# none\n")),
            3,
            r"None of the 0 images of images\.txt is usable.*Solve the cameras again",
        ),
    ),
    (f"{_READER}::test_wrong_numbers_in_text_name_the_line",),
)


def _smaller_text(folder: Path) -> None:
    write_text(ring_model(3), folder / _SPARSE)


def _second(folder: Path) -> None:
    write_binary(ring_model(6, points=POINTS), folder / "set" / "sparse" / "1")


_MODELS = Case(
    15,
    "Several models, or models in other places",
    (
        Variant("binary and text that disagree", steps(colmap(), _smaller_text), 0, _GOOD),
        Variant("only text", colmap(text=True), 0, _GOOD),
        Variant(
            "sparse/0 empty, sparse/1 full",
            steps(colmap(place="set/sparse/1"), folder_of(_SPARSE)),
            0,
            _GOOD,
        ),
        Variant("in sparse itself", colmap(place="set/sparse"), 0, _GOOD),
        Variant("beside the photos", colmap(place="set"), 0, _GOOD),
        Variant(
            "two models",
            steps(colmap(count=3), _second),
            0,
            r"The input holds 2 models: sparse/0 \(3\), sparse/1 \(6\); sparse/1 was used",
        ),
        Variant(
            "two models, one of them broken",
            steps(colmap(), _second, file(f"{_SPARSE}/images.bin", b"broken")),
            0,
            r"Model 0 was left out: images\.bin, byte 0: the file ends",
        ),
        Variant(
            "rigs and frames that are broken",
            steps(
                colmap(), file(f"{_SPARSE}/rigs.bin", b"\xff" * 9), file(f"{_SPARSE}/frames.bin")
            ),
            0,
            _GOOD,
        ),
        Variant(
            "cameras without images",
            steps(colmap(), remove(f"{_SPARSE}/images.bin")),
            0,
            "cameras to be solved|they will be solved from the photos",
        ),
    ),
)

_NO_POINTS = Case(
    16,
    "No sparse points",
    (
        Variant(
            "points3D.bin missing",
            steps(colmap(), remove(f"{_SPARSE}/points3D.bin")),
            0,
            r"points3D\.bin is missing; start points are made from the photos.*Export the COLMAP",
        ),
        Variant("no points", colmap(points=0), 0, "6 posed photos, 0 sparse points"),
        Variant(
            "no points, loaded",
            colmap(points=0),
            0,
            r"6 photos and [1-9]\d* points are ready",
            way=Way.LOADING,
            writes=("out",),
            starts=True,
        ),
    ),
)


_View = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Centre of a camera and what it looks at."""


def _look(*views: _View) -> Callable[[Model], None]:
    def change(model: Model) -> None:
        for image, (center, target) in zip(model.images, views, strict=True):
            pose = look_at_pose(np.array(center), np.array(target))
            image.quaternion = quaternion_from_rotation(pose[:, :3])
            image.translation = pose[:, 3]

    return change


_ORIGIN = (0.0, 0.0, 0.0)
_ONE_PLACE = [((3.0, 0.0, 1.0), _ORIGIN)] * 6
_ONE_LINE = [((float(x), -4.0, 1.5), (0.5 * x, 0.0, 0.0)) for x in range(-3, 3)]
_APART = [
    ((100.0 * np.cos(a), 100.0 * np.sin(a), 0.0), (200.0 * np.cos(a), 200.0 * np.sin(a), 0.0))
    for a in np.arange(6) * np.pi / 3
]
_FEW = "at least 3 are needed.*Add photos of the same thing from other places"

_CAMERAS = Case(
    17,
    "Too few cameras, or cameras that do not see a thing from several places",
    (
        Variant("two images", colmap(count=2), 3, f"Only 2 photos are usable; {_FEW}"),
        Variant("one image", colmap(count=1), 3, f"Only 1 photo is usable; {_FEW}"),
        Variant(
            "all at one place",
            colmap(_look(*_ONE_PLACE)),
            3,
            "taken from one place.*Walk around",
        ),
        Variant(
            "all on a line",
            colmap(_look(*_ONE_LINE)),
            0,
            "All cameras lie on one line; depth will be inaccurate",
        ),
        Variant(
            "all look away from each other",
            colmap(_look(*_APART)),
            0,
            "they show nothing in common.*Check the poses, or take photos of the same thing",
        ),
        Variant(
            "all look away from each other, loaded",
            colmap(_look(*_APART)),
            0,
            "they show nothing in common.*Check the poses, or take photos of the same thing",
            way=Way.LOADING,
            writes=("out",),
        ),
    ),
    ("tests/core/jobs/test_hard_photos.py::test_it_ends_in_a_closed_mesh",),
)


def _on_the_disk(pattern: str) -> Build:
    """Return the build of a project whose photos lie under other names."""
    moves = (
        renamed(f"set/images/p{i:02d}.png", f"set/images/{pattern.format(i=i, side=i % 2)}")
        for i in range(COUNT)
    )
    return steps(colmap(), *moves)


def _twenty_of_500(folder: Path) -> None:
    colmap(count=20)(folder)
    write_binary(ring_model(500, points=POINTS), folder / _SPARSE)


_MATCHES = Case(
    18,
    "Photos that are not where or what the model says",
    (
        Variant(
            "20 of 500 photos", _twenty_of_500, 0, "480 of 500 photos were not found, such as p20"
        ),
        Variant(
            "upper case on the disk",
            _on_the_disk("P{i:02d}.PNG"),
            0,
            _GOOD,
        ),
        Variant(
            "another extension on the disk",
            _on_the_disk("p{i:02d}.jpg"),
            0,
            _GOOD,
        ),
        Variant(
            "in sub-folders",
            _on_the_disk("{side}/p{i:02d}.png"),
            0,
            _GOOD,
        ),
        Variant(
            "none of them",
            colmap(photos=False),
            3,
            "None of the 6 photos that the COLMAP model names was found.*Looked for p00.png in",
        ),
    ),
)

GROUP = Group("COLMAP, text and projects", (_TEXT, _MODELS, _NO_POINTS, _CAMERAS, _MATCHES))
