# SPDX-License-Identifier: GPL-3.0-or-later
"""Multi-view terms: values, gradients, neighbours, chosen pixels."""

from __future__ import annotations

import dataclasses
import types

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewPass, ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings import TrainingSettings, preset
from gaussian_wrapping_addon.core.training.adam import merge_gradients
from gaussian_wrapping_addon.core.training.losses import NO_MASK
from gaussian_wrapping_addon.core.training.multi_view import (
    MultiViewLoss,
    MultiViewOptions,
    PhotoView,
    choose_pixels,
    find_neighbours,
    grey_image,
    multi_view_losses,
)
from gaussian_wrapping_addon.core.training.multi_view_kernels import KEPT, SAMPLES, SKIPPED
from tests.core.render.query_autograd import query_depth
from tests.core.render.scenes import look_at
from tests.core.training.plane_scene import (
    NORMAL,
    PlaneView,
    camera_pair,
    grey_of,
    inner_pixels,
    moved,
    pair_of,
    plane_depth,
    plane_gaussians,
    plane_photo,
    plane_view,
)

# -- Multi-view losses end to end against their definition in torch; excluded pixels --------------

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
        image, raw, PhotoView(REFERENCE, photo, mask), PhotoView(other, other_photo, other_mask),
        options, random, threads=threads,
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
        image, raw, PhotoView(REFERENCE, photo), PhotoView(OTHER, OTHER_PHOTO), options, random
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
            stepped, raw, PhotoView(REFERENCE, PHOTO), PhotoView(OTHER, OTHER_PHOTO),  # type: ignore[arg-type]
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
        image, raw, PhotoView(REFERENCE, PHOTO), PhotoView(OTHER, photo), OPTIONS, random
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


def test_options_of_settings() -> None:
    options = MultiViewOptions.of_settings(TrainingSettings(multi_view_every=3))
    assert options == MultiViewOptions(0.15, 0.02, "signed", 4000, weight=3.0)


# -- Multi-view kernels on an exact plane: zero errors, derivatives, skipped pixels ---------------

PIXELS = inner_pixels(REFERENCE)
GREY, OTHER_GREY = grey_of(plane_photo(REFERENCE)), grey_of(plane_photo(OTHER))
TILTED, STEEP = np.array([0.2, -0.1, 1.0]), np.array([0.8, -0.4, 1.0])


def compare(  # type: ignore[no-untyped-def]  # four arrays
    view: PlaneView,
    pixels: np.ndarray = PIXELS,
    *,
    grey: np.ndarray = GREY,
    other_grey: np.ndarray = OTHER_GREY,
    mask: np.ndarray = NO_MASK,
    other_mask: np.ndarray = NO_MASK,
    squared: bool = False,
    threads: int = 1,
):
    noise = np.zeros(len(pixels))
    pair = pair_of(view, pixels, threads)
    options = MultiViewOptions(correlation="squared" if squared else "signed", patch_sizes=1)
    return pair.compare(noise, (grey, other_grey), (mask, other_mask), options)


def test_true_plane_shows_both_photos_the_same() -> None:
    states, errors, _, _ = compare(plane_view(REFERENCE))
    assert (states == KEPT).mean() > 0.9
    # What is left is that pixels are joined by straight lines, most where contrast is weak.
    assert errors[states == KEPT].mean() < 1e-3
    assert errors.max() < 1e-2


def test_error_grows_with_the_displacement() -> None:
    means = []
    for shift in (0.0, 0.02, 0.04, 0.08):
        view = moved(plane_view(REFERENCE), depth=plane_depth(REFERENCE, shift))
        states, errors, _, _ = compare(view)
        means.append(errors[states == KEPT].mean())
    assert np.all(np.diff(means) > 2e-4)
    assert means[3] > 8 * means[0]


def test_error_grows_with_the_tilt() -> None:
    flat, tilted = (compare(plane_view(REFERENCE, n))[1].mean() for n in (NORMAL, STEEP))
    assert tilted > 4 * flat


