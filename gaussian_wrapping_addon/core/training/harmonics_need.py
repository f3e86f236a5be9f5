# SPDX-License-Identifier: GPL-3.0-or-later
"""Does the next degree of spherical harmonics lower the error of photos not fitted to?

Training twice would tell, but costs two trainings. Colours enter an image linearly, so the next
degree can be tried in closed form: the residuals of a few photos, sent backwards, give the mean
residual of each Gaussian in each of them; a small regression over the viewing directions gives its
coefficients; photos that took no part judge them (design.md 6).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import uniform_filter

from .. import tolerances
from ..dataset.camera import Camera
from ..errors import UsageError
from ..gaussians.model import OrientedGaussians
from ..parallel import default_threads
from ..render.harmonics_kernels import MAX_DEGREE
from ..render.projection import RawArrays
from ..render.reference_projection import harmonics_basis
from ..render.types import ImageGradients, RenderOptions
from ..render.view_renderer import ViewRenderer
from .needs import OFF, Decision

MAX_FIT_VIEWS = 30
"""Coefficients are fitted to no more views, spread evenly: three to seven unknowns a channel."""

MARGIN_DB = 0.02
"""A degree is needed where it lowers the error of the judging photos by more than this. Counted is
only the error that changes slowly over the image, against the whole error of whole photos, so that
a shiny thing in the middle of a matte room gives small figures: +0.04 dB, where a matte one gives
-0.05 dB, each trained for 2000 iterations at 288 pixels."""

SWEEPS = 1
"""Directions of descent that the closed form looks along, each from the residuals left over."""

SETTLING = 3
"""Fits without the degree before the comparison. Colours that training has not settled yet lend any
further unknown a gain: on a matte sphere with colours 0.15 off, degree 1 gains 0.11 dB without."""

RIDGE_SHARE = 0.05
RIDGE_PX = 2.0
"""Ridge of the regressions, in shares of a Gaussian's weight in all views, the judging ones too,
and in pixels. It holds what few or one-sided views cannot tell: a Gaussian close to a camera fills
the view of that camera and is a few pixels elsewhere."""

LEFT_OUT_EVERY = 5
"""Where no photo is held out, every so many views judge instead of being fitted to."""

MIN_FIT_VIEWS = 4
"""Nothing can be told from fewer."""

COARSE_SHARE = 1.0 / 8.0
"""Residuals are averaged over squares of this share of the long side. Reflections change colours
slowly over a surface; errors of shape and detail change with the view as well, but average out."""

_C0 = 0.5 / math.sqrt(math.pi)
_BLOCK = 4096
_STEP_RIDGE = 1e-6
_ERROR_FLOOR = 1e-12

Correction = tuple[np.ndarray, np.ndarray]
"""Gain and offset, (3,) each: what the photo shows is ``gain * render + offset``."""


@dataclass(frozen=True)
class NeedView:
    """A photo at a small size, to fit to or to judge by."""

    camera: Camera
    photo: np.ndarray
    """(h, w, 3) uint8, or floats in [0, 1]."""
    mask: np.ndarray | None = None
    """(h, w) bool, true where the photo counts."""
    correction: Correction | None = None
    """The photo's exposure, where it is known."""


@dataclass(frozen=True)
class HarmonicsNeed:
    """What trying a degree has shown."""

    degree: int
    """The degree that was tried."""
    gain_db: float
    """Fall of the judging photos' mean squared error against the best without it, as far as the
    error changes slowly over the image; 0 if unknown."""
    needed: bool
    better_share: float
    """Share of the judging photos that it makes better."""
    judged: int
    """Photos that judged."""
    held_out: bool
    """Whether they were never trained on; otherwise they were left out of the fit alone."""
    coefficients: np.ndarray | None
    """(n, (degree + 1)^2, 3) float32: all harmonics as fitted, a start for training; ``None`` where
    the degree is not needed."""

    def decision(self, setting: str = "auto", degree: int | None = None) -> Decision:
        """Return the record.

        Parameters
        ----------
        setting : str
        degree : int, optional
            The degree now in use; by default what follows from this trial alone.
        """
        if degree is None:
            degree = self.degree if self.needed else self.degree - 1
        degree = 0 if setting == OFF else degree
        figures = {
            "gain_db": self.gain_db,
            "limit_db": MARGIN_DB,
            "degree_tried": float(self.degree),
            "photos": float(self.judged),
        }
        if not self.judged:
            evidence = "Too few photos to tell whether colours change with the viewing direction."
        else:
            kind = "never trained on" if self.held_out else "left out of the fit"
            evidence = (
                f"Colours that change with the viewing direction (degree {self.degree}) would "
                f"change the error of {self.judged} photos {kind} by {-self.gain_db:+.2f} dB "
                f"(worth it from {-MARGIN_DB:+.2f} dB)."
            )
        return Decision("harmonics", setting, f"degree {degree}", evidence, figures)


