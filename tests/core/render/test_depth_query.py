# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth and transmittance at sub-pixel positions against the definition from Sigma, mu and rays."""

from __future__ import annotations

import dataclasses
import math
import platform

import llvmlite.binding
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.area_lists import list_areas, sort_positions
from gaussian_wrapping_addon.core.render.blend import (
    Images,
    RenderBuffers,
    blend,
    blend_backward,
)
from gaussian_wrapping_addon.core.render.depth_query import (
    add_query_gradients,
    query_depth,
    query_transmittance,
    query_view,
    query_view_of,
    solve_depths,
)
from gaussian_wrapping_addon.core.render.depth_query_gradient import pull_range
from gaussian_wrapping_addon.core.render.depth_query_kernels import query_kernel
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    RawGradients,
    project_backward,
)
from gaussian_wrapping_addon.core.render.reference import (
    reference_depth_at,
    reference_transmittance_at,
)
from gaussian_wrapping_addon.core.render.render import project_view, render
from gaussian_wrapping_addon.core.render.types import RenderOptions

from .scenes import isotropic, look_at, random_gaussians
from .test_vectorised import fused_instructions

SHAPES = ("means", "log_scales", "quats", "opacity_logits")
EYE = (2.2, 1.0, 0.8)
# Keyword arguments of random_gaussians, number of Gaussians, camera position.
SCENES = {
    "generic": ({}, 120, EYE),
    "thin": ({"scale": (0.002, 0.4), "opacity": (0.3, 0.97)}, 150, EYE),
    "inside": ({"scale": (0.1, 0.8), "opacity": (0.02, 0.3)}, 25, (0.7, 0.3, 0.2)),
    "opaque": ({"opacity": (0.95, 0.9999)}, 60, EYE),
}


def scene(name: str, seed: int = 3) -> tuple[OrientedGaussians, Camera]:
    """Return float32 Gaussians and a camera of several tiles, the last ones cut."""
    values, count, eye = SCENES[name]
    gaussians = random_gaussians(count, seed=seed, dtype=torch.float32, sh_degree=1, **values)  # type: ignore[arg-type]
    return gaussians, look_at(eye, width=50, height=40, focal=60.0)


def random_positions(camera: Camera, count: int, seed: int = 0) -> np.ndarray:
    """Return (count, 2) float32 positions, a few of them beyond each side of the image."""
    random = np.random.default_rng(seed)
    size = np.array([camera.width, camera.height])
    return (random.uniform(-0.03, 1.03, (count, 2)) * size).astype(np.float32)


def doubled(gaussians: OrientedGaussians) -> OrientedGaussians:
    """Return the same values as float64."""
    return gaussians.replaced(**{name: t.double() for name, t in gaussians.tensors()})


def leaves(gaussians: OrientedGaussians, dtype: torch.dtype) -> OrientedGaussians:
    """Return copies whose shapes collect gradients."""
    return gaussians.replaced(
        **{
            name: t.detach().to(dtype).clone().requires_grad_(name in SHAPES)
            for name, t in gaussians.tensors()
        }
    )


