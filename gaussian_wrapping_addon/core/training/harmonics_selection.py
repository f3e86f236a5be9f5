# SPDX-License-Identifier: GPL-3.0-or-later
"""Fit spherical harmonics to a few photos in closed form, without training.

Images are linear in the colours: back-projecting the residuals of a photo gives the mean residual
of each Gaussian in it, and a small regression over the viewing directions gives its coefficients
(docs/method.md, section 4.4). :mod:`.harmonics_selection` evaluates the result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import uniform_filter

from .. import limits
from ..errors import UsageError
from ..gaussians.model import OrientedGaussians
from ..parallel import default_threads
from ..render.projection import RawArrays
from ..render.projection_kernels import MAX_DEGREE
from ..render.reference import harmonics_basis
from ..render.types import ImageGradients, Renderer, RenderOptions
from ..render.view_renderer import ViewRenderer
from ..scene.camera import Camera
from .model_selection import OFF, Decision

# -- Fit spherical harmonics to a few photos in closed form, without training ---------------------
#
# Images are linear in the colours: back-projecting the residuals of a photo gives the mean
# residual of each Gaussian in it, and a small regression over the viewing directions gives its
# coefficients (docs/method.md, section 4.4). :mod:`.harmonics_selection` evaluates the result.


LOWER_DEGREE_FITS = 3
"""Fits without the degree before the comparison. With unconverged colours any further parameter
shows a gain: on a matte sphere with colours 0.15 off, degree 1 gains 0.11 dB without these fits."""

RIDGE_SHARE = 0.05
RIDGE_PX = 2.0
"""Ridge of the regressions, as a share of a Gaussian's weight in all views, including those for
evaluation, and in pixels. It constrains coefficients that few or one-sided views do not determine:
a Gaussian close to a camera fills the view of that camera and is a few pixels elsewhere."""

LOW_PASS_SHARE = 1.0 / 8.0
"""Residuals are box-filtered with this share of the long side. Reflections vary slowly over a
surface; errors of shape and detail also depend on the view, but average out."""

_C0 = 0.5 / math.sqrt(math.pi)
_BLOCK = 4096
_STEP_RIDGE = 1e-6
_ERROR_FLOOR = 1e-12

Correction = tuple[np.ndarray, np.ndarray]
"""Gain and offset, (3,) each: the photo is ``gain * render + offset``."""


@dataclass(frozen=True)
class TrialView:
    """A photo at a small size, for fitting or evaluation."""

    camera: Camera
    photo: np.ndarray
    """(h, w, 3) uint8, or floats in [0, 1]."""
    mask: np.ndarray | None = None
    """(h, w) bool, true for pixels that count."""
    correction: Correction | None = None
    """The photo's exposure, if known."""


@dataclass(frozen=True)
class TrialErrors:
    """Errors of a photo excluded from the fit, without and with the degree."""

    without: np.ndarray
    """(n,) sums over the pixels of squared :func:`low_pass` errors, back-projected to the
    Gaussians."""
    with_degree: np.ndarray
    weights: np.ndarray
    """(n,) sums of blending weights over the unmasked pixels."""
    low_frequency: tuple[float, float]
    """Mean squared :func:`low_pass` error of the photo without the degree and with it."""
    total: float
    """Mean squared error without the degree."""


