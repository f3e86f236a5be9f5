# SPDX-License-Identifier: GPL-3.0-or-later
"""Texturing from renderings of the Gaussians: diffuse colour, limited to covered pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.atlas_colors import GaussianPhotos
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh
from tests.core.texture.test_texture_mesh import texels
from tests.core.texture.texture_scenes import FakePhotos, scene_of, sphere
from tests.core.training.small_scene import RADIUS, ring_cameras, sphere_gaussians, surface_color


@pytest.fixture
def photos() -> FakePhotos:
    """Photos of noise: none of it may be used."""
    random = np.random.default_rng(0)
    cameras = ring_cameras(8, 96)
    return FakePhotos(cameras, [random.integers(0, 255, (96, 96, 3), np.uint8) for _ in cameras])


def test_the_texture_has_the_gaussians_colour(photos: FakePhotos, tmp_path: Path) -> None:
    source = GaussianPhotos(sphere_gaussians(800), photos, threads=1)
    mesh = sphere(3, RADIUS)
    textured = texture_mesh(
        mesh, scene_of(photos), source, TextureSettings(128), tmp_path, Progress(), threads=1
    )
    positions, colors, _ = texels(textured)
    wanted = 255.0 * surface_color(positions / np.linalg.norm(positions, axis=1, keepdims=True))
    assert textured.statistics["coverage"] > 0.6
    assert np.median(np.abs(colors - wanted)) < 12.0


def test_what_changes_with_the_direction_is_left_out(photos: FakePhotos) -> None:
    plain = sphere_gaussians()
    rest = 0.3 * torch.randn(len(plain), 3, 3, generator=torch.Generator().manual_seed(1))
    shiny = plain.replaced(sh=torch.cat([plain.sh, rest], dim=1))
    one = GaussianPhotos(plain, photos, threads=1)
    other = GaussianPhotos(shiny, photos, threads=1)
    for index, divisor in ((0, 1), (3, 1), (3, 2)):
        assert one.photo(index, divisor).shape == photos.photo(index, divisor).shape
        assert (one.photo(index, divisor) == other.photo(index, divisor)).all()


def test_only_what_the_gaussians_hide_counts(photos: FakePhotos) -> None:
    source = GaussianPhotos(sphere_gaussians(), photos, threads=1)
    mask = source.mask(2)
    assert mask[48, 48]
    assert not mask[0, 0]
    photos.masks = [np.zeros((96, 96), bool) for _ in photos.images]
    assert not source.mask(2).any()