def relative_l2(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return |a - b| / |b|."""
    return float((a.double() - b.double()).norm() / b.double().norm())


class Oracle:
    """Numpy float64 from inverse covariances and world-space rays; bisection of 200 steps."""

    def __init__(self, gaussians: OrientedGaussians, camera: Camera) -> None:
        raw = {name: t.detach().double().numpy() for name, t in gaussians.tensors()}
        self.camera = camera
        variance = np.exp(2.0 * raw["log_scales"])
        blurred = variance + raw["filter_3d"][:, None] ** 2
        opacity = np.sqrt((variance / blurred).prod(1)) / (1.0 + np.exp(-raw["opacity_logits"]))
        turn = Rotation.from_quat(raw["quats"][:, [1, 2, 3, 0]]).as_matrix()
        precision = np.linalg.inv(turn @ (blurred[:, :, None] * turn.transpose(0, 2, 1)))
        gap = raw["means"] - camera.center
        distance = np.linalg.norm(gap, axis=1)
        order = np.lexsort((np.arange(len(gap)), distance.astype(np.float32)))
        order = order[gap[order] @ camera.forward > 0.2]
        self.opacity, self.precision, self.gap = opacity[order], precision[order], gap[order]

    def cast(self, positions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return alpha before its cap (0 where none), peak, sharpness (p, n) and final T (p,)."""
        x, y = positions.astype(np.float64).T
        camera = self.camera
        local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 0.0 * x + 1], 1)
        rays = local @ camera.rotation  # (p, 3), z-depth 1
        turned = np.einsum("nij,pj->pni", self.precision, rays)  # (p, n, 3)
        sharpness = np.einsum("pi,pni->pn", rays, turned)
        peak = np.einsum("ni,pni->pn", self.gap, turned) / sharpness
        miss = peak[:, :, None] * rays[:, None, :] - self.gap  # (p, n, 3)
        smallest = np.einsum("pni,nij,pnj->pn", miss, self.precision, miss, optimize=True)
        raw = self.opacity * np.exp(-0.5 * smallest)
        through = np.ones(len(positions))
        for i in range(raw.shape[1]):
            counts = (raw[:, i] >= 1.0 / 255.0) & (through >= 1e-4)
            raw[:, i] = np.where(counts, raw[:, i], 0.0)
            through *= 1.0 - np.minimum(raw[:, i], 0.99)
        return raw, peak, sharpness, through

    @staticmethod
    def through(hits: tuple[np.ndarray, ...], t: np.ndarray) -> np.ndarray:
        """T (p,) up to z-depth t (p,)."""
        raw, peak, sharpness, _ = hits
        ahead = np.maximum(peak - t[:, None], 0.0)
        density = raw * np.exp(-0.5 * sharpness * ahead * ahead)
        return np.prod(1.0 - np.minimum(density, 0.99), axis=1)

    def transmittance(self, positions: np.ndarray, depths: np.ndarray) -> np.ndarray:
        """T (p,) at positions of the image."""
        return self.through(self.cast(positions), depths.astype(np.float64))

    def depth(self, positions: np.ndarray, limit: float = 0.45) -> np.ndarray:
        """z-depth (p,); 0 where there is none and off the image."""
        size = np.array([self.camera.width, self.camera.height])
        on_image = ((positions >= 0) & (positions <= size)).all(1)
        hits = self.cast(positions)
        low, high = np.zeros(len(positions)), np.full(len(positions), 1e3)
        valid = on_image & (hits[3] <= limit) & (hits[3] < 0.5) & (self.through(hits, low) > 0.5)
        kept = tuple(part[valid] for part in hits)
        low, high = low[valid], high[valid]
        for _ in range(200):
            middle = 0.5 * (low + high)
            clear = self.through(kept, middle) > 0.5
            low, high = np.where(clear, middle, low), np.where(clear, high, middle)
        out = np.zeros(len(positions))
        out[valid] = low
        return out


def assert_depths(found: np.ndarray, wanted: np.ndarray) -> None:
    """Check validity and the error's distribution."""
    # A float32 alpha may fall on the other side of 1/255, a float32 T on that of 0.45.
    assert ((found > 0) != (wanted > 0)).mean() <= 1e-3
    both = (found > 0) & (wanted > 0)
    error = np.abs(found - wanted)[both] / wanted[both]
    assert both.mean() > 0.2
    assert (error < 1e-5).mean() >= 0.999
    assert error.max() < 1e-3


# -- values ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_depth_is_the_definition_at_any_position(name: str) -> None:
    gaussians, camera = scene(name)
    positions = random_positions(camera, 3000)
    found = query_depth(gaussians, camera, torch.from_numpy(positions)).numpy()
    assert_depths(found, Oracle(gaussians, camera).depth(positions))


