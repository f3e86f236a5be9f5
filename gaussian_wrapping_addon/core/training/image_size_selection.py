# SPDX-License-Identifier: GPL-3.0-or-later
"""Model selection: the size of the photos that are trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .model_selection import Decision

# Do photos hold detail that is lost at half size?

DETAIL_RMS = 0.01
"""Detail, relative to full brightness, below which halving loses nothing: if half the size
reproduces the photo with 40 dB, training, which reaches 20 to 35 dB, cannot tell them apart."""

DETAIL_QUANTILE = 0.9
"""Quantile over the blocks that defines detail: fine spokes before a plain wall count."""

NOISE_QUANTILE = 0.1
"""Quantile over the blocks that defines noise: the quietest ones."""

NOISE_FACTOR = 2.0
"""Energy up to this multiple of the noise's is attributed to noise, which grows with brightness and
is left unevenly by compression."""

BLOCK_PX = 16
SMALLEST_SIDE_PX = 240
"""Photos are not halved below this long side."""

MIN_BLOCKS = 8

_NOISE_LOST = 0.75
"""Share of the energy of white noise that halving removes: three quarters of all frequencies."""


@dataclass(frozen=True)
class PhotoDetail:
    """Detail that a photo loses by halving."""

    side_px: int
    """Long side."""
    useful_px: int
    """Smallest long side, of repeated halvings, that loses no detail."""
    detail: float
    """RMS lost by the first halving in the most detailed blocks, less noise; brightness 1."""
    noise: float
    """Standard deviation of the noise, brightness 1."""


@dataclass(frozen=True)
class ImageSizeEvidence:
    """Largest useful size of a scene's photos."""

    useful_px: int
    """Long side: the median over the photos."""
    side_px: int
    """Original long side of the photo that is this median."""
    detail: float
    noise: float
    photos: int

    def uses_full_size(self, setting: str = "auto") -> bool:
        """Tell whether to train on photos at full size instead of half size."""
        return setting == "on" or (setting == "auto" and 2 * self.useful_px > self.side_px)

    def decision(self, setting: str = "auto") -> Decision:
        """Return the decision; the setting ``max_image_px`` also bounds the size."""
        fine = self.useful_px >= self.side_px
        evidence = (
            f"Halved from {self.side_px} px, {self.photos} photos lose detail of "
            f"{100.0 * self.detail:.2f} % of full brightness beyond their noise of "
            f"{100.0 * self.noise:.2f} % (threshold {100.0 * DETAIL_RMS:.0f} %)."
        )
        if not fine:
            evidence += f" Images of {self.useful_px} px hold all of their detail."
        figures = {
            "useful_px": float(self.useful_px),
            "side_px": float(self.side_px),
            "detail": self.detail,
            "noise": self.noise,
            "photos": float(self.photos),
            "limit": DETAIL_RMS,
        }
        size_px = self.side_px if self.uses_full_size(setting) else self.side_px // 2
        return Decision("full_size", setting, f"{size_px} px", evidence, figures)


def photo_detail(photo: np.ndarray, mask: np.ndarray | None = None) -> PhotoDetail:
    """Measure what a photo loses by halving and enlarging again.

    The noise is estimated from the diagonal differences of 2 x 2 pixels, to which edges hardly
    contribute, in the quietest blocks (after Donoho's estimate from the finest wavelet band).

    Parameters
    ----------
    photo : (h, w, 3) uint8, or floats in [0, 1]
    mask : (h, w) bool, optional
        Only fully unmasked blocks are used.
    """
    scale = np.float32(255 if photo.dtype == np.uint8 else 1)
    # Twice the green, which has the least noise in photos.
    grey = (photo.astype(np.float32) @ np.array([0.25, 0.5, 0.25], np.float32)) / scale
    side = max(grey.shape)
    useful, first = side, None
    while True:
        energy, diagonal = _lost(grey), _diagonal(grey)
        lost, quiet = _blocks(energy, mask), _blocks(diagonal, mask)
        if len(lost) < MIN_BLOCKS:
            break
        noise = float(np.sqrt(np.quantile(quiet, NOISE_QUANTILE)))
        beyond = float(np.quantile(lost, DETAIL_QUANTILE)) - NOISE_FACTOR * _NOISE_LOST * noise**2
        detail = float(np.sqrt(max(0.0, beyond)))
        first = first or (detail, noise)
        if detail >= DETAIL_RMS or max(grey.shape) // 2 < SMALLEST_SIDE_PX:
            break
        grey = _halved(grey)
        mask = None if mask is None else _halved_mask(mask)
        useful = max(grey.shape)
    detail, noise = first or (0.0, 0.0)
    return PhotoDetail(side, useful, detail, noise)


def select_image_size(details: Sequence[PhotoDetail]) -> ImageSizeEvidence:
    """Return the useful size of a sample of photos: it keeps all detail of half of them.

    Raises
    ------
    ValueError
        There are no photos.
    """
    if not details:
        raise ValueError("no photo was measured")
    # The upper median: detail is kept if half of the photos have it.
    chosen = sorted(details, key=lambda d: (d.useful_px, d.side_px))[len(details) // 2]
    return ImageSizeEvidence(
        chosen.useful_px,
        chosen.side_px,  # of the same photo, as original sizes may differ
        float(np.median([d.detail for d in details])),
        float(np.median([d.noise for d in details])),
        len(details),
    )


def _resized(grey: np.ndarray, width: int, height: int) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.fromarray(grey).resize((width, height), Image.Resampling.LANCZOS))


def _halved(grey: np.ndarray) -> np.ndarray:
    height, width = grey.shape[0] // 2, grey.shape[1] // 2
    return _resized(np.ascontiguousarray(grey[: 2 * height, : 2 * width]), width, height)


def _halved_mask(mask: np.ndarray) -> np.ndarray:
    height, width = mask.shape[0] // 2, mask.shape[1] // 2
    return mask[: 2 * height, : 2 * width].reshape(height, 2, width, 2).all((1, 3))


def _lost(grey: np.ndarray) -> np.ndarray:
    """(h, w) squared difference to the image halved and enlarged again."""
    half = _halved(grey)
    height, width = 2 * half.shape[0], 2 * half.shape[1]
    return (grey[:height, :width] - _resized(half, width, height)) ** 2


def _diagonal(grey: np.ndarray) -> np.ndarray:
    """(h, w) squared diagonal differences of 2 x 2 pixels; of white noise, its variance."""
    height, width = 2 * (grey.shape[0] // 2), 2 * (grey.shape[1] // 2)
    cut = grey[:height, :width]
    mixed = cut[::2, ::2] - cut[::2, 1::2] - cut[1::2, ::2] + cut[1::2, 1::2]
    return np.repeat(np.repeat((0.5 * mixed) ** 2, 2, 0), 2, 1)


def _blocks(values: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return the means over fully unmasked blocks."""
    rows, columns = values.shape[0] // BLOCK_PX, values.shape[1] // BLOCK_PX
    shape = (rows, BLOCK_PX, columns, BLOCK_PX)
    cut = values[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(shape)
    means = cut.mean((1, 3), dtype=np.float64)
    if mask is None:
        return means.reshape(-1)
    whole = mask[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(shape).all((1, 3))
    return means[whole]
