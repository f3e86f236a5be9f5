# SPDX-License-Identifier: GPL-3.0-or-later
"""Density control: statistics, clone, split, prune."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from .. import limits
from ..gaussians.model import OrientedGaussians
from ..render.cuda.device_view import DeviceView
from ..render.projection import RawArrays
from ..render.types import Renderer, RenderOptions, RenderStatistics
from ..settings import TrainingSettings
from ..stereo.depth_maps import DepthPrior
from ..stereo.plane_evidence import AGREEING_SHARE, THROUGH_SHARE, photos_asked
from .adam import Adam
from .wrapping import WrapView

# -- Density control: clone and split Gaussians with high gradients, prune transparent ones -------

GRADIENT_THRESHOLD = 2e-4
"""Average loss gradient, in half image units, from which a Gaussian is densified.

See docs/method.md, section 4.1.
"""

LOWEST_SCORE = TrainingSettings.densify_score
"""If the budget has room for more than those above the threshold, candidates down to this share of
it are taken, best first: the budget decides how many, the gradients which (Taming 3DGS)."""

CLONE_SIZE = 0.01 * limits.SCENE_RADIUS
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

        ``part`` is the share of the image of ``width`` x ``height`` pixels that was rendered: a
        mean loss over fewer pixels has larger gradients.
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
    adam: Adam, statistics: DensityStatistics, limit: int, random: np.random.Generator,
    weights: np.ndarray | None = None, *, least_score: float = LOWEST_SCORE,
    min_opacity: float = MIN_OPACITY,
) -> DensityChange:  # fmt: skip
    """Clone small and split large Gaussians with high gradients; prune transparent ones.

    A Gaussian is a candidate by its average gradient, or by an average absolute gradient above the
    quantile that selects the same share (docs/method.md, section 4.1). If there are more candidates
    than room up to ``limit``, those with the highest gradients are taken. New Gaussians start with
    zero moments; frozen ones are neither parents, nor pruned, nor counted by the limit.

    Parameters
    ----------
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


# -- Density statistics whose running sums lie on a device ----------------------------------------


class DeviceDensityStatistics(DensityStatistics):
    """Running sums on a device; what density control and checkpoints read is copied to the host.

    Parameters
    ----------
    statistics : DensityStatistics
        Sums so far.
    """

    def __init__(self, statistics: DensityStatistics, device: torch.device) -> None:
        self.device = device
        self._gradient, self._gradient_abs, self._views = (
            torch.from_numpy(np.array(array)).to(device)
            for array in (statistics.gradient, statistics.gradient_abs, statistics.views)
        )

    gradient = property(lambda self: _read(self._gradient))
    gradient_abs = property(lambda self: _read(self._gradient_abs))
    views = property(lambda self: _read(self._views))

    def cleared(self, count: int) -> DeviceDensityStatistics:
        """Return empty statistics of ``count`` Gaussians on the same device."""
        return DeviceDensityStatistics(DensityStatistics.zeros(count), self.device)

    def on_host(self) -> DensityStatistics:
        """Return a copy that lies on the host."""
        return DensityStatistics(self.gradient, self.gradient_abs, self.views)

    def add_view(self, view: DeviceView, width: int, height: int, part: float = 1.0) -> None:
        """Accumulate one view after its backward pass; see :meth:`.DensityStatistics.add`."""
        measured = view.statistics
        half_image = 0.5 * max(width, height) * part
        weight = measured.reached.to(torch.float32).mul_(half_image)
        self._gradient.addcmul_(weight, measured.grad_px)
        self._gradient_abs.addcmul_(weight, measured.grad_abs_px)
        self._views += measured.reached


def _read(tensor: Tensor) -> np.ndarray:
    return tensor.to("cpu", copy=True).numpy()


# -- Measure the contribution of each Gaussian to the views and prune the smallest ones -----------


def largest_contributors(weights: np.ndarray, share: float) -> np.ndarray:
    """Return the Gaussians (k,) that a view needs: all but the least, ``share`` of it together.

    ``weights`` (n,) are the contributions of the Gaussians to the view, at least 0.
    """
    seen = np.flatnonzero(weights > 0.0)
    if len(seen) == 0:
        return seen
    amount = weights[seen]
    order = np.argsort(amount, kind="stable")
    running = np.cumsum(amount[order])
    return seen[order[running > share * running[-1]]]


def needed_by_a_view(
    gaussians: OrientedGaussians, views: Iterable[WrapView], renderer: Renderer, share: float,
    weights: np.ndarray | None = None, *, threads: int = 0,
) -> np.ndarray:  # fmt: skip
    """Tell which Gaussians any view needs, (n,) bool (docs/method.md, section 4.3).

    A view does not need its least contributors, which together make up ``share`` of its blending
    weights, by factors ``weights`` (n,). The Gaussians that any view needs therefore keep at least
    ``1 - share`` of the weights of every view, however many views there are, and however few of
    them see a part of the scene. The renderer overwrites its last view.
    """
    raw = RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=False, sh_degree=0, threads=threads, statistics=True)
    needed = np.zeros(len(gaussians), np.bool_)
    for view in views:
        statistics = renderer.render(raw, view.camera, options).statistics
        assert statistics is not None
        amount = statistics.weight_sum.astype(np.float64)
        if weights is not None:
            amount *= weights
        needed[largest_contributors(amount, share)] = True
    return needed


def prune_contributors(adam: Adam, needed: np.ndarray) -> int:
    """Keep the Gaussians of a mask, unless it is empty; return the number of those removed.

    Frozen Gaussians are kept, and the mask of the others must not be empty.
    """
    if not needed[adam.frozen :].any():
        return 0
    keep = np.flatnonzero(needed | (np.arange(len(needed)) < adam.frozen))
    if len(keep) == len(needed):
        return 0
    adam.rebuild(keep, np.zeros(len(keep), np.bool_), {})
    return len(needed) - len(keep)


# -- Gaussians in space that photos see through (docs/method.md, section 4.6) ---------------------


def contradicted(
    means: np.ndarray, priors: Mapping[int, DepthPrior], least_views: int
) -> np.ndarray:
    """Tell which Gaussians stand where photos show nothing, (n,) bool; scene frame.

    At least ``least_views`` photos must see through a Gaussian, and more of them than of those
    whose confirmed depth agrees with its own. Never true beyond the smallest radius of the far
    shell: what lies there may be the sky.
    """
    means = np.asarray(means, np.float64)
    through, agreeing = (np.zeros(len(means), np.int32) for _ in range(2))
    views = sorted(priors)
    for prior in (priors[views[k]] for k in photos_asked(len(views))):
        shown, row, column, own = prior.camera.shown(means)
        through[shown] += prior.free[row, column] > (1.0 + THROUGH_SHARE) * own
        agreeing[shown] += np.abs(prior.known[row, column] - own) < AGREEING_SHARE * own
    near = np.linalg.norm(means, axis=1) < limits.FAR_RADIUS
    return near & (through >= least_views) & (through > agreeing)