class HarmonicsTrial:
    """Fit of the harmonics of all Gaussians to some photos.

    Every Gaussian is fitted separately; the length of the common step is then chosen by least
    squares of the fitted views' residuals, since separate fits of overlapping Gaussians overshoot.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Coefficients of ``degree`` and above are taken as 0. Scene frame.
    fitted : sequence of TrialView
    degree : int
        The degree to try, 1 to 3.
    weight_sums : (n,) array
        Weights of the Gaussians in all views, fitted or not (:func:`summed_weights`), pixels.
    threads : int
    check : callable
        Called before each view is rendered; an exception ends the trial.
    """

    def __init__(
        self,
        gaussians: OrientedGaussians,
        fitted: Sequence[TrialView],
        degree: int,
        weight_sums: np.ndarray,
        renderer: Renderer,
        threads: int,
        check: Callable[[], None],
    ) -> None:
        self.check, self.threads, self.degree, self.weight_sums = (
            check,
            threads,
            degree,
            weight_sums,
        )
        self.renderer = renderer
        self.raw = raw = RawArrays.from_gaussians(gaussians)
        count, kept = len(raw), min(raw.sh.shape[1], degree**2)
        self.start = np.zeros((count, (degree + 1) ** 2, 3), np.float32)
        self.start[:, :kept] = raw.sh[:, :kept]
        self.fitted = list(fitted)
        self.corrected = any(view.correction is not None for view in self.fitted)
        self.directions = [_directions(raw.means, view.camera) for view in self.fitted]
        self.targets = [_target(view, None) for view in self.fitted]

    def fit_lower_degrees(self) -> None:
        """Fit the lower degrees, the common start of both sides of the comparison."""
        for _ in range(LOWER_DEGREE_FITS):
            (self.start,) = self.fit(self.degree - 1)

    def fit(self, *degrees: int) -> list[np.ndarray]:
        """Return (n, k, 3) float32 coefficients for each degree, fitted up to that degree."""
        count = len(self.raw)
        sums = np.zeros((len(self.fitted), count, 3), np.float32)  # back-projected, pixels
        weights = np.zeros((len(self.fitted), count), np.float32)
        before, residuals = [], []
        options = RenderOptions(depth=False, threads=self.threads, statistics=True)
        start = self._with_coefficients(self.start)
        for row, (view, (target, counts)) in enumerate(zip(self.fitted, self.targets, strict=True)):
            self.check()
            image = self.renderer.render(start, view.camera, options)
            assert image.statistics is not None
            before.append(image.color.copy())
            residuals.append(low_pass(target - image.color, counts))
            seen = image.backward(ImageGradients(color=residuals[-1].astype(np.float32)))
            sums[row, seen.ids] = seen.sh[:, 0] / _C0
            if view.mask is None:
                weights[row] = image.statistics.weight_sum
            else:  # the same sums over unmasked pixels only
                ones = np.repeat(counts[..., None], 3, 2).astype(np.float32)
                seen = image.backward(ImageGradients(color=ones))
                weights[row, seen.ids] = seen.sh[:, 0].max(1) / _C0
        out = []
        for degree in degrees:
            step = _regress(sums, weights, self.weight_sums, self.directions, degree)
            length = self._step_length(step, before, residuals)
            out.append(self._stepped(length * step))
        return out

    def compare(self, view: TrialView, without: np.ndarray, with_degree: np.ndarray) -> TrialErrors:
        """Evaluate two sets of coefficients on a photo excluded from the fit.

        Where exposures are known, a photo without one is matched to the image of the start.
        """
        matched = self.corrected and view.correction is None
        target, counts = _target(view, self._image(self.start, view.camera) if matched else None)
        differences = [self._image(sh, view.camera) - target for sh in (without, with_degree)]
        squares = [np.square(low_pass(d, counts)).mean(2) for d in differences]  # (h, w) each
        # Zero coefficients give unclamped grey, so that all three channels have the same gradient.
        self.check()
        grey = self._with_coefficients(np.zeros((len(self.raw), 1, 3), np.float32))
        image = self.renderer.render(
            grey, view.camera, RenderOptions(depth=False, sh_degree=0, threads=self.threads)
        )
        sent = np.stack([*squares, counts], 2).astype(np.float32)  # (h, w, 3)
        seen = image.backward(ImageGradients(color=sent))
        blended = np.zeros((len(self.raw), 3), np.float64)
        blended[seen.ids] = seen.sh[:, 0] / _C0
        low_frequency = [float(square[counts].mean()) for square in squares]
        total = float((differences[0][counts].astype(np.float64) ** 2).mean())
        return TrialErrors(
            blended[:, 0], blended[:, 1], blended[:, 2], (low_frequency[0], low_frequency[1]), total
        )  # fmt: skip

    def _image(self, sh: np.ndarray, camera: Camera) -> np.ndarray:
        self.check()
        options = RenderOptions(depth=False, threads=self.threads)
        return self.renderer.render(self._with_coefficients(sh), camera, options).color.copy()

    def _with_coefficients(self, sh: np.ndarray) -> RawArrays:
        raw = self.raw
        return RawArrays(
            raw.means, raw.log_scales, raw.quats, raw.opacity_logits,
            np.ascontiguousarray(sh, raw.means.dtype), raw.orientation, raw.filter_3d,
        )  # fmt: skip

    def _stepped(self, step: np.ndarray) -> np.ndarray:
        sh = self.start.copy()
        sh[:, : step.shape[1]] += step.astype(np.float32)
        return sh

    def _step_length(
        self, step: np.ndarray, before: list[np.ndarray], residuals: list[np.ndarray]
    ) -> float:
        """Return the step length that minimises the squared residuals of the fitted views."""
        normal, right = _ERROR_FLOOR, 0.0
        moved = self._stepped(step)
        for view, (_, counts), base, residual in zip(
            self.fitted, self.targets, before, residuals, strict=True
        ):
            part = low_pass(self._image(moved, view.camera) - base, counts)[counts]
            right += float((part * residual[counts]).sum())
            normal += (1.0 + _STEP_RIDGE) * float((part * part).sum())
        return right / normal