@pytest.mark.parametrize("squared", [False, True])
def test_derivatives_are_central_differences(squared: bool) -> None:
    exact = plane_view(REFERENCE, TILTED, length=0.7)
    view = moved(exact, depth=plane_depth(REFERENCE, 0.02))
    states, _, by_depth, by_normals = compare(view, squared=squared)
    kept = states == KEPT
    assert kept.mean() > 0.9
    step = 1e-6

    def slope(**sides: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        errors = [
            compare(moved(view, **{name: side[i] for name, side in sides.items()}),
                    squared=squared)[1]
            for i in range(2)
        ]  # fmt: skip
        return (errors[0] - errors[1]) / (2 * step)

    # A sample that steps over a pixel centre within the difference has two slopes.
    found = slope(depth=(view.depth + step, view.depth - step))[kept]
    scale = np.abs(by_depth[kept]).max()
    assert scale > 0.1
    assert np.quantile(np.abs(found - by_depth[kept]), 0.99) < 1e-6 * scale
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        sides = (view.geometric_normal + shift, view.geometric_normal - shift)
        found = slope(geometric_normal=sides)[kept]
        wrong = np.abs(found - by_normals[kept, axis])
        assert np.quantile(wrong, 0.99) < 1e-6 * np.abs(by_normals[kept]).max()
    # The length of the normal does not matter.
    along = (by_normals * view.geometric_normal.reshape(-1, 3)[PIXELS]).sum(1)
    assert np.abs(along).max() < 1e-12 * np.abs(by_normals).max()


def test_sign_of_the_correlation() -> None:
    view = plane_view(REFERENCE)
    states, errors, by_depth, _ = compare(view, other_grey=1.0 - OTHER_GREY)
    assert (states == SKIPPED).all()
    assert not errors.any()
    assert not by_depth.any()
    states, errors, _, _ = compare(view, other_grey=1.0 - OTHER_GREY, squared=True)
    assert (states == KEPT).mean() > 0.9
    assert errors.max() < 2e-2


def test_brightness_and_contrast_do_not_matter() -> None:
    view = moved(plane_view(REFERENCE), depth=plane_depth(REFERENCE, 0.02))
    _, errors, _, _ = compare(view)
    states, brighter, _, _ = compare(view, other_grey=np.float32(0.8) * OTHER_GREY + 0.2)
    # Weak contrast counts less: the product of the spreads has a floor.
    assert np.abs(brighter - errors)[states == KEPT].mean() < 1e-4


def test_flat_patches_are_skipped() -> None:
    view = plane_view(REFERENCE)
    for name in ("grey", "other_grey"):
        flat = np.full(GREY.shape if name == "grey" else OTHER_GREY.shape, 0.4, np.float32)
        states, _, _, _ = compare(view, **{name: flat})
        assert (states == SKIPPED).all()


def test_edge_on_and_short_normals_are_skipped() -> None:
    ray = REFERENCE.rays().reshape(-1, 3)[PIXELS] @ REFERENCE.rotation
    edge_on = np.cross(ray, [0.0, 0.0, 1.0])
    view = plane_view(REFERENCE)
    view.geometric_normal.reshape(-1, 3)[PIXELS] = edge_on
    states, _, by_depth, by_normals = compare(view)
    assert (states == SKIPPED).all()
    assert np.isfinite(by_depth).all()
    assert np.isfinite(by_normals).all()
    assert (compare(plane_view(REFERENCE, length=0.29))[0] == SKIPPED).all()
    assert (compare(plane_view(REFERENCE, length=0.31))[0] == KEPT).any()
    assert (compare(plane_view(REFERENCE, length=0.0))[0] == SKIPPED).all()


def test_numbers_that_are_not_finite_are_skipped() -> None:
    for name in ("depth", "geometric_normal", "alpha"):
        for value in (np.nan, np.inf):
            view = plane_view(REFERENCE)
            getattr(view, name).fill(value)
            states, errors, by_depth, by_normals = compare(view)
            assert not (states == KEPT).any()
            for array in (errors, by_depth, by_normals):
                assert not array.any()


def test_patches_end_at_borders_and_masks() -> None:
    view = plane_view(REFERENCE)
    row, column = np.mgrid[0 : REFERENCE.height, 0 : REFERENCE.width]
    pixels = np.arange(row.size, dtype=np.int32)
    states, _, _, _ = compare(view, pixels)
    kept = (states == KEPT).reshape(row.shape)
    # The reference's border, and in the other image: 1.5 px of the patch and half a pixel.
    inside = (row >= 2) & (column >= 2) & (row < row.shape[0] - 2) & (column < row.shape[1] - 2)
    assert not kept[~inside].any()
    place = REFERENCE.center + (view.depth[..., None] * (REFERENCE.rays() @ REFERENCE.rotation))
    there = OTHER.project(place.reshape(-1, 3))[0].reshape(*row.shape, 2)
    size = np.array([OTHER.width, OTHER.height])
    assert (there[kept] > 0.5).all()
    assert (there[kept] < size - 0.5).all()
    assert kept[inside & (there > 3.5).all(2) & (there < size - 3.5).all(2)].mean() > 0.9

    mask = np.ones(row.shape, np.bool_)
    mask[:, 30] = False
    states, _, _, _ = compare(view, pixels, mask=mask)
    masked = (states == KEPT).reshape(row.shape)
    assert not masked[:, 28:33].any()
    assert np.array_equal(masked[:, :28], kept[:, :28])
    assert np.array_equal(masked[:, 33:], kept[:, 33:])
    other_mask = np.ones((OTHER.height, OTHER.width), np.bool_)
    other_mask[:, :30] = False
    states, _, _, _ = compare(view, pixels, other_mask=other_mask)
    masked = (states == KEPT).reshape(row.shape)
    assert masked.any()
    assert not masked[there[..., 0] < 30.5].any()


def test_points_come_back_to_their_pixel() -> None:
    view = plane_view(REFERENCE)
    pair = pair_of(view, PIXELS)
    positions, _ = pair.lift(NO_MASK)
    point = REFERENCE.center + view.depth[..., None] * (REFERENCE.rays() @ REFERENCE.rotation)
    wanted, depth = OTHER.project(point.reshape(-1, 3)[PIXELS])
    assert np.abs(positions - wanted).max() < 1e-5
    noise, by_found, by_positions = pair.reproject(positions, depth.astype(np.float32))
    assert noise.max() < 1e-4
    assert np.isfinite(by_found).all()
    assert np.isfinite(by_positions).all()


def test_derivatives_of_the_way_back() -> None:
    view = moved(plane_view(REFERENCE), depth=plane_depth(REFERENCE, 0.02))
    pair = pair_of(view, PIXELS)
    positions, position_slopes = (array.astype(np.float64) for array in pair.lift(NO_MASK))
    _, found = OTHER.project(
        (REFERENCE.center + view.depth[..., None] * (REFERENCE.rays() @ REFERENCE.rotation))
        .reshape(-1, 3)[PIXELS]
    )  # fmt: skip
    found = found + 0.01
    noise, by_found, by_positions = pair.reproject(positions, found)
    assert (noise < np.inf).all()
    assert noise.min() > 1e-3
    step = 1e-6
    slope = (
        pair.reproject(positions, found + step)[0] - pair.reproject(positions, found - step)[0]
    ) / (2 * step)
    assert np.abs(slope - by_found).max() < 1e-6 * np.abs(by_found).max()
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        ends = [pair.reproject(positions + sign * shift, found)[0] for sign in (1, -1)]
        assert np.abs((ends[0] - ends[1]) / (2 * step) - by_positions[:, axis]).max() < 1e-7
    step = 1e-2  # places are float32
    ends = [
        pair_of(moved(view, depth=view.depth + sign * step), PIXELS).lift(NO_MASK)[0]
        for sign in (1, -1)
    ]
    assert np.abs((ends[0] - ends[1]) / (2 * step) - position_slopes).max() < 2e-3


def test_no_way_back() -> None:
    view = plane_view(REFERENCE)
    pair = pair_of(view, PIXELS)
    positions, _ = pair.lift(NO_MASK)
    for found in (0.0, np.nan, np.inf, 0.1, 1.0, 9.0):
        noise, by_found, _ = pair.reproject(positions, np.full(len(PIXELS), found, np.float32))
        assert np.isinf(noise).all()
        assert not by_found.any()


def test_places_behind_off_the_image_or_masked_are_none() -> None:
    view = plane_view(REFERENCE)
    behind = moved(view, depth=np.full_like(view.depth, -3.0))
    assert np.isnan(pair_of(behind, PIXELS).lift(NO_MASK)[0]).all()
    far = moved(view, depth=np.full_like(view.depth, 0.3))
    assert np.isnan(pair_of(far, PIXELS).lift(NO_MASK)[0]).any()
    other_mask = np.zeros((OTHER.height, OTHER.width), np.bool_)
    assert np.isnan(pair_of(view, PIXELS).lift(other_mask)[0]).all()
    for value in (np.nan, np.inf):
        broken = moved(view, depth=np.full_like(view.depth, value))
        assert np.isnan(pair_of(broken, PIXELS).lift(NO_MASK)[0]).all()


def test_kernels_do_not_depend_on_the_number_of_threads() -> None:
    view = moved(plane_view(REFERENCE), depth=plane_depth(REFERENCE, 0.02))
    for one, three in zip(compare(view), compare(view, threads=3), strict=True):
        assert np.array_equal(one, three)


# -- Neighbouring cameras: limits, order, independence of other cameras ---------------------------

RADIUS = limits.SCENE_RADIUS
PUBLISHED = preset("paper").training


def turned(x: float, angle_deg: float) -> Camera:
    """Return a camera on the x axis, turned within the plane z = 0."""
    angle = np.radians(angle_deg)
    return look_at((x, 0.0, 0.0), (x + np.sin(angle), np.cos(angle), 0.0))


def listed(found: list[np.ndarray]) -> list[list[int]]:
    return [indices.tolist() for indices in found]


def test_nearest_first_ties_by_angle_then_index() -> None:
    cameras = [turned(0, 0), turned(1, 0), turned(0.5, 9), turned(-0.5, -5), turned(-0.5, 5)]
    assert find_neighbours(cameras)[0].tolist()[:2] == [3, 4]
    assert find_neighbours(cameras)[0].tolist() == [3, 4, 2, 1]


@pytest.mark.parametrize(
    ("camera", "counts"),
    [
        (turned(0.5, 29.9), True),
        (turned(0.5, 30.1), False),
        (turned(0.003 * RADIUS, 0), True),
        (turned(0.0019 * RADIUS, 0), False),
        (turned(0.29 * RADIUS, 0), True),
        (turned(0.31 * RADIUS, 0), False),
        (turned(0.5, 180), False),
    ],
)
def test_limits_of_the_method(camera: Camera, counts: bool) -> None:
    found = listed(find_neighbours([turned(0, 0), camera], PUBLISHED))
    assert found == ([[1], [0]] if counts else [[], []])


def test_default_reaches_across_a_sparse_ring() -> None:
    eyes = [(4.5 * np.cos(a), 4.5 * np.sin(a), 1.0) for a in np.linspace(0, 2 * np.pi, 18)[:-1]]
    cameras = [look_at(eye) for eye in eyes]  # 21 degrees, 0.33 radii apart
    assert all(len(found) == 0 for found in find_neighbours(cameras, PUBLISHED))
    for index, found in enumerate(find_neighbours(cameras)):
        assert sorted(found.tolist()) == sorted([(index - 1) % 17, (index + 1) % 17])


def test_a_camera_without_candidates_changes_no_other() -> None:
    close = [turned(0.1 * i, i) for i in range(12)]
    alone = find_neighbours(close)
    assert [len(found) for found in alone] == [8] * 12
    lonely = [turned(40.0, 0), turned(0.05, 180)]
    together = find_neighbours([*lonely, *close])
    assert listed(together[:2]) == [[], []]
    assert [(found - 2).tolist() for found in together[2:]] == listed(alone)


def test_images_of_other_points_do_not_count() -> None:
    cameras = [turned(0.0, 0), turned(0.4, 0), turned(4.0, 0)]
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 8), np.linspace(-0.3, 0.3, 8))
    near = np.stack([x.ravel(), np.full(64, 2.0), z.ravel()], 1)
    points = np.concatenate([near, near + np.array([4.0, 0.0, 0.0])])
    assert listed(find_neighbours(cameras)) == [[1, 2], [0, 2], [1, 0]]
    assert listed(find_neighbours(cameras, points=points)) == [[1], [0], []]
    # Too few points say nothing.
    assert listed(find_neighbours(cameras, points=points[:3])) == [[1, 2], [0, 2], [1, 0]]