def test_depth_is_the_definition_beside_the_edges_of_tiles() -> None:
    gaussians, camera = scene("thin", seed=9)
    random = np.random.default_rng(2)
    edges = random.choice([0.0, 16.0, 32.0, 48.0], 2500) + random.choice([-0.01, 0.0, 0.3], 2500)
    along = random.uniform(0.0, 40.0, 2500)
    positions = np.stack([edges, along], 1)
    positions[::2] = np.minimum(positions[::2, ::-1], [50.0, 40.0])
    positions = positions.astype(np.float32)
    found = query_depth(gaussians, camera, torch.from_numpy(positions)).numpy()
    assert_depths(found, Oracle(gaussians, camera).depth(positions))


@pytest.mark.parametrize("name", SCENES)
def test_pixel_centres_equal_the_image(name: str) -> None:
    gaussians, camera = scene(name, seed=5)
    image = render(gaussians, camera, RenderOptions()).depth.numpy().reshape(-1)
    y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    positions = torch.from_numpy(np.stack([x.reshape(-1), y.reshape(-1)], 1))
    found = query_depth(gaussians, camera, positions).numpy()
    assert np.array_equal(found > 0, image > 0)
    both = image > 0
    error = np.abs(found - image)[both] / image[both]
    # Where T is nearly flat at the crossing, rounding of either is magnified.
    assert (error < 2e-6).mean() > 0.995
    assert error.max() < 5e-5


@pytest.mark.parametrize("name", SCENES)
def test_transmittance_is_the_definition(name: str) -> None:
    gaussians, camera = scene(name)
    positions = np.clip(random_positions(camera, 2000), 0.0, [50.0, 40.0]).astype(np.float32)
    depths = np.random.default_rng(1).uniform(0.0, 5.0, 2000).astype(np.float32)
    found = query_transmittance(
        gaussians, camera, torch.from_numpy(positions), torch.from_numpy(depths)
    ).numpy()
    wanted = Oracle(gaussians, camera).transmittance(positions, depths)
    error = np.abs(found - wanted)
    assert ((wanted > 0.05) & (wanted < 0.95)).mean() > 0.05
    assert (error < 1e-5).mean() >= 0.999
    assert error.max() < 1.0 / 255.0


def test_half_of_the_light_reaches_the_depth() -> None:
    gaussians, camera = scene("generic")
    positions = torch.from_numpy(random_positions(camera, 2000))
    depths = query_depth(gaussians, camera, positions)
    through = query_transmittance(gaussians, camera, positions, depths)
    assert (through[depths > 0] - 0.5).abs().max() < 2e-6


def test_transmittance_is_that_of_the_vacancy() -> None:
    gaussians, camera = scene("generic")
    positions = random_positions(camera, 1500).astype(np.float64).clip(0.5, [49.5, 39.5])
    depths = np.random.default_rng(4).uniform(0.3, 4.0, 1500)
    local = np.stack(
        [
            (positions[:, 0] - camera.cx) / camera.fx,
            (positions[:, 1] - camera.cy) / camera.fy,
            np.ones(1500),
        ],
        1,
    )
    points = (depths[:, None] * local - camera.cam_from_world[:, 3]) @ camera.rotation
    field = VacancyField(gaussians.arrays(), [camera], threads=1)
    wanted = field.transmittance(points, 0)
    found = query_transmittance(
        gaussians, camera, torch.from_numpy(positions), torch.from_numpy(depths)
    ).numpy()
    # What lies behind 1e-4 is left out by one, all below 1e-4 is 0 for the other.
    assert np.abs(found - wanted)[wanted > 0].max() < 1e-4
    assert found[wanted == 0].max(initial=0.0) <= 1.1e-4


