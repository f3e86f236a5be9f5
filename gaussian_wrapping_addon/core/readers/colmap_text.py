# SPDX-License-Identifier: GPL-3.0-or-later
"""Bounded reader of COLMAP's text files."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .. import limits
from ..errors import ParseError
from ..files import open_regular
from ..progress import ReportWarning
from .colmap_binary import AGAIN, RawImage, RawPoints, add_camera
from .source_model import LENS_NAMES, LensCamera

_NUMERIC = re.compile(r"[+-]?[0-9.]+([eE][+-]?[0-9]+)?")


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line number, text without its end); comments are left out, empty lines are not."""
    try:
        stream = open_regular(path, follow_links=True)
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read: {error.strerror}.", AGAIN) from None
    with stream:
        number = 0
        while raw := stream.readline(limits.MAX_LINE_BYTES * 64 + 1):
            number += 1
            # The second line of an image lists its 2D points and can be very long.
            if len(raw) > limits.MAX_LINE_BYTES * 64:
                raise ParseError(path, f"line {number}", "the line is too long.", AGAIN)
            if number == 1 and raw.startswith(b"\xef\xbb\xbf"):
                raw = raw[3:]
            text = raw.decode(errors="surrogateescape").rstrip("\r\n")
            if not text.lstrip().startswith("#"):
                yield number, text


def _number(path: Path, line: int, text: str, what: str) -> float:
    """Parse a number; C's ``-nan(ind)`` counts as NaN, a decimal comma is refused by name."""
    try:
        return float(text)
    except ValueError:
        if re.fullmatch(r"[+-]?(nan|inf)(\(\w*\))?", text.lower()):
            return float("nan")
        hint = "Write decimals with a point." if "," in text else AGAIN
        message = f"{text[:40]!r} is not a number ({what})."
        raise ParseError(path, f"line {line}", message, hint) from None


def _whole(path: Path, line: int, text: str, what: str) -> int:
    value = _number(path, line, text, what)
    if not (value == value and abs(value) < 2**62 and value == int(value)):
        message = f"{text[:40]!r} is not a whole number ({what})."
        raise ParseError(path, f"line {line}", message, AGAIN)
    return int(value)


def read_cameras(path: Path) -> tuple[dict[int, LensCamera], list[ReportWarning]]:
    """Read ``cameras.txt``.

    Raises ParseError with the line: unknown model, wrong number of parameters, unusable values.
    """
    cameras: dict[int, LensCamera] = {}
    for line, text in _lines(path):
        words = text.split()
        if not words:
            continue
        if len(words) < 5:
            raise ParseError(path, f"line {line}", "a camera needs at least 5 entries.", AGAIN)
        if words[1] not in LENS_NAMES:
            raise ParseError(
                path, f"line {line}", f"camera model {words[1][:60]} is not supported.",
                "Convert the photos to perspective images, or solve the cameras again.",
            )  # fmt: skip
        width = _whole(path, line, words[2], "width")
        height = _whole(path, line, words[3], "height")
        params = tuple(_number(path, line, word, "camera parameter") for word in words[4:])
        if len(cameras) >= limits.MAX_IMAGES:
            raise ParseError(path, f"line {line}", "there are too many cameras.", AGAIN)
        camera_id = _whole(path, line, words[0], "camera number")
        camera = LensCamera(words[1], width, height, params)
        add_camera(cameras, camera_id, camera, path, f"line {line}")
    return cameras, []


def read_images(path: Path) -> tuple[list[RawImage], list[ReportWarning]]:
    """Read ``images.txt``: two lines per image, of which the second may be empty.

    Where a second line was left out, the next line is not a list of 2D points (triples of
    numbers); such a file is read with a warning instead of losing every second image.

    Raises ParseError with the line.
    """
    images: list[RawImage] = []
    without_points = 0
    expects_points = False
    for line, text in _lines(path):
        words = text.split()
        lists_points = len(words) % 3 == 0 and all(_NUMERIC.fullmatch(w) for w in words)
        if expects_points and lists_points:  # an empty line lists no points
            expects_points = False
            observed = sum(not word.startswith("-") for word in words[2::3])
            images[-1] = dataclasses.replace(images[-1], observed=observed)
            continue
        if not words:
            continue
        without_points += expects_points
        images.append(_image(path, line, text))
        expects_points = True
        if len(images) > limits.MAX_IMAGES:
            raise ParseError(path, f"line {line}", "there are too many images.", AGAIN)
    if not without_points:
        return images, []
    text = (
        f"{path.name} lacks the line of 2D points of {without_points} images; they were read "
        "without it."
    )
    return images, [ReportWarning("point-lines-missing", text)]


def _image(path: Path, line: int, text: str) -> RawImage:
    words = text.split(maxsplit=9)
    if len(words) < 10:
        raise ParseError(path, f"line {line}", "an image needs 10 entries.", AGAIN)
    values = [_number(path, line, word, "pose") for word in words[1:8]]
    image_id = _whole(path, line, words[0], "image number")
    camera_id = _whole(path, line, words[8], "camera number")
    quaternion, translation = np.array(values[:4]), np.array(values[4:])
    return RawImage(image_id, quaternion, translation, camera_id, words[9].rstrip(), f"line {line}")


def read_points(path: Path) -> tuple[RawPoints, list[ReportWarning]]:
    """Read ``points3D.txt``. Raises ParseError with the line."""
    positions: list[list[float]] = []
    colors: list[list[int]] = []
    errors: list[float] = []
    lengths: list[int] = []
    for line, text in _lines(path):
        words = text.split()
        if not words:
            continue
        if len(words) < 8 or len(words) % 2:
            text = "a point needs 8 entries and pairs after them."
            raise ParseError(path, f"line {line}", text, AGAIN)
        if len(positions) >= limits.MAX_POINTS:
            raise ParseError(path, f"line {line}", "there are too many points.", AGAIN)
        positions.append([_number(path, line, word, "position") for word in words[1:4]])
        color = [_whole(path, line, word, "colour") for word in words[4:7]]
        if not all(0 <= c <= 255 for c in color):
            raise ParseError(path, f"line {line}", "a colour is not from 0 to 255.", AGAIN)
        colors.append(color)
        errors.append(_number(path, line, words[7], "error"))
        lengths.append((len(words) - 8) // 2)
    xyz = np.array(positions, np.float64).reshape(-1, 3)
    rgb = np.array(colors, np.uint8).reshape(-1, 3)
    return RawPoints(xyz, rgb, np.array(errors, np.float64), np.array(lengths, np.int64)), []
