# SPDX-License-Identifier: GPL-3.0-or-later
"""Does the next degree of spherical harmonics explain what the surface shows?

Training twice would tell, but costs two trainings. The degree is fitted in closed form instead
(:mod:`.harmonics_trial`) and judged by photos that took no part (docs/method.md, section 4.4). A
gain of whole photos does not tell gloss from errors of shape, which any further unknown lowers a
little in many places. Gloss is local and the same in all photos: so the errors are told apart by
the place on the surface, and what counts is how much of it gains clearly.
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
from .harmonics_trial import HarmonicsTrial, TrialView, summed_weights
from .model_selection import OFF, Decision

MAX_FIT_VIEWS = 40
MAX_HELD_OUT = 10
"""No more training views and held-out ones are looked at, spread evenly."""

MIN_FIT_VIEWS = 4
"""A fold is fitted to at least so many views: from fewer nothing can be told."""

MIN_RELATIVE_REDUCTION = 0.4
"""Share by which the slow error of a place must fall to count. At 0.3, exposures that the gains of
training only nearly undo look like gloss: 0.08 of a matte surface against 0.11 of a glossy one."""

MIN_REDUCTION_RMS = 0.007
"""Root of the least fall of a place's mean squared slow error that counts, of white: about two
steps of an 8-bit photo. Shares of smaller errors fall and rise by chance: without this limit 0.07
of a matte room count."""

NEEDED_SHARE = 0.055
"""Share of the well-seen surface from which a degree is needed. Of scenes trained without harmonics
for 600 iterations at 288 pixels, 40 photos, one with a glossy thing shows 0.080, matte ones 0.000
(spokes) to 0.012 (a room), and a matte one with the exposures that training had found 0.038 (in a
later run 0.063: too many)."""

SEEN_PX = 0.05
SEEN_PHOTOS = 8
"""A Gaussian is well seen with at least this blended weight in at least so many photos."""

WELL_SEEN_SHARE = 0.1
"""Share of the shown surface that must be well seen, or nothing is told."""


@dataclass(frozen=True)
class HarmonicsEvidence:
    """What trying a degree has shown."""

    degree: int
    """The degree that was tried."""
    share: float
    """Share of the well-seen surface where it lowers the slow error clearly; 0 if unknown."""
    gain_db: float
    """Fall of the photos' mean squared error against the best without it, as far as the error
    changes slowly over the image; 0 if unknown. Told, not decided by."""
    well_seen: float
    """Share of the shown surface that could be judged."""
    needed: bool
    judged: int
    """Photos that judged; 0 where they were too few."""
    coefficients: np.ndarray | None
    """(n, (degree + 1)^2, 3) float32: all harmonics as fitted to all training views, a start for
    training; ``None`` where the degree is not needed."""

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
            "share": self.share,
            "limit_share": NEEDED_SHARE,
            "gain_db": self.gain_db,
            "well_seen": self.well_seen,
            "degree_tried": float(self.degree),
            "photos": float(self.judged),
        }
        if not self.judged:
            evidence = "Too few photos to tell whether colours change with the viewing direction."
        else:
            evidence = (
                f"On {100 * self.share:.1f} % of the well-seen surface, colours that change with "
                f"the viewing direction (degree {self.degree}) visibly lower the error by "
                f"{100 * MIN_RELATIVE_REDUCTION:.0f} % or more (worth it from "
                f"{100 * NEEDED_SHARE:.1f} %), judged on {self.judged} photos by folds."
            )
        return Decision("harmonics", setting, f"degree {degree}", evidence, figures)


def select_harmonics(
    gaussians: OrientedGaussians,
    views: Sequence[TrialView],
    held_out: Sequence[TrialView],
    degree: int,
    *,
    threads: int = 0,
    check: Callable[[], None] | None = None,
) -> HarmonicsEvidence:
    """Try a degree of the harmonics on Gaussians that were trained below it.

    The photos are halved. Each half is judged by what was fitted to the training views of the
    other. Both with the degree and without it all coefficients may move, so that what training has
    not yet made of the lower degrees is not taken for view dependence; these are settled first.

    The squared slow errors are sent backwards to the Gaussians and summed over all photos. A
    Gaussian counts, with the weight that it is shown with, where this error falls by
    :data:`MIN_RELATIVE_REDUCTION` or more and visibly (:data:`MIN_REDUCTION_RMS`), and falls in
    most photos that show it: a single photo must not decide. Surfaces that are wrong by as much as
    a Gaussian is wide count too.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Coefficients of ``degree`` and above are taken as 0. Scene frame.
    views : sequence of TrialView
        Training views at a small size (about 144 pixels); :data:`MAX_FIT_VIEWS` of them are used.
    held_out : sequence of TrialView
        Photos never trained on; they judge and are never fitted to.
    degree : int
        The degree to try, from 1 to 3.
    threads : int
        0 uses every core. The result does not depend on it.
    check : callable, optional
        Called before each view is rendered; what it raises ends the trial.

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
    fitted, judging = _evenly_spaced(views, MAX_FIT_VIEWS), _evenly_spaced(held_out, MAX_HELD_OUT)
    unknown = HarmonicsEvidence(degree, 0.0, 0.0, 0.0, False, 0, None)
    halves = _halves(fitted)
    if min(len(half) for half in halves) < MIN_FIT_VIEWS or len(gaussians) == 0:
        return unknown
    shown = summed_weights(gaussians, [*fitted, *judging], threads, check)
    statistics = _ErrorStatistics(len(gaussians))
    for half, other, apart in zip(halves, reversed(halves), _halves(judging), strict=True):
        trial = HarmonicsTrial(gaussians, half, degree, shown, threads, check)
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
        trial = HarmonicsTrial(gaussians, fitted, degree, shown, threads, check)
        trial.fit_lower_degrees()
        (coefficients,) = trial.fit(degree)
    judged = len(fitted) + len(judging)
    return HarmonicsEvidence(
        degree, share, statistics.gain_db(), well_seen, needed, judged, coefficients
    )  # fmt: skip


