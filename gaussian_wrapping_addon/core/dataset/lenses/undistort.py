# SPDX-License-Identifier: GPL-3.0-or-later
"""Undistort photos: pinhole intrinsics of a lens model and the sampling map into the photo.

Lens formulas are pycolmap's, and :mod:`.skewed_brown` for what it lacks; the parameters are
validated before, see :meth:`~..readers.source_model.LensCamera.problem`. The
pinhole image shows the largest axis-parallel rectangle, in normalised coordinates, that the photo
fills without a black border.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...errors import DatasetError
from ..pycolmap_import import import_pycolmap
from ..readers.source_model import SKEWED_BROWN, LensCamera
from .skewed_brown import SkewedBrown

_MAX_SLOPE = math.tan(math.radians(65.0))
"""Fields of view are limited to 130 degrees: a planar image would waste its pixels on the rim."""
_MAX_GROWTH = 1.5
"""Largest ratio of the pinhole image's side to the photo's."""
_BORDER_SAMPLES = 200
_CHUNK_PIXELS = 1 << 20
_ROUND_TRIP_PX = 0.1
"""A border pixel whose unprojection and projection differ by more is outside the model's range."""


def pinhole_of(camera: LensCamera) -> LensCamera:
    """Return the PINHOLE camera that a photo of ``camera`` is resampled to.

    Raises
    ------
    DatasetError
        The distortion leaves no usable rectangle.
    """
    if camera.is_pinhole:
        (fx, fy), (cx, cy) = camera.focal, camera.principal_point
        return LensCamera("PINHOLE", camera.width, camera.height, (fx, fy, cx, cy))
    fx, fy = _central_focal(camera)
    left, top, right, bottom = _inner_rectangle(camera)
    growth = max((right - left) * fx / camera.width, (bottom - top) * fy / camera.height)
    if growth > _MAX_GROWTH:
        fx, fy = fx * _MAX_GROWTH / growth, fy * _MAX_GROWTH / growth
    # Rounded down, so that the last pixel still lies inside the rectangle.
    width, height = math.floor((right - left) * fx), math.floor((bottom - top) * fy)
    if width < 8 or height < 8:
        raise _unusable(camera)
    return LensCamera("PINHOLE", width, height, (fx, fy, -left * fx, -top * fy))


def sampling_map(camera: LensCamera, pinhole: LensCamera) -> np.ndarray:
    """Return the photo coordinates of each pixel of the pinhole image.

    Returns
    -------
    (height, width, 2) float32
        Pixel coordinates x, y in the photo of ``camera``, first pixel's centre at (0.5, 0.5).
    """
    fx, fy, cx, cy = pinhole.params
    out = np.zeros((pinhole.height, pinhole.width, 2), np.float32)
    x = (np.arange(pinhole.width) + 0.5 - cx) / fx
    step = max(1, _CHUNK_PIXELS // pinhole.width)
    for begin in range(0, pinhole.height, step):
        end = min(begin + step, pinhole.height)
        rays = np.ones((end - begin, pinhole.width, 3))
        rays[..., 0] = x
        rays[..., 1] = ((np.arange(begin, end) + 0.5 - cy) / fy)[:, None]
        pixels = project(camera, rays.reshape(-1, 3)).reshape(end - begin, pinhole.width, 2)
        out[begin:end] = pixels
    if not np.isfinite(out).all():
        raise _unusable(camera)
    return out


def pinhole_pixels(camera: LensCamera, pinhole: LensCamera, pixels: np.ndarray) -> np.ndarray:
    """Return where the pinhole image shows (n, 2) pixels of the photo; not finite where nowhere."""
    pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
    if camera.is_pinhole:
        return pixels
    fx, fy, cx, cy = pinhole.params
    slopes = np.asarray(_native(camera).cam_from_img(pixels), np.float64)
    return slopes * (fx, fy) + (cx, cy)


def project(camera: LensCamera, points: np.ndarray) -> np.ndarray:
    """Return (n, 2) pixels of (n, 3) points in camera coordinates, as the lens shows them."""
    pixels: np.ndarray = np.asarray(_native(camera).img_from_cam(points), np.float64)
    return pixels


def _native(camera: LensCamera) -> Any:
    if camera.model == SKEWED_BROWN:
        return SkewedBrown(camera)
    pycolmap = import_pycolmap()

    return pycolmap.Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
    )


def _central_focal(camera: LensCamera) -> tuple[float, float]:
    """Return pixels per unit slope at the optical axis, the focal lengths of the pinhole."""
    step = 1e-4
    rays = np.array([[step, 0, 1], [-step, 0, 1], [0, step, 1], [0, -step, 1]], np.float64)
    pixels = project(camera, rays)
    fx = float((pixels[0] - pixels[1])[0] / (2 * step))
    fy = float((pixels[2] - pixels[3])[1] / (2 * step))
    if not (math.isfinite(fx) and math.isfinite(fy) and fx > 0 and fy > 0):
        raise _unusable(camera)
    return fx, fy


def _inner_rectangle(camera: LensCamera) -> tuple[float, float, float, float]:
    """Return left, top, right, bottom of the rectangle that the photo fills, as slopes x/z, y/z."""
    width, height = camera.width, camera.height
    along_x = np.linspace(0.0, width, _BORDER_SAMPLES)
    along_y = np.linspace(0.0, height, _BORDER_SAMPLES)
    # Pixel coordinates 0 and width (height) are the outer borders of the photo's area.
    left = _slopes(camera, np.stack([np.zeros_like(along_y), along_y], 1))[:, 0].max()
    right = _slopes(camera, np.stack([np.full_like(along_y, width), along_y], 1))[:, 0].min()
    top = _slopes(camera, np.stack([along_x, np.zeros_like(along_x)], 1))[:, 1].max()
    bottom = _slopes(camera, np.stack([along_x, np.full_like(along_x, height)], 1))[:, 1].min()
    if not (left < 0 < right and top < 0 < bottom):
        raise _unusable(camera)
    return float(left), float(top), float(right), float(bottom)


def _slopes(camera: LensCamera, pixels: np.ndarray) -> np.ndarray:
    """Return (n, 2) slopes of border pixels, those out of range moved towards the centre."""
    lens = _native(camera)
    center = np.array(camera.principal_point)
    slopes = np.zeros_like(pixels)
    share = np.ones((len(pixels), 1))
    open_rows = np.ones(len(pixels), bool)
    for _ in range(60):
        trial = center + share * (pixels - center)
        found = np.asarray(lens.cam_from_img(trial), np.float64)
        good = np.isfinite(found).all(1) & (np.abs(found).max(1) <= _MAX_SLOPE)
        rays = np.concatenate([np.where(good[:, None], found, 0.0), np.ones((len(found), 1))], 1)
        back = project(camera, rays)
        good &= np.abs(back - trial).max(1) <= _ROUND_TRIP_PX
        slopes[open_rows & good] = found[open_rows & good]
        open_rows &= ~good
        if not open_rows.any():
            return slopes
        share[open_rows] *= 0.95
    raise _unusable(camera)


def _unusable(camera: LensCamera) -> DatasetError:
    return DatasetError(
        f"The distortion of a {camera.model} camera ({camera.width} x {camera.height}) cannot be "
        "removed: its parameters map several rays to one pixel.",
        "Solve the cameras again.",
    )
