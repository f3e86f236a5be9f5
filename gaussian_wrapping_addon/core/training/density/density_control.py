# SPDX-License-Identifier: GPL-3.0-or-later
"""Density control: clone and split Gaussians with high gradients, prune transparent ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ... import tolerances
from ...render.types.images import RenderStatistics
from ...settings import TrainingSettings
from ..optimizer.adam import Adam

GRADIENT_THRESHOLD = 2e-4
"""Average loss gradient, in half image units, from which a Gaussian is densified.

See docs/method.md, section 4.1.
"""

LOWEST_SCORE = TrainingSettings.densify_score
"""If the budget has room for more than those above the threshold, candidates down to this share of
it are taken, best first: the budget decides how many, the gradients which (Taming 3DGS)."""

CLONE_SIZE = 0.01 * tolerances.SCENE_RADIUS
"""Gaussians with a largest raw standard deviation of at most this are cloned, others are split."""

SPLIT_FACTOR = 1.6
MIN_OPACITY = TrainingSettings.min_opacity
"""Gaussians with a smaller raw opacity are pruned. Between the 0.05 and 0.005 of the two published
codes (docs/method.md, section 4.1): short runs hardly recover what 0.05 removes."""

RESET_OPACITY = 0.01


@dataclass
class DensityStatistics:
    """Running sums over the views since the last densification, all (n,)."""

    gradient: np.ndarray
    """float32: sum of screen-space gradients, in half image units."""
    gradient_abs: np.ndarray
    """float32: the same for absolute gradients (AbsGS)."""
    views: np.ndarray
    """int32: number of views that saw the Gaussian."""

    @classmethod
    def zeros(cls, count: int) -> DensityStatistics:
        """Return empty statistics."""
        return cls(
            np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.int32)
        )

    def cleared(self, count: int) -> DensityStatistics:
        """Return empty statistics of ``count`` Gaussians of the same kind."""
        return DensityStatistics.zeros(count)

    def on_host(self) -> DensityStatistics:
        """Return the statistics in the host's memory: these."""
        return self

    def add(self, statistics: RenderStatistics, width: int, height: int, part: float = 1.0) -> None:
        """Accumulate one view after its backward pass.

        Parameters
        ----------
        width, height : int
            Size of its image, pixels.
        part : float
            Share of the image that was rendered: a mean loss over fewer pixels has larger
            gradients.
        """
        half_image = 0.5 * max(width, height) * part
        # 0 for invisible ones: adding all is faster than indexing the visible.
        weight = np.multiply(statistics.visible, half_image, dtype=np.float32)
        self.gradient += weight * statistics.grad_px
        self.gradient_abs += weight * statistics.grad_abs_px
        self.views += statistics.visible

    def beyond(self, first: int) -> DensityStatistics:
        """Return those of all Gaussians but the first ones, in the host's memory."""
        sums = (self.gradient, self.gradient_abs, self.views)
        return DensityStatistics(*(array[first:] for array in sums))


@dataclass(frozen=True)
class DensityChange:
    """Numbers of Gaussians changed by one round of density control."""

    cloned: int
    split: int
    pruned: int


