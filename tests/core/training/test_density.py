# SPDX-License-Identifier: GPL-3.0-or-later
"""Density control: clone, split, prune, free space, statistics."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians
from gaussian_wrapping_addon.core.render.cuda.device_view import DeviceView
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import (
    ImageGradients,
    RenderOptions,
    RenderStatistics,
)
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthPrior
from gaussian_wrapping_addon.core.stereo.plane_evidence import (
    AGREEING_SHARE,
    MOST_ASKED,
    THROUGH_SHARE,
)
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.density import (
    CLONE_SIZE,
    GRADIENT_THRESHOLD,
    MIN_OPACITY,
    RESET_OPACITY,
    SPLIT_FACTOR,
    DensityStatistics,
    DeviceDensityStatistics,
    contradicted,
    densify_and_prune,
    needed_by_a_view,
    prune_contributors,
    reset_opacity,
)
from gaussian_wrapping_addon.core.training.wrapping import WrapView
from tests.core.device_kernels import DEVICES, kernels_of
from tests.core.render.scenes import look_at, random_gaussians
from tests.synthetic import look_at as looking_at

# -- Density control: cloning, splitting, pruning, the cap, the opacity reset ---------------------


def filled(gaussians: OrientedGaussians) -> Adam:
    """Return an optimiser whose moments are all one and whose steps are all five."""
    adam = Adam(gaussians)
    for name in TRAINED:
        for moment in adam.moments(name):
            moment[...] = 1.0
    adam.steps[:] = 5
    return adam


def gaussians_of_sizes(sizes: list[float], opacity: float = 0.5) -> OrientedGaussians:
    count = len(sizes)
    some = random_gaussians(count, dtype=torch.float32, filter_size=0.0)
    log_scales = torch.log(torch.tensor(sizes))[:, None].repeat(1, 3)
    logit = float(np.log(opacity / (1 - opacity)))
    return some.replaced(log_scales=log_scales, opacity_logits=torch.full((count,), logit))


def with_gradients(values: list[float]) -> DensityStatistics:
    statistics = DensityStatistics.zeros(len(values))
    statistics.views[:] = 2
    statistics.gradient[:] = 2 * np.asarray(values) * GRADIENT_THRESHOLD
    return statistics


def test_statistics_average_per_half_image_over_the_views_that_saw() -> None:
    statistics = DensityStatistics.zeros(3)
    for visible in ([True, True, False], [True, False, False]):
        statistics.add(
            RenderStatistics(
                np.array(visible), *(np.zeros(3, np.float32) for _ in range(3)),
                grad_px=np.array([1.0, 2.0, 9.0], np.float32),
                grad_abs_px=np.array([3.0, 4.0, 9.0], np.float32),
            ), 40, 30,
        )  # fmt: skip
    assert statistics.gradient.tolist() == [40.0, 40.0, 0.0]
    assert statistics.gradient_abs.tolist() == [120.0, 80.0, 0.0]
    assert statistics.views.tolist() == [2, 1, 0]


def test_small_ones_are_cloned_large_ones_split_quiet_ones_stay() -> None:
    small, large = 0.5 * CLONE_SIZE, 4.0 * CLONE_SIZE
    adam = filled(gaussians_of_sizes([small, large, small, large]))
    before = adam.gaussians().detached().select(torch.arange(4))
    change = densify_and_prune(
        adam, with_gradients([1.5, 1.5, 0.2, 0.2]), 100, np.random.default_rng(0)
    )
    assert (change.cloned, change.split, change.pruned) == (1, 1, 0)
    assert len(adam) == 6
    means, scales = adam.array("means"), np.exp(adam.array("log_scales"))
    # Rows that stay: 0 (cloned), 2, 3; then the clone, then the two halves of 1.
    assert np.array_equal(means[:3], before.means[[0, 2, 3]].numpy())
    assert np.allclose(scales[3], small)
    assert np.allclose(scales[4:], large / SPLIT_FACTOR, rtol=1e-6)
    offset = np.linalg.norm(means[3:] - before.means[[0, 1, 1]].numpy(), axis=1)
    assert (offset > 0).all()
    assert (offset / np.array([small, large, large]) < 5).all()
    assert not np.array_equal(means[4], means[5])
    for name in TRAINED:
        for moment in adam.moments(name):
            assert (moment[:3] == 1).all()
            assert not moment[3:].any()
    assert adam.steps.tolist() == [5, 5, 5, 0, 0, 0]
    for name in ("quats", "sh", "opacity_logits", "orientation"):
        wanted = getattr(before, name)[[0, 2, 3, 0, 1, 1]].numpy()
        assert np.array_equal(adam.array(name), wanted), name


def test_new_positions_are_drawn_from_the_gaussian() -> None:
    count = 4000
    one = random_gaussians(1, 2, filter_size=0.0).replaced(
        log_scales=torch.log(torch.tensor([[0.3, 0.1, 0.02]], dtype=torch.float64)),
        opacity_logits=torch.zeros(1, dtype=torch.float64),
    )
    many = OrientedGaussians(
        **{n: t.float().repeat(count, *[1] * (t.ndim - 1)) for n, t in one.tensors()}
    )
    adam = filled(many)
    densify_and_prune(adam, with_gradients([2.0] * count), 10 * count, np.random.default_rng(1))
    offsets = adam.array("means").astype(np.float64) - one.means.numpy()
    rotation = one.rotations().numpy()[0]
    wanted = rotation @ np.diag([0.3**2, 0.1**2, 0.02**2]) @ rotation.T
    assert len(offsets) == 2 * count
    assert np.abs(np.cov(offsets.T) - wanted).max() < 0.05 * 0.3**2
    assert np.abs(offsets.mean(0)).max() < 0.02


def test_either_statistic_selects_and_both_select_the_same_share() -> None:
    adam = filled(gaussians_of_sizes([0.01] * 10))
    statistics = with_gradients([2, 2, 0, 0, 0, 0, 0, 0, 0, 0])
    statistics.gradient_abs[:] = [0, 0, 7, 8, 0, 0, 0, 0, 0, 0]
    change = densify_and_prune(adam, statistics, 100, np.random.default_rng(0))
    assert change.cloned == 4


def test_the_cap_is_never_passed_and_the_highest_gradients_come_first() -> None:
    gradients = np.random.default_rng(0).permutation(np.arange(20) / 4 + 1.1)
    adam = filled(gaussians_of_sizes([0.01] * 20))
    before = adam.array("means").copy()
    change = densify_and_prune(
        adam, with_gradients(gradients.tolist()), 23, np.random.default_rng(0)
    )
    assert len(adam) == 23
    assert change.cloned == 3
    best = np.sort(np.argsort(-gradients)[:3])
    offset = np.linalg.norm(adam.array("means")[20:] - before[best], axis=1)
    assert offset.max() < 0.05
    for limit in (23, 5, 0):
        densify_and_prune(adam, with_gradients([2.0] * 23), limit, np.random.default_rng(0))
        assert len(adam) == 23


def test_transparent_ones_are_pruned_but_never_all() -> None:
    gaussians = gaussians_of_sizes([0.01, 0.02, 0.03], 0.5 * MIN_OPACITY)
    gaussians.opacity_logits[1] = 1.0
    adam = filled(gaussians)
    change = densify_and_prune(adam, with_gradients([9, 0, 9]), 100, np.random.default_rng(0))
    assert (change.cloned, change.pruned, len(adam)) == (0, 2, 1)
    assert np.allclose(np.exp(adam.array("log_scales")), 0.02)
    adam = filled(gaussians_of_sizes([0.01, 0.02], 0.5 * MIN_OPACITY))
    densify_and_prune(adam, with_gradients([0, 0]), 100, np.random.default_rng(0))
    assert len(adam) == 1


def test_opacity_reset_caps_the_effective_opacity() -> None:
    gaussians = random_gaussians(200, dtype=torch.float32, filter_size=0.1)
    gaussians.opacity_logits[:5] = -9.0
    adam = filled(gaussians)
    before = gaussians.log_opacities().exp().numpy()
    reset_opacity(adam)
    after = adam.gaussians().detached().log_opacities().exp().numpy()
    faint = before < RESET_OPACITY
    assert 5 <= faint.sum() < 100
    assert np.allclose(after[faint], before[faint], rtol=1e-5)
    assert np.allclose(after[~faint], RESET_OPACITY, rtol=1e-3)
    assert not any(moment.any() for moment in adam.moments("opacity_logits"))
    assert all((moment == 1).all() for moment in adam.moments("means"))


def behind_frozen(rest: OrientedGaussians, frozen: int) -> Adam:
    """Return an optimiser of frozen Gaussians, some transparent, and these after them."""
    front = random_gaussians(frozen, 9, dtype=torch.float32, filter_size=0.0)
    front.opacity_logits[::3] = -9.0
    adam = filled(front.joined(rest))
    adam.frozen = frozen
    return adam


def test_frozen_ones_stay_and_change_nothing_for_the_others() -> None:
    sizes = [0.5 * CLONE_SIZE, 4.0 * CLONE_SIZE] * 10
    rest = gaussians_of_sizes(sizes)
    rest.opacity_logits[5] = -9.0
    values = np.random.default_rng(1).uniform(0.1, 2.0, 20).tolist()
    alone, adam = filled(rest), behind_frozen(rest, 30)
    front = adam.gaussians().detached().select(torch.arange(30))
    weights = np.random.default_rng(2).uniform(1, 2, 20)
    one = densify_and_prune(alone, with_gradients(values), 25, np.random.default_rng(0), weights)
    # Their gradients would come first.
    other = densify_and_prune(
        adam, with_gradients([50.0] * 30 + values), 25, np.random.default_rng(0),
        np.concatenate([np.full(30, 9.0), weights]),
    )  # fmt: skip
    assert one == other
    assert one.pruned == 1
    assert len(adam) == 30 + len(alone) == 55
    found = adam.gaussians().detached()
    for name, tensor in alone.gaussians().detached().tensors():
        assert torch.equal(getattr(found, name)[30:], tensor), name
        assert torch.equal(getattr(found, name)[:30], getattr(front, name)), name
    assert np.array_equal(adam.all_moments[30:], alone.all_moments)
    reset_opacity(adam)
    reset_opacity(alone)
    assert np.array_equal(adam.array("opacity_logits")[:30], front.opacity_logits.numpy())
    assert np.array_equal(adam.array("opacity_logits")[30:], alone.array("opacity_logits"))
    # Of the others one is always left.
    few = behind_frozen(gaussians_of_sizes([1.0, 1.0], opacity=0.001), 30)
    densify_and_prune(few, with_gradients([0.0] * 32), 100, np.random.default_rng(0))
    assert len(few) == 31


# -- Contribution of Gaussians over the views, and pruning by it ----------------------------------


def camera(shift: float = 0.0) -> Camera:
    pose = np.concatenate([np.eye(3), [[shift], [0.0], [6.0]]], 1)
    return Camera("view", 64, 48, 60.0, 60.0, 32.0, 24.0, pose)


def a_wall_before(gaussians: OrientedGaussians) -> OrientedGaussians:
    """Put an opaque disc before all others as Gaussian 0."""
    first = torch.zeros(len(gaussians), dtype=torch.bool)
    first[0] = True
    means = torch.where(first[:, None], torch.tensor([0.0, 0.0, -4.0]), gaussians.means)
    logits = torch.where(first, torch.tensor(12.0), gaussians.opacity_logits)
    flat = torch.log(torch.tensor([3.0, 3.0, 0.01]))
    scales = torch.where(first[:, None], flat, gaussians.log_scales)
    quats = torch.where(first[:, None], torch.tensor([1.0, 0, 0, 0]), gaussians.quats)
    return gaussians.replaced(means=means, opacity_logits=logits, log_scales=scales, quats=quats)


def view_weights(gaussians: OrientedGaussians, views: list[WrapView]) -> np.ndarray:
    """Return (views, n) blending weights of the Gaussians in each view."""
    options = RenderOptions(depth=False, sh_degree=0, threads=1, statistics=True)
    found = [render(gaussians, view.camera, options).statistics for view in views]
    return np.stack([statistics.weight_sum for statistics in found if statistics is not None])


def test_what_hides_behind_a_wall_is_not_needed() -> None:
    gaussians = a_wall_before(random_gaussians(40, dtype=torch.float32))
    needed = needed_by_a_view(gaussians, [WrapView(camera(), None)], ViewRenderer(), 0.2, threads=1)
    assert needed[0]
    assert (~needed).sum() > 20


@pytest.mark.parametrize("share", [0.0, 0.03, 0.2])
def test_every_view_keeps_its_share_of_the_weights(share: float) -> None:
    gaussians = random_gaussians(80, dtype=torch.float32)
    views = [WrapView(camera(s), None) for s in (-2.0, -0.5, 0.5, 2.5)]
    needed = needed_by_a_view(gaussians, views, ViewRenderer(), share, threads=1)
    weights = view_weights(gaussians, views).astype(np.float64)
    kept = weights[:, needed].sum(1) / weights.sum(1)
    assert (kept >= 1.0 - share - 1e-9).all()
    # No more are kept than views ask for: of each, the next smaller ones would exceed the share.
    for index in np.flatnonzero(needed):
        alone = [row[row <= row[index]].sum() > share * row.sum() for row in weights]
        assert any(alone & (weights[:, index] > 0.0))
    if share == 0.0:
        assert np.array_equal(needed, weights.max(0) > 0.0)


def test_what_weighs_more_is_kept_first() -> None:
    gaussians = random_gaussians(80, dtype=torch.float32)
    views = [WrapView(camera(s), None) for s in (-0.5, 0.5)]
    plain = needed_by_a_view(gaussians, views, ViewRenderer(), 0.2, threads=1)
    chosen = ~plain & (view_weights(gaussians, views).max(0) > 0.0)
    heavy = np.where(chosen, 1e6, 1.0)
    weighted = needed_by_a_view(gaussians, views, ViewRenderer(), 0.2, heavy, threads=1)
    assert chosen.sum() > 5
    assert weighted[chosen].mean() > 0.5


def test_images_change_by_no_more_than_the_share() -> None:
    gaussians = random_gaussians(80, dtype=torch.float32)
    views = [WrapView(camera(s), None) for s in (-0.5, 0.0, 0.5)]
    adam = Adam(gaussians)
    before = [render(gaussians, v.camera, RenderOptions(threads=1)).alpha.numpy() for v in views]
    needed = needed_by_a_view(gaussians, views, ViewRenderer(), 0.02, threads=1)
    gone = prune_contributors(adam, needed)
    assert 0 < gone < 80
    after = [
        render(adam.gaussians(), v.camera, RenderOptions(threads=1)).alpha.numpy() for v in views
    ]
    # What was behind them shows instead, so an image loses less than the share of its weights.
    for a, b in zip(before, after, strict=True):
        assert 0 <= a.sum() - b.sum() <= 0.02 * a.sum()


def test_never_all_are_removed() -> None:
    adam = Adam(random_gaussians(5, dtype=torch.float32))
    assert prune_contributors(adam, np.zeros(5, bool)) == 0
    assert prune_contributors(adam, np.ones(5, bool)) == 0
    assert prune_contributors(adam, np.arange(5) >= 2) == 2
    assert len(adam) == 3


def test_frozen_ones_are_needed_by_definition() -> None:
    adam = Adam(random_gaussians(10, dtype=torch.float32))
    adam.frozen = 4
    means = adam.array("means").copy()
    needed = np.array([False] * 6 + [True, False, False, True])
    assert prune_contributors(adam, needed) == 4
    assert np.array_equal(adam.array("means"), means[[0, 1, 2, 3, 6, 9]])
    assert prune_contributors(adam, np.array([True] * 4 + [False] * 2)) == 0


# -- Gaussians that photos see through, by depths in closed form ----------------------------------

FLOOR_Z = -2.0
COUNT = 6


def cameras(count: int = COUNT) -> list[Camera]:
    """Return cameras around the axis of z, above a floor."""
    angles = 2.0 * np.pi * np.arange(count) / count
    return [
        looking_at(
            np.array([3.0 * np.cos(a), 3.0 * np.sin(a), 3.0]), np.zeros(3), f"{k}", 80, 60, 70.0
        )
        for k, a in enumerate(angles)
    ]


def floor_depth(camera: Camera) -> np.ndarray:
    """Return the (h, w) z-depth of the floor; of a plane that every ray of these cameras meets."""
    along = (camera.rays() @ camera.rotation)[..., 2]
    depth = (FLOOR_Z - camera.center[2]) / along
    return np.where(depth > 0, depth, 0.0).astype(np.float32)


def priors(free: int) -> dict[int, DepthPrior]:
    """Return priors of which the first ones see the floor; no depth is known."""
    found = {}
    for view, camera in enumerate(cameras()):
        known, nothing = (np.zeros((60, 80), np.float32) for _ in range(2))
        seen = floor_depth(camera) if view < free else nothing
        found[view] = DepthPrior(camera, nothing, nothing, known, seen)
    return found


INSIDE = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, -1.0]])
"""Points that all cameras see before the floor."""


def test_what_stands_before_the_floor_in_enough_photos_is_contradicted() -> None:
    assert contradicted(INSIDE, priors(free=COUNT), 2).all()
    assert contradicted(INSIDE, priors(free=2), 2).all()
    assert not contradicted(INSIDE, priors(free=1), 2).any()
    assert not contradicted(INSIDE, priors(free=0), 2).any()
    assert not contradicted(INSIDE, priors(free=2), 3).any()


def test_what_lies_on_the_floor_or_behind_it_is_not() -> None:
    points = np.array([[0.1, 0.2, FLOOR_Z], [0.1, 0.2, FLOOR_Z - 0.5]])
    assert not contradicted(points, priors(free=COUNT), 1).any()


def test_the_margin_is_that_of_the_depth() -> None:
    camera = cameras()[0]
    given = {0: priors(free=1)[0]}
    ray = (camera.rays() @ camera.rotation)[30, 40]
    whole = float(floor_depth(camera)[30, 40])
    for share, expected in ((1.0 + 0.5 * THROUGH_SHARE, False), (1.0 + 2.0 * THROUGH_SHARE, True)):
        point = camera.center + ray * whole / share
        assert contradicted(point[None], given, 1).tolist() == [expected]


def test_depths_that_agree_outvote_those_that_see_through() -> None:
    """Confirmed depths at the point itself, in as many photos or more."""
    point = INSIDE[:1]
    found = priors(free=3)
    assert contradicted(point, found, 2).all()
    for view, prior in found.items():
        pixels, depth = prior.camera.project(point)
        column, row = pixels[0].astype(int)
        prior.known[row, column] = depth[0] * (1.0 + 0.5 * AGREEING_SHARE)
        assert contradicted(point, found, 2).all() == (view + 1 < 3)


def test_what_may_be_the_sky_is_left() -> None:
    found = {0: priors(free=1)[0]}
    found[0].free[...] = 1e6
    axis = -found[0].camera.center / np.linalg.norm(found[0].camera.center)
    points = np.array([[0.9], [1.1]]) * limits.FAR_RADIUS * axis
    assert contradicted(points, found, 1).tolist() == [True, False]


@pytest.mark.parametrize("point", [[0.0, 0.0, 50.0], [np.nan] * 3])
def test_what_no_photo_shows_is_left(point: list[float]) -> None:
    assert not contradicted(np.array([point]), priors(free=COUNT), 1).any()


def test_of_many_photos_a_regular_choice_is_asked() -> None:
    one = priors(free=1)[0]
    asked: list[int] = []

    class Counting(dict[int, DepthPrior]):
        def __getitem__(self, view: int) -> DepthPrior:
            asked.append(view)
            return one

    contradicted(INSIDE, Counting.fromkeys(range(200), one), 1)
    assert len(asked) == MOST_ASKED
    assert asked[0] == 0
    assert asked[-1] == 199


# -- Density statistics on a device, emulated or a GPU, equal those of the processor --------------

SEEN = 60
SUMS = ("gradient", "gradient_abs", "views")


def some(seed: int) -> DensityStatistics:
    random = np.random.default_rng(seed)
    sums = random.uniform(0.0, 1e-3, (2, SEEN)).astype(np.float32)
    return DensityStatistics(sums[0], sums[1], random.integers(0, 9, SEEN).astype(np.int32))


@pytest.mark.parametrize("device", DEVICES)
def test_views_add_what_they_add_on_the_processor(
    request: pytest.FixtureRequest, device: str
) -> None:
    kernels = kernels_of(device, request)
    there = torch.device("cuda" if device == "cuda" else "cpu")
    gaussians = random_gaussians(SEEN, seed=3, dtype=torch.float32)
    sent = OrientedGaussians(**{name: t.to(there) for name, t in gaussians.tensors()})
    options = RenderOptions(depth=False, screen_gradients=True, threads=1)
    wanted, start = some(1), some(1)
    found = DeviceDensityStatistics(start, there)
    renderer, random = ViewRenderer(), np.random.default_rng(2)
    # The second sees a part of them.
    for eye, part in (((3.0, 1.0, 0.5), 1.0), ((0.6, 0.3, 0.2), 0.25)):
        camera = look_at(eye, width=24, height=20, focal=30.0)
        color = random.normal(size=(20, 24, 3)).astype(np.float32)
        image = renderer.render(RawArrays.from_gaussians(gaussians), camera, options)
        image.backward(ImageGradients(color=color))
        assert image.statistics is not None
        wanted.add(image.statistics, 96, 80, part)
        view = DeviceView(kernels, sent, camera, options, 1 << 26)
        view.backward([torch.from_numpy(color).to(there), None, None, None, None])
        found.add_view(view, 96, 80, part)
    assert 0 < np.count_nonzero(wanted.views - start.views == 1) < SEEN
    assert np.array_equal(found.views, wanted.views)
    for name in SUMS[:2]:
        a, b = getattr(found, name), getattr(wanted, name)
        assert a.dtype == b.dtype == np.float32
        assert np.linalg.norm(a - b) <= 1e-4 * np.linalg.norm(b), name


def test_copies_on_the_host_are_copies() -> None:
    start = some(4)
    found = DeviceDensityStatistics(start, torch.device("cpu"))
    hosted = found.on_host()
    assert type(hosted) is DensityStatistics
    for name in SUMS:
        assert np.array_equal(getattr(hosted, name), getattr(start, name))
        assert getattr(found, name).dtype == getattr(start, name).dtype
        for array in (getattr(start, name), getattr(hosted, name), getattr(found, name)):
            array[:] = 7
    again = some(4)
    assert all(np.array_equal(getattr(found, name), getattr(again, name)) for name in SUMS)


def test_cleared_ones_stay_on_their_device() -> None:
    found = DeviceDensityStatistics(some(5), torch.device("cpu")).cleared(7)
    assert isinstance(found, DeviceDensityStatistics)
    assert found.device == torch.device("cpu")
    for name in SUMS:
        assert np.array_equal(getattr(found, name), np.zeros(7))
