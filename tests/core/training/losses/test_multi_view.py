# SPDX-License-Identifier: GPL-3.0-or-later
"""Multi-view losses end to end against their definition in torch; excluded pixels."""

from __future__ import annotations

import dataclasses
import types

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewPass, ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.adam import merge_gradients
from gaussian_wrapping_addon.core.training.multi_view import (
    SAMPLES,
    MultiViewLoss,
    MultiViewOptions,
    choose_pixels,
    grey_image,
    multi_view_losses,
)
from tests.core.render.query_autograd import query_depth
from tests.core.training.plane_scene import camera_pair, plane_gaussians, plane_photo

REFERENCE, OTHER = camera_pair()
PHOTO, OTHER_PHOTO = plane_photo(REFERENCE), plane_photo(OTHER)
OPTIONS = MultiViewOptions(0.6, 0.3, "signed", 400, weight=2.0)
RIM = [7 * i + j for i in (0, 3, 6) for j in (0, 3, 6) if (i, j) != (3, 3)]
"""Samples of a patch where the surface must lie near its plane."""
TRAINED = ("means", "log_scales", "quats", "opacity_logits")


def rendered(gaussians: OrientedGaussians) -> tuple[RawArrays, ViewPass]:
    raw = RawArrays.from_gaussians(gaussians)
    return raw, ViewRenderer().render(raw, REFERENCE, RenderOptions(sh_degree=0))


def losses(
    gaussians: OrientedGaussians,
    options: MultiViewOptions = OPTIONS,
    *,
    photo: np.ndarray = PHOTO,
    mask: np.ndarray | None = None,
    other: Camera = OTHER,
    other_photo: np.ndarray = OTHER_PHOTO,
    other_mask: np.ndarray | None = None,
    threads: int = 1,
) -> MultiViewLoss:
    raw, image = rendered(gaussians)
    random = np.random.default_rng(1)
    return multi_view_losses(
        image, raw, REFERENCE, photo, mask, other, other_photo, other_mask, options, random,
        threads=threads,
    )  # fmt: skip