def densify_and_prune(
    adam: Adam,
    statistics: DensityStatistics,
    limit: int,
    random: np.random.Generator,
    weights: np.ndarray | None = None,
    *,
    least_score: float = LOWEST_SCORE,
    min_opacity: float = MIN_OPACITY,
) -> DensityChange:
    """Clone small and split large Gaussians with high gradients; prune transparent ones.

    A Gaussian is a candidate by its average gradient, or by an average absolute gradient above the
    quantile that selects the same share (docs/method.md, section 4.1). If there are more candidates
    than room up to ``limit``, those with the highest gradients are taken.

    Parameters
    ----------
    adam : Adam
        Rebuilt; new Gaussians start with zero moments. Frozen ones are neither parents nor pruned.
    statistics : DensityStatistics
        Statistics of the current Gaussians.
    limit : int
        Largest number of Gaussians that are not frozen.
    random : numpy.random.Generator
        Draws the means of new Gaussians from the distributions of the old ones.
    weights : (n,), optional
        Factors on the gradients in the ranking when room is short.
    least_score : float
        Share of the gradient threshold from which a Gaussian is a candidate.
    min_opacity : float
        Gaussians with a smaller raw opacity are pruned.
    """
    log_scales = adam.array("log_scales")
    opacity = 1.0 / (1.0 + np.exp(-adam.array("opacity_logits").astype(np.float64)))
    keep, frozen = opacity >= min_opacity, adam.frozen
    trained = keep[frozen:]  # a view
    if not trained.any():
        trained[np.argmax(opacity[frozen:])] = True
    chosen = np.zeros(len(keep), np.bool_)
    chosen[frozen:] = _qualified(
        statistics.beyond(frozen), trained, limit - int(trained.sum()),
        None if weights is None else weights[frozen:], least_score,
    )  # fmt: skip
    keep[:frozen] = True
    small = log_scales.max(axis=1) <= np.log(CLONE_SIZE)
    cloned = np.nonzero(chosen & small)[0]
    split = np.nonzero(chosen & ~small)[0]
    stay = keep.copy()
    stay[split] = False
    old = np.nonzero(stay)[0]
    parents = np.concatenate([old, cloned, split, split])
    fresh = np.arange(len(parents)) >= len(old)
    born = parents[fresh]
    means = adam.array("means")[parents].copy()
    means[fresh] += _offsets(adam, born, random)
    new_scales = log_scales[parents].copy()
    new_scales[len(old) + len(cloned) :] -= np.float32(np.log(SPLIT_FACTOR))
    adam.rebuild(parents, fresh, {"means": means, "log_scales": new_scales})
    return DensityChange(len(cloned), len(split), int((~keep).sum()))


def _qualified(
    statistics: DensityStatistics,
    keep: np.ndarray,
    room: int,
    weights: np.ndarray | None,
    least_score: float,
) -> np.ndarray:
    """Return (n,) bool: Gaussians to densify, at most ``room`` of them."""
    views = np.maximum(statistics.views, 1)
    average = statistics.gradient / views
    average_abs = statistics.gradient_abs / views
    above = average >= GRADIENT_THRESHOLD
    share = float(above.mean())
    score = average / GRADIENT_THRESHOLD
    if share > 0.0:
        level = float(np.quantile(average_abs, 1.0 - share))
        if level > 0.0:
            score = np.maximum(score, average_abs / level)
    chosen = (score >= least_score) & keep & (statistics.views > 0)
    if chosen.sum() > room:
        weighted = score if weights is None else score * weights
        ranked = np.argsort(-np.where(chosen, weighted, -np.inf), kind="stable")
        chosen[:] = False
        chosen[ranked[: max(0, room)]] = True
    return chosen


def _offsets(adam: Adam, rows: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return (m, 3) samples of the Gaussians of ``rows``, relative to their means."""
    gaussians = adam.gaussians().detached()
    rotations = gaussians.rotations().numpy()[rows]  # (m, 3, 3)
    local = np.exp(adam.array("log_scales")[rows]) * random.normal(size=(len(rows), 3))
    return np.einsum("nij,nj->ni", rotations, local).astype(np.float32)


def reset_opacity(adam: Adam) -> None:
    """Cap all effective opacities but frozen ones at 0.01 and reset their moments.

    See docs/method.md, section 4.1.
    """
    gaussians = adam.gaussians().detached()
    log_factor = (gaussians.log_scales - gaussians.scales().log()).sum(1).numpy()  # (n,) <= 0
    log_cap = np.minimum(np.log(RESET_OPACITY) - log_factor, np.log1p(-1e-6))
    cap = log_cap - np.log(-np.expm1(log_cap))  # logit of the raw opacity
    logits = adam.array("opacity_logits")[adam.frozen :]
    np.minimum(logits, cap[adam.frozen :], out=logits)
    adam.reset_moments("opacity_logits")
