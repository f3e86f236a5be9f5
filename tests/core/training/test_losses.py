# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses on images and regularisers: values by definition, gradients, masks, threads."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.render.types import ImageGradients, VisibleGradients
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthPrior
from gaussian_wrapping_addon.core.training.backend import Window
from gaussian_wrapping_addon.core.training.losses import (
    FAINT,
    OUTLIER_SHARE,
    SURE,
    TOLERANCE_SHARE,
    add_footprint_regulariser,
    add_opacity_prior,
    color_loss,
    depth_prior_loss,
    footprint_shares,
    normal_losses,
    normals_from_depth,
)
from tests.core.render.scenes import look_at
from tests.core.test_image_metrics import naive_ssim

# -- Losses against naive definitions, gradients against float64 central differences --------------

WIDTH, HEIGHT = 14, 12


class WithGradients(torch.autograd.Function):
    """A scalar whose gradients were computed along with it, for torch to check."""

    @staticmethod
    def forward(ctx: Any, value: float, gradients: tuple[np.ndarray, ...], *inputs: Any) -> Any:
        ctx.save_for_backward(*(torch.from_numpy(g) for g in gradients))
        return inputs[0].new_tensor(value)

    @staticmethod
    def backward(ctx: Any, *outputs: Any) -> Any:
        return (None, None, *(outputs[0] * g for g in ctx.saved_tensors))


def in_order(gradients: ImageGradients) -> tuple[np.ndarray, ...]:
    """Gradients in the order of the arguments of ``normal_losses``."""
    return gradients.depth, gradients.geometric_normal, gradients.normal, gradients.alpha


def camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    return look_at((1.0, -4.0, 2.0), width=width, height=height, focal=1.2 * width)


def random_mask(share: float = 0.7) -> np.ndarray:
    return np.random.default_rng(5).uniform(size=(HEIGHT, WIDTH)) < share


