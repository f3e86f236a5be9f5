# SPDX-License-Identifier: GPL-3.0-or-later
"""PSNR, SSIM and LPIPS between a rendered view and its photo, over the pixels of a mask."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..kernels.parallel import even_bounds, run_chunks
from .image_values import as_unit_floats, check_sizes
from .ssim_kernels import BLOCK_PX, RADIUS, WINDOW, compare_rows

if TYPE_CHECKING:
    from .lpips import Lpips

PSNR_CAP_DB = 100.0
"""Replaces the infinite PSNR of equal images in averages and reports."""

_NO_MASK = np.zeros((0, 0), np.bool_)


@dataclass(frozen=True)
class ViewScores:
    """Metrics between an image and its photo."""

    psnr: float
    """dB, at most :data:`PSNR_CAP_DB`."""
    ssim: float
    lpips: float | None = None
    """``None`` where it was not measured."""

    def to_json(self) -> dict[str, float]:
        """Return plain JSON values; ``lpips`` only where it was measured."""
        values = {"psnr": self.psnr, "ssim": self.ssim}
        return values if self.lpips is None else {**values, "lpips": self.lpips}


@dataclass(frozen=True)
class Comparison:
    """Errors and SSIM of an image over the pixels of a mask, and their gradient."""

    absolute: float
    """Mean absolute error over pixels and colours; 0 if there are none."""
    squared: float
    """Mean squared error."""
    similarity: float
    """Mean SSIM over windows and colours; 1 if there are none."""
    windows: int
    gradient: np.ndarray | None
    """(h, w, 3), of the image's type: derivative of ``weights[0] absolute + weights[1] similarity``
    with respect to the image; ``None`` without weights."""


def psnr(image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB; infinite for equal images.

    Parameters
    ----------
    image, photo : (h, w, 3)
        uint8, or floats whose white is 1. The image is clamped to [0, 1] as a display would.
    mask : (h, w) bool, optional
        Pixels to measure.

    Raises
    ------
    UsageError
        If the shapes differ or no pixel is left.
    """
    a = np.clip(as_unit_floats(image, np.float64), 0.0, 1.0)
    b = as_unit_floats(photo, np.float64)
    check_sizes(a, b, mask)
    error = (a - b) ** 2 if mask is None else (a - b)[np.asarray(mask, bool)] ** 2
    mean = float(error.mean())
    return math.inf if mean == 0.0 else -10.0 * math.log10(mean)


def ssim(
    image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None, *, threads: int = 1
) -> float:
    """Return the mean structural similarity (docs/method.md, section 3.1); see :func:`compare`.

    The image is clamped to [0, 1] as a display would.
    """
    a = np.clip(as_unit_floats(image, np.float64), 0.0, 1.0)
    return compare(a, photo, mask, threads=threads).similarity


def score_images(
    image: np.ndarray,
    photo: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    lpips: Lpips | None = None,
    threads: int = 1,
) -> ViewScores:
    """Return all metrics of an image and its photo.

    Parameters
    ----------
    image, photo : (h, w, 3)
        uint8, or floats whose white is 1. The image is clamped to [0, 1] as a display would.
    mask : (h, w) bool, optional
        Pixels to compare. PSNR is over these; SSIM over the windows centred on them, both images
        black elsewhere (1 if there are none: see :func:`has_windows`); LPIPS is of the whole image,
        with the photo's pixels in both elsewhere.
    lpips : Lpips, optional
        Without it, or if the image is too small for it, LPIPS is not measured.

    Raises
    ------
    UsageError
        If the shapes differ or no pixel is left.
    """
    distance = None
    decibels = min(psnr(image, photo, mask), PSNR_CAP_DB)
    if lpips is not None and lpips.fits(photo.shape):
        shown, target = as_unit_floats(image), as_unit_floats(photo)
        if mask is not None:
            shown = np.where(np.asarray(mask, np.bool_)[..., None], shown, target)
        distance = lpips.distance(shown, target)
    return ViewScores(decibels, ssim(image, photo, mask, threads=threads), distance)


def has_windows(shape: tuple[int, ...], mask: np.ndarray | None = None) -> bool:
    """Return whether an image of this shape has any SSIM window centred in the mask."""
    if min(shape[:2]) < WINDOW:
        return False
    return mask is None or bool(mask[RADIUS : shape[0] - RADIUS, RADIUS : shape[1] - RADIUS].any())


def compare(
    image: np.ndarray,
    photo: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    weights: tuple[float, float] | None = None,
    threads: int = 1,
    out: np.ndarray | None = None,
) -> Comparison:
    """Return the mean errors and the mean SSIM, with their gradient if weights are given.

    The window of SSIM is 11 x 11, Gaussian with sigma 1.5, "valid" padding. With a mask, both
    images are black outside it, and only windows centred inside it are counted.

    Parameters
    ----------
    image : (h, w, 3) float32 or float64
        Colours in [0, 1]. Computation is in its type.
    photo : (h, w, 3) uint8, or floats whose white is 1
    mask : (h, w) bool, optional
        Pixels to compare.
    weights : (float, float), optional
        Weights of the mean absolute error and the mean SSIM in the scalar to differentiate.
    out : (h, w, 3), C-contiguous, of the image's type, optional
        Receives the gradient; by default a new array.

    Returns
    -------
    Comparison
        Bitwise the same for any number of threads.

    Raises
    ------
    UsageError
        If the shapes differ.
    """
    image, photo = np.ascontiguousarray(image), np.ascontiguousarray(photo)
    check_sizes(image, photo, mask, may_be_empty=True)
    if photo.dtype != np.uint8:
        photo = photo.astype(image.dtype, copy=False)
    height, width = image.shape[:2]
    inside = (slice(RADIUS, height - RADIUS), slice(RADIUS, width - RADIUS))
    if mask is None:
        mask = _NO_MASK
        pixels = height * width
        windows = max(0, height - 2 * RADIUS) * max(0, width - 2 * RADIUS)
    else:
        mask = np.ascontiguousarray(mask, np.bool_)
        pixels = int(np.count_nonzero(mask))
        fits = min(height, width) >= WINDOW
        windows = int(np.count_nonzero(mask[inside])) if fits else 0
    values, windows = 3 * pixels, 3 * windows
    flat_image, flat_photo = image.reshape(height, -1), photo.reshape(height, -1)  # (h, 3 w)
    sums = np.zeros((-(-width // BLOCK_PX), height, 3))
    gradient = np.empty((0, 0), image.dtype)
    if weights:
        gradient = (np.empty_like(image) if out is None else out).reshape(height, -1)
    absolute, similar = weights or (0.0, 0.0)
    white = 1.0 / 255.0 if photo.dtype == np.uint8 else 1.0

    def run(begin: int, end: int) -> None:
        compare_rows(
            begin, end, flat_image, flat_photo, white, mask, absolute / max(1, values),
            similar / max(1, windows), sums, gradient,
        )  # fmt: skip

    run_chunks(run, even_bounds(height, threads, 1), threads)
    total, total_sq, total_similar = sums.sum((0, 1)).tolist()
    return Comparison(
        total / max(1, values),
        total_sq / max(1, values),
        total_similar / windows if windows else 1.0,
        windows,
        gradient.reshape(image.shape) if weights else None,
    )
