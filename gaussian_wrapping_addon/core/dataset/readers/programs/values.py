# SPDX-License-Identifier: GPL-3.0-or-later
"""Checked values of camera files: numbers, vectors, rotations, sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .... import limits
from ....errors import ParseError
from ..source_model import LensCamera

AGAIN = "Export the cameras again."

ROTATION_TOLERANCE = 1e-2
"""How far a matrix may be from a rotation; exporters write as few as 4 digits."""
_LARGEST = 1e15
"""Of a number in a file: the squares of larger ones leave no digits for a camera."""


def number(path: Path, place: str, value: Any) -> float:
    """Return a finite number, also where the file writes it as text.

    Raises
    ------
    ParseError
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ParseError(path, place, "a number was expected.", AGAIN)
    try:
        result = float(value)
    except (ValueError, OverflowError):
        raise ParseError(path, place, "a number was expected.", AGAIN) from None
    if not math.isfinite(result) or abs(result) > _LARGEST:
        raise ParseError(path, place, "the number is not finite, or too large.", AGAIN)
    return result


def numbers(path: Path, place: str, values: Any, count: int) -> np.ndarray:
    """Return (count,) float64 of a list of numbers, or of a text with blanks between them.

    Raises
    ------
    ParseError
    """
    if isinstance(values, str):
        values = values.split()
    if not isinstance(values, Sequence) or len(values) != count:
        raise ParseError(path, place, f"{count} numbers were expected.", AGAIN)
    return np.array([number(path, f"{place}[{i}]", value) for i, value in enumerate(values)])


def whole(path: Path, place: str, value: Any) -> int:
    """Return a whole number of at most 10 digits.

    Raises
    ------
    ParseError
    """
    result = number(path, place, value)
    if result != round(result) or abs(result) > 1e10:
        raise ParseError(path, place, "a whole number was expected.", AGAIN)
    return round(result)


def image_size(path: Path, place: str, width: Any, height: Any) -> tuple[int, int]:
    """Return a photo's width and height in pixels.

    Raises
    ------
    ParseError
    """
    size = whole(path, f"{place}.width", width), whole(path, f"{place}.height", height)
    if not all(0 < side <= limits.MAX_IMAGE_SIDE_PX for side in size):
        raise ParseError(path, place, f"image size {size[0]} x {size[1]} is out of range.", AGAIN)
    return size


def rotation(path: Path, place: str, matrix: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a (3, 3) matrix that is one but for the digits written.

    Raises
    ------
    ParseError
        The matrix is not orthonormal, or it mirrors.
    """
    u, sizes, vt = np.linalg.svd(matrix)
    nearest: np.ndarray = u @ vt
    if np.abs(sizes - 1.0).max() > ROTATION_TOLERANCE:
        raise ParseError(path, place, "the matrix is not a rotation.", AGAIN)
    if np.linalg.det(nearest) < 0:
        raise ParseError(path, place, "the matrix mirrors; a rotation was expected.", AGAIN)
    return nearest


def pose_at(cam_from_world: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the (3, 4) pose of a camera with rotation (3, 3) and centre (3,)."""
    return np.concatenate([cam_from_world, -(cam_from_world @ center)[:, None]], 1)


def checked_lens(path: Path, place: str, lens: LensCamera) -> LensCamera:
    """Return the lens, or raise :class:`ParseError` with what makes it unusable."""
    problem = lens.problem()
    if problem:
        raise ParseError(path, place, f"{problem}.", AGAIN)
    return lens


def unsupported(path: Path, place: str, what: str, hint: str) -> ParseError:
    """Return the error for a lens or an option that no model here can express."""
    return ParseError(path, place, f"{what[:80]} is not supported.", hint)
