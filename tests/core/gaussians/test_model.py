# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial Gaussians from any points, and the 3D filter."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.gaussians.model import (
    MIN_START_POINTS,
    SH_C0,
    OrientedGaussians,
    gaussians_at,
    initial_gaussians,
    mip_filter,
    without_blur,
)
from gaussian_wrapping_addon.core.limits import NEAR_Z, POINT_REACH, SCENE_RADIUS
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from tests.core.render.scenes import look_at


def ring(count: int = 8) -> tuple[View, ...]:
    angles = 2 * np.pi * np.arange(count) / count
    return tuple(
        View(look_at((4 * np.cos(a), 4 * np.sin(a), 1.0), name=f"{i}"), Path(f"{i}.png"))
        for i, a in enumerate(angles.tolist())
    )


def scene(points: np.ndarray, colors: np.ndarray | None = None) -> Scene:
    if colors is None:
        colors = np.full(points.shape, 128, np.uint8)
    return Scene(ring(), points, colors, Similarity())


def start(given: Scene, cap: int = 20_000, seed: int = 0, degree: int = 2):  # type: ignore[no-untyped-def]
    asked = []

    def photograph(index: int):  # type: ignore[no-untyped-def]
        asked.append(index)
        camera = given.views[index].camera
        photo = np.zeros((camera.height, camera.width, 3), np.uint8)
        photo[..., 0] = 10 * (index + 1)
        # Only the left half counts: the right one is green.
        photo[:, camera.width // 2 :] = (0, 255, 0)
        mask = np.ones(photo.shape[:2], bool)
        mask[:, camera.width // 2 :] = False
        return camera, photo, mask

    gaussians = initial_gaussians(
        given, [0, 1, 2, 3, 5], photograph, max_gaussians=cap, sh_degree=degree, seed=seed
    )
    return gaussians, asked


def test_many_points_become_gaussians_one_by_one() -> None:
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (MIN_START_POINTS, 3))
    colors = random.integers(0, 256, points.shape, dtype=np.uint8)
    gaussians, asked = start(scene(points, colors))
    assert asked == []
    assert len(gaussians) == MIN_START_POINTS
    assert np.abs(gaussians.means.numpy() - points).max() < 1e-6
    assert gaussians.sh.shape == (MIN_START_POINTS, 9, 3)
    assert np.abs(0.5 + SH_C0 * gaussians.sh[:, 0].numpy() - colors / 255).max() < 1e-6
    assert not gaussians.sh[:, 1:].any()
    assert not gaussians.orientation.any()
    assert torch.sigmoid(gaussians.opacity_logits).numpy() == pytest.approx(0.1, abs=1e-6)
    assert torch.equal(gaussians.quats[0], torch.tensor([1.0, 0, 0, 0]))
    # Size against all pairs, for some of them.
    for i in range(0, MIN_START_POINTS, 500):
        nearest = np.sort(((points - points[i]) ** 2).sum(1))[1:4].mean() ** 0.5
        assert np.exp(gaussians.log_scales[i].numpy()) == pytest.approx(nearest, rel=1e-5)


def test_the_cap_holds_and_the_seed_decides() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 3))
    one, _ = start(scene(points), cap=700, seed=1)
    same, _ = start(scene(points), cap=700, seed=1)
    other, _ = start(scene(points), cap=700, seed=2)
    assert len(one) == len(other) == 700
    assert torch.equal(one.means, same.means)
    assert not torch.equal(one.means, other.means)
    few, _ = start(scene(points[:10]), cap=300)
    assert len(few) == 300


def test_few_points_are_filled_up_at_their_depth_with_the_photos_colours() -> None:
    random = np.random.default_rng(3)
    sphere = random.normal(size=(400, 3))
    sphere *= 0.7 / np.linalg.norm(sphere, axis=1, keepdims=True)
    gaussians, asked = start(scene(sphere))
    assert asked == 2 * [0, 1, 2, 3, 5]  # one is held at a time
    assert len(gaussians) == MIN_START_POINTS
    assert np.abs(gaussians.means[:400].numpy() - sphere).max() < 1e-6
    added = gaussians.means[400:].numpy()
    # Camera depth of the points lies in [3.4, 4.9]; 5 % jitter around it.
    assert np.linalg.norm(added, axis=1).max() < 4.0
    reds = 0.5 + SH_C0 * gaussians.sh[400:, 0, 0].numpy()
    values, counts = np.unique(np.round(255 * reds), return_counts=True)
    assert values.tolist() == [10, 20, 30, 40, 60]
    assert counts.max() - counts.min() <= 1
    assert np.abs(0.5 + SH_C0 * gaussians.sh[400:, 0, 1].numpy()).max() < 1e-6


