# SPDX-License-Identifier: GPL-3.0-or-later
"""Gradient with respect to a camera's pose: its algebra exactly, and against renderings."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import (
    ImageGradients,
    RenderOptions,
    VisibleGradients,
)
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.camera_poses import pose_gradient
from tests.core.training.small_scene import ring_cameras, sphere_gaussians

OPTIONS = RenderOptions(depth=False, threads=1)


def times(rotation: Rotation, quats: np.ndarray) -> np.ndarray:
    """Return (n, 4) quaternions (w, x, y, z) turned by a rotation; lengths stay."""
    x, y, z, w = rotation.as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return quats @ left.T


def test_motion_of_a_camera_is_that_of_all_gaussians_the_other_way() -> None:
    """A loss that is linear in means and quaternions: differences are exact."""
    random = np.random.default_rng(5)
    means, quats = (random.normal(size=(40, k)).astype(np.float32) for k in (3, 4))
    ids = np.sort(random.choice(40, 25, replace=False)).astype(np.int32)
    by_means, by_quats = (random.normal(size=(25, k)).astype(np.float32) for k in (3, 4))
    nothing = np.zeros((25, 4), np.float32)
    seen = VisibleGradients(
        ids, by_means, nothing[:, :3], by_quats, nothing[:, 0], nothing[:, None, :3], nothing
    )
    turn = Rotation.from_rotvec([0.3, -0.8, 0.4])
    pose = np.concatenate([turn.as_matrix(), [[0.2], [-0.5], [3.0]]], 1)

    def value(motion: np.ndarray) -> float:
        step = Rotation.from_rotvec(motion[:3])
        local = means[ids] @ pose[:, :3].T + pose[:, 3]
        local = step.apply(local) + motion[3:]
        world = (local - pose[:, 3]) @ pose[:, :3]
        turned = times(turn.inv() * step * turn, quats[ids].astype(np.float64))
        return float((by_means * world).sum() + (by_quats * turned).sum())

    found = pose_gradient(pose, seen, means, quats)
    slopes = [(value(1e-6 * axis) - value(-1e-6 * axis)) / 2e-6 for axis in np.eye(6)]
    assert found == pytest.approx(slopes, rel=1e-5, abs=1e-5)


def moved(camera: Camera, motion: np.ndarray) -> Camera:
    pose = Rotation.from_rotvec(motion[:3]).as_matrix() @ camera.cam_from_world
    pose[:, 3] += motion[3:]
    return dataclasses.replace(camera, cam_from_world=pose)


@pytest.mark.parametrize("view", [0, 3])
def test_gradient_is_that_of_the_rendering(view: int) -> None:
    """But for what enters and leaves footprints at their edges, which gradients do not see."""
    gaussians = RawArrays.from_gaussians(sphere_gaussians(400, opacity=0.7))
    camera, renderer = ring_cameras(5, 64)[view], ViewRenderer()
    rows, columns = np.mgrid[:64, :64] / 64.0
    weights = np.stack([np.sin(9 * rows), np.cos(7 * columns), rows * columns], 2)
    weights = weights.astype(np.float32)

    def value(motion: np.ndarray) -> float:
        color = renderer.render(gaussians, moved(camera, motion), OPTIONS).color
        return float((weights.astype(np.float64) * color).sum())

    seen = renderer.render(gaussians, camera, OPTIONS).backward(ImageGradients(color=weights))
    found = pose_gradient(camera.cam_from_world, seen, gaussians.means, gaussians.quats)
    slopes = np.array([(value(2e-3 * axis) - value(-2e-3 * axis)) / 4e-3 for axis in np.eye(6)])
    assert np.linalg.norm(found[:3] - slopes[:3]) < 0.06 * np.linalg.norm(slopes[:3])
    assert np.linalg.norm(found[3:] - slopes[3:]) < 0.1 * np.linalg.norm(slopes[3:])