def summed_weights(
    gaussians: OrientedGaussians,
    views: Sequence[TrialView],
    renderer: Renderer,
    threads: int,
    check: Callable[[], None],
) -> np.ndarray:
    """Return (n,) sums of blending weights over all views, pixels."""
    raw = RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=False, sh_degree=0, threads=threads, statistics=True)
    weight_sums = np.zeros(len(raw), np.float64)
    for view in views:
        check()
        statistics = renderer.render(raw, view.camera, options).statistics
        assert statistics is not None
        weight_sums += statistics.weight_sum
    return weight_sums


def _regress(
    sums: np.ndarray,
    weights: np.ndarray,
    weight_sums: np.ndarray,
    directions: list[Callable[[int, int, int], np.ndarray]],
    degree: int,
) -> np.ndarray:
    """Return (n, k, 3) float32 ridge regressions of the mean residuals on the harmonics.

    Parameters
    ----------
    sums : (v, n, 3)
        Sums of back-projected residuals.
    weights : (v, n)
        Sums of blending weights.
    weight_sums : (n,)
        The same over all views, including those not fitted to.
    directions : list of callables
        For each view, a function that evaluates the harmonics of a range of Gaussians.
    """
    views, count = weights.shape
    size = (degree + 1) ** 2
    out = np.zeros((count, size, 3), np.float32)
    for begin in range(0, count, _BLOCK):
        end = min(count, begin + _BLOCK)
        normal = np.zeros((end - begin, size, size))
        right = np.zeros((end - begin, size, 3))
        for view in range(views):
            basis = directions[view](begin, end, degree)  # (m, k)
            weight = weights[view, begin:end].astype(np.float64)  # (m,)
            normal += (weight[:, None] * basis)[:, :, None] * basis[:, None, :]
            right += basis[:, :, None] * sums[view, begin:end, None, :]
        ridge = _C0**2 * (RIDGE_SHARE * weight_sums[begin:end] + RIDGE_PX)  # (m,)
        normal[:, np.arange(size), np.arange(size)] += ridge[:, None]
        out[begin:end] = np.linalg.solve(normal, right)
    return out


def _directions(means: np.ndarray, camera: Camera) -> Callable[[int, int, int], np.ndarray]:
    """Return a function for the (m, k) harmonics of a range of Gaussians seen from a camera."""
    center = camera.center

    def basis(begin: int, end: int, degree: int) -> np.ndarray:
        offset = means[begin:end].astype(np.float64) - center  # (m, 3)
        length = np.maximum(np.linalg.norm(offset, axis=1), limits.DIRECTION_MIN_NORM)
        unit = torch.from_numpy(offset / length[:, None])
        return harmonics_basis(unit, degree).numpy()

    return basis