def test_without_points_most_cameras_see_the_gaussians() -> None:
    given = scene(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    gaussians, _ = start(given)
    assert len(gaussians) == MIN_START_POINTS
    means = gaussians.means.double().numpy()
    seen = np.zeros(len(means), int)
    for view in given.views:
        pixels, depth = view.camera.project(means)
        inside = (pixels >= 0).all(1) & (pixels[:, 0] < 40) & (pixels[:, 1] < 30)
        seen += inside & (depth > 0)
    # Uniform random positions along the rays would be seen by 1 to 2 of the 8 cameras.
    assert np.median(seen) >= 5
    assert seen.min() >= 1


def test_unusable_points_are_left_out_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (MIN_START_POINTS + 3, 3))
    points[7] = 1.01 * POINT_REACH * np.array([0.6, 0.8, 0.0])
    points[8] = (np.nan, 0.0, 0.0)
    points[9] = (0.0, -np.inf, 0.0)
    with np.errstate(all="raise"):
        gaussians, _ = start(scene(points))
    assert caplog.messages == [
        "3 of 5003 sparse points are not finite or too far away: no Gaussian starts there"
    ]
    good = np.delete(points, [7, 8, 9], axis=0)
    np.testing.assert_array_equal(gaussians.means.numpy(), good.astype(np.float32))
    assert all(torch.isfinite(t).all() for _, t in gaussians.tensors())


def test_a_lonely_far_point_stays_where_it_is_and_covers_a_tenth_of_its_distance() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (MIN_START_POINTS, 3))
    points[7] = 0.99 * POINT_REACH * np.array([0.6, 0.8, 0.0])
    gaussians, _ = start(scene(points))
    np.testing.assert_array_equal(gaussians.means.numpy(), points.astype(np.float32))
    sizes = gaussians.log_scales.exp().numpy()
    assert sizes[7] == pytest.approx(0.1 * 0.99 * POINT_REACH, rel=1e-3)
    assert np.delete(sizes, 7, axis=0).max() < 1.0


@pytest.mark.parametrize("radii", [3.0, 100.0, 1000.0])
def test_a_far_wall_starts_in_its_place_and_as_closed_as_a_near_one(radii: float) -> None:
    # A grid of 30 by 20 points that looks the same from the scene's centre at any distance.
    distance = radii * SCENE_RADIUS
    across, up = np.meshgrid(np.linspace(-0.3, 0.3, 30), np.linspace(-0.2, 0.2, 20))
    wall = distance * np.stack([across.ravel(), np.ones(600), up.ravel()], 1)
    near = np.random.default_rng(0).uniform(-1, 1, (MIN_START_POINTS, 3))
    gaussians, _ = start(scene(np.concatenate([near, wall])))
    assert len(gaussians) == MIN_START_POINTS + 600
    found = gaussians.means[MIN_START_POINTS:].double().numpy()
    np.testing.assert_allclose(found, wall, rtol=1e-6, atol=1e-6 * distance)
    sizes = gaussians.log_scales[MIN_START_POINTS:].exp().double().numpy()
    spacing = distance * 0.6 / 29
    assert sizes.min() > 0.99 * spacing, "no holes between neighbours"
    assert sizes.max() < 1.8 * spacing, "at a corner two of three neighbours are next to it"
    camera = look_at((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), width=64, height=48, focal=64.0)
    alpha = render(gaussians.select(slice(MIN_START_POINTS, None)), camera, RenderOptions()).alpha
    # The wall covers the middle of the image as evenly as its opacity of 0.1 lets it.
    middle = alpha.detach().numpy()[18:30, 20:44]
    assert middle.min() > 0.3
    assert middle.max() - middle.min() < 0.05


@pytest.mark.parametrize("count", [1, 2, 3])
def test_very_few_points_and_coincident_ones(count: int) -> None:
    gaussians, _ = start(scene(np.zeros((count, 3))), cap=count)
    assert len(gaussians) == count
    assert all(torch.isfinite(t).all() for _, t in gaussians.tensors())


def test_no_view_is_refused() -> None:
    with pytest.raises(DatasetError):
        initial_gaussians(
            scene(np.zeros((5, 3))), [], lambda i: None, max_gaussians=9, sh_degree=0, seed=0
        )


