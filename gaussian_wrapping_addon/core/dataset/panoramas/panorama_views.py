# SPDX-License-Identifier: GPL-3.0-or-later
"""The pinhole views of an equirectangular photo: directions, lens, and where their pixels lie.

A panorama's frame has x right, y down and z forward, where forward is the middle of the photo; its
long side is a full turn about y. Needs numpy only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from ...errors import DatasetError
from ..photos.photo_header import PhotoHeader, read_photo_header
from ..readers.source_model import LensCamera

FIELD_OF_VIEW_DEG = 84.0
"""Of each view: neighbours on the horizon, 45 degrees apart, share nearly half of their width; with
80 degrees there are gaps between the horizon and the tilted views."""
_TILT_DEG = 55.0
_HORIZON, _TILTED = 8, 3


_EQUIRECTANGULAR = "equirectangular"
STATED, BY_SHAPE = "stated", "shape"
"""How it is known that photos are panoramas."""


@dataclass(frozen=True)
class PanoramaView:
    """Direction of a view: to the right of the photo's middle, and above its horizon."""

    yaw_deg: float
    pitch_deg: float

    @property
    def cam_from_panorama(self) -> np.ndarray:
        """(3, 3) rotation; rows are the view's right, down and forward."""
        yaw, pitch = math.radians(self.yaw_deg), math.radians(self.pitch_deg)
        right = np.array([math.cos(yaw), 0.0, -math.sin(yaw)])
        forward = np.array([
            math.sin(yaw) * math.cos(pitch), -math.sin(pitch), math.cos(yaw) * math.cos(pitch),
        ])  # fmt: skip
        return np.stack([right, np.cross(forward, right), forward])


VIEWS = (
    *(PanoramaView(360.0 * i / _HORIZON, 0.0) for i in range(_HORIZON)),
    *(PanoramaView(360.0 * i / _TILTED, _TILT_DEG) for i in range(_TILTED)),
    *(PanoramaView(360.0 * (i + 0.5) / _TILTED, -_TILT_DEG) for i in range(_TILTED)),
)
"""Eight around the horizon, three upwards, three downwards: they cover all but the two poles."""


def view_name(name: str, view: int) -> str:
    """Return the name of a view of a panorama: ``hall-view-00.jpg`` of ``hall.jpg``."""
    pure = PurePosixPath(name.replace("\\", "/"))
    return f"{pure.with_suffix('')}-view-{view:02d}.jpg"


def view_lens(width: int) -> LensCamera:
    """Return the lens of the views of a panorama ``width`` pixels wide, at its own scale."""
    focal = width / (2.0 * math.pi)
    side = max(1, round(2.0 * focal * math.tan(math.radians(0.5 * FIELD_OF_VIEW_DEG))))
    return LensCamera("PINHOLE", side, side, (focal, focal, 0.5 * side, 0.5 * side))


def _has_panorama_size(width: int, height: int) -> bool:
    """Whether a photo is exactly twice as wide as high."""
    return width == 2 * height


def panorama_evidence(photos: Sequence[Path]) -> str:
    """Return what tells that photos are panoramas, by the headers of those that can be read.

    Returns
    -------
    str
        :data:`BY_SHAPE` where all are exactly twice as wide as high, :data:`STATED` where one of
        them also says that it is equirectangular. Empty where they are none: another shape, or one
        says another projection.
    """
    stated: set[str] = set()
    for path in photos:
        try:
            header = read_photo_header(path)
        except DatasetError:
            continue
        if header is None or not _has_panorama_size(*header.upright_size):
            return ""
        stated.add(header.projection)
    if stated - {"", _EQUIRECTANGULAR}:
        return ""
    return STATED if _EQUIRECTANGULAR in stated else BY_SHAPE if stated else ""


def check_panorama(header: PhotoHeader, file_name: str) -> None:
    """Raise :class:`DatasetError` where a photo has not the shape of a whole panorama."""
    width, height = header.upright_size
    if not _has_panorama_size(width, height):
        raise DatasetError(
            f"{file_name} is {width} x {height} pixels; a panorama is twice as wide as high.",
            "Export the photos as whole equirectangular panoramas.",
        )


def panorama_pixels(view: PanoramaView, width: int, height: int) -> np.ndarray:
    """Return where the pixels of a view lie in a panorama of ``width`` x ``height``.

    Returns
    -------
    (side, side, 2) float64
        First pixel's centre at (0.5, 0.5); x in [0, width].
    """
    lens = view_lens(width)
    fx, fy, cx, cy = lens.params
    rays = np.ones((lens.height, lens.width, 3))
    rays[..., 0] = (np.arange(lens.width) + 0.5 - cx) / fx
    rays[..., 1] = ((np.arange(lens.height) + 0.5 - cy) / fy)[:, None]
    x, y, z = np.moveaxis(rays @ view.cam_from_panorama, -1, 0)
    longitude, latitude = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
    return np.stack(
        [(longitude / (2 * np.pi) + 0.5) * width, (0.5 - latitude / np.pi) * height], -1
    )
