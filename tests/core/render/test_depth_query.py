# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth queries: values, gradients, edges and difficult cases against the definition."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.area_lists import sort_positions
from gaussian_wrapping_addon.core.render.depth_query import query_view
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.reference import reference_projection
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.device_kernels import DEVICES, kernels_of
from tests.core.render.comparisons import leaves, narrowed, relative_l2
from tests.core.render.depth_scenes import SCENES as HARD_SCENES
from tests.core.render.depth_scenes import WIDE, assert_depth, ball_before_disc, doubled
from tests.core.render.depth_scenes import scene as hard_scene
from tests.core.render.first_principles import FirstPrinciples
from tests.core.render.query_autograd import query_depth, slopes_of
from tests.core.render.query_scenes import (
    EYE,
    HARD,
    SCENES,
    SHAPES,
    assert_depths,
    random_positions,
    reference_depth_at,
    scene,
    true_depth,
)
from tests.core.render.scenes import front_camera, isotropic, look_at, one_gaussian
from tests.core.render.test_properties import cameras, steady, wild_gaussians

OPTIONS = RenderOptions(threads=1)
FRONT = look_at((0.0, -4.0, 0.0)).cam_from_world


Query = Callable[..., torch.Tensor]


@pytest.fixture(params=["cpu", *DEVICES])
def query(request: pytest.FixtureRequest) -> Query:
    """Return the query by the processor, or by an emulated device or a GPU."""
    if request.param == "cpu":
        return query_depth
    return functools.partial(query_depth, kernels=kernels_of(request.param, request))


def beside_the_edges_of_tiles() -> np.ndarray:
    random = np.random.default_rng(2)
    edges = random.choice([0.0, 16.0, 32.0, 48.0], 2500) + random.choice([-0.01, 0.0, 0.3], 2500)
    positions = np.stack([edges, random.uniform(0.0, 40.0, 2500)], 1)
    positions[::2] = np.minimum(positions[::2, ::-1], [50.0, 40.0])
    return positions.astype(np.float32)


@pytest.mark.parametrize("name", SCENES)
def test_depth_is_the_definition_at_any_position(query: Query, name: str) -> None:
    gaussians, camera = scene(name)
    positions = random_positions(camera, 3000)
    if name == "thin":
        positions = np.concatenate([positions, beside_the_edges_of_tiles()])
    found = query(gaussians, camera, torch.from_numpy(positions)).numpy()
    assert_depths(found, true_depth(gaussians, camera, positions))


def test_a_gaussian_between_pixel_centres_is_found(query: Query) -> None:
    # At (8, 8), the corner of four pixels, and a tenth of a pixel wide.
    gaussians = isotropic([(0.0, 0.0, 0.0)], [0.01], [0.9], torch.float32)
    camera = Camera("front", 16, 16, 40.0, 40.0, 8.0, 8.0, FRONT)
    assert not render(gaussians, camera).depth.any()
    positions = torch.tensor([[8.0, 8.0], [8.05, 7.97], [8.5, 8.5]])
    depth = query(gaussians, camera, positions).numpy()
    wanted = 4.0 - 0.01 * math.sqrt(2.0 * math.log(1.8))
    assert depth[0] == pytest.approx(wanted, rel=1e-6)
    np.testing.assert_allclose(depth, true_depth(gaussians, camera, positions.numpy()), 2e-6)


def test_plateau_at_half_and_limits_of_validity(query: Query) -> None:
    camera = Camera("front", 20, 20, 40.0, 40.0, 10.3, 9.6, FRONT)
    middle = torch.tensor([[10.3, 9.6]])

    def depth(sigmas: list[float], opacities: list[float], limit: float = 0.45) -> float:
        means = [(0.0, 3.0 * i, 0.0) for i in range(len(sigmas))]
        gaussians = isotropic(means, sigmas, opacities, torch.float32)
        options = RenderOptions(depth_valid_transmittance=limit)
        return float(query(gaussians, camera, middle, options))

    closed_form = 4.0 - 0.2 * math.sqrt(2.0 * math.log(1.9))
    assert depth([0.2], [0.95]) == pytest.approx(closed_form, rel=1e-6)
    # The first layer lets exactly half through, up to rounding; the second is 3 units behind.
    assert 4.0 - 1e-3 < depth([0.05, 0.05], [0.5, 0.9]) < 7.0 - 0.05
    assert depth([0.3], [0.53]) == 0.0
    assert depth([0.3], [0.53], limit=0.5) > 3.0
    assert depth([0.3], [0.4], limit=1.0) == 0.0
    # Less than half of the light reaches the camera's own place.
    assert depth([9.0], [0.95]) == 0.0


def test_few_positions_and_many_are_answered_alike() -> None:
    # Many positions are sorted into smaller cells, with lists of their own.
    gaussians, camera = scene("generic")
    many = random_positions(camera, 6000)
    tiles = 4 * 3
    assert sort_positions(many, 50, 40).shift == 2
    assert sort_positions(many[:tiles], 50, 40).shift == 0
    whole = query_depth(gaussians, camera, torch.from_numpy(many)).numpy()
    parts = [
        query_depth(gaussians, camera, torch.from_numpy(many[i : i + 30])).numpy()
        for i in range(0, 600, 30)
    ]
    np.testing.assert_allclose(np.concatenate(parts), whole[:600], rtol=5e-6)


