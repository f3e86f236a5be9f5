# SPDX-License-Identifier: GPL-3.0-or-later
"""Lenses, and the pinhole cameras that photos are undistorted to."""

from __future__ import annotations

import math
import sys
import threading
from typing import Any

import numpy as np

from ..errors import DatasetError
from ..photos.formats import PhotoHeader
from ..worker.spawn import kept_signal_handlers
from .source_model import SKEWED_BROWN, LensCamera, PosedPhoto

# -- The one place where pycolmap is imported -----------------------------------------------------

_importing = threading.Lock()


def import_pycolmap() -> Any:
    """Return the module pycolmap; the worker's handling of SIGTERM stays as it is.

    Its own log goes to stderr, not to files.

    Raises ImportError: it is not installed.
    """
    # One thread at a time: another one would take the half imported module, or the handlers that it
    # has just set for those to keep.
    with _importing:
        if "pycolmap" in sys.modules:
            return sys.modules["pycolmap"]
        with kept_signal_handlers():
            import pycolmap

        # Its warnings would otherwise fill the folder for temporary files, one file a process.
        pycolmap.logging.logtostderr = True
        return pycolmap


# -- Brown's polynomial with k4 and skew: project and unproject, as pycolmap's cameras do ---------
#
# With ``r`` the length of the ray's slope (x, y): ``x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4
# r^8) + 2 p1 x y + p2 (r^2 + 2 x^2)`` and y' likewise with p1 and p2 swapped; ``u = fx x' + skew
# y' + cx``, ``v = fy y' + cy``. See docs/method.md, section 1.2.

_STEPS = 50
_SHORTEST_STEP = 1e-13
"""Of Newton's method, in slope: rounding ends it."""
_MISS = 1e-9
"""Largest miss of a solution, in slope: far below a pixel at any focal length."""


class SkewedBrown:
    """Projection of a :data:`~.source_model.SKEWED_BROWN` camera."""

    def __init__(self, camera: LensCamera) -> None:
        self._fx, self._fy, self._cx, self._cy, self._skew, *self._terms = camera.params
        k1, k2, k3, k4 = self._terms[:4]
        # Slopes up to here bend outwards; the polynomial folds back beyond.
        turns = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        squares = turns.real[(np.abs(turns.imag) < 1e-12) & (turns.real > 0)]
        self._reach2 = float(squares.min()) if squares.size else np.inf

    def img_from_cam(self, rays: np.ndarray) -> np.ndarray:
        """Return (n, 2) pixels of (n, 3) rays in front of the camera."""
        slopes = np.asarray(rays, np.float64)
        bent, _ = self._bent(slopes[:, :2] / slopes[:, 2:])
        x, y = bent[:, 0], bent[:, 1]
        u = self._fx * x + self._skew * y + self._cx
        return np.stack([u, self._fy * y + self._cy], 1)

    def cam_from_img(self, pixels: np.ndarray) -> np.ndarray:
        """Return (n, 2) slopes of (n, 2) pixels; NaN where no ray short of the fold reaches."""
        pixels = np.asarray(pixels, np.float64)
        y = (pixels[:, 1] - self._cy) / self._fy
        target = np.stack([(pixels[:, 0] - self._cx - self._skew * y) / self._fx, y], 1)
        slopes = target.copy()
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(_STEPS):
                bent, slope = self._bent(slopes)
                a, b, d = slope[:, 0], slope[:, 1], slope[:, 2]
                miss = bent - target
                determinant = a * d - b * b
                step_x = (d * miss[:, 0] - b * miss[:, 1]) / determinant
                step_y = (a * miss[:, 1] - b * miss[:, 0]) / determinant
                step = np.stack([step_x, step_y], 1)
                slopes = slopes - step
                if not (np.abs(step) > _SHORTEST_STEP).any():
                    break
            bent, _ = self._bent(slopes)
            # As with a pixel that no ray reaches: the caller moves it towards the middle.
            found = (np.abs(bent - target).max(1) < _MISS) & ((slopes**2).sum(1) < self._reach2)
            slopes[~found] = np.nan
        return slopes

    def _bent(self, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (n, 2) distorted slopes and (n, 3) derivatives xx, xy = yx, yy."""
        k1, k2, k3, k4, p1, p2 = self._terms
        x, y = slopes[:, 0], slopes[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        growth = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * 4.0 * k4)))
        bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        bent_y = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
        xx = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + growth * y * y + 2.0 * p2 * x + 6.0 * p1 * y
        xy = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        return np.stack([bent_x, bent_y], 1), np.stack([xx, xy, yy], 1)


# -- Fit the cameras of an input to the sizes of its photos; needs their headers only -------------


def fit_lens(
    posed: PosedPhoto, header: PhotoHeader, file_name: str, *, prefers_stored: bool
) -> tuple[LensCamera, bool, bool]:
    """Fit the intrinsics of the input to the size of the photo.

    Returns ``lens``: intrinsics for exactly the photo's size; ``upright``: whether the EXIF
    orientation has to be applied; ``rescaled``: whether the photo is a scaled copy of the one
    described by the input.
    Raises DatasetError: the photo's aspect ratio differs from its camera's.
    """
    if posed.is_panorama:
        text = f"{file_name} is a panorama, which has no lens."
        raise DatasetError(text, "Give photos of pinhole cameras here.")
    stored, upright = (header.width, header.height), header.upright_size
    if posed.relative is not None:
        width, height = stored if prefers_stored else upright
        lens = posed.relative.of_size(width, height)
        if problem := lens.problem():
            text = f"The camera of {file_name}: {problem}."
            raise DatasetError(text, "Export the cameras again.")
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
    return abs(size[0] * lens.height - size[1] * lens.width) < lens.width + lens.height


# -- Undistort photos: pinhole intrinsics of a lens model and the sampling map into the photo -----
#
# Lens formulas are pycolmap's, and :mod:`.lenses` for what it lacks; the parameters are
# validated before, see :meth:`~.source_model.LensCamera.problem`. The pinhole image
# shows the largest axis-parallel rectangle, in normalised coordinates, that the photo fills
# without a black border.

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

    Raises DatasetError: the distortion leaves no usable rectangle.
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

    Returns (height, width, 2) float32, pixel coordinates x, y in the photo of ``camera``, first
    pixel's centre at (0.5, 0.5).
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
        out[begin:end] = project(camera, rays.reshape(-1, 3)).reshape(end - begin, pinhole.width, 2)
    if not np.isfinite(out).all():
        raise _unusable(camera)
    return out


def pinhole_pixels(camera: LensCamera, pinhole: LensCamera, pixels: np.ndarray) -> np.ndarray:
    """Return where the pinhole image shows (n, 2) pixels of the photo; not finite where nowhere."""
    pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
    if camera.is_pinhole:
        return pixels
    fx, fy, cx, cy = pinhole.params
    return np.asarray(_native(camera).cam_from_img(pixels), np.float64) * (fx, fy) + (cx, cy)


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
        good &= np.abs(project(camera, rays) - trial).max(1) <= _ROUND_TRIP_PX
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
