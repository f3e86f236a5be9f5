# SPDX-License-Identifier: GPL-3.0-or-later
"""Decide whether to raise the degree of spherical harmonics, by cross-validation on the photos.

Training with and without the degree would tell, at the cost of two trainings. The degree is fitted
in closed form instead (:mod:`.harmonics_trial`) and evaluated on photos excluded from the fit
(docs/method.md, section 4.4). The mean gain over photos does not separate gloss from errors of
shape, which any additional parameter lowers slightly in many places. Gloss is local and consistent
over all photos: so errors are accumulated per Gaussian, and the criterion is the share of the
surface that gains clearly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ...errors import UsageError
from ...gaussians.model import OrientedGaussians
from ...kernels.parallel import default_threads
from ...render.projection.harmonics_kernels import MAX_DEGREE
from ...render.types.renderer import Renderer
from ...render.view_renderer import ViewRenderer
from .harmonics_trial import HarmonicsTrial, TrialView, summed_weights
from .model_selection import OFF, Decision

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