def bilinear(grey: torch.Tensor, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return values at (..., 2) pixels and whether they lie between pixel centres."""
    x, y = positions[..., 0] - 0.5, positions[..., 1] - 0.5
    height, width = grey.shape
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    column, row = (v.detach().floor().clamp(0, n - 2).long() for v, n in ((x, width), (y, height)))
    right, low = x - column, y - row
    top = grey[row, column] * (1 - right) + grey[row, column + 1] * right
    below = grey[row + 1, column] * (1 - right) + grey[row + 1, column + 1] * right
    return top * (1 - low) + below * low, inside


def definition(
    gaussians: OrientedGaussians,
    pixels: np.ndarray,
    options: MultiViewOptions,
    photo: np.ndarray,
) -> torch.Tensor:
    """Return the loss of docs/method.md, section 3.4, with its homography, for autograd."""
    image = render(gaussians, REFERENCE, RenderOptions(sh_degree=0))
    row, column = (torch.from_numpy(v) for v in np.divmod(pixels.astype(np.int64), REFERENCE.width))
    depth = image.depth[row, column].double()
    normal = image.geometric_normal[row, column].double()
    cover = image.alpha[row, column].double()

    def matrix(camera: Camera) -> torch.Tensor:
        return torch.tensor(
            [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]], dtype=torch.double
        )

    k_r, k_c = matrix(REFERENCE), matrix(OTHER)
    r_r, r_c = (torch.from_numpy(c.rotation.copy()) for c in (REFERENCE, OTHER))
    turn = r_c @ r_r.T
    shift = torch.from_numpy(OTHER.cam_from_world[:, 3].copy())
    shift = shift - turn @ torch.from_numpy(REFERENCE.cam_from_world[:, 3].copy())
    centres = torch.stack([column + 0.5, row + 0.5, torch.ones_like(row)], 1).double()
    point = depth[:, None] * (centres @ torch.linalg.inv(k_r).T)
    there = (point @ turn.T + shift) @ k_c.T
    positions = there[:, :2] / there[:, 2:]
    # The terms round places to float32 too.
    positions = positions + (positions.detach().float().double() - positions.detach())
    found = query_depth(gaussians, OTHER, positions, RenderOptions()).double()
    ones = torch.ones_like(found)[:, None]
    reprojected = found[:, None] * (torch.cat([positions, ones], 1) @ torch.linalg.inv(k_c).T)
    again = ((reprojected - shift) @ turn) @ k_r.T
    again = again[:, :2] / again[:, 2:]
    noise = (again - centres[:, :2]).norm(dim=1)
    size_px = torch.tensor([REFERENCE.width, REFERENCE.height])
    valid = (found > 0.2) & (noise < 1) & (again >= 0).all(1) & (again <= size_px).all(1)
    weight = torch.exp(-noise).detach()
    geometric = (weight * noise)[valid].mean()

    unit = (normal / normal.norm(dim=1, keepdim=True)) @ r_r.T
    delta = (unit * point).sum(1)
    plane = turn + shift[None, :, None] * unit[:, None, :] / delta[:, None, None]
    homography = k_c @ plane @ torch.linalg.inv(k_r)  # (m, 3, 3)
    error = torch.zeros_like(depth)
    kept, undecided = torch.zeros_like(valid), valid.clone()
    for size in range(options.patch_sizes):
        steps = torch.arange(-3, 4) * 0.5 * 2**size
        grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).reshape(-1, 2)
        patch = centres[:, None, :2] + grid  # (m, 49, 2)
        corners = torch.cat([patch, torch.ones_like(patch[..., :1])], 2)  # (m, 49, 3)
        warped = corners @ homography.transpose(1, 2)
        warped = warped[..., :2] / warped[..., 2:]
        ours, here = bilinear(torch.from_numpy(photo[..., 0]), patch)
        theirs, inside = bilinear(torch.from_numpy(OTHER_PHOTO[..., 0]), warped)
        rays = corners @ torch.linalg.inv(k_r).T
        of_plane = delta[:, None] / (rays * unit[:, None]).sum(2)  # (m, 49) depths
        at = patch.long()
        at_x, at_y = (
            v.clamp(0, n - 1) for v, n in ((at[..., 0], size_px[0]), (at[..., 1], size_px[1]))
        )
        rise = (image.depth[at_y, at_x] / of_plane - 1).abs() * REFERENCE.fx / (3 * steps[4])
        flat_enough = (rise[:, RIM] < options.max_rise).all(1)
        undecided = undecided & here.all(1) & inside.all(1) & flat_enough
        a, b = ours - ours.mean(1, keepdim=True), theirs - theirs.mean(1, keepdim=True)
        spreads = (a * a).sum(1), (b * b).sum(1)
        correlation = (a * b).sum(1) / torch.sqrt(spreads[0] * spreads[1] + 1e-8)
        found_error = 1 - (correlation if options.correlation == "signed" else correlation**2)
        least = SAMPLES * options.min_contrast**2
        clear = undecided & (spreads[0] > least) & (spreads[1] > least)
        error = torch.where(clear, found_error, error)
        kept, undecided = kept | clear, undecided & ~clear
    kept = kept & (error < 0.9) & (normal.norm(dim=1) >= 0.3 * cover)
    photometric = (weight * error)[kept].mean()
    assert valid.sum() > 100
    assert kept.sum() > 100
    assert (~valid).any()
    total = options.lambda_photometric * photometric + options.lambda_geometric * geometric
    return options.weight * total


@pytest.mark.parametrize("correlation", ["signed", "squared"])
@pytest.mark.parametrize("patch_sizes", [1, 3])
@pytest.mark.parametrize("max_rise", [0.5, TrainingSettings.patch_rise])
def test_value_and_gradients_are_those_of_the_definition(
    correlation: str, patch_sizes: int, max_rise: float
) -> None:
    options = dataclasses.replace(
        OPTIONS, correlation=correlation, patch_sizes=patch_sizes, max_rise=max_rise
    )
    # Half of the photo is so weak that only large patches show something.
    photo = PHOTO.copy()
    half = photo.shape[1] // 2
    photo[:, :half] = 0.5 + 0.25 * (photo[:, :half] - 0.5)
    gaussians = plane_gaussians(noise=0.03)
    raw, image = rendered(gaussians)
    random = np.random.default_rng(1)
    found = multi_view_losses(
        image, raw, REFERENCE, photo, None, OTHER, OTHER_PHOTO, None, options, random
    )
    assert found.other is not None
    merged = merge_gradients(image.backward(found.gradients), found.other, len(raw))

    random = np.random.default_rng(1)
    grey = grey_image(photo, "grey", threads=1)
    pixels = choose_pixels(grey, image.depth, None, options.pixels, random, threads=1)
    leaves = {name: getattr(gaussians, name).clone().requires_grad_() for name in TRAINED}
    wanted = definition(gaussians.replaced(**leaves), pixels, options, photo)
    assert found.value == pytest.approx(wanted.item(), rel=1e-4)
    wanted.backward()  # type: ignore[no-untyped-call]
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        dense = np.zeros(leaf.shape, np.float32)
        dense[merged.ids] = getattr(merged, name)
        assert np.abs(leaf.grad.numpy()).max() > 1e-6
        wrong = np.abs(dense - leaf.grad.numpy())
        assert wrong.max() < 2e-3 * np.abs(leaf.grad.numpy()).max(), name
    assert not merged.sh.any()
    assert not merged.orientation.any()


def test_weights_scale_terms_and_gradients() -> None:
    gaussians = plane_gaussians(noise=0.03)
    both = losses(gaussians)
    photometric = losses(gaussians, dataclasses.replace(OPTIONS, lambda_geometric=0.0))
    geometric = losses(gaussians, dataclasses.replace(OPTIONS, lambda_photometric=0.0))
    half = losses(gaussians, dataclasses.replace(OPTIONS, weight=1.0))
    assert both.value == pytest.approx(photometric.value + geometric.value)
    assert both.value == pytest.approx(2 * half.value)
    wanted = 1.2 * both.figures.photometric + 0.6 * both.figures.geometric
    assert both.value == pytest.approx(wanted)
    assert photometric.other is None
    assert not geometric.gradients.geometric_normal.any()
    summed = photometric.gradients.depth + geometric.gradients.depth
    assert np.allclose(both.gradients.depth, summed, rtol=1e-5, atol=1e-9)
    assert both.gradients.color is None


def test_exact_geometry_has_no_loss_and_shifted_geometry_has() -> None:
    exact = losses(plane_gaussians(side=40))
    means = plane_gaussians(side=40).means
    shifted = losses(plane_gaussians(side=40).replaced(means=means + torch.tensor([0, 0, 0.1])))
    assert exact.figures.geometric < 0.1
    assert exact.figures.photometric < 0.01
    assert shifted.figures.photometric > 5 * exact.figures.photometric
    assert exact.figures.dropped == 0
    assert exact.figures.kept > 0.7 * exact.figures.chosen > 100


def test_masks_leave_out_both_terms() -> None:
    gaussians = plane_gaussians(noise=0.03)
    mask = np.zeros((REFERENCE.height, REFERENCE.width), np.bool_)
    mask[:, 20:40] = True
    found = losses(gaussians, mask=mask)
    assert found.figures.valid > 50
    assert not found.gradients.depth[~mask].any()
    other_mask = np.zeros((OTHER.height, OTHER.width), np.bool_)
    nothing = losses(gaussians, other_mask=other_mask)
    assert nothing.value == 0.0
    assert nothing.other is None
    assert not nothing.gradients.depth.any()
    nothing = losses(gaussians, mask=np.zeros_like(mask))
    assert nothing.figures.chosen == 0
    assert nothing.value == 0.0


def test_constant_photos_leave_the_geometric_term() -> None:
    flat = np.full_like(PHOTO, 0.5)
    found = losses(plane_gaussians(noise=0.03), photo=flat)
    assert found.figures.kept == 0
    assert found.figures.photometric == 0.0
    assert found.figures.geometric > 0.0
    assert found.other is not None


def test_weak_texture_is_seen_by_larger_patches() -> None:
    weak = 0.5 + 0.25 * (PHOTO - 0.5)
    other = 0.5 + 0.25 * (OTHER_PHOTO - 0.5)
    kept = [
        losses(
            plane_gaussians(side=40),
            dataclasses.replace(OPTIONS, patch_sizes=sizes),
            photo=weak,
            other_photo=other,
        ).figures.kept
        for sizes in (1, 2, 3)
    ]
    assert kept[0] < kept[1] < kept[2]
    assert kept[2] > 2 * kept[0]


def test_patches_across_a_step_of_the_surface_are_left_out() -> None:
    raw, image = rendered(plane_gaussians(side=40))
    depth = image.depth.copy()
    edge = 30
    depth[:, edge:] *= 0.7
    stepped = types.SimpleNamespace(
        depth=depth, geometric_normal=image.geometric_normal, alpha=image.alpha
    )
    options = dataclasses.replace(OPTIONS, lambda_geometric=0.0, patch_sizes=1, pixels=3000)

    def pulled(max_rise: float) -> np.ndarray:
        found = multi_view_losses(
            stepped, raw, REFERENCE, PHOTO, None, OTHER, OTHER_PHOTO, None,  # type: ignore[arg-type]
            dataclasses.replace(options, max_rise=max_rise), np.random.default_rng(1),
        )  # fmt: skip
        return np.asarray(found.gradients.depth != 0.0)

    all_of_them, on_planes = pulled(np.inf), pulled(TrainingSettings.patch_rise)
    assert all_of_them[:, edge - 1].any()
    assert not on_planes[:, edge - 1].any()
    far = np.s_[:, : edge - 3]
    assert np.array_equal(all_of_them[far], on_planes[far])


def test_a_camera_that_looks_away_has_no_part() -> None:
    pose = OTHER.cam_from_world.copy()
    pose[0], pose[2] = -pose[0], -pose[2]
    found = losses(plane_gaussians(), other=dataclasses.replace(OTHER, cam_from_world=pose))
    assert found.value == 0.0
    assert found.other is None
    assert found.figures.chosen > 0


def test_the_number_of_threads_does_not_matter() -> None:
    one, three = (losses(plane_gaussians(noise=0.03), threads=n) for n in (1, 3))
    assert one.value == three.value
    assert np.array_equal(one.gradients.depth, three.gradients.depth)
    assert np.array_equal(one.gradients.geometric_normal, three.gradients.geometric_normal)
    assert one.other is not None
    assert three.other is not None
    for name in ("ids", *TRAINED):
        assert np.array_equal(getattr(one.other, name), getattr(three.other, name))


def test_numbers_that_are_not_finite_are_dropped_and_counted() -> None:
    gaussians = plane_gaussians(noise=0.03)
    raw, image = rendered(gaussians)
    image.geometric_normal[20:24] = np.nan
    image.depth[30, :] = np.inf
    photo = OTHER_PHOTO.copy()
    photo[20:22, 20:22] = np.nan
    random = np.random.default_rng(1)
    found = multi_view_losses(
        image, raw, REFERENCE, PHOTO, None, OTHER, photo, None, OPTIONS, random
    )
    assert np.isfinite(found.value)
    assert found.value > 0.0
    for array in (found.gradients.depth, found.gradients.geometric_normal):
        assert np.isfinite(array).all()
    assert 20 < found.figures.dropped < found.figures.chosen


def test_bytes_are_read_like_floats() -> None:
    gaussians = plane_gaussians(noise=0.03)
    photos = [np.round(255 * photo).astype(np.uint8) for photo in (PHOTO, OTHER_PHOTO)]
    found = losses(gaussians, photo=photos[0], other_photo=photos[1])
    assert found.figures.photometric == pytest.approx(
        losses(gaussians).figures.photometric, rel=0.5
    )


def test_options_and_sizes() -> None:
    options = MultiViewOptions.of_settings(TrainingSettings(multi_view_every=3))
    assert options == MultiViewOptions(0.15, 0.02, "signed", 4000, weight=3.0)
    with pytest.raises(UsageError, match="cubed"):
        MultiViewOptions(correlation="cubed")
    with pytest.raises(UsageError, match="photo is"):
        losses(plane_gaussians(), other_photo=PHOTO)
    with pytest.raises(UsageError, match="mask is"):
        losses(plane_gaussians(), mask=np.ones((3, 3), np.bool_))
