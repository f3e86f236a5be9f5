# SPDX-License-Identifier: GPL-3.0-or-later
"""Training from a splat: transforms, 3D filter, cap, check against photos, orientation."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.loading.other_inputs import fibonacci_directions
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.reference import render_reference
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity, rotation_from_quaternion
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.splat_start import (
    FILTER_MULTIPLE,
    baked,
    fit_filter,
    start_from_splat,
    transform_gaussians,
    with_degree,
)
from gaussian_wrapping_addon.core.training.wrapping import voted_orientation
from tests.core.gaussians.splat_files import splat_columns, write_ply
from tests.core.render.scenes import look_at, random_gaussians
from tests.core.training.splat_shells import AXES, shell_of_discs

TURN = rotation_from_quaternion(np.array([0.3, -0.8, 0.5, 0.2]))
WORLD_FROM_SCENE = Similarity(3.7, TURN, np.array([4.0, -11.0, 2.5]))
SETTINGS = TrainingSettings(sh_degree=2, max_gaussians=10_000)


class Pictures:
    """Photos held in memory."""

    def __init__(self, cameras: list[Camera], photos: list[np.ndarray]) -> None:
        self.cameras, self.photos = cameras, photos

    def camera(self, index: int, divisor: int = 1) -> Camera:
        camera = self.cameras[index]
        return camera.resized(camera.width // divisor, camera.height // divisor)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        return self.photos[index][::divisor, ::divisor]

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        return None


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_moved_gaussians_look_the_same_from_the_moved_camera(degree: int) -> None:
    gaussians = random_gaussians(25, 4, sh_degree=degree, filter_size=0.02)
    camera = look_at((2.0, -3.0, 1.0))
    near = RenderOptions(near_z=0.1)
    before = render_reference(gaussians, camera, near)
    moved = transform_gaussians(gaussians, WORLD_FROM_SCENE)
    after = render_reference(
        moved, camera.moved(WORLD_FROM_SCENE), replace(near, near_z=0.1 * WORLD_FROM_SCENE.scale)
    )
    assert float(before.alpha.max()) > 0.5
    assert float((after.color - before.color).abs().max()) < 1e-9
    assert float((after.alpha - before.alpha).abs().max()) < 1e-9
    depth = after.depth / WORLD_FROM_SCENE.scale
    assert float((depth - before.depth).abs().max()) < 1e-7
    turned = before.normal @ torch.from_numpy(TURN).T
    assert float((after.normal - turned).abs().max()) < 1e-9


def test_moving_forth_and_back_gives_the_same_gaussians() -> None:
    gaussians = random_gaussians(10, 4, sh_degree=3)
    back = transform_gaussians(
        transform_gaussians(gaussians, WORLD_FROM_SCENE), WORLD_FROM_SCENE.inverse()
    )
    for name, tensor in gaussians.tensors():
        np.testing.assert_allclose(getattr(back, name), tensor, atol=1e-10, err_msg=name)


def test_a_degree_is_cut_or_filled_up() -> None:
    gaussians = random_gaussians(5, 1, sh_degree=2)
    assert torch.equal(with_degree(gaussians, 1).sh, gaussians.sh[:, :4])
    filled = with_degree(gaussians, 3).sh
    assert torch.equal(filled[:, :9], gaussians.sh)
    assert not filled[:, 9:].any()


def test_the_filter_is_fitted_exactly_where_it_can_be() -> None:
    cameras = [look_at((0.0, -4.0, 0.5), focal=400.0, width=300, height=200)]
    gaussians = random_gaussians(50, 2, scale=(0.1, 0.3), opacity=(0.05, 0.9), filter_size=0.0)
    fitted = fit_filter(gaussians, cameras, threads=1)
    assert float(fitted.filter_3d.min()) > 0
    np.testing.assert_allclose(fitted.scales(), gaussians.scales(), rtol=1e-5)
    np.testing.assert_allclose(fitted.log_opacities(), gaussians.log_opacities(), atol=1e-5)
    thin = gaussians.replaced(log_scales=gaussians.log_scales - torch.tensor([0.0, 0.0, 12.0]))
    scales = fit_filter(thin, cameras, threads=1).scales()
    least = FILTER_MULTIPLE * fitted.filter_3d
    np.testing.assert_allclose(scales[:, 2], least, rtol=1e-5)
    np.testing.assert_allclose(scales[:, :2], thin.scales()[:, :2], rtol=1e-5)
    opacity = fit_filter(thin, cameras, threads=1).log_opacities()
    low = gaussians.log_opacities() < math.log(0.8)
    np.testing.assert_allclose(opacity[low], gaussians.log_opacities()[low], atol=1e-4)


def test_a_baked_filter_changes_no_picture() -> None:
    gaussians = random_gaussians(20, 2, filter_size=0.1)
    camera = look_at((2.0, -3.0, 1.0))
    bare = baked(gaussians)
    assert not bare.filter_3d.any()
    options = RenderOptions()
    before = render_reference(gaussians, camera, options)
    after = render_reference(bare, camera, options)
    assert float((after.color - before.color).abs().max()) < 1e-9


def test_the_vote_turns_a_shell_of_discs_outwards() -> None:
    shell, normals = shell_of_discs(1500)
    cameras = [look_at(tuple(4.0 * d)) for d in fibonacci_directions(12)]
    voted = voted_orientation(shell, cameras, threads=1)
    seen = voted[:, 3] != 0
    assert seen.mean() > 0.95
    outwards = (voted[:, :3] * normals).sum(1) * np.sign(voted[:, 3])
    assert (outwards[seen] > 0.999).mean() > 0.99


def _scene(shell: OrientedGaussians) -> tuple[Scene, Pictures]:
    """Return a scene whose photos show a shell that stands in the scene frame."""
    cameras = [
        look_at(tuple(4.0 * d), width=96, height=96, focal=110.0, name=f"{i}")
        for i, d in enumerate(fibonacci_directions(9))
    ]
    options = RenderOptions(depth=False, threads=1)
    photos = [
        (255 * render(shell, camera, options).color.numpy().clip(0, 1)).round().astype(np.uint8)
        for camera in cameras
    ]
    views = tuple(View(camera, Path(f"{camera.name}.png")) for camera in cameras)
    none = np.zeros((0, 3))
    scene = Scene(views, none, none.astype(np.uint8), WORLD_FROM_SCENE)
    return scene, Pictures(cameras, photos)


def test_a_splat_in_the_world_frame_starts_in_the_scene_frame(tmp_path: Path) -> None:
    shell, normals = shell_of_discs(800, sh_degree=3)
    scene, photos = _scene(with_degree(shell, 2))
    world = transform_gaussians(shell, WORLD_FROM_SCENE)
    columns = splat_columns(world)
    path = write_ply(tmp_path / "a.ply", columns, kinds=dict.fromkeys(columns, "f8"))
    gaussians, _ = start_from_splat(path, scene, photos, range(9), SETTINGS, Progress(), threads=1)
    assert gaussians.sh.shape[1] == 9
    np.testing.assert_allclose(gaussians.means, shell.means, atol=1e-5)
    np.testing.assert_allclose(gaussians.sh, shell.sh[:, :9], atol=1e-5)
    assert len(gaussians) == 800
    outwards = (gaussians.normals().numpy() * normals).sum(1)
    assert (outwards > 0).mean() > 0.95
    few = replace(SETTINGS, max_gaussians=300)
    capped, warnings = start_from_splat(path, scene, photos, range(9), few, Progress(), threads=1)
    assert len(capped) == 300
    assert any("800" in warning.text for warning in warnings)


def test_the_cap_keeps_what_photos_show(tmp_path: Path) -> None:
    shell, _ = shell_of_discs(400)
    scene, photos = _scene(shell)
    world = transform_gaussians(shell, WORLD_FROM_SCENE)
    inside = transform_gaussians(
        shell.replaced(means=0.3 * shell.means, log_scales=shell.log_scales - 2.0),
        WORLD_FROM_SCENE,
    )
    both = {
        k: np.concatenate([splat_columns(inside)[k], v]) for k, v in splat_columns(world).items()
    }
    path = write_ply(tmp_path / "a.ply", both)
    few = replace(SETTINGS, max_gaussians=400)
    started, _ = start_from_splat(path, scene, photos, range(9), few, Progress(), threads=1)
    level = np.linalg.norm(started.means.numpy() / np.array(AXES), axis=1)
    assert (level > 0.9).mean() > 0.97


def test_a_splat_in_another_frame_is_refused(tmp_path: Path) -> None:
    shell, _ = shell_of_discs(400)
    scene, photos = _scene(shell)
    path = write_ply(tmp_path / "a.ply", splat_columns(shell))  # scene frame, not the world's
    with pytest.raises(DatasetError, match="does not match") as caught:
        start_from_splat(path, scene, photos, range(9), SETTINGS, Progress(), threads=1)
    assert "camera poses" in caught.value.hint


@pytest.mark.parametrize("where", [1e30, 1e300])
def test_gaussians_out_of_reach_are_left_out(tmp_path: Path, where: float) -> None:
    shell, _ = shell_of_discs(400)
    scene, photos = _scene(shell)
    columns = splat_columns(transform_gaussians(shell, WORLD_FROM_SCENE))
    columns["x"] = columns["x"].astype(np.float64)
    columns["x"][0] = where
    path = write_ply(tmp_path / "a.ply", columns, kinds=dict.fromkeys(columns, "f8"))
    started, warnings = start_from_splat(
        path, scene, photos, range(9), SETTINGS, Progress(), threads=1
    )
    assert len(started) == 399
    assert all(bool(tensor.isfinite().all()) for _, tensor in started.tensors())
    (warning,) = [w for w in warnings if w.code == "gaussians-far-away"]
    assert warning.text.startswith("1 of 400 Gaussians of the splat were left out")


def test_a_splat_that_is_far_away_altogether_is_refused(tmp_path: Path) -> None:
    shell, _ = shell_of_discs(50)
    scene, photos = _scene(shell)
    columns = splat_columns(transform_gaussians(shell, WORLD_FROM_SCENE))
    columns["x"] = columns["x"] + 1e20
    path = write_ply(tmp_path / "a.ply", columns)
    with pytest.raises(DatasetError, match="far away from the cameras"):
        start_from_splat(path, scene, photos, range(9), SETTINGS, Progress(), threads=1)
