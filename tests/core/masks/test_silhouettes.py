# SPDX-License-Identifier: GPL-3.0-or-later
"""Silhouettes against those of analytic bodies; holes stay open, what stands in front hides."""

from __future__ import annotations

import math

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.masks.making import silhouettes
from gaussian_wrapping_addon.core.masks.segmentation import THRESHOLD, cleaned
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.scenes import look_at
from tests.core.training.small_scene import sphere_gaussians

SIZE = 120
THICKNESS = 0.002


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera's centre and the unit directions (h, w, 3) of its pixels, scene frame."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    local = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1)
    world = local @ camera.cam_from_world[:, :3]
    return camera.center, world / np.linalg.norm(world, axis=-1, keepdims=True)


def sphere_seen(camera: Camera, middle: np.ndarray, radius: float) -> np.ndarray:
    center, directions = rays(camera)
    along = directions @ (middle - center)
    squared = ((middle - center) ** 2).sum() - along**2
    return (squared < radius**2) & (along > 0)


def thin_sphere(count: int) -> OrientedGaussians:
    """Return a sphere whose silhouette is that of its radius: Gaussians thinner than a pixel."""
    sphere = sphere_gaussians(count)
    scales = sphere.log_scales.clone()
    scales[:, 2] = math.log(THICKNESS)
    return sphere.replaced(log_scales=scales)


def moved(gaussians: OrientedGaussians, offset: tuple[float, float, float]) -> OrientedGaussians:
    return gaussians.replaced(means=gaussians.means + torch.tensor(offset))


def shares_of(gaussians: OrientedGaussians, inside: np.ndarray, camera: Camera) -> np.ndarray:
    (share,) = silhouettes(gaussians, inside, [camera], ViewRenderer(), threads=1)
    assert share.shape == (camera.height, camera.width)
    assert share.min() >= 0.0
    assert share.max() <= 1.0
    return share


def test_a_sphere_beside_another_has_its_own_silhouette() -> None:
    count = 2500
    two = thin_sphere(count).joined(moved(thin_sphere(count), (0.0, 3.0, 0.0)))
    inside = np.arange(2 * count) < count
    for angle in (0.0, 1.0, 2.2):
        eye = (8.0 * math.cos(angle), 8.0 * math.sin(angle), 2.0)
        camera = look_at(eye, width=SIZE, height=SIZE, focal=2.0 * SIZE)
        share = shares_of(two, inside, camera)
        # In front of it, the other sphere hides it; none of these views has it behind.
        truth = sphere_seen(camera, np.zeros(3), 1.0)
        assert overlap(share >= THRESHOLD, truth) >= 0.97
        whole = cleaned(share, (4 * SIZE, 4 * SIZE))
        finer = look_at(eye, width=4 * SIZE, height=4 * SIZE, focal=8.0 * SIZE)
        assert overlap(whole, sphere_seen(finer, np.zeros(3), 1.0)) >= 0.97


def test_what_stands_in_front_takes_its_part_away() -> None:
    count = 2500
    two = thin_sphere(count).joined(moved(thin_sphere(count), (0.9, 3.0, 0.0)))
    inside = np.arange(2 * count) < count
    camera = look_at((0.0, 9.0, 0.0), width=SIZE, height=SIZE, focal=2.0 * SIZE)
    mask = shares_of(two, inside, camera) >= THRESHOLD
    before = sphere_seen(camera, np.array([0.9, 3.0, 0.0]), 1.0)
    alone = sphere_seen(camera, np.zeros(3), 1.0)
    assert 0.3 < before[alone].mean() < 0.7
    assert overlap(mask, alone & ~before) >= 0.9


def torus_gaussians(around: int = 160, across: int = 48, thick: float = 0.3) -> OrientedGaussians:
    """Return flat Gaussians on a torus about z with radii 1 and ``thick``."""
    u, v = np.meshgrid(
        np.arange(around) * 2 * math.pi / around, np.arange(across) * 2 * math.pi / across
    )
    u, v = u.ravel(), v.ravel()
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], 1)
    means = np.stack([np.cos(u), np.sin(u), 0 * u], 1) + thick * normals
    quats = np.stack([1.0 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * u], 1)
    quats[np.linalg.norm(quats, axis=1) < 1e-6] = (0.0, 1.0, 0.0, 0.0)
    size = 0.6 * 2 * math.pi * (1 + thick) / around
    values = {
        "means": means,
        "log_scales": np.log(np.tile([size, size, THICKNESS], (len(u), 1))),
        "quats": quats,
        "opacity_logits": np.full(len(u), 3.0),
        "sh": np.zeros((len(u), 4, 3)),
        "orientation": np.zeros((len(u), 4)),
        "filter_3d": np.zeros(len(u)),
    }
    return OrientedGaussians(
        **{k: torch.from_numpy(v.astype(np.float32)) for k, v in values.items()}
    )


def test_the_hole_of_a_torus_stays_open() -> None:
    torus = torus_gaussians()
    camera = look_at((0.5, 0.0, 6.0), width=SIZE, height=SIZE, focal=2.0 * SIZE)
    share = shares_of(torus, np.ones(len(torus), bool), camera)
    mask = cleaned(share, (SIZE, SIZE))
    center, directions = rays(camera)
    seen = np.zeros((SIZE, SIZE), bool)
    for step in np.linspace(4.0, 8.0, 400):  # the ray passes through the solid
        points = center + step * directions
        ring = np.hypot(points[..., 0], points[..., 1]) - 1.0
        seen |= np.hypot(ring, points[..., 2]) < 0.3
    assert overlap(mask, seen) >= 0.97
    middle = SIZE // 2
    hole = sphere_seen(camera, np.zeros(3), 0.5)
    assert hole.sum() > 300
    assert not mask[hole].any()
    assert not mask[middle - 3 : middle + 3, middle - 3 : middle + 3].any()