def test_a_gaussian_between_pixel_centres_is_found() -> None:
    # At (8, 8), the corner of four pixels, and a tenth of a pixel wide.
    gaussians = isotropic([(0.0, 0.0, 0.0)], [0.01], [0.9], torch.float32)
    pose = look_at((0.0, -4.0, 0.0)).cam_from_world
    camera = Camera("front", 16, 16, 40.0, 40.0, 8.0, 8.0, pose)
    assert not render(gaussians, camera).depth.any()
    positions = torch.tensor([[8.0, 8.0], [8.05, 7.97], [8.5, 8.5]])
    depth = query_depth(gaussians, camera, positions).numpy()
    wanted = 4.0 - 0.01 * math.sqrt(2.0 * math.log(1.8))
    assert depth[0] == pytest.approx(wanted, rel=1e-6)
    np.testing.assert_allclose(depth, Oracle(gaussians, camera).depth(positions.numpy()), 2e-6)
    # A view that is shared with the image has no such Gaussian.
    shared = query_view_of(
        project_view(RawArrays.from_gaussians(gaussians), camera, RenderOptions())
    )
    assert not solve_depths(shared, positions.numpy()).values.any()


@pytest.mark.parametrize("alpha", [0.56, 0.8, 0.95])
def test_first_gaussian_alone_has_its_closed_form(alpha: float) -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0)], [0.2], [alpha], torch.float32)
    pose = look_at((0.0, -4.0, 0.0)).cam_from_world
    camera = Camera("front", 20, 20, 40.0, 40.0, 10.3, 9.6, pose)
    depth = float(query_depth(gaussians, camera, torch.tensor([[10.3, 9.6]])))
    assert depth == pytest.approx(4.0 - 0.2 * math.sqrt(2.0 * math.log(2.0 * alpha)), rel=1e-6)


def test_plateau_at_half_and_limits_of_validity() -> None:
    pose = look_at((0.0, -4.0, 0.0)).cam_from_world
    camera = Camera("front", 20, 20, 40.0, 40.0, 10.3, 9.6, pose)
    middle = torch.tensor([[10.3, 9.6]])

    def depth(sigmas: list[float], opacities: list[float], limit: float = 0.45) -> float:
        means = [(0.0, 3.0 * i, 0.0) for i in range(len(sigmas))]
        gaussians = isotropic(means, sigmas, opacities, torch.float32)
        options = RenderOptions(depth_valid_transmittance=limit)
        return float(query_depth(gaussians, camera, middle, options))

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


# -- gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "bound"), [("generic", 1e-4), ("thin", 1e-4), ("inside", 1e-4)])
def test_depth_gradients_are_those_of_the_definition(name: str, bound: float) -> None:
    gaussians, camera = scene(name)
    options = RenderOptions(threads=2)
    positions = random_positions(camera, 1500)
    one, two = leaves(gaussians, torch.float32), leaves(gaussians, torch.float64)
    at_one = torch.from_numpy(positions).requires_grad_()
    at_two = torch.from_numpy(positions).double().requires_grad_()
    fast = query_depth(one, camera, at_one, options)
    exact = reference_depth_at(two, camera, at_two, options)
    # A depth's gradient is something well conditioned over the slope of log T.
    result = solve_depths(query_view(RawArrays.from_gaussians(one), camera, options), positions)
    slopes = np.zeros(len(positions))
    slopes[result.positions.order] = result.slopes
    random = np.random.default_rng(6)
    weight = torch.from_numpy(random.normal(size=len(positions)) * slopes)
    weight = torch.where((fast.detach() > 0) & (exact.detach() > 0), weight, 0.0)
    assert int((weight != 0).sum()) > 300
    (fast.double() * weight).sum().backward()
    (exact * weight).sum().backward()
    for field in SHAPES:
        assert relative_l2(getattr(one, field).grad, getattr(two, field).grad) < bound, field
    assert at_one.grad is not None
    assert at_two.grad is not None
    assert relative_l2(at_one.grad, at_two.grad) < bound