def harmonics_need(
    gaussians: OrientedGaussians,
    views: Sequence[NeedView],
    held_out: Sequence[NeedView],
    degree: int,
    *,
    threads: int = 0,
    check: Callable[[], None] | None = None,
) -> HarmonicsNeed:
    """Try a degree of the harmonics on Gaussians that were trained below it.

    Both with the degree and without it all coefficients may move, so that what training has not
    yet made of the lower degrees is not taken for view dependence; these are settled first. Each
    sweep sends the residuals backwards, fits every Gaussian alone, and chooses the lengths of all
    steps so far by least squares of the fitted views' residuals: Gaussians overlap, so single fits
    overshoot.

    Errors of geometry that change with the view gain by a degree too, on matte scenes as well, the
    more the coarser the Gaussians are.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Coefficients of ``degree`` and above are taken as 0. Scene frame.
    views : sequence of NeedView
        Training views at a small size (about 144 pixels); :data:`MAX_FIT_VIEWS` of them are used.
    held_out : sequence of NeedView
        Photos never trained on; without any, some of ``views`` are left out to judge.
    degree : int
        The degree to try, from 1 to 3.
    threads : int
        0 uses every core. The result does not depend on it.
    check : callable, optional
        Called before each view is rendered; what it raises ends the trial.

    Returns
    -------
    HarmonicsNeed

    Raises
    ------
    UsageError
        ``degree`` is out of range, or a photo has another size than its camera.
    """
    if not 1 <= degree <= MAX_DEGREE:
        raise UsageError(f"Degree {degree} cannot be tried.", f"Give 1 to {MAX_DEGREE}.")
    usable = [view for view in views if view.mask is None or view.mask.any()]
    judges = [view for view in held_out if view.mask is None or view.mask.any()]
    count = min(len(usable), MAX_FIT_VIEWS)
    spread = np.linspace(0, len(usable) - 1, count).round().astype(int)
    fitted = [usable[i] for i in spread.tolist()]
    never_trained = bool(judges)
    if not never_trained:
        judges = fitted[LEFT_OUT_EVERY // 2 :: LEFT_OUT_EVERY]
        fitted = [v for v in fitted if not any(v is judge for judge in judges)]
    if len(fitted) < MIN_FIT_VIEWS or not judges or len(gaussians) == 0:
        return HarmonicsNeed(degree, 0.0, False, 0.0, 0, never_trained, None)
    trial = _Trial(gaussians, fitted, judges, degree, threads or default_threads(), check)
    trial.settle()
    without, all_without, _ = trial.errors(degree - 1)
    with_degree, _, sh = trial.errors(degree)
    # What the degree explains of the slow residual, as a part of the whole error.
    whole = max(float(all_without.sum()), _ERROR_FLOOR)
    explained = min(float((without - with_degree).sum()) / whole, 1.0 - 1e-6)
    gain = -10.0 * math.log10(1.0 - explained)
    better = float((with_degree < without).mean())
    # A single photo must not decide for all.
    needed = gain > MARGIN_DB and better > 0.5
    return HarmonicsNeed(
        degree,
        gain,
        needed,
        better,
        len(judges),
        never_trained,
        sh if needed else None,
    )


class _Trial:
    """The fit and its judgement, for the two degrees that are compared."""

    def __init__(
        self,
        gaussians: OrientedGaussians,
        fitted: list[NeedView],
        judges: list[NeedView],
        degree: int,
        threads: int,
        check: Callable[[], None] | None,
    ) -> None:
        self.check = check or (lambda: None)
        self.renderer, self.threads, self.degree = ViewRenderer(), threads, degree
        raw = RawArrays.from_gaussians(gaussians)
        count, kept = len(raw), min(raw.sh.shape[1], degree**2)
        self.start = np.zeros((count, (degree + 1) ** 2, 3), np.float32)
        self.start[:, :kept] = raw.sh[:, :kept]
        self.raw = raw
        self.fitted, self.judges = fitted, judges
        self.directions = [_directions(raw.means, view.camera) for view in fitted]
        self.shown = np.zeros(count, np.float64)
        for view in (*fitted, *judges):
            self.shown += self._weights(view.camera)
        self.targets = [_target(view, None) for view in fitted]
        self.judged: list[tuple[np.ndarray, np.ndarray]] = []

    def settle(self) -> None:
        """Fit the lower degrees, then match the judging photos whose exposure is not known."""
        for _ in range(SETTLING):
            self.start = self.fit(self.degree - 1)
        corrected = any(view.correction is not None for view in self.fitted)
        self.judged = [
            _target(view, self._image(self.start, view.camera) if corrected else None)
            for view in self.judges
        ]

    def errors(self, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit all coefficients up to a degree.

        Returns
        -------
        slow : (judges,) float64
            Mean squared :func:`coarse` error of each judging photo.
        whole : (judges,) float64
            Mean squared error.
        sh : (n, k, 3) float32
            The coefficients.
        """
        sh = self.fit(degree)
        slow, whole = [], []
        for view, (target, counts) in zip(self.judges, self.judged, strict=True):
            difference = self._image(sh, view.camera) - target
            slow.append(_mean_squared(coarse(difference, counts), counts))
            whole.append(_mean_squared(difference, counts))
        return np.array(slow), np.array(whole), sh

    def fit(self, degree: int) -> np.ndarray:
        """Return (n, k, 3) float32: the coefficients with all up to a degree fitted."""
        coefficients = (degree + 1) ** 2
        before = [self._image(self.start, view.camera) for view in self.fitted]
        sh = self.start
        steps: list[np.ndarray] = []  # (n, coefficients, 3) each
        images: list[list[np.ndarray]] = []  # of each step, what it adds to each fitted view
        for _ in range(SWEEPS):
            step = self._fit(sh, degree)
            moved = self.start.copy()
            moved[:, :coefficients] += step
            steps.append(step)
            images.append(
                [
                    self._image(moved, view.camera) - base
                    for view, base in zip(self.fitted, before, strict=True)
                ]
            )
            lengths = self._lengths(images, before)
            sh = self.start.copy()
            for length, one in zip(lengths, steps, strict=True):
                sh[:, :coefficients] += (length * one).astype(np.float32)
        return sh

    def _weights(self, camera: Camera) -> np.ndarray:
        """(n,) sums of blending weights, pixels."""
        self.check()
        options = RenderOptions(depth=False, sh_degree=0, threads=self.threads, statistics=True)
        statistics = self.renderer.render(self.raw, camera, options).statistics
        assert statistics is not None
        return statistics.weight_sum

    def _image(self, sh: np.ndarray, camera: Camera) -> np.ndarray:
        self.check()
        options = RenderOptions(depth=False, threads=self.threads)
        return self.renderer.render(self._with(sh), camera, options).color.copy()

    def _with(self, sh: np.ndarray) -> RawArrays:
        raw = self.raw
        return RawArrays(
            raw.means, raw.log_scales, raw.quats, raw.opacity_logits,
            np.ascontiguousarray(sh, raw.means.dtype), raw.orientation, raw.filter_3d,
        )  # fmt: skip

    def _fit(self, sh: np.ndarray, degree: int) -> np.ndarray:
        """Return (n, (degree + 1)^2, 3) float32: each Gaussian alone fitted to its residuals."""
        count = len(self.raw)
        options = RenderOptions(depth=False, threads=self.threads, statistics=True)
        sums = np.zeros((len(self.fitted), count, 3), np.float32)  # blended residuals, in pixels
        weights = np.zeros((len(self.fitted), count), np.float32)
        for row, (view, (target, counts)) in enumerate(zip(self.fitted, self.targets, strict=True)):
            self.check()
            image = self.renderer.render(self._with(sh), view.camera, options)
            assert image.statistics is not None
            residual = coarse(target - image.color, counts)
            seen = image.backward(ImageGradients(color=residual.astype(np.float32)))
            sums[row, seen.ids] = seen.sh[:, 0] / _C0
            if view.mask is None:
                weights[row] = image.statistics.weight_sum
            else:  # the same sums, of the pixels that count alone
                ones = np.repeat(counts[..., None], 3, 2).astype(np.float32)
                seen = image.backward(ImageGradients(color=ones))
                weights[row, seen.ids] = seen.sh[:, 0].max(1) / _C0
        return _regress(sums, weights, self.shown, self.directions, degree)

    def _lengths(self, images: list[list[np.ndarray]], before: list[np.ndarray]) -> np.ndarray:
        """Return the step lengths that leave the fitted views the least squared residual."""
        size = len(images)
        normal, right = np.zeros((size, size)), np.zeros(size)
        for index, ((target, counts), base) in enumerate(zip(self.targets, before, strict=True)):
            residual = coarse(target - base, counts)[counts]
            parts = [coarse(of_step[index], counts)[counts] for of_step in images]
            for i in range(size):
                right[i] += float((parts[i] * residual).sum())
                for j in range(i + 1):
                    normal[i, j] += float((parts[i] * parts[j]).sum())
        normal += np.tril(normal, -1).T
        normal[np.diag_indices(size)] *= 1.0 + _STEP_RIDGE
        normal[np.diag_indices(size)] += _ERROR_FLOOR
        return np.linalg.solve(normal, right)


def _regress(
    sums: np.ndarray,
    weights: np.ndarray,
    shown: np.ndarray,
    directions: list[Callable[[int, int, int], np.ndarray]],
    degree: int,
) -> np.ndarray:
    """Return (n, k, 3) float32 ridge regressions of mean residuals on the harmonics.

    Parameters
    ----------
    sums : (v, n, 3)
        Sums of blended residuals.
    weights : (v, n)
        Sums of blending weights.
    shown : (n,)
        The same over all views, those too that are not fitted to.
    directions : list of callables
        Of each view, the harmonics of a range of Gaussians.
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
        ridge = _C0**2 * (RIDGE_SHARE * shown[begin:end] + RIDGE_PX)  # (m,)
        normal[:, np.arange(size), np.arange(size)] += ridge[:, None]
        out[begin:end] = np.linalg.solve(normal, right)
    return out


def _directions(means: np.ndarray, camera: Camera) -> Callable[[int, int, int], np.ndarray]:
    """Return what gives the harmonics (m, k) of a range of Gaussians as the camera sees them."""
    center = camera.center

    def basis(begin: int, end: int, degree: int) -> np.ndarray:
        offset = means[begin:end].astype(np.float64) - center  # (m, 3)
        length = np.maximum(np.linalg.norm(offset, axis=1), tolerances.DIRECTION_MIN_NORM)
        unit = torch.from_numpy(offset / length[:, None])
        return harmonics_basis(unit, degree).numpy()

    return basis


def _target(view: NeedView, image: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the photo as the Gaussians should show it, and (h, w) bool where it counts.

    A photo whose exposure is not known is matched to ``image`` where that is given.
    """
    camera, photo = view.camera, view.photo
    if photo.shape != (camera.height, camera.width, 3):
        raise UsageError(
            f"Photo {camera.name} is {photo.shape}, its camera {camera.width} x {camera.height}.",
            "Give both at one size.",
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
    """Return the gain and offset per channel that bring a render closest to a photo.

    Least squares over (p, 3) colours; a channel that does not vary keeps gain 1.
    """
    image, photo = image.astype(np.float64), photo.astype(np.float64)
    mean, wanted = image.mean(0), photo.mean(0)
    variance = ((image - mean) ** 2).mean(0)
    covariance = ((image - mean) * (photo - wanted)).mean(0)
    varies = (variance > 1e-6) & (covariance > 1e-6)
    gain = np.where(varies, covariance / np.where(varies, variance, 1.0), 1.0)
    return gain, wanted - gain * mean


def coarse(difference: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return an image's averages over squares of :data:`COARSE_SHARE`, of the pixels that count.

    Parameters
    ----------
    difference : (h, w, 3)
    counts : (h, w) bool

    Returns
    -------
    (h, w, 3) float64
        0 where a pixel does not count.
    """
    size = max(1, round(COARSE_SHARE * max(counts.shape)))
    weight = uniform_filter(counts.astype(np.float64), size, mode="constant")  # (h, w)
    kept = np.where(counts[..., None], difference, 0.0).astype(np.float64)
    sums = uniform_filter(kept, (size, size, 1), mode="constant")
    mean = sums / np.maximum(weight, 1e-9)[..., None]
    return np.where(counts[..., None], mean, 0.0)


def _mean_squared(difference: np.ndarray, counts: np.ndarray) -> float:
    return float((difference[counts].astype(np.float64) ** 2).mean())