def _target(view: TrialView, image: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the target image in the Gaussians' exposure, and (h, w) bool of the pixels that count.

    A photo of unknown exposure is matched to ``image`` if given.
    """
    camera, photo = view.camera, view.photo
    if photo.shape != (camera.height, camera.width, 3):
        raise UsageError(
            f"Photo {camera.name} is {photo.shape}, its camera {camera.width} x {camera.height}.",
            "Give both at the same size.",
        )
    target = photo.astype(np.float32) / np.float32(255 if photo.dtype == np.uint8 else 1)
    counts = np.ones(photo.shape[:2], np.bool_) if view.mask is None else view.mask
    correction = view.correction
    if correction is None and image is not None:
        correction = match_exposure(image[counts], target[counts])
    if correction is not None:
        gain, offset = (np.asarray(value, np.float32) for value in correction)
        target = (target - offset) / gain
    return target, counts


def match_exposure(image: np.ndarray, photo: np.ndarray) -> Correction:
    """Return the gain and offset per channel that match a render to a photo.

    Least squares over (p, 3) colours; a constant channel keeps gain 1.
    """
    image, photo = image.astype(np.float64), photo.astype(np.float64)
    mean, wanted = image.mean(0), photo.mean(0)
    variance = ((image - mean) ** 2).mean(0)
    covariance = ((image - mean) * (photo - wanted)).mean(0)
    varies = (variance > 1e-6) & (covariance > 1e-6)
    gain = np.where(varies, covariance / np.where(varies, variance, 1.0), 1.0)
    return gain, wanted - gain * mean


def low_pass(difference: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Box-filter an image over the pixels that count, with sides of :data:`LOW_PASS_SHARE`.

    Parameters
    ----------
    difference : (h, w, 3)
    counts : (h, w) bool

    Returns
    -------
    (h, w, 3) float64
        0 at pixels that do not count.
    """
    size = max(1, round(LOW_PASS_SHARE * max(counts.shape)))
    weight = uniform_filter(counts.astype(np.float64), size, mode="constant")  # (h, w)
    kept = np.where(counts[..., None], difference, 0.0).astype(np.float64)
    sums = uniform_filter(kept, (size, size, 1), mode="constant")
    mean = sums / np.maximum(weight, 1e-9)[..., None]
    return np.where(counts[..., None], mean, 0.0)


# -- Decide whether to raise the degree of spherical harmonics, by cross-validation on the photos
#
# Training with and without the degree would tell, at the cost of two trainings. The degree is
# fitted in closed form instead (:mod:`.harmonics_selection`) and evaluated on photos excluded from
# the fit (docs/method.md, section 4.4). The mean gain over photos does not separate gloss from
# errors of shape, which any additional parameter lowers slightly in many places. Gloss is local
# and consistent over all photos: so errors are accumulated per Gaussian, and the criterion is the
# share of the surface that gains clearly.


MAX_FIT_VIEWS = 40
MAX_HELD_OUT = 10
"""Most training and held-out views used, evenly spread."""

MIN_FIT_VIEWS = 4
"""Fewest views to fit a fold to; with fewer the result is unknown."""

MIN_RELATIVE_REDUCTION = 0.4
"""Relative reduction of a Gaussian's low-frequency error from which it counts as improved. At 0.3,
exposures that training compensates only partly look like gloss: 0.08 of a matte surface against
0.11 of a glossy one."""

MIN_REDUCTION_RMS = 0.007
"""Root of the smallest reduction of a Gaussian's mean squared low-frequency error that counts,
white being 1: about two steps of an 8-bit photo. Relative changes of smaller errors are random:
without this limit 0.07 of a matte room counts."""

NEEDED_SHARE = 0.055
"""Share of the well-observed surface from which a degree is selected. Among scenes trained without
harmonics for 600 iterations at 288 pixels, 40 photos, one with a glossy object has 0.080, matte
ones 0.000 (spokes) to 0.012 (a room), and a matte one with the exposures found by training 0.038
(0.063 in a later run: too many)."""

SEEN_PX = 0.05
SEEN_PHOTOS = 8
"""A Gaussian is well observed with at least this sum of blending weights in this many photos."""

WELL_SEEN_SHARE = 0.1
"""Least well-observed share of the visible surface; below it the result is unknown."""


@dataclass(frozen=True)
class HarmonicsEvidence:
    """Result of the trial of a degree."""

    degree: int
    """The degree that was tried."""
    share: float
    """Share of the well-observed surface with a clearly lower low-frequency error; 0 if unknown."""
    gain_db: float
    """Reduction of the photos' mean squared error by the degree, low frequencies only; 0 if
    unknown. Reported, not part of the criterion."""
    well_seen: float
    """Share of the visible surface that is well observed."""
    needed: bool
    evaluated: int
    """Photos used for evaluation; 0 if there were too few."""
    coefficients: np.ndarray | None
    """(n, (degree + 1)^2, 3) float32: all harmonics fitted to all training views, an initial value
    for training; ``None`` if the degree is not needed."""

    def decision(self, setting: str = "auto", degree: int | None = None) -> Decision:
        """Return the decision.

        Parameters
        ----------
        setting : str
        degree : int, optional
            The degree now in use; by default the one that follows from this trial.
        """
        if degree is None:
            degree = self.degree if self.needed else self.degree - 1
        degree = 0 if setting == OFF else degree
        figures = {
            "share": self.share,
            "limit_share": NEEDED_SHARE,
            "gain_db": self.gain_db,
            "well_seen": self.well_seen,
            "degree_tried": float(self.degree),
            "photos": float(self.evaluated),
        }
        if not self.evaluated:
            evidence = "Too few photos to tell whether colours depend on the viewing direction."
        else:
            evidence = (
                f"View-dependent colours of degree {self.degree} visibly lower the error by "
                f"{100 * MIN_RELATIVE_REDUCTION:.0f} % or more on {100 * self.share:.1f} % of the "
                f"well-observed surface (threshold {100 * NEEDED_SHARE:.1f} %), cross-validated on "
                f"{self.evaluated} photos."
            )
        return Decision("harmonics", setting, f"degree {degree}", evidence, figures)


def select_harmonics(
    gaussians: OrientedGaussians,
    views: Sequence[TrialView],
    held_out: Sequence[TrialView],
    degree: int,
    renderer: Renderer | None = None,
    *,
    threads: int = 0,
    check: Callable[[], None] | None = None,
) -> HarmonicsEvidence:
    """Try a degree of the harmonics on Gaussians that were trained below it.

    The photos are split into two folds. Each is evaluated with coefficients fitted to the training
    views of the other. All coefficients are fitted both with and without the degree, so that
    unconverged lower degrees are not taken for view dependence; the lower degrees are fitted first.

    The squared low-frequency errors are back-projected to the Gaussians and summed over all photos.
    A Gaussian counts as improved, with its visible weight, if this error falls by
    :data:`MIN_RELATIVE_REDUCTION` or more and visibly (:data:`MIN_REDUCTION_RMS`), and falls in
    most photos that show it: a single photo must not decide. Surfaces that are off by as much as
    the width of a Gaussian count too.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Coefficients of ``degree`` and above are taken as 0. Scene frame.
    views : sequence of TrialView
        Training views at a small size (about 144 pixels); :data:`MAX_FIT_VIEWS` of them are used.
    held_out : sequence of TrialView
        Photos never trained on; used for evaluation only.
    degree : int
        The degree to try, from 1 to 3.
    renderer : Renderer, optional
        Overwrites its last view; by default one on the processor.
    threads : int
        0 uses every core. The result does not depend on it.
    check : callable, optional
        Called before each view is rendered; an exception ends the trial.

    Returns
    -------
    HarmonicsEvidence

    Raises
    ------
    UsageError
        ``degree`` is out of range, or a photo has another size than its camera.
    """
    if not 1 <= degree <= MAX_DEGREE:
        raise UsageError(f"Degree {degree} cannot be tried.", f"Give 1 to {MAX_DEGREE}.")
    threads, check = threads or default_threads(), check or _no_check
    renderer = renderer or ViewRenderer()
    fitted, evaluation_views = (
        _evenly_spaced(views, MAX_FIT_VIEWS),
        _evenly_spaced(held_out, MAX_HELD_OUT),
    )
    unknown = HarmonicsEvidence(degree, 0.0, 0.0, 0.0, False, 0, None)
    halves = _halves(fitted)
    if min(len(half) for half in halves) < MIN_FIT_VIEWS or len(gaussians) == 0:
        return unknown
    shown = summed_weights(gaussians, [*fitted, *evaluation_views], renderer, threads, check)
    statistics = _ErrorStatistics(len(gaussians))
    for half, other, apart in zip(halves, reversed(halves), _halves(evaluation_views), strict=True):
        trial = HarmonicsTrial(gaussians, half, degree, shown, renderer, threads, check)
        trial.fit_lower_degrees()
        without, with_degree = trial.fit(degree - 1, degree)
        for view in (*other, *apart):
            compared = trial.compare(view, without, with_degree)
            statistics.add(compared.without, compared.with_degree, compared.weights)
            statistics.low_frequency += compared.low_frequency
            statistics.total += compared.total
    share, well_seen = statistics.shares()
    if well_seen < WELL_SEEN_SHARE:
        return unknown
    needed = share > NEEDED_SHARE
    coefficients = None
    if needed:
        trial = HarmonicsTrial(gaussians, fitted, degree, shown, renderer, threads, check)
        trial.fit_lower_degrees()
        (coefficients,) = trial.fit(degree)
    evaluated = len(fitted) + len(evaluation_views)
    return HarmonicsEvidence(
        degree, share, statistics.gain_db(), well_seen, needed, evaluated, coefficients
    )  # fmt: skip


class _ErrorStatistics:
    """Error sums over the evaluation photos, for each of n Gaussians and in total."""

    def __init__(self, count: int) -> None:
        self.without, self.with_degree = np.zeros(count), np.zeros(count)
        self.weights = np.zeros(count)
        self.photos, self.better = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.low_frequency, self.total = np.zeros(2), 0.0

    def add(self, without: np.ndarray, with_degree: np.ndarray, weights: np.ndarray) -> None:
        """Add the errors of a photo: (n,) each."""
        self.without += without
        self.with_degree += with_degree
        self.weights += weights
        seen = weights > SEEN_PX
        self.photos += seen
        self.better += seen & (with_degree < without)

    def shares(self) -> tuple[float, float]:
        """Return the improved share of the well-observed surface, and the well-observed share."""
        seen = self.photos >= SEEN_PHOTOS
        total, shown = float(self.weights[seen].sum()), float(self.weights.sum())
        if total <= 0.0:
            return 0.0, 0.0
        gains = seen & (self.without - self.with_degree > MIN_REDUCTION_RMS**2 * self.weights)
        gains &= self.with_degree < (1.0 - MIN_RELATIVE_REDUCTION) * self.without
        gains &= 2 * self.better > self.photos
        return float(self.weights[gains].sum()) / total, total / shown

    def gain_db(self) -> float:
        """Return the low-frequency reduction as a gain of the total error, dB."""
        explained = float(self.low_frequency[0] - self.low_frequency[1]) / max(self.total, 1e-12)
        return -10.0 * math.log10(1.0 - min(explained, 1.0 - 1e-6))


def _evenly_spaced(views: Sequence[TrialView], most: int) -> list[TrialView]:
    """Return at most ``most`` of the views with unmasked pixels, evenly spread."""
    usable = [view for view in views if view.mask is None or view.mask.any()]
    count = min(len(usable), most)
    chosen = np.linspace(0, len(usable) - 1, count).round().astype(int)
    return [usable[i] for i in chosen.tolist()]


def _halves(views: Sequence[TrialView]) -> tuple[list[TrialView], list[TrialView]]:
    """Split the views into two folds: one of each pair of neighbours, drawn with a fixed seed.

    A deterministic rule would fail for captures with the same period: two alternating heights, or
    three cameras in turn.
    """
    draws = np.random.default_rng(0).integers(0, 2, size=(len(views) + 1) // 2).tolist()
    sides = [(draws[position // 2] + position) % 2 for position in range(len(views))]
    return (
        [view for view, side in zip(views, sides, strict=True) if side == 0],
        [view for view, side in zip(views, sides, strict=True) if side == 1],
    )


def _no_check() -> None:
    """Check nothing."""