def test_positions_off_the_image_have_no_answer_and_no_gradient(query: Query) -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0)], [15.0], [0.9], torch.float32)  # covers everything
    pose = look_at((0.0, -40.0, 0.0)).cam_from_world
    camera = Camera("front", 20, 10, 40.0, 40.0, 10.0, 5.0, pose)
    inside = [[0.0, 0.0], [20.0, 10.0], [0.0, 10.0], [7.3, 2.2]]
    nan, inf = math.nan, math.inf
    outside = [[-1e-3, 5.0], [5.0, 10.001], [20.01, 5.0], [nan, 5.0], [5.0, nan], [inf, 5.0]]
    outside += [[-inf, 5.0], [1e30, -1e30], [nan, inf]]
    leaf = leaves(gaussians, torch.float32)
    at = torch.tensor(inside + outside, requires_grad=True)
    found = query(leaf, camera, at)
    assert (found[: len(inside)] > 0).all()
    assert not found[len(inside) :].any()
    found.sum().backward()
    assert at.grad is not None
    assert torch.isfinite(at.grad).all()
    assert at.grad[: len(inside)].any()
    assert not at.grad[len(inside) :].any()


def test_nothing_to_see_and_nothing_asked(query: Query) -> None:
    gaussians = isotropic([(0.0, 9.0, 0.0)], [0.1], [0.9], torch.float32)
    camera = look_at((0.0, 3.0, 0.0), width=18, height=10)  # looks away
    for some in (gaussians, gaussians.select(torch.zeros(1, dtype=torch.bool))):
        for count in (0, 3):
            leaf = leaves(some, torch.float32)
            at = torch.full((count, 2), 4.0, requires_grad=True)
            depth = query(leaf, camera, at)
            assert depth.shape == (count,)
            assert not depth.any()
            depth.sum().backward()
            assert leaf.means.grad is not None
            assert not leaf.means.grad.any()


def test_wrong_shapes_are_refused(query: Query) -> None:
    gaussians, camera = scene("generic")
    with pytest.raises(UsageError, match="shape"):
        query(gaussians, camera, torch.zeros((4, 3)))


def assert_same_as_the_definition(query: Query, name: str) -> None:
    """Compare depths, or log T where that is flat, and gradients on everything."""
    gaussians, camera = scene(name)
    options = RenderOptions(threads=2)
    positions = random_positions(camera, 1500)
    one, two = leaves(gaussians, torch.float32), leaves(gaussians, torch.float64)
    at_one = torch.from_numpy(positions).requires_grad_()
    at_two = torch.from_numpy(positions).double().requires_grad_()
    fast = query(one, camera, at_one, options)
    exact = reference_depth_at(two, camera, at_two, options)
    found, wanted, slopes = fast.detach().double(), exact.detach(), slopes_of(fast)
    assert ((found > 0) != (wanted > 0)).double().mean() <= 1e-3
    both = (found > 0) & (wanted > 0)
    away = torch.where(both, (found - wanted).abs(), 0.0).numpy()
    relative = away / np.where(both, wanted, 1.0)
    assert np.quantile(np.minimum(relative, away * slopes), 0.999) < 1e-5
    # A depth's gradient is something well conditioned over the slope of log T.
    random = np.random.default_rng(6)
    weight = torch.where(both, torch.from_numpy(random.normal(size=len(positions)) * slopes), 0.0)
    assert int((weight != 0).sum()) > 300
    (fast.double() * weight).sum().backward()
    (exact * weight).sum().backward()
    for field in SHAPES:
        assert relative_l2(getattr(one, field).grad, getattr(two, field).grad) < 1e-4, field
    assert at_one.grad is not None
    assert at_two.grad is not None
    assert relative_l2(at_one.grad, at_two.grad) < 1e-4


@pytest.mark.parametrize("name", [*SCENES, *HARD])
def test_depths_and_gradients_are_those_of_the_definition(query: Query, name: str) -> None:
    assert_same_as_the_definition(query, name)


def test_gradient_on_positions_is_the_slope_of_the_depth(query: Query) -> None:
    gaussians, camera = scene("generic")
    positions = random_positions(camera, 800).clip(1.0, [49.0, 39.0]).astype(np.float32)
    at = torch.from_numpy(positions).requires_grad_()
    depth = query(gaussians, camera, at)
    depth.sum().backward()
    assert at.grad is not None
    checked = 0
    for axis, shift in enumerate(1e-5 * np.eye(2)):
        ahead, behind = (true_depth(gaussians, camera, positions + s) for s in (shift, -shift))
        difference = (ahead - behind) / 2e-5
        # A contributor that enters between the two positions is a jump, not a slope.
        smooth = (ahead > 0) & (behind > 0) & (np.abs(difference) < 1.0)
        error = np.abs(at.grad[:, axis].numpy() - difference)[smooth]
        assert (error < 1e-4).mean() > 0.99
        checked += int(smooth.sum())
    assert checked > 600