@pytest.mark.parametrize("masked", [False, True])
def test_color_loss_is_its_definition(masked: bool) -> None:
    random = np.random.default_rng(0)
    photo = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    image = random.uniform(-0.1, 1.2, photo.shape)
    mask = random_mask() if masked else None
    loss, _, mean_squared = color_loss(image, photo, mask, lambda_dssim=0.3)
    where = np.ones((HEIGHT, WIDTH), bool) if mask is None else mask
    difference = (image - photo / 255.0)[where]
    similar = naive_ssim(image, photo / 255.0, mask)
    wanted = 0.7 * np.abs(difference).mean() + 0.3 * (1 - similar)
    assert loss == pytest.approx(wanted, abs=1e-12)
    assert mean_squared == pytest.approx((difference**2).mean(), abs=1e-12)
    narrow, _, _ = color_loss(image.astype(np.float32), photo, mask, lambda_dssim=0.3)
    assert narrow == pytest.approx(wanted, abs=1e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_gradient_of_color_loss(masked: bool) -> None:
    random = np.random.default_rng(1)
    photo = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    image = torch.from_numpy(random.uniform(0, 1, photo.shape)).requires_grad_()
    mask = random_mask() if masked else None

    def loss(x: torch.Tensor) -> torch.Tensor:
        value, gradient, _ = color_loss(x.detach().numpy(), photo, mask, threads=2)
        return WithGradients.apply(value, (gradient,), x)

    assert torch.autograd.gradcheck(loss, [image], eps=1e-7, atol=1e-9, rtol=1e-5)
    if mask is not None:
        assert not color_loss(image.detach().numpy(), photo, mask)[1][~mask].any()


def test_color_loss_of_a_tiny_or_fully_masked_image() -> None:
    photo = np.full((6, 6, 3), 51, np.uint8)
    loss, _, _ = color_loss(np.zeros((6, 6, 3)), photo, lambda_dssim=0.2)
    assert loss == pytest.approx(0.2)  # L1 alone, with its full weight
    image = np.random.default_rng(2).uniform(size=(HEIGHT, WIDTH, 3))
    photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    loss, gradient, _ = color_loss(image, photo, np.zeros((HEIGHT, WIDTH), bool))
    assert loss == 0.0
    assert not gradient.any()
    edge = np.zeros((HEIGHT, WIDTH), bool)
    edge[0, 0] = True  # no window is centred there
    loss, _, _ = color_loss(image, photo, edge)
    assert loss == pytest.approx(image[0, 0].mean())


def plane_depth(view: Camera, normal: np.ndarray, offset: float) -> np.ndarray:
    """z-depth of the plane ``normal . x = offset`` (scene frame)."""
    rays = view.rays() @ view.rotation  # (h, w, 3) scene frame, z-depth 1
    return (offset - normal @ view.center) / (rays @ normal)


def test_normals_of_a_plane_are_exact() -> None:
    view = camera(40, 30)
    normal = np.array([0.3, -0.8, 0.6])
    normal /= np.linalg.norm(normal)
    normals, valid = normals_from_depth(plane_depth(view, normal, 0.4), view)
    assert valid[1:-1, 1:-1].all()
    assert not valid[0].any()
    assert not valid[:, -1].any()
    assert np.abs(normals[valid] - normal).max() < 1e-12
    single, _ = normals_from_depth(plane_depth(view, normal, 0.4).astype(np.float32), view)
    assert np.abs(single[valid] - normal).max() < 2e-4


def test_normals_of_a_sphere_are_radial_and_face_the_camera() -> None:
    view = look_at((0.0, -4.0, 0.5), width=160, height=120, focal=300)
    rays = view.rays() @ view.rotation
    along = rays @ view.center
    square = (rays**2).sum(2)
    root = along**2 - square * (view.center @ view.center - 1.0)
    depth = np.where(root > 0, (-along - np.sqrt(np.maximum(root, 0))) / square, 0.0)
    normals, valid = normals_from_depth(depth, view)
    points = view.center + rays * depth[..., None]
    assert valid.sum() > 3000
    facing = (normals * rays).sum(2)
    assert (facing[valid] < 0).all()
    # Second-order differences: away from the rim the error is (pixel / radius)^2.
    inner = valid & (root > 0.15 * root.max())
    assert np.abs(normals[inner] - points[inner]).max() < 2e-3
    # The five-pixel rule: a valid pixel has four neighbours with depth.
    has = depth > 0
    cross = has[1:-1, 1:-1] & has[:-2, 1:-1] & has[2:, 1:-1] & has[1:-1, :-2] & has[1:-1, 2:]
    assert np.array_equal(valid[1:-1, 1:-1], cross)


def test_a_jump_of_depth_can_be_excluded() -> None:
    view = camera(20, 16)
    depth = np.full((16, 20), 4.0)
    depth[:, 10:] = 6.0
    _, everywhere = normals_from_depth(depth, view)
    _, without = normals_from_depth(depth, view, max_jump=0.1)
    assert everywhere[1:-1, 1:-1].all()
    assert not without[:, 9:11].any()
    assert without[1:-1, 1:9].all()
    assert without[1:-1, 11:-1].all()


def normal_inputs(seed: int = 0) -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(seed)
    view = camera()
    depth = plane_depth(view, np.array([0.2, -0.9, 0.5]), 0.0)
    depth = depth * (1 + 0.01 * random.normal(size=depth.shape))
    depth[random.uniform(size=depth.shape) < 0.05] = 0.0
    geometric, learned = random.normal(size=(2, HEIGHT, WIDTH, 3)) * 0.5
    alpha = random.uniform(0.5, 1.0, (HEIGHT, WIDTH))
    return depth, geometric, learned, alpha


@pytest.mark.parametrize("masked", [False, True])
def test_normal_losses_are_their_definition(masked: bool) -> None:
    depth, geometric, learned, alpha = normal_inputs()
    view = camera()
    mask = random_mask() if masked else None
    images = (depth, geometric, learned, alpha)
    loss, first, second = (
        normal_losses(*images, view, mask, lambda_depth_normal=a, lambda_normal=b)[0]
        for a, b in ((0.7, 0.2), (1.0, 0.0), (0.0, 1.0))
    )
    points = view.rays() * depth[..., None]
    depth_normal, oriented, pixels = 0.0, 0.0, 0
    for i in range(HEIGHT):
        for j in range(WIDTH):
            if mask is not None and not mask[i, j]:
                continue
            pixels += 1
            cross = [(i, j), (i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)]
            if not all(0 <= a < HEIGHT and 0 <= b < WIDTH and depth[a, b] > 0 for a, b in cross):
                continue
            n = np.cross(points[i + 1, j] - points[i - 1, j], points[i, j + 1] - points[i, j - 1])
            n = view.rotation.T @ (n / np.linalg.norm(n))
            depth_normal += 1 - float(geometric[i, j] @ n) / float(alpha[i, j])
            oriented += 1 - float(learned[i, j] @ n)
    assert first == pytest.approx(depth_normal / pixels, rel=1e-9)
    assert second == pytest.approx(oriented / pixels, rel=1e-9)
    assert loss == pytest.approx((0.7 * depth_normal + 0.2 * oriented) / pixels, rel=1e-9)


@pytest.mark.parametrize("masked", [False, True])
def test_gradients_of_normal_losses(masked: bool) -> None:
    inputs = [torch.from_numpy(a).requires_grad_() for a in normal_inputs(3)]
    mask = random_mask() if masked else None

    def loss(*tensors: torch.Tensor) -> torch.Tensor:
        # The depth is 0 or safely positive, so a small step changes no pixel's validity.
        tensors = (torch.where(tensors[0] > 0.1, tensors[0], 0.0), *tensors[1:])
        arrays = [tensor.detach().numpy() for tensor in tensors]
        value, gradients = normal_losses(
            *arrays, camera(), mask, lambda_depth_normal=5.0, lambda_normal=3.0
        )
        return WithGradients.apply(value, in_order(gradients), *tensors)

    assert torch.autograd.gradcheck(loss, inputs, eps=1e-6, atol=1e-8, rtol=1e-5)


def test_perfect_normals_cost_nothing_and_flipped_ones_two() -> None:
    view = camera(30, 24)
    normal = np.array([0.0, -0.8, 0.6])
    depth = plane_depth(view, normal, 0.1)
    cover = np.full((24, 30), 0.9)
    blended = np.tile(0.9 * normal, (24, 30, 1))
    flipped = np.tile(-normal, (24, 30, 1))
    perfect, turned = (
        normal_losses(depth, blended, flipped, cover, view, lambda_depth_normal=a, lambda_normal=b)[
            0
        ]
        for a, b in ((1.0, 0.0), (0.0, 1.0))
    )
    assert perfect == pytest.approx(0.0, abs=1e-12)
    assert turned == pytest.approx(2.0 * 28 * 22 / (30 * 24), abs=1e-12)


def test_single_precision_is_close_and_threads_agree() -> None:
    view = camera(300, 40)
    random = np.random.default_rng(4)
    depth = plane_depth(view, np.array([0.2, -0.9, 0.5]), 0.0)
    depth = np.where(depth > 0, depth * (1 + 3e-4 * random.normal(size=depth.shape)), 0.0)
    normals = 0.5 * random.normal(size=(2, 40, 300, 3))
    narrow = [x.astype(np.float32) for x in (depth, *normals, random.uniform(0.5, 1, (40, 300)))]
    mask = random.uniform(size=depth.shape) < 0.9
    exact = in_order(normal_losses(*[x.astype(float) for x in narrow], view, mask)[1])
    one, *others = (normal_losses(*narrow, view, mask, threads=t) for t in (1, 2, 5))
    store = ArrayStore()
    normal_losses(*narrow, view, store=store)  # its memory is written anew
    others.append(normal_losses(*narrow, view, mask, store=store))
    for other in others:
        assert one[0] == other[0]
        assert all(map(np.array_equal, in_order(one[1]), in_order(other[1])))
    for wide, single in zip(exact, in_order(one[1]), strict=True):
        assert np.linalg.norm(single - wide) < 1e-5 * np.linalg.norm(wide)


# -- Loss on depths that leave those that stereo confirmed: values, gradient, what does not count -

WEIGHT = 0.3


def prior_of(camera: Camera, seed: int = 0) -> DepthPrior:
    """Return random depths around 2, a few of them unconfirmed."""
    random = np.random.default_rng(seed)
    shape = (camera.height, camera.width)
    depth = random.uniform(1.5, 2.5, shape).astype(np.float32)
    confidence = random.uniform(0.1, 1.0, shape).astype(np.float32)
    depth[random.random(shape) < 0.2] = 0.0
    return DepthPrior(camera, depth, confidence, depth, np.zeros_like(depth))


def plane_camera() -> Camera:
    return look_at((0.0, -2.0, 1.0), width=24, height=16, focal=20.0)


def test_the_gradient_is_that_of_the_loss() -> None:
    prior, random = prior_of(plane_camera()), np.random.default_rng(1)
    # Away from the kinks of the loss at both limits.
    off = random.choice([-2.4, -1.5, -0.6, 0.3, 0.8, 2.2], prior.depth.shape) * TOLERANCE_SHARE
    depth = prior.depth.astype(np.float64) * (1.0 + off)
    _, found = depth_prior_loss(depth, plane_camera(), prior, weight=WEIGHT)
    assert found.depth is not None
    for row, column in random.integers(0, depth.shape, (40, 2)):
        values = []
        for step in (-1e-6, 1e-6):
            moved = depth.copy()
            moved[row, column] += step
            values.append(depth_prior_loss(moved, plane_camera(), prior, weight=WEIGHT)[0])
        numeric = (values[1] - values[0]) / 2e-6
        assert found.depth[row, column] == pytest.approx(numeric, rel=1e-5, abs=1e-9)


def test_values_are_those_of_the_formula() -> None:
    prior = prior_of(plane_camera())
    known = prior.depth > 0
    for off, height in ((0.5, 0.125), (1.0, 0.5), (2.0, 1.5), (-2.0, 1.5)):
        depth = prior.depth.astype(np.float64) * (1.0 + off * TOLERANCE_SHARE)
        value, _ = depth_prior_loss(depth, plane_camera(), prior, weight=WEIGHT)
        expected = WEIGHT * height * prior.confidence[known].sum() / depth.size
        assert value == pytest.approx(expected, rel=1e-5)


def test_outliers_masked_pixels_and_missing_depths_do_not_count() -> None:
    prior = prior_of(plane_camera())
    far = prior.depth * np.float32(1.0 + 1.01 * OUTLIER_SHARE)
    near = prior.depth * np.float32(1.0 + 0.5 * OUTLIER_SHARE)
    nothing = np.zeros_like(near)
    for depth, mask in ((far, None), (nothing, None), (near, np.zeros(near.shape, bool))):
        value, found = depth_prior_loss(depth, plane_camera(), prior, mask, weight=WEIGHT)
        assert value == 0.0
        assert found.depth is not None
        assert not found.depth.any()
    assert depth_prior_loss(near, plane_camera(), prior, weight=WEIGHT)[0] > 0.0


@pytest.mark.parametrize("scale", [1, 2])
def test_windows_of_any_size_read_the_prior_of_their_place(scale: int) -> None:
    whole = plane_camera().resized(24 * scale, 16 * scale)
    prior = prior_of(plane_camera())
    depth = np.repeat(np.repeat(prior.depth, scale, 0), scale, 1)
    window = Window(8 * scale, 4 * scale, 10 * scale, 8 * scale)
    part = np.ascontiguousarray(window.of(depth))
    value, found = depth_prior_loss(part, window.camera(whole), prior, weight=WEIGHT)
    assert part.any()
    assert value == 0.0
    assert found.depth is not None
    assert not found.depth.any()


def test_threads_do_not_change_the_result() -> None:
    prior = prior_of(plane_camera())
    depth = prior.depth * np.float32(1.004)
    one, two = (
        depth_prior_loss(depth, plane_camera(), prior, weight=WEIGHT, threads=n) for n in (1, 2)
    )
    assert one[0] == two[0]
    assert np.array_equal(one[1].depth, two[1].depth)


# -- Footprint regulariser: its value, and its gradient on the scales -----------------------------


def no_gradients(ids: list[int]) -> VisibleGradients:
    count = len(ids)
    zeros = lambda *shape: np.zeros((count, *shape), np.float32)  # noqa: E731
    return VisibleGradients(
        np.array(ids, np.int32), zeros(3), zeros(3), zeros(4), zeros(), zeros(1, 3), zeros(4)
    )


def test_price_is_the_mean_number_of_boxes_over_a_pixel() -> None:
    boxes = np.array([[0, 0, 10, 10], [0, 0, 5, 10], [90, 90, 99, 99]], np.float32)
    gradients = no_gradients([0, 1])  # the third is not seen
    shares = footprint_shares(boxes[gradients.ids], (10, 10))
    mean = add_footprint_regulariser(gradients, np.zeros((3, 3), np.float32), shares, 0.5)
    assert mean == pytest.approx(1.5)


def test_what_lies_outside_of_the_image_costs_nothing() -> None:
    boxes = np.array([[-20, -20, 10, 10], [30, 0, 40, 10]], np.float32)
    assert footprint_shares(boxes, (20, 10)) == pytest.approx([0.5, 0.0])


def test_gradient_is_that_of_an_area_that_grows_with_the_scales() -> None:
    """Of a disc towards the camera the box is k s1 times k s2: both axes shrink it evenly."""
    scales = np.array([[0.2, 0.2, 1e-3], [0.3, 0.01, 0.01]], np.float32)
    shares = np.array([0.16, 0.06], np.float32)
    gradients = no_gradients([0, 1])
    gradients.log_scales[...] = 0.25
    add_footprint_regulariser(gradients, np.log(scales), shares, 0.1)
    added = gradients.log_scales - 0.25
    # d area / d log s over both axes of a disc together is twice the area.
    assert added[0, :2] == pytest.approx([0.016, 0.016], rel=1e-3)
    assert added[0, 2] < 1e-5
    assert added[1, 0] == pytest.approx(0.1 * 2 * 0.06, rel=0.01)
    assert (added >= 0).all()


# -- Opacity prior: its value, its gradient, and what it leaves alone -----------------------------

SHARES = np.array([1.0, 0.5, 0.12], np.float32)
"""Of the image in the footprints of the first three Gaussians; the fourth is not seen."""


def seen(by_opacity: list[float]) -> VisibleGradients:
    count = len(by_opacity)
    zeros = lambda *shape: np.zeros((count, *shape), np.float32)  # noqa: E731
    opacity = np.array(by_opacity, np.float32)
    ids = np.arange(count, dtype=np.int32)
    return VisibleGradients(ids, zeros(3), zeros(3), zeros(4), opacity, zeros(1, 3), zeros(4))


def logits(opacities: list[float]) -> np.ndarray:
    opacity = np.array(opacities)
    return np.log(opacity / (1.0 - opacity)).astype(np.float32)


def prior(raw: np.ndarray) -> float:
    return add_opacity_prior(seen([1.0, 1.0, 1.0]), raw, SHARES, 0.0)


@pytest.mark.parametrize("opacities", [[0.3, 0.45, 0.6], [0.9, 0.21, 0.99], [0.05, 0.7, 0.5]])
def test_gradient_is_that_of_the_value(opacities: list[float]) -> None:
    raw, step = logits([*opacities, 0.8]), 0.02
    gradients = seen([0.25, -0.25, 0.125])
    add_opacity_prior(gradients, raw, SHARES, 0.3)
    added = gradients.opacity_logits - np.array([0.25, -0.25, 0.125])
    for k in range(3):
        change = np.zeros(4, np.float32)
        change[k] = step
        slope = (prior(raw + change) - prior(raw - change)) / (2.0 * step)
        assert added[k] == pytest.approx(-0.3 * slope, rel=0.02, abs=1e-5)


def test_what_is_opaque_enough_gains_by_more_opacity() -> None:
    gradients = seen([1e-9, 1e-9, 1e-9])
    opacity = np.array([0.5, 0.6, 0.97])
    add_opacity_prior(gradients, logits([*opacity, 0.5]), SHARES, 0.1)
    expected = -0.4 * SHARES * opacity * (1.0 - opacity)
    assert gradients.opacity_logits == pytest.approx(expected, rel=1e-4)
    assert FAINT < SURE <= 0.5


def test_faint_gaussians_are_left_to_the_photos() -> None:
    gradients = seen([0.5, -0.5, 0.5])
    value = add_opacity_prior(gradients, logits([0.02, 0.1, FAINT, 0.9]), SHARES, 1.0)
    assert gradients.opacity_logits == pytest.approx([0.5, -0.5, 0.5], abs=1e-6)
    assert value == pytest.approx(0.0, abs=1e-6)


def test_gaussians_that_no_pixel_asks_about_stay_so() -> None:
    """The optimizer leaves rows alone whose opacity has no gradient."""
    gradients = seen([0.0, 0.5, 0.0])
    add_opacity_prior(gradients, logits([0.9, 0.9, 0.9, 0.9]), SHARES, 1.0)
    assert gradients.opacity_logits[0] == gradients.opacity_logits[2] == 0.0
    assert gradients.opacity_logits[1] < 0.5