class _ErrorStatistics:
    """Sums over the judging photos, for each of n Gaussians and as a whole."""

    def __init__(self, count: int) -> None:
        self.without, self.with_degree = np.zeros(count), np.zeros(count)
        self.weights = np.zeros(count)
        self.photos, self.better = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.low_frequency, self.total = np.zeros(2), 0.0

    def add(self, without: np.ndarray, with_degree: np.ndarray, weights: np.ndarray) -> None:
        """Take in a photo: (n,) each."""
        self.without += without
        self.with_degree += with_degree
        self.weights += weights
        seen = weights > SEEN_PX
        self.photos += seen
        self.better += seen & (with_degree < without)

    def shares(self) -> tuple[float, float]:
        """Return the share of the well-seen surface that gains, and the well-seen share."""
        seen = self.photos >= SEEN_PHOTOS
        total, shown = float(self.weights[seen].sum()), float(self.weights.sum())
        if total <= 0.0:
            return 0.0, 0.0
        gains = seen & (self.without - self.with_degree > MIN_REDUCTION_RMS**2 * self.weights)
        gains &= self.with_degree < (1.0 - MIN_RELATIVE_REDUCTION) * self.without
        gains &= 2 * self.better > self.photos
        return float(self.weights[gains].sum()) / total, total / shown

    def gain_db(self) -> float:
        """Return what the degree explains of the slow error, as a part of the whole error."""
        explained = float(self.low_frequency[0] - self.low_frequency[1]) / max(self.total, 1e-12)
        return -10.0 * math.log10(1.0 - min(explained, 1.0 - 1e-6))


def _evenly_spaced(views: Sequence[TrialView], most: int) -> list[TrialView]:
    """Return the views of which some pixels count, at most so many, spread evenly."""
    usable = [view for view in views if view.mask is None or view.mask.any()]
    count = min(len(usable), most)
    chosen = np.linspace(0, len(usable) - 1, count).round().astype(int)
    return [usable[i] for i in chosen.tolist()]


def _halves(views: Sequence[TrialView]) -> tuple[list[TrialView], list[TrialView]]:
    """Return the views in two halves: of each pair of neighbours one, drawn with a fixed seed.

    Any rule without chance fails a capture that repeats in step with it: two heights in turn, three
    cameras in turn.
    """
    draws = np.random.default_rng(0).integers(0, 2, size=(len(views) + 1) // 2).tolist()
    sides = [(draws[position // 2] + position) % 2 for position in range(len(views))]
    return (
        [view for view, side in zip(views, sides, strict=True) if side == 0],
        [view for view, side in zip(views, sides, strict=True) if side == 1],
    )


def _no_check() -> None:
    """Ask for nothing."""
