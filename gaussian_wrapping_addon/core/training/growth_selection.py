# SPDX-License-Identifier: GPL-3.0-or-later
"""Model selection: image size, number of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .model_selection import Decision

# -- Choose the finest training image size: do photos hold detail that is lost at half size? ------

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


# -- Decide when to stop densification: error reduction per doubling of the Gaussians -------------

MIN_GAIN_DB = 0.2
"""Growth stops if twice the Gaussians would lower the error of the training photos by less than
this. Twice the Gaussians cost up to twice the time. Gains fall with each doubling; if each is about
half of the one before, all further gains add up to no more than this again."""

MIN_GROWTH = 1.15
"""Least growth of the number of Gaussians between two compared errors of a photo: below it, the
noise of single errors dominates the gain per doubling."""

MAX_GROWTH = 3.0
"""Largest such growth: older errors are ignored, as early gains do not predict late ones."""

MIN_VIEWS = 5
"""Fewest photos with errors before and after the growth for a decision."""

CERTAINTY = 2.0
"""Standard errors required between the gain and :data:`MIN_GAIN_DB`. Growth is tested after every
densification and stops for good: with one standard error, a scene of 40 photos stopped by chance at
36 000 of 80 000 Gaussians and lost 3.5 dB on held-out photos."""

CAPACITY = 32_768
"""Entries kept; older ones are dropped."""

_COLUMNS = 5
_SPREAD_OF_MAD = 1.4826
_ERROR_FLOOR = 1e-10


@dataclass(frozen=True)
class GrowthEvidence:
    """Estimate of whether growth still pays."""

    pays: bool
    """True also if not known yet: only evidence stops growth."""
    known: bool
    gain_db: float
    """Median over the photos of the error reduction per doubling; NaN if unknown."""
    spread_db: float
    """Standard error of that median; NaN if unknown."""
    views: int
    """Number of photos in the median."""
    gaussians: int
    iteration: int

    def decision(self, setting: str = "auto") -> Decision:
        """Return the decision: ``"stopped"``, ``"to the cap"`` or ``"none added"``."""
        chosen = {
            "auto": "to the cap" if self.pays else "stopped",
            "on": "to the cap",
            "off": "none added",
        }.get(setting, "")
        figures = {"gaussians": float(self.gaussians), "iteration": float(self.iteration)}
        if not self.known:
            evidence = "Too few photos were rendered before and after the Gaussians grew in number."
            return Decision("growth", setting, chosen, evidence, figures)
        evidence = (
            f"At iteration {self.iteration}, with {self.gaussians} Gaussians, twice as many would "
            f"have lowered the error by about {self.gain_db:.2f} dB (± {self.spread_db:.2f}, from "
            f"{self.views} photos; threshold {MIN_GAIN_DB:.1f} dB)."
        )
        figures |= {
            "gain_db": self.gain_db,
            "spread_db": self.spread_db,
            "views": float(self.views),
            "limit_db": MIN_GAIN_DB,
        }
        return Decision("growth", setting, chosen, evidence, figures)


class ErrorHistory:
    """Colour errors of the training photos by iteration; part of the training state."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, int, float, int]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(
        self, iteration: int, view: int, gaussians: int, mean_squared: float, divisor: int
    ) -> None:
        """Record one iteration.

        Parameters
        ----------
        mean_squared : float
            Mean squared colour error of the photo, before the step.
        divisor : int
            Divisor of the image size: only errors at the same size are compared.
        """
        self._rows.append((iteration, view, gaussians, mean_squared, divisor))
        if len(self._rows) > CAPACITY:
            del self._rows[: len(self._rows) - CAPACITY]

    def clear(self) -> None:
        """Drop all entries, as after an opacity reset."""
        self._rows.clear()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return all entries, by name; the key ``visits`` is that of checkpoints."""
        return {"visits": np.array(self._rows, np.float64).reshape(-1, _COLUMNS)}

    @classmethod
    def restore(cls, arrays: dict[str, np.ndarray]) -> ErrorHistory:
        """Build from :meth:`to_arrays`.

        Raises
        ------
        KeyError, ValueError
            The array is missing or has another shape.
        """
        errors = arrays["visits"]
        if errors.ndim != 2 or errors.shape[1] != _COLUMNS:
            raise ValueError(f"visits are {errors.shape}")
        history = cls()
        for row in errors.tolist():
            history.add(int(row[0]), int(row[1]), int(row[2]), row[3], int(row[4]))
        return history

    def growth_evidence(self) -> GrowthEvidence:
        """Estimate whether more Gaussians still pay.

        The last error of each photo is compared with its latest earlier one at which there were
        fewer Gaussians by :data:`MIN_GROWTH`, at the same image size: errors differ several times
        over between photos, so that each photo is compared with itself only. The median over the
        photos is robust against outliers. Gains of training itself between the two errors count as
        gains of growth, so the decision errs towards further growth; it stops only if the median
        lies below :data:`MIN_GAIN_DB` by :data:`CERTAINTY` standard errors. Rising errors say
        nothing about growth: another loss term started, or Gaussians were removed.
        """
        iteration, _, gaussians, _, _ = self._rows[-1] if self._rows else (0, 0, 0, 0.0, 1)
        gains = np.array(list(self._gains()))
        nan = math.nan
        if len(gains) < MIN_VIEWS:
            return GrowthEvidence(True, False, nan, nan, len(gains), gaussians, iteration)
        median = float(np.median(gains))
        # The standard error of a median is 1.2533 times that of a mean, for normal values.
        spread = _SPREAD_OF_MAD * float(np.median(np.abs(gains - median)))
        spread *= 1.2533 / math.sqrt(len(gains))
        if median + CERTAINTY * spread < -MIN_GAIN_DB:  # errors rose for other reasons
            return GrowthEvidence(True, False, nan, nan, len(gains), gaussians, iteration)
        pays = median + CERTAINTY * spread >= MIN_GAIN_DB
        return GrowthEvidence(pays, True, median, spread, len(gains), gaussians, iteration)

    def _gains(self) -> Iterator[float]:
        """Yield the gain of each comparable photo, dB per doubling."""
        by_view: dict[int, list[tuple[int, int, int, float, int]]] = {}
        for row in self._rows:
            by_view.setdefault(row[1], []).append(row)
        for view in sorted(by_view):
            errors = by_view[view]
            _, _, now, error, divisor = errors[-1]
            # Skip photos not rendered at the current image size.
            if divisor != self._rows[-1][4]:
                continue
            for _, _, then, before, size in reversed(errors[:-1]):
                growth = now / max(1, then)
                if size != divisor or growth > MAX_GROWTH:
                    break
                if growth >= MIN_GROWTH:
                    ratio = max(before, _ERROR_FLOOR) / max(error, _ERROR_FLOOR)
                    yield 10.0 * math.log10(ratio) / math.log2(growth)
                    break