@pytest.mark.parametrize("name", ["generic", "thin", "opaque"])
def test_transmittance_gradients_are_those_of_the_definition(name: str) -> None:
    gaussians, camera = scene(name)
    positions = torch.from_numpy(random_positions(camera, 1500))
    random = np.random.default_rng(7)
    depths = torch.from_numpy(random.uniform(1.0, 4.0, 1500).astype(np.float32))
    weight = torch.from_numpy(random.normal(size=1500))
    grads = []
    for dtype in (torch.float32, torch.float64):
        leaf = leaves(gaussians, dtype)
        at = positions.to(dtype).clone().requires_grad_()
        deep = depths.to(dtype).clone().requires_grad_()
        if dtype == torch.float32:
            through = query_transmittance(leaf, camera, at, deep)
        else:
            through = reference_transmittance_at(leaf, camera, at, deep, RenderOptions())
        (through.double() * weight).sum().backward()
        grads.append([*(getattr(leaf, field).grad for field in SHAPES), at.grad, deep.grad])
    for fast, exact in zip(*grads, strict=True):
        assert relative_l2(fast, exact) < 1e-4


def test_gradient_on_positions_is_the_slope_of_the_depth() -> None:
    gaussians, camera = scene("generic")
    oracle = Oracle(gaussians, camera)
    positions = random_positions(camera, 800).clip(1.0, [49.0, 39.0]).astype(np.float32)
    at = torch.from_numpy(positions).requires_grad_()
    depth = query_depth(gaussians, camera, at)
    depth.sum().backward()
    assert at.grad is not None
    step = 1e-5
    checked = 0
    for axis in range(2):
        shift = np.zeros(2)
        shift[axis] = step
        ahead, behind = oracle.depth(positions + shift), oracle.depth(positions - shift)
        difference = (ahead - behind) / (2.0 * step)
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
    for threads in (1, 2, 4):
        leaf, at = leaves(gaussians, torch.float32), positions.clone().requires_grad_()
        options = RenderOptions(threads=threads)
        depth = query_depth(leaf, camera, at, options)
        through = query_transmittance(leaf, camera, at, torch.full((5000,), 2.3), options)
        (depth.square().sum() + through.square().sum()).backward()
        results.append(
            [depth.detach(), through.detach(), at.grad]
            + [getattr(leaf, field).grad for field in SHAPES]
        )
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


def test_one_projection_serves_image_and_query() -> None:
    gaussians, camera = scene("generic")
    options = RenderOptions(threads=1)
    positions = random_positions(camera, 500)
    weight = np.random.default_rng(3).normal(size=500).astype(np.float32)

    raw = RawArrays.from_gaussians(gaussians)
    view = project_view(raw, camera, options)
    images, buffers = Images.allocate(camera, options), RenderBuffers()
    blend(view, images, buffers)
    ones = [np.ones_like(images.color), *[np.zeros_like(images.color)] * 2]
    ones += [np.zeros_like(images.alpha)] * 2
    grad_params, _, _ = blend_backward(view, images, ones, buffers, absolute=False)
    shared = query_view_of(view)
    result = solve_depths(shared, positions)
    on_positions, _ = add_query_gradients(shared, result, weight, grad_params)
    total = RawGradients.zeros(raw)
    project_backward(raw, camera, options, view.screen, grad_params, total)

    leaf, at = leaves(gaussians, torch.float32), torch.from_numpy(positions).requires_grad_()
    depth = query_depth(leaf, camera, at, options)
    loss = render(leaf, camera, options).color.sum() + (depth * torch.from_numpy(weight)).sum()
    loss.backward()
    np.testing.assert_allclose(result.values, depth.detach().numpy(), rtol=5e-6)
    assert relative_l2(torch.from_numpy(on_positions), at.grad) < 1e-4  # type: ignore[arg-type]
    for field in SHAPES:
        both = torch.from_numpy(getattr(total, field)), getattr(leaf, field).grad
        assert relative_l2(*both) < 1e-4, field