def test_bitwise_the_same_for_any_number_of_threads() -> None:
    gaussians, _ = scene("generic")
    camera = look_at(EYE, width=90, height=70, focal=100.0)
    positions = torch.from_numpy(random_positions(camera, 5000))
    results = []
    for threads in (1, 4):
        leaf, at = leaves(gaussians, torch.float32), positions.clone().requires_grad_()
        options = RenderOptions(threads=threads)
        depth = query_depth(leaf, camera, at, options)
        depth.square().sum().backward()
        results.append([depth.detach(), at.grad] + [getattr(leaf, field).grad for field in SHAPES])
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


def pixel_centres(camera: Camera) -> torch.Tensor:
    """Return (h * w, 2) positions, row by row."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    return torch.from_numpy(np.stack([x.reshape(-1), y.reshape(-1)], 1))


@pytest.mark.parametrize("name", HARD_SCENES)
def test_depth_against_bisection(query: Query, name: str) -> None:
    gaussians, camera = hard_scene(name)
    with torch.no_grad():
        found = query(leaves(gaussians, torch.float32), camera, pixel_centres(camera), OPTIONS)
    truth = FirstPrinciples(gaussians, camera).images()
    assert_depth(found.double().numpy().reshape(truth.depth.shape), truth)


@pytest.mark.parametrize("thickness", [1e-2, 1e-4, 1e-6])
def test_a_hidden_thin_disc_leaves_the_gradient_alone(thickness: float) -> None:
    # All depths of the ball before it weigh alike, flat or not.
    gaussians = narrowed(ball_before_disc(thickness))
    grads = []
    for dtype in (torch.float32, torch.float64):
        leaf, at = leaves(gaussians, dtype), pixel_centres(WIDE).to(dtype).requires_grad_()
        ask = query_depth if dtype == torch.float32 else reference_depth_at
        depth = ask(leaf, WIDE, at, OPTIONS)
        near = (depth.detach() > 0) & (depth.detach() < 4.0)
        assert int(near.sum()) >= 4
        weight = torch.from_numpy(np.random.default_rng(7).normal(size=len(at)))
        (depth.double() * torch.where(near, weight, 0.0)).sum().backward()
        found = [getattr(leaf, name).grad for name in SHAPES]
        grads.append([grad.double().numpy() for grad in (*found, at.grad)])
    whole = float(np.linalg.norm([np.linalg.norm(grad) for grad in grads[1]]))
    for fast, exact in zip(*grads, strict=True):
        assert relative_l2(fast, exact, whole) < 1e-4
    # The disc itself gets none.
    assert not any(grad[0].any() for grad in grads[0][: len(SHAPES)])


# Hundreds of images aside, beyond where a finer screen numbers its pixels; and boxes that are cut
# off far beyond the image, and are no longer those of the ellipse.
FAR = {
    f"{aside:g} aside": one_gaussian((3 * aside, 0.1, 3 * aside), 0.98, (aside, -3.5, 0.0))
    for aside in (300.0, 3000.0)
} | {
    f"a slanted beam of {length:g}": one_gaussian((length, 0.01, 0.3), 0.98, turn=0.6, axis=1)
    for length in (1e3, 1e5, 1e8)
}


@pytest.mark.parametrize("name", FAR)
def test_what_reaches_far_beyond_the_image_is_seen_whole(name: str) -> None:
    gaussians, camera = narrowed(FAR[name]), front_camera(40, 36, focal=45.0)
    positions = pixel_centres(camera)
    with torch.no_grad():
        found = query_depth(leaves(gaussians, torch.float32), camera, positions, OPTIONS)
        exact = reference_depth_at(gaussians, camera, positions, OPTIONS)
    assert (exact > 0).sum() >= (len(positions) if "aside" in name else 300)
    assert torch.equal(found > 0, exact > 0)
    assert ((found - exact).abs() <= 1e-5 * exact).all()


@steady(60)
@given(gaussians=wild_gaussians(), camera=cameras(), near_z=st.sampled_from([0.2, 0.0, -1.0]))
def test_what_the_image_hides_is_hidden(
    gaussians: OrientedGaussians, camera: Camera, near_z: float
) -> None:
    options = RenderOptions(near_z=near_z, sh_degree=0, threads=1)
    # In the projection's own arithmetic: at the rule's edge float32 decides otherwise.
    usable = reference_projection(doubled(gaussians), camera, options).usable
    leaf = leaves(gaussians, torch.float32)
    view = query_view(RawArrays.from_gaussians(leaf), camera, options)
    assert not view.screen.visible[~usable.numpy()].any()
    at = pixel_centres(camera).float().requires_grad_()
    depth = query_depth(leaf, camera, at, options)
    assert torch.isfinite(depth).all()
    depth.sum().backward()
    for grad in [*(getattr(leaf, name).grad for name in SHAPES), at.grad]:
        assert grad is not None
        assert torch.isfinite(grad).all()
