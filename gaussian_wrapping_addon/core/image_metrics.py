# SPDX-License-Identifier: GPL-3.0-or-later
"""PSNR, SSIM and LPIPS of images, and a render brought to the exposure of a photo."""

from __future__ import annotations

import importlib.util
import logging
import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .compiled import inline, kernel, part
from .filters import LANES, RING, TAPS, filter_run, filter_two_runs
from .parallel import even_bounds, run_chunks
from .resampling import as_unit_floats, check_sizes

# -- Compiled comparison of two images: errors, structural similarity (SSIM), and the gradient ----


WINDOW = TAPS  # Side of the Gaussian window, pixels; sigma is 1.5 (docs/method.md, section 3.1).
RADIUS = WINDOW // 2
SIGMA_PX = 1.5
REACH = WINDOW - 1
"""Rows or columns of a window after its first."""

_taps = [np.exp(-0.5 * ((i - RADIUS) / SIGMA_PX) ** 2) for i in range(WINDOW)]
WEIGHTS = tuple(float(tap / sum(_taps)) for tap in _taps)

C1 = 0.01**2
C2 = 0.03**2

BLOCK_PX = 512  # width of a column block: the buffered last rows of one fit a cache of 1 MB
_AVERAGED = 4  # x, y, x^2 + y^2, x y: SSIM only needs the sum of the two variances
_MAPS = 3  # derivatives of SSIM with respect to E[x], E[x^2] and E[x y] of its window
_MARGIN = 3 * REACH
STRIDE = (3 * (BLOCK_PX + 2 * REACH) + 2 * _MARGIN + 2 * LANES) // LANES * LANES
"""Offset between two scratch rows; constant, so that LLVM can rule out overlap."""


@part(fast=True)
def _filter_along(count, target, target_at, source, source_at, weights):  # type: ignore[no-untyped-def]
    """Filter one row of interleaved colours; writes ``count`` values, rounded up to whole runs."""
    for j in range(0, count, LANES):
        filter_run(target, target_at + j, source, source_at + j, 3, weights)  # type: ignore[call-arg]


@inline
def _filter_rings(at, count, apart, target, ring, weights, first):  # type: ignore[no-untyped-def]
    """Filter one kind of row; ``first`` is a constant, see ``filter_two_runs``."""
    for j in range(at, at + count, LANES):
        filter_two_runs(target, j, apart, ring, j, apart, weights, first)  # type: ignore[call-arg]


@part(fast=True)
def _filter_across(count, kinds, target, ring, first, weights):  # type: ignore[no-untyped-def]
    """Filter a ring of ``kinds`` rows a slot into two times ``kinds`` rows.

    ``first``: slot of the first row of the first window, even.
    """
    apart = kinds * STRIDE
    for q in range(kinds):
        at = q * STRIDE
        if first == 0:
            _filter_rings(at, count, apart, target, ring, weights, 0)
        elif first == 2:
            _filter_rings(at, count, apart, target, ring, weights, 2)
        elif first == 4:
            _filter_rings(at, count, apart, target, ring, weights, 4)
        elif first == 6:
            _filter_rings(at, count, apart, target, ring, weights, 6)
        elif first == 8:
            _filter_rings(at, count, apart, target, ring, weights, 8)
        elif first == 10:
            _filter_rings(at, count, apart, target, ring, weights, 10)


@part(fast=True)
def _keep_row(mask, row, first, last, keep):  # type: ignore[no-untyped-def]
    """Write 1 or 0 for each value of the pixels [first, last) of a row of the mask."""
    for p in range(last - first):
        value = keep.dtype.type(1.0 if mask[row, first + p] else 0.0)
        keep[3 * p] = value
        keep[3 * p + 1] = value
        keep[3 * p + 2] = value


@part(fast=True)
def _load_row(row, first, count, image, photo, scale, keep, rows):  # type: ignore[no-untyped-def]
    """Write x, y, x^2 + y^2 and x y of ``count`` values of a row, 0 outside the mask."""
    kind = rows.dtype.type
    x_row, y_row = image[row, first : first + count], photo[row, first : first + count]
    for j in range(count):
        rows[j] = x_row[j]
    for j in range(count):
        rows[STRIDE + j] = kind(y_row[j]) * scale
    for j in range(count):
        x, y = rows[j] * keep[j], rows[STRIDE + j] * keep[j]
        rows[j] = x
        rows[STRIDE + j] = y
        rows[2 * STRIDE + j] = x * x + y * y
        rows[3 * STRIDE + j] = x * y