def test_no_cameras() -> None:
    assert find_neighbours([]) == []
    assert listed(find_neighbours([turned(0, 0)])) == [[]]


# -- Sampled pixels: distinct, inside the mask, stratified, more of them on texture ---------------

HEIGHT, WIDTH = 60, 80


def half_textured() -> np.ndarray:
    """Return grey that is noise in its right half and constant in the left one."""
    grey = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    grey[:, 40:] = np.random.default_rng(0).uniform(size=(HEIGHT, 40))
    return grey


def choose(
    grey: np.ndarray,
    count: int,
    *,
    depth: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    seed: int = 0,
    threads: int = 1,
) -> np.ndarray:
    depth = np.ones(grey.shape, np.float32) if depth is None else depth
    return choose_pixels(grey, depth, mask, count, np.random.default_rng(seed), threads=threads)


def test_half_of_them_follow_the_texture() -> None:
    pixels = choose(half_textured(), 400)
    assert len(np.unique(pixels)) == len(pixels)
    assert 300 < len(pixels) <= 400
    row, column = np.divmod(pixels, WIDTH)
    assert row.min() >= 2
    assert column.min() >= 2
    assert row.max() < HEIGHT - 2
    assert column.max() < WIDTH - 2
    assert 0.18 < (column < 38).mean() < 0.32