# -- edges of the interface -----------------------------------------------------------------------


def test_positions_off_the_image_have_no_answer_and_no_gradient() -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0)], [15.0], [0.9], torch.float32)  # covers everything
    pose = look_at((0.0, -40.0, 0.0)).cam_from_world
    camera = Camera("front", 20, 10, 40.0, 40.0, 10.0, 5.0, pose)
    inside = [[0.0, 0.0], [20.0, 10.0], [0.0, 10.0], [7.3, 2.2]]
    nan, inf = math.nan, math.inf
    outside = [[-1e-3, 5.0], [5.0, 10.001], [20.01, 5.0], [nan, 5.0], [5.0, nan], [inf, 5.0]]
    outside += [[-inf, 5.0], [1e30, -1e30], [nan, inf]]
    leaf = leaves(gaussians, torch.float32)
    at = torch.tensor(inside + outside, requires_grad=True)
    depths = torch.full((len(at),), 38.0, requires_grad=True)
    found = [query_depth(leaf, camera, at), query_transmittance(leaf, camera, at, depths)]
    for answer in found:
        assert (answer[: len(inside)] > 0).all()
        assert not answer[len(inside) :].any()
    (found[0].sum() + found[1].sum()).backward()
    for grad in (at.grad, depths.grad):
        assert grad is not None
        assert torch.isfinite(grad).all()
        assert grad[: len(inside)].any()
        assert not grad[len(inside) :].any()
    deep = torch.tensor([nan, inf, -inf, 38.0])
    through = query_transmittance(leaf, camera, at.detach()[3].expand(4, 2), deep)
    assert through[0] == 0.0
    assert 0.0 < through[1] < through[3] < through[2] <= 1.0


def test_nothing_to_see_and_nothing_asked() -> None:
    gaussians = isotropic([(0.0, 9.0, 0.0)], [0.1], [0.9], torch.float32)
    camera = look_at((0.0, 3.0, 0.0), width=18, height=10)  # looks away
    for some in (gaussians, gaussians.select(torch.zeros(1, dtype=torch.bool))):
        for count in (0, 3):
            leaf = leaves(some, torch.float32)
            at = torch.full((count, 2), 4.0, requires_grad=True)
            depth = query_depth(leaf, camera, at)
            assert depth.shape == (count,)
            assert not depth.any()
            through = query_transmittance(leaf, camera, at, torch.ones(count))
            assert (through == 1.0).all()
            (depth.sum() + through.sum()).backward()
            assert leaf.means.grad is not None
            assert not leaf.means.grad.any()


def test_wrong_shapes_are_refused() -> None:
    gaussians, camera = scene("generic")
    with pytest.raises(UsageError, match="shape"):
        query_depth(gaussians, camera, torch.zeros((4, 3)))
    with pytest.raises(UsageError, match="depths of shape"):
        query_transmittance(gaussians, camera, torch.zeros((4, 2)), torch.zeros(3))