@part(fast=True)
def _similarity_row(count, means, keep, partial):  # type: ignore[no-untyped-def]
    """Write SSIM of one row of windows, and its derivatives by E[x], E[x^2] and E[x y]."""
    kind = means.dtype.type
    c1, c2, one, two = kind(C1), kind(C2), kind(1.0), kind(2.0)
    for j in range(count):
        mx, my = means[j], means[STRIDE + j]
        square, product = mx * mx + my * my, mx * my
        a1 = two * product + c1
        a2 = two * (means[3 * STRIDE + j] - product) + c2
        b1 = square + c1
        b2 = (means[2 * STRIDE + j] - square) + c2
        inverse = one / (b1 * b2)
        s = a1 * a2 * inverse
        weight = two * keep[j] * inverse
        partial[_MARGIN + j] = weight * (my * (a2 - a1) - s * mx * (b2 - b1))
        partial[STRIDE + _MARGIN + j] = kind(-0.5) * weight * s * b1
        partial[2 * STRIDE + _MARGIN + j] = weight * a1
        partial[3 * STRIDE + _MARGIN + j] = keep[j] * s


@part(fast=True)
def _sum(values):  # type: ignore[no-untyped-def]
    total = values.dtype.type(0.0)
    for j in range(len(values)):
        total += values[j]
    return total


@part(fast=True)
def _errors_row(count, x_row, y_row, scale_y, keep):  # type: ignore[no-untyped-def]
    """Return the sums of absolute and squared errors of a row."""
    kind = x_row.dtype.type
    total, total_sq = kind(0.0), kind(0.0)
    for j in range(count):
        difference = (x_row[j] - kind(y_row[j]) * scale_y) * keep[j]
        total += abs(difference)
        total_sq += difference * difference
    return total, total_sq


@part(fast=True)
def _gradient_row(count, x_row, y_row, scale_y, keep, maps, step, scale, out):  # type: ignore[no-untyped-def]
    """Write a row of the gradient from the derivatives' maps, filtered both ways."""
    kind = x_row.dtype.type
    zero, two = kind(0.0), kind(2.0)
    for j in range(count):
        x, y = x_row[j], kind(y_row[j]) * scale_y
        similar = maps[j] + two * x * maps[STRIDE + j] + y * maps[2 * STRIDE + j]
        sign = step if x > y else (-step if x < y else zero)
        out[j] = keep[j] * (sign + scale * similar)


