# SPDX-License-Identifier: GPL-3.0-or-later
"""Gain and offset per photo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..compiled import kernel
from ..image_metrics import MAX_LOG_GAIN
from ..parallel import ArrayStore, run_rows

# -- Adam for values of single photos: exposures, camera poses ------------------------------------
#
# A step moves the values of one photo only, so that each photo has its own moments and count of
# steps, and the rate follows from how many turns a photo has.

BETAS = (0.9, 0.99)
"""Decay rates of the moments. A photo has only some dozens of steps in a short run, and its
gradient, a mean over all its pixels, has little noise: a shorter memory than 0.999 works better."""

_STATE = ("first", "second", "steps")


def photo_rate(
    iteration: int, iterations: int, photos: int, *, travel: float, bounds: tuple[float, float],
    last_share: float,
) -> float:  # fmt: skip
    """Return the learning rate of an iteration.

    Parameters
    ----------
    photos : int
        Number of photos that take turns.
    travel : float
        Total of a photo's steps if its rate stayed at the first one.
    bounds : (float, float)
        Smallest and largest first rate.
    last_share : float
        Ratio of the last rate to the first; between them the rate falls log-linearly.
    """
    turns = max(1.0, iterations / max(1, photos))
    first = min(bounds[1], max(bounds[0], travel / turns))
    return first * last_share ** min(1.0, iteration / max(1, iterations))


class PhotoAdam:
    """Moments, of type ``dtype``, of ``values`` values of each of ``count`` photos.

    ``epsilon`` is added to the root of the second moment.
    """

    def __init__(self, count: int, values: int, dtype: type[np.floating], epsilon: float) -> None:
        self.first = np.zeros((count, values), dtype)
        self.second = np.zeros((count, values), dtype)
        self.steps = np.zeros(count, np.int64)
        self._dtype, self._epsilon = dtype, epsilon

    def step(self, view: int, gradient: np.ndarray, rate: float) -> np.ndarray:
        """Take in a photo's (values,) gradient; return the (values,) float64 to subtract."""
        gradient = gradient.astype(self._dtype)
        self.steps[view] += 1
        taken = int(self.steps[view])
        shares = [self._dtype(1.0 - beta) for beta in BETAS]
        self.first[view] += shares[0] * (gradient - self.first[view])
        self.second[view] += shares[1] * (gradient**2 - self.second[view])
        mean = self.first[view].astype(np.float64) / (1.0 - BETAS[0] ** taken)
        size = np.sqrt(self.second[view].astype(np.float64) / (1.0 - BETAS[1] ** taken))
        return rate * mean / (size + self._epsilon)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays that the next step depends on, by name."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over arrays of :meth:`to_arrays`.

        Raises
        ------
        KeyError, ValueError
            An array is missing, or its shape or type is another.
        """
        for name in _STATE:
            own, given = getattr(self, name), arrays[name]
            if given.shape != own.shape or given.dtype != own.dtype:
                raise ValueError(f"{name} of the photos' steps: {given.dtype} {given.shape}")
            own[...] = given


# -- Kernels of the trained exposure: an affine map per colour channel and its gradients ----------


@kernel(fast=True)
def apply_rows(
    begin: int, end: int, color: Any, alpha: Any, gains: Any, offsets: Any, out: Any
) -> None:
    """Write ``gains color + offsets alpha`` of rows; an ``alpha`` without rows stands for 1."""
    with_alpha = alpha.shape[0] > 0
    red, green, blue = gains[0], gains[1], gains[2]
    for y in range(begin, end):
        for x in range(color.shape[1]):
            cover = alpha[y, x] if with_alpha else color.dtype.type(1)
            out[y, x, 0] = red * color[y, x, 0] + offsets[0] * cover
            out[y, x, 1] = green * color[y, x, 1] + offsets[1] * cover
            out[y, x, 2] = blue * color[y, x, 2] + offsets[2] * cover


@kernel(fast=True)
def backward_rows(
    begin: int, end: int, color: Any, alpha: Any, by_out: Any, gains: Any, offsets: Any,
    by_color: Any, by_alpha: Any, sums: Any,
) -> None:  # fmt: skip
    """Write the gradients on colour and alpha, and each row's six sums for gains and offsets.

    ``sums[y]`` = sums over the row of ``by_out color`` (3) and ``by_out alpha`` (3), in float64:
    a row is summed by one thread, so that the total does not depend on the number of threads.
    """
    with_alpha = alpha.shape[0] > 0
    for y in range(begin, end):
        gain_r = gain_g = gain_b = 0.0
        offset_r = offset_g = offset_b = 0.0
        for x in range(color.shape[1]):
            cover = alpha[y, x] if with_alpha else color.dtype.type(1)
            r, g, b = by_out[y, x, 0], by_out[y, x, 1], by_out[y, x, 2]
            gain_r += r * color[y, x, 0]
            gain_g += g * color[y, x, 1]
            gain_b += b * color[y, x, 2]
            offset_r += r * cover
            offset_g += g * cover
            offset_b += b * cover
            by_color[y, x, 0] = gains[0] * r
            by_color[y, x, 1] = gains[1] * g
            by_color[y, x, 2] = gains[2] * b
            if with_alpha:
                by_alpha[y, x] = offsets[0] * r + offsets[1] * g + offsets[2] * b
        sums[y, 0], sums[y, 1], sums[y, 2] = gain_r, gain_g, gain_b
        sums[y, 3], sums[y, 4], sums[y, 5] = offset_r, offset_g, offset_b


# -- Trained exposure of each photo: a gain and an offset per colour channel ----------------------
#
# See docs/method.md, section 1.6.
#
# The method's ``exp(a) I + b`` has one gain and one offset per photo. Cameras in automatic mode
# also change the white balance, so here every channel has its own. The offset is necessary: with
# the sRGB curve ``s = 1.055 L^(1/2.4) - 0.055``, light ``L`` times ``g`` maps ``s`` exactly to
# ``k s + 0.055 (k - 1)`` with ``k = g^(1/2.4)``, which a gain alone cannot fit in dark parts.
#
# The corrected image enters the whole colour loss. In the method, SSIM is computed on the raw
# render; its luminance and contrast terms then demand a different brightness of the same
# Gaussians for every photo, which is the contradiction that the exposure removes.
#
# The Gaussians have the mean exposure of the training photos: the means over these of all log
# gains and of all offsets (at middle grey) are held at 0; otherwise colours and exposures could
# drift against each other.

SRGB_PEDESTAL = 0.055
"""Offset of the sRGB curve: display values plus this are a power of the light."""

PIVOT = 0.5
"""Display value about which gains act: an offset then shifts the mean of a typical image and a gain
its contrast. This decorrelates them, which helps Adam, as it scales every value separately. Middle
grey is also the value that zero means leave unchanged."""

REFERENCE_RATE = 1e-3
"""Learning rate of docs/method.md, section 1.4."""

TRAVEL = 1.5
"""Total change that a short run's first rate allows over all steps of a photo; as the rate decays,
it is 0.6. Light altered by a factor of 1.35 either way is a log gain of 0.13."""

LARGEST_RATE = 0.02
LAST_SHARE = 0.1
"""Ratio of the last rate to the first: Adam's steps are about as large as its rate, and the last
ones remain as an error of colour."""

MAX_OFFSET = 1.0

EPSILON = 1e-15

_NO_ALPHA = {np.dtype(t): np.zeros((0, 0), t) for t in (np.float32, np.float64)}


def exposure_rate(iteration: int, iterations: int, photos: int) -> float:
    """Return the learning rate of an iteration: :data:`TRAVEL` over a photo's steps, decaying.

    Never below :data:`REFERENCE_RATE` nor above :data:`LARGEST_RATE` at the start; then log-linear
    to :data:`LAST_SHARE` of that.
    """
    return photo_rate(
        iteration, iterations, photos,
        travel=TRAVEL, bounds=(REFERENCE_RATE, LARGEST_RATE), last_share=LAST_SHARE,
    )  # fmt: skip


class Exposure:
    """Gains and offsets of all photos, with their optimiser state.

    Parameters
    ----------
    count : int
        Number of the scene's views.
    trained : sequence of int
        Training views; the others stay neutral and are excluded from the mean.
    log_gains : (count, 3), optional
        Initial log gains of display values plus :data:`SRGB_PEDESTAL`, as estimated by
        :mod:`.exposure_selection`; a short run then only refines them. Non-finite
        values count as 0.
    """

    def __init__(
        self, count: int, trained: Sequence[int], log_gains: np.ndarray | None = None
    ) -> None:
        self.trained = np.unique(np.asarray(trained, np.int64))
        self.values = np.zeros((count, 6), np.float32)
        """Log gains of red, green, blue, then offsets at :data:`PIVOT`; display values."""
        self.adam = PhotoAdam(count, 6, np.float32, EPSILON)
        self.gradient = np.zeros(6)
        """Gradient of the last backward pass, for the next step; not part of the state."""
        self._store = ArrayStore()
        self.active = True
        """Whether steps change exposures."""
        if log_gains is not None:
            start = np.where(np.isfinite(log_gains), log_gains, 0.0)[self.trained]
            self.values[self.trained, :3] = start
            self.values[self.trained, 3:] = (SRGB_PEDESTAL + PIVOT) * np.expm1(start)
        self.pin()

    def corrected(
        self, view: int, color: np.ndarray, alpha: np.ndarray | None = None, *, threads: int = 0
    ) -> np.ndarray:
        """Apply the photo's exposure to a render: ``exp(a) color + b``, valid until the next call.

        ``color`` is (h, w, 3) float32 or float64. With an ``alpha`` (h, w) the offset is
        ``b alpha``, as for a colour blended over emptiness: for images that are composited
        afterwards (:mod:`.background`).
        """
        color, alpha = self._arrays(color, alpha)
        out = self._store.take(f"corrected {color.dtype}", color.shape, color.dtype)
        gains, offsets = self.factors(view, color.dtype)
        run_rows(apply_rows, len(color), threads, color, alpha, gains, offsets, out, chunks=1)
        return out

    def backward(
        self, view: int, color: np.ndarray, by_corrected: np.ndarray,
        alpha: np.ndarray | None = None, *, threads: int = 0,
    ) -> tuple[np.ndarray, np.ndarray | None]:  # fmt: skip
        """Return the gradients on colour and alpha; store that of the exposure for :meth:`step`.

        ``by_corrected`` (h, w, 3) is the gradient of the loss on the corrected image. The results,
        (h, w, 3) and (h, w) or ``None`` without alpha, are valid until the next call, and bitwise
        the same for any number of threads.
        """
        color, cover = self._arrays(color, alpha)
        by_out = np.ascontiguousarray(by_corrected, color.dtype)
        by_color = self._store.take(f"by color {color.dtype}", color.shape, color.dtype)
        by_alpha = self._store.take(f"by alpha {color.dtype}", cover.shape, color.dtype)
        gains, offsets = self.factors(view, color.dtype)
        sums = np.zeros((len(color), 6))
        run_rows(
            backward_rows, len(color), threads, color, cover, by_out, gains, offsets, by_color,
            by_alpha, sums, chunks=1,
        )  # fmt: skip
        self.gradient[:] = sums.sum(axis=0)
        # d/da of exp(a) (color - PIVOT alpha)
        self.gradient[:3] = gains * (self.gradient[:3] - PIVOT * self.gradient[3:])
        return by_color, None if alpha is None else by_alpha

    def step(self, view: int, rate: float) -> None:
        """Apply an Adam step of a photo's exposure with the last gradient, then pin the mean.

        A non-finite gradient is skipped.
        """
        if not self.active or not np.isfinite(self.gradient).all():
            return
        self.values[view] -= self.adam.step(view, self.gradient, rate).astype(np.float32)
        self.pin()

    def pin(self) -> None:
        """Subtract the means over the trained photos (0 to rounding) and clip values to bounds."""
        if len(self.trained) == 0:
            return
        kept = self.values[self.trained].astype(np.float64)
        limit = np.repeat([MAX_LOG_GAIN, MAX_OFFSET], 3)
        kept = np.clip(kept - kept.mean(axis=0), -limit, limit)
        self.values[self.trained] = kept - kept.mean(axis=0)

    def factors(self, view: int, dtype: np.dtype | type = np.float64) -> tuple[np.ndarray, ...]:
        """Return ``exp(a)`` (3,) and the offset at black ``b`` (3,) of a photo."""
        value = self.values[view].astype(np.float64)
        gains = np.exp(value[:3])
        return gains.astype(dtype), (value[3:] + PIVOT * (1.0 - gains)).astype(dtype)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays that the next iteration depends on, by name."""
        own: dict[str, np.ndarray] = {"values": self.values.copy(), "trained": self.trained.copy()}
        if not self.active:
            own["active"] = np.array(False)
        return own | self.adam.to_arrays()

    @classmethod
    def restore(cls, arrays: dict[str, np.ndarray]) -> Exposure:
        """Build from :meth:`to_arrays`, bit for bit; the arrays are copied.

        Raises
        ------
        KeyError, ValueError
            An array is missing, or arrays are inconsistent.
        """
        count = len(arrays["values"])
        trained = arrays["trained"]
        if trained.ndim != 1 or (
            len(trained) and not (0 <= trained.min() <= trained.max() < count)
        ):
            raise ValueError("the trained views of the exposures are not among the scene's")
        made = cls(count, trained.tolist())
        values = arrays["values"]
        if values.shape != made.values.shape or values.dtype != made.values.dtype:
            raise ValueError(f"values of the exposures: {values.dtype} {values.shape}")
        made.values[...] = values
        made.adam.load(arrays)
        made.active = bool(arrays.get("active", True))
        return made

    @staticmethod
    def _arrays(color: np.ndarray, alpha: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        color = np.ascontiguousarray(color)
        if alpha is None:
            return color, _NO_ALPHA[color.dtype]
        return color, np.ascontiguousarray(alpha, color.dtype)