def test_gaussians_lie_flat_across_normals() -> None:
    random = np.random.default_rng(4)
    normals = random.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:3] = [[0, 0, 1], [0, 0, -1], [1, 0, 0]]
    points, sizes = random.normal(size=(50, 3)), random.uniform(0.01, 2.0, 50)
    flatness, opacities = random.uniform(0.1, 1.0, 50), random.uniform(0.1, 0.9, 50)
    colors = random.uniform(size=(50, 3))
    made = gaussians_at(
        points, colors, sizes, 2, normals=normals, flatness=flatness, opacities=opacities
    )
    w, *vector = made.quats.numpy().astype(float).T
    turned = Rotation.from_quat(np.stack([*vector, w], 1)).as_matrix()
    assert turned[:, :, 2] == pytest.approx(normals, abs=1e-6)
    scales = np.exp(made.log_scales.numpy())
    assert scales[:, 0] == pytest.approx(sizes, rel=1e-5)
    assert scales[:, 1] == pytest.approx(sizes, rel=1e-5)
    assert scales[:, 2] == pytest.approx(sizes * flatness, rel=1e-5)
    assert torch.sigmoid(made.opacity_logits).numpy() == pytest.approx(opacities, abs=1e-5)
    assert made.means.numpy() == pytest.approx(points, abs=1e-6)
    assert 0.5 + SH_C0 * made.sh[:, 0].numpy() == pytest.approx(colors, abs=1e-6)
    assert made.sh.shape == (50, 9, 3)
    assert not made.orientation.any()


def test_without_normals_gaussians_are_round_and_there_may_be_none() -> None:
    made = gaussians_at(np.ones((3, 3)), np.zeros((3, 3)), np.full(3, 0.5), 0)
    assert made.quats.tolist() == [[1, 0, 0, 0]] * 3
    assert np.exp(made.log_scales.numpy()) == pytest.approx(0.5)
    assert torch.sigmoid(made.opacity_logits).numpy() == pytest.approx(0.1, abs=1e-6)
    nothing = gaussians_at(
        np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), 1, normals=np.zeros((0, 3)), flatness=0.1
    )
    assert len(nothing) == 0
    assert nothing.sh.shape == (0, 4, 3)


def test_filter_is_its_definition_for_any_thread_count() -> None:
    cameras = [
        look_at((4.0, 0.0, 0.5), focal=60.0),
        look_at((-1.5, 2.0, 1.0), focal=45.0),
        look_at((0.3, 0.1, 0.2), (2.0, 1.0, 0.0), focal=30.0),
    ]
    means = np.random.default_rng(0).uniform(-2, 2, (400, 3))
    depths = np.full(400, math.inf)
    for camera in cameras:
        pixels, depth = camera.project(means)
        inside = depth > NEAR_Z
        for axis, size in ((0, camera.width), (1, camera.height)):
            inside &= (pixels[:, axis] >= -0.15 * size) & (pixels[:, axis] <= 1.15 * size)
        depths[inside] = np.minimum(depths[inside], depth[inside])
    seen = np.isfinite(depths)
    assert 0 < seen.sum() < 400
    depths[~seen] = depths[seen].max()
    wanted = depths / (1.03 * 60.0) * math.sqrt(0.05)
    for threads in (1, 4):
        assert np.abs(mip_filter(means, cameras, threads=threads) - wanted).max() < 1e-12