@kernel(fast=True)
def compare_rows(  # type: ignore[no-untyped-def]
    begin, end, image, photo, scale_photo, mask, weight_absolute, weight_similar, sums, gradient
):
    """Compare the rows [begin, end) of two images in one pass from top to bottom.

    The window is separable: each row is filtered horizontally, and the last 11 are kept in a ring
    buffer to be filtered vertically. SSIM's derivatives are filtered in the same way. A strip
    recomputes the 10 rows above it, so that results do not depend on where strips begin. Two
    windows are filtered vertically at once, which halves the loads from the ring.

    Parameters
    ----------
    image : (h, 3 w) float
        Interleaved colours in [0, 1].
    photo : (h, 3 w) float or uint8
    scale_photo : float
        Factor of the photo's values.
    mask : (h, w) bool, or (0, 0) for none
        Where it is false both images count as black, and windows centred there are ignored.
    weight_absolute, weight_similar : float
        ``gradient`` is that of ``weight_absolute`` x the sum of absolute errors +
        ``weight_similar`` x the sum of SSIM over all windows and colours.
    sums : (b, h, 3) float64
        Written: sums over a row of one of the b column blocks of absolute errors, squared errors,
        and SSIM of the row of windows that begins in this row.
    gradient : (h, 3 w) float, or (0, 0) for none
        Written.
    """
    height, width = image.shape[0], image.shape[1] // 3
    kind = image.dtype.type
    scale_y, step, scale = kind(scale_photo), kind(weight_absolute), kind(weight_similar)
    masked, differentiated = mask.shape[0] > 0, gradient.shape[0] > 0
    has_windows = height >= WINDOW and width >= WINDOW
    reach = REACH if has_windows else 0
    above = reach if differentiated else 0
    weights = (
        kind(WEIGHTS[0]), kind(WEIGHTS[1]), kind(WEIGHTS[2]),
        kind(WEIGHTS[3]), kind(WEIGHTS[4]), kind(WEIGHTS[5]),
    )  # fmt: skip
    rows = np.empty(_AVERAGED * STRIDE, kind)
    ring = np.zeros(RING * _AVERAGED * STRIDE, kind)
    means = np.empty(2 * _AVERAGED * STRIDE, kind)
    partial = np.empty((_MAPS + 1) * STRIDE, kind)
    maps_ring = np.empty(RING * _MAPS * STRIDE, kind)
    maps = np.zeros(2 * _MAPS * STRIDE, kind)
    keep = np.ones(STRIDE, kind)
    # Rows come in pairs of an even and an odd one, for any strip.
    top = max(0, begin - above) // 2 * 2
    for block in range(sums.shape[0]):
        left = block * BLOCK_PX
        right = min(width, left + BLOCK_PX)
        first = max(0, left - above)
        last = min(width, right + reach)
        inner = 3 * (right - left)
        count = 3 * (last - first - REACH)  # values of a row of windows
        counted = 3 * (min(right, width - REACH) - left)  # of them, those of no other block
        partial[:] = kind(0.0)  # there are no windows beyond the left and right borders,
        maps_ring[:] = kind(0.0)  # nor above the first row
        for pair in range(top // 2, (end + reach + 1) // 2):
            for i in range(2 * pair, 2 * pair + 2):
                if has_windows and i < height:
                    if masked:
                        _keep_row(mask, i, first, last, keep)
                    span = 3 * (last - first)
                    _load_row(i, 3 * first, span, image, photo, scale_y, keep, rows)
                    for q in range(_AVERAGED):
                        at = ((i % RING) * _AVERAGED + q) * STRIDE
                        _filter_along(count, ring, at, rows, q * STRIDE, weights)
            row = 2 * pair - reach  # the windows and the gradient of two rows are complete now
            if row < top:
                continue
            if has_windows:
                _filter_across(count, _AVERAGED, means, ring, row % RING, weights)
                for r in range(row, row + 2):
                    if r + REACH < height:
                        if masked:
                            _keep_row(mask, r + RADIUS, first + RADIUS, last - RADIUS, keep)
                        own = means[(r - row) * _AVERAGED * STRIDE :]
                        _similarity_row(count, own, keep, partial)
                    else:
                        partial[:] = kind(0.0)
                    if begin <= r < end:
                        at = _MAPS * STRIDE + _MARGIN + 3 * (left - first)
                        sums[block, r, 2] = _sum(partial[at : at + max(0, counted)])
                    if differentiated:
                        for q in range(_MAPS):
                            at = ((r % RING) * _MAPS + q) * STRIDE
                            source = q * STRIDE + 3 * (left - first)
                            _filter_along(inner, maps_ring, at, partial, source, weights)
                if differentiated:
                    above_row = (row + 2) % RING  # that of 10 rows above
                    _filter_across(inner, _MAPS, maps, maps_ring, above_row, weights)
            for r in range(max(row, begin), min(row + 2, end)):
                if masked:
                    _keep_row(mask, r, left, right, keep)
                x_row = image[r, 3 * left : 3 * right]
                y_row = photo[r, 3 * left : 3 * right]
                total, total_sq = _errors_row(inner, x_row, y_row, scale_y, keep)
                sums[block, r, 0] = total
                sums[block, r, 1] = total_sq
                if differentiated:
                    out = gradient[r, 3 * left : 3 * right]
                    own = maps[(r - row) * _MAPS * STRIDE :]
                    _gradient_row(inner, x_row, y_row, scale_y, keep, own, step, scale, out)


# -- PSNR, SSIM and LPIPS between a rendered view and its photo, over the pixels of a mask --------


PSNR_CAP_DB = 100.0  # replaces the infinite PSNR of equal images in averages and reports
_NO_MASK = np.zeros((0, 0), np.bool_)


@dataclass(frozen=True)
class ViewScores:
    """Metrics between an image and its photo."""

    psnr: float  # dB, at most :data:`PSNR_CAP_DB`
    ssim: float
    lpips: float | None = None  # ``None`` where it was not measured

    def to_json(self) -> dict[str, float]:
        """Return plain JSON values; ``lpips`` only where it was measured."""
        values = {"psnr": self.psnr, "ssim": self.ssim}
        return values if self.lpips is None else {**values, "lpips": self.lpips}


@dataclass(frozen=True)
class Comparison:
    """Errors and SSIM of an image over the pixels of a mask, and their gradient."""

    absolute: float  # Mean absolute error over pixels and colours; 0 if there are none.
    squared: float  # mean squared error
    similarity: float  # Mean SSIM over windows and colours; 1 if there are none.
    windows: int
    gradient: np.ndarray | None
    """(h, w, 3), of the image's type: derivative of ``weights[0] absolute + weights[1] similarity``
    with respect to the image; ``None`` without weights."""


def psnr(image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB; infinite for equal images.

    Both are (h, w, 3) uint8, or floats whose white is 1, and measured at the pixels of the mask
    (h, w) bool. The image is clamped to [0, 1] as a display would.

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
    image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None, *,
    lpips: Lpips | None = None, threads: int = 1,
) -> ViewScores:  # fmt: skip
    """Return all metrics of an image and its photo, as for :func:`psnr`.

    PSNR is over the pixels of the mask; SSIM over the windows centred on them, both images black
    elsewhere (1 if there are none: see :func:`has_windows`); LPIPS is of the whole image, with the
    photo's pixels in both elsewhere. Without ``lpips``, or if the image is too small for it, it is
    not measured.

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
    image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None, *,
    weights: tuple[float, float] | None = None, threads: int = 1, out: np.ndarray | None = None,
) -> Comparison:  # fmt: skip
    """Return the mean errors and the mean SSIM, with their gradient if weights are given.

    The window of SSIM is 11 x 11, Gaussian with sigma 1.5, "valid" padding. With a mask, both
    images are black outside it, and only windows centred inside it are counted.

    The result is bitwise the same for any number of threads.

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
        mask, pixels = _NO_MASK, height * width
        windows = max(0, height - 2 * RADIUS) * max(0, width - 2 * RADIUS)
    else:
        mask = np.ascontiguousarray(mask, np.bool_)
        pixels = int(np.count_nonzero(mask))
        windows = int(np.count_nonzero(mask[inside])) if min(height, width) >= WINDOW else 0
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


# -- Exposure of a photo that nobody trained, fitted so that a render can be compared with it ------


MAX_LOG_GAIN = 1.5
"""Bound of the log gains; larger ones stem from photos without content, not from exposure."""
FIT_ROUNDS = 8
FIT_PRIOR_SQ = 0.02**2
"""Weight of the prior on a fitted gain of 1, as a variance of display values: a photo of uniform
colour does not separate gain and offset."""
FIT_SCALE = 0.05
"""Errors beyond this display value have decreasing weight."""
FIT_DARKEST, FIT_BRIGHTEST = 2.5 / 255, 252.5 / 255
"""Values of the photo outside this range may be clipped and are ignored."""
MIN_FIT_PIXELS = 64


def fit_exposure(
    render: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return gain and offset (3,) float64 that fit a render to a photo.

    ``photo ~ gain render + offset`` for each channel, by least squares in closed form, reweighted
    with ``1 / max(|error|, 0.05)`` (Huber), with a weak prior :data:`FIT_PRIOR_SQ` on a gain of 1;
    1 and 0 for a channel with fewer than :data:`MIN_FIT_PIXELS` usable pixels. For photos whose
    exposure was not trained. Metrics on the fitted pixels are too optimistic; report those of
    :func:`corrected_for_measuring`.

    Parameters
    ----------
    render : (h, w, 3) floats
    photo : (h, w, 3) uint8, or floats in [0, 1]
    mask : (h, w) bool, optional
        Pixels to use.
    """
    x, y = np.asarray(render, np.float64), np.asarray(photo)
    y = y / 255.0 if y.dtype == np.uint8 else y.astype(np.float64)
    gain, offset = np.ones(3), np.zeros(3)
    for channel in range(3):
        value = y[..., channel]
        usable = (value >= FIT_DARKEST) & (value <= FIT_BRIGHTEST) & np.isfinite(x[..., channel])
        if mask is not None:
            usable &= np.asarray(mask, np.bool_)
        if np.count_nonzero(usable) >= MIN_FIT_PIXELS:
            gain[channel], offset[channel] = _fit(x[..., channel][usable], value[usable])
    return gain, offset


def _fit(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    weight = np.ones(len(x))
    gain = offset = 0.0
    for _ in range(FIT_ROUNDS):
        total = weight.sum()
        mean_x, mean_y = float(weight @ x / total), float(weight @ y / total)
        variance = float(weight @ (x - mean_x) ** 2 / total)
        covariance = float(weight @ ((x - mean_x) * (y - mean_y)) / total)
        gain = (covariance + FIT_PRIOR_SQ) / (variance + FIT_PRIOR_SQ)
        gain = min(max(gain, math.exp(-MAX_LOG_GAIN)), math.exp(MAX_LOG_GAIN))
        offset = mean_y - gain * mean_x
        weight = 1.0 / np.maximum(np.abs(gain * x + offset - y), FIT_SCALE)
    return gain, offset


def corrected_for_measuring(
    render: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None
) -> np.ndarray:
    """Return the render in the photo's exposure, each half corrected by a fit to the other half.

    The exposure of a held-out photo was never trained. As each half of the pixels (left, right) is
    corrected by the fit to the other, metrics of the whole image measure how well the scene is
    reconstructed and not how well six numbers fit. They must be named as such: "PSNR after an
    exposure fitted crosswise on the image's halves".

    Images are as for :func:`fit_exposure`, the result is (h, w, 3) float32 in [0, 1]. A half whose
    other half has too few pixels is not corrected.
    """
    middle = np.shape(render)[1] // 2
    if mask is not None and mask.any():  # what is compared may lie in one half of the image
        middle = int(np.median(np.nonzero(mask)[1])) + 1
    halves = (slice(None, middle), slice(middle, None))
    result = np.array(render, np.float64)
    for half, other in (halves, halves[::-1]):
        part = None if mask is None else mask[:, other]
        gain, offset = fit_exposure(render[:, other], photo[:, other], part)
        result[:, half] = gain * result[:, half] + offset
    return np.clip(result, 0.0, 1.0).astype(np.float32)


# -- LPIPS, a learned perceptual distance between images, if its package is installed -------------
#
# Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric" (CVPR
# 2018), variant AlexNet, version 0.1. The package downloads a missing backbone: without it in
# torch's cache nothing is measured, as no job may depend on a network.


_logger = logging.getLogger(__name__)

BACKBONE_PATTERN = "alexnet-owt-*.pth"  # name of torchvision's AlexNet weights in torch's hub cache
MIN_SIDE_PX = 31  # for smaller images, the last layers of AlexNet have no pixel


def lpips_ready() -> tuple[bool, str]:
    """Return whether LPIPS can be measured; if not, the reason and the next step."""
    import torch

    missing = [name for name in ("lpips", "torchvision") if importlib.util.find_spec(name) is None]
    cache = Path(torch.hub.get_dir()) / "checkpoints"
    if not any(cache.glob(BACKBONE_PATTERN)):
        missing.append(f"AlexNet's weights ({BACKBONE_PATTERN}) in torch's hub cache")
    if not missing:
        return True, ""
    lack = f"LPIPS is not measured: this Python has no {', no '.join(missing)}."
    return False, f"{lack} Install the package lpips and use it once; nothing is downloaded here."


def lpips_if_ready() -> tuple[Lpips | None, str]:
    """Return the metric, or ``None`` and the reason. It accompanies other work: nothing raises."""
    ready, reason = lpips_ready()
    if not ready:
        return None, reason
    try:
        return Lpips(), ""
    except Exception as error:  # the packages raise almost anything, for damaged files, too
        words = str(error).splitlines()
        reason = f"LPIPS is not measured: {words[0] if words else type(error).__name__}"
        _logger.warning("%s", reason)
        return None, reason


class Lpips:
    """The metric of the package ``lpips``; float32, on the CPU."""

    def __init__(self) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it calls torchvision by names of former versions
            from lpips import LPIPS

            self._network = LPIPS(net="alex", version="0.1", verbose=False).eval()

    @staticmethod
    def fits(shape: tuple[int, ...]) -> bool:
        """Return whether images of this shape are large enough for the network."""
        return min(shape[:2]) >= MIN_SIDE_PX

    def distance(self, image: np.ndarray, photo: np.ndarray) -> float:
        """Return the distance: 0 for equal images, about 0.7 for unrelated ones.

        Both are (h, w, 3) sRGB, uint8 or floats with white = 1, clamped to [0, 1] as by a display.
        """
        import torch

        pair = [np.clip(as_unit_floats(x), 0.0, 1.0) for x in (image, photo)]
        a, b = (torch.from_numpy(np.ascontiguousarray(x.transpose(2, 0, 1))[None]) for x in pair)
        with torch.inference_mode():
            return float(self._network(a, b, normalize=True))