def test_changed_parameters_are_refused_by_backward() -> None:
    gaussians, camera = scene("generic")
    leaf = leaves(gaussians, torch.float32)
    depth = query_depth(leaf, camera, torch.full((3, 2), 20.0))
    with torch.no_grad():
        leaf.means.mul_(1.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        depth.sum().backward()


def test_area_lists_hold_every_gaussian_that_reaches_a_tile() -> None:
    gaussians, camera = scene("thin", seed=1)
    view = query_view(RawArrays.from_gaussians(gaussians), camera, RenderOptions(threads=1))
    lists = view.lists
    random = np.random.default_rng(5)
    q = view.screen.params.astype(np.float64)
    missing = reached = 0
    for tile in range(lists.tiles_x * lists.tiles_y):
        listed = set(lists.gaussian_ids[lists.start[tile] : lists.start[tile + 1]].tolist())
        corner = np.array([tile % lists.tiles_x, tile // lists.tiles_x]) * 16
        places = corner + random.uniform(0.0, 16.0, (1500, 2))
        dx, dy = (places[:, i, None] - q[:, i] for i in range(2))  # (p, n)
        num = q[:, 2] * dx * dx + q[:, 3] * dx * dy + q[:, 4] * dy * dy
        den = 1.0 + 2.0 * (q[:, 5] * dx + q[:, 6] * dy)
        den = den + q[:, 7] * dx * dx + q[:, 8] * dx * dy + q[:, 9] * dy * dy
        alpha = q[:, 11] * np.exp(-0.5 * num / den)
        hit = set(np.flatnonzero((alpha >= 1.0 / 255.0).any(0)).tolist())
        missing += len(hit - listed)
        reached += len(listed & hit)
    assert missing == 0
    # Nor does it list much that reaches nothing.
    assert reached > 0.85 * len(lists.gaussian_ids)
    other = list_areas(view.screen, camera.width, camera.height, 3)
    for field in dataclasses.fields(lists):
        assert np.array_equal(getattr(lists, field.name), getattr(other, field.name)), field.name


def test_queries_use_packed_arithmetic() -> None:
    if platform.machine().lower() not in ("x86_64", "amd64"):
        pytest.skip("packed FMA is looked for in x86 code")
    if not llvmlite.binding.get_host_cpu_features().get("fma"):
        pytest.skip("this processor has no FMA instructions")
    gaussians, camera = scene("generic")
    leaf = leaves(gaussians, torch.float32)
    query_depth(leaf, camera, torch.full((1, 2), 20.0)).sum().backward()
    for kernel, least in ((query_kernel(True), 30), (pull_range, 40)):
        packed, single = fused_instructions(kernel)
        assert packed >= least
        assert single < packed


def floats(low: float, high: float, shape: tuple[int, ...]) -> st.SearchStrategy[np.ndarray]:
    """Return arrays of finite float32 between two bounds."""
    return hnp.arrays(np.float32, shape, elements=st.floats(low, high, width=32))


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_answers_and_gradients_are_finite(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 5))
    gaussians = OrientedGaussians(
        torch.from_numpy(data.draw(floats(-8.0, 8.0, (count, 3)))),
        torch.from_numpy(data.draw(floats(-40.0, 8.0, (count, 3)))),
        torch.from_numpy(data.draw(floats(-2.0, 2.0, (count, 4)))),
        torch.from_numpy(data.draw(floats(-40.0, 40.0, (count,)))),
        torch.zeros((count, 1, 3)),
        torch.zeros((count, 4)),
        torch.from_numpy(data.draw(floats(0.0, 0.5, (count,)))),
    )
    camera = look_at((0.0, -4.0, 0.0), width=20, height=18, focal=25.0)
    anything = st.one_of(st.floats(-2.0, 22.0, width=32), st.floats(width=32))
    at = torch.from_numpy(data.draw(hnp.arrays(np.float32, (12, 2), elements=anything)))
    # However small a Gaussian is, some position looks at it.
    at[:count] = torch.from_numpy(camera.project(gaussians.means.numpy())[0]).float()
    deep = torch.from_numpy(data.draw(hnp.arrays(np.float32, (12,), elements=anything)))
    options = RenderOptions(threads=1, depth_valid_transmittance=data.draw(st.floats(0.0, 1.0)))
    leaf = leaves(gaussians, torch.float32)
    at, deep = at.requires_grad_(), deep.requires_grad_()
    depth = query_depth(leaf, camera, at, options)
    through = query_transmittance(leaf, camera, at, deep, options)
    assert torch.isfinite(depth).all()
    assert (depth >= 0).all()
    assert ((through >= 0) & (through <= 1)).all()
    (depth.sum() + through.sum()).backward()
    for grad in [*(getattr(leaf, field).grad for field in SHAPES), at.grad, deep.grad]:
        assert grad is not None
        assert torch.isfinite(grad).all()