def test_strata_spread_them_out() -> None:
    grey = np.full((64, 64), 0.5, np.float32)
    row, column = np.divmod(choose(grey, 225), 64)
    counts = np.histogram2d(row, column, bins=[[8, 24, 40, 56]] * 2)[0]
    assert np.abs(counts - 16).max() <= 4  # independent draws would scatter by 4, often by 8


def test_only_pixels_with_depth_inside_the_mask() -> None:
    random = np.random.default_rng(1)
    depth = np.where(random.uniform(size=(HEIGHT, WIDTH)) < 0.5, 1.0, 0.0).astype(np.float32)
    depth[random.uniform(size=depth.shape) < 0.1] = np.nan
    mask = random.uniform(size=depth.shape) < 0.5
    pixels = choose(half_textured(), 200, depth=depth, mask=mask)
    assert len(pixels) > 100
    assert (depth.ravel()[pixels] > 0).all()
    assert mask.ravel()[pixels].all()


def test_all_of_them_where_as_many_are_asked_for() -> None:
    grey = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    assert len(choose(grey, 20_000)) == (HEIGHT - 4) * (WIDTH - 4)


def test_none() -> None:
    grey = half_textured()
    assert len(choose(grey, 50, depth=np.zeros_like(grey))) == 0
    assert len(choose(grey[:4, :4], 50)) == 0
    assert len(choose(np.full_like(grey, np.nan), 50)) == 0


def test_same_numbers_same_pixels() -> None:
    grey = half_textured()
    assert np.array_equal(choose(grey, 300), choose(grey, 300, threads=3))
    assert not np.array_equal(choose(grey, 300), choose(grey, 300, seed=1))
    states = []
    for depth in (np.ones_like(grey), np.zeros_like(grey)):
        random = np.random.default_rng(4)
        choose_pixels(grey, depth, None, 100, random, threads=1)
        states.append(random.random())
    assert states[0] == states[1]


def test_grey_of_bytes_and_floats() -> None:
    photo = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    wanted = photo @ [0.299, 0.587, 0.114] / 255
    assert grey_image(photo, "grey", threads=1) == pytest.approx(wanted, abs=1e-6)
    assert grey_image(photo / 255.0, "grey", threads=2) == pytest.approx(wanted, abs=1e-6)
