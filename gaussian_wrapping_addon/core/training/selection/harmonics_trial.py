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

from ... import tolerances
from ...dataset.camera import Camera
from ...errors import UsageError
from ...gaussians.model import OrientedGaussians
from ...render.projection.projection import RawArrays
from ...render.reference.reference_projection import harmonics_basis
from ...render.types.gradients import ImageGradients
from ...render.types.options import RenderOptions
from ...render.types.renderer import Renderer

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
        length = np.maximum(np.linalg.norm(offset, axis=1), tolerances.DIRECTION_MIN_NORM)
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
