# SPDX-License-Identifier: GPL-3.0-or-later
"""Fit the cameras of an input to the sizes of its photos; needs their headers only."""

from __future__ import annotations

import math

from ...errors import DatasetError
from ..photos.photo_header import PhotoHeader
from ..readers.source_model import LensCamera, PosedPhoto

MIN_PHOTO_SIDE_PX = 16


def fit_lens(
    posed: PosedPhoto, header: PhotoHeader, file_name: str, *, prefers_stored: bool
) -> tuple[LensCamera, bool, bool]:
    """Fit the intrinsics of the input to the size of the photo.

    Returns
    -------
    lens : LensCamera
        Intrinsics for exactly the photo's size.
    upright : bool
        Whether the EXIF orientation has to be applied.
    rescaled : bool
        Whether the photo is a scaled copy of the one described by the input.

    Raises
    ------
    DatasetError
        The photo's aspect ratio differs from its camera's.
    """
    if posed.is_panorama:
        raise DatasetError(
            f"{file_name} is a panorama, which has no lens.", "Give photos of pinhole cameras here."
        )
    stored, upright = (header.width, header.height), header.upright_size
    if posed.relative is not None:
        width, height = stored if prefers_stored else upright
        lens = posed.relative.of_size(width, height)
        problem = lens.problem()
        if problem:
            raise DatasetError(
                f"The camera of {file_name}: {problem}.", "Export the cameras again."
            )
        return lens, not prefers_stored, False
    if posed.lens is None:
        assert posed.angle_x is not None
        width, height = upright
        focal = 0.5 * width / math.tan(0.5 * posed.angle_x)
        lens = LensCamera("PINHOLE", width, height, (focal, focal, width / 2, height / 2))
        return lens, True, False
    lens = posed.lens
    choices = [(stored, False), (upright, True)]
    if not prefers_stored or header.orientation == 1:
        choices.reverse()
    for size, turn in choices:
        if size == (lens.width, lens.height):
            return lens, turn, False
    for size, turn in choices:
        if same_proportions(size, lens):
            return lens.resized(*size), turn, True
    turned = same_proportions(upright[::-1], lens)
    raise DatasetError(
        f"{file_name} is {upright[0]} x {upright[1]} pixels, its camera {lens.width} x "
        f"{lens.height}" + (": the photo is rotated by 90 degrees." if turned else "."),
        "Use the photos that the cameras were solved with, or scaled copies of them.",
    )


def same_proportions(size: tuple[int, int], lens: LensCamera) -> bool:
    """Whether ``size`` is the camera's size times a factor, up to rounding to whole pixels."""
    tolerance = lens.width + lens.height
    return abs(size[0] * lens.height - size[1] * lens.width) < tolerance