def test_filter_scales_with_the_image_and_the_scene() -> None:
    camera = look_at((4.0, 0.0, 0.5))
    means = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3))
    full = mip_filter(means, [camera])
    half = mip_filter(means, [camera.resized(camera.width // 2, camera.height // 2)])
    assert np.abs(half / full - 2.0).max() < 1e-9


def test_nothing_seen_or_nothing_there() -> None:
    camera = look_at((4.0, 0.0, 0.5))
    behind = mip_filter(np.array([[100.0, 0.0, 0.0]]), [camera])
    assert behind.shape == (1,)
    assert 0 < behind[0] < 1
    assert mip_filter(np.zeros((0, 3)), [camera]).shape == (0,)
    assert mip_filter(np.zeros((2, 3)), []).tolist() == [0.0, 0.0]


# -- Opacity without the photos' blur -------------------------------------------------------------

PIXEL, FILTER_PX2, BLUR_PX2 = 0.02, 0.05, 0.25


def learnt(own_px: list[tuple[float, float, float]], opacity: list[float]) -> OrientedGaussians:
    """Return Gaussians as photos with blur show them: widths in pixels and opacities are their own.

    A photo keeps the integral of the opacity across what it shows.
    """
    own = np.array(own_px)
    wide = np.sqrt(own**2 + BLUR_PX2)  # (n, 3)
    across = np.sort(own / wide, axis=1)[:, 1]
    shown = np.array(opacity) * across
    count = len(own)
    filter_sq = FILTER_PX2 * PIXEL**2
    raw = np.sqrt((PIXEL * wide) ** 2 - filter_sq)
    log_loss = np.log(raw / (PIXEL * wide)).sum(1)
    trained = shown / np.exp(log_loss)
    assert (trained < 1).all()
    return OrientedGaussians(
        means=torch.zeros(count, 3), log_scales=torch.from_numpy(np.log(raw)).float(),
        quats=torch.tensor([[0.7, 0.1, -0.2, 0.5]]).repeat(count, 1),
        opacity_logits=torch.from_numpy(np.log(trained / (1 - trained))).float(),
        sh=torch.zeros(count, 1, 3), orientation=torch.zeros(count, 4),
        filter_3d=torch.full((count,), math.sqrt(filter_sq)),
    )  # fmt: skip


def test_rods_get_back_the_opacity_that_blur_took() -> None:
    """A rod of any orientation of its axes, a thinner one, a dot."""
    own = [(0.9, 0.9, 20.0), (20.0, 0.5, 0.5), (0.6, 0.6, 0.6)]
    opacity = [0.9, 0.8, 0.7]
    gaussians = learnt(own, opacity)
    sharp = without_blur(gaussians, BLUR_PX2, FILTER_PX2)
    assert sharp.opacity_logits.dtype == torch.float32
    assert (torch.exp(gaussians.log_opacities()).numpy() < np.array(opacity) - 0.05).all()
    assert torch.exp(sharp.log_opacities()).numpy() == pytest.approx(opacity, abs=1e-4)
    assert sharp.scales().numpy() == pytest.approx(gaussians.scales().numpy(), rel=1e-5)
    for name in ("means", "quats", "sh", "orientation"):
        assert torch.equal(getattr(sharp, name), getattr(gaussians, name))


def test_surfaces_keep_their_opacity_and_none_is_lost_or_becomes_solid() -> None:
    gaussians = learnt([(5.0, 8.0, 0.1), (0.2, 0.2, 9.0), (4.0, 4.0, 4.0)], [0.6, 0.95, 0.99])
    before = torch.exp(gaussians.log_opacities()).numpy()
    after = torch.exp(without_blur(gaussians, BLUR_PX2, FILTER_PX2).log_opacities()).numpy()
    assert after[0] == pytest.approx(before[0], rel=0.01)
    assert before[1] < 0.4
    assert after[1] == pytest.approx(0.95, abs=1e-4)  # its width is .37 of what is shown
    twice = without_blur(gaussians, 10.0 * BLUR_PX2, FILTER_PX2)
    assert torch.exp(twice.log_opacities()).max() == pytest.approx(0.99, abs=1e-6)
    faint = gaussians.replaced(opacity_logits=torch.full((3,), -6.0))
    rise = without_blur(faint, 1000.0, FILTER_PX2).log_opacities() - faint.log_opacities()
    assert rise.numpy() == pytest.approx(math.log(1 / 0.3), abs=1e-4)
    solid = gaussians.replaced(opacity_logits=torch.full((3,), 12.0))
    kept = without_blur(solid.baked().mapped(torch.Tensor.float), BLUR_PX2, FILTER_PX2)
    assert (kept.log_opacities() >= solid.log_opacities() - 1e-6).all()


@pytest.mark.parametrize(("blur", "filtered"), [(0.0, FILTER_PX2), (BLUR_PX2, 0.0)])
def test_without_blur_or_the_size_of_pixels_nothing_changes(blur: float, filtered: float) -> None:
    gaussians = learnt([(0.5, 0.5, 9.0)], [0.8])
    assert without_blur(gaussians, blur, filtered) is gaussians


def test_baked_gaussians_are_the_same_without_a_filter() -> None:
    gaussians = learnt([(0.5, 0.7, 9.0), (3.0, 2.0, 0.1)], [0.8, 0.5])
    baked, before = gaussians.baked().arrays(), gaussians.arrays()
    assert not gaussians.baked().filter_3d.any()
    for name in ("means", "scales", "rotations", "log_opacities", "normals"):
        assert np.allclose(getattr(baked, name), getattr(before, name), rtol=1e-9, atol=1e-12)
