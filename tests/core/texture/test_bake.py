# SPDX-License-Identifier: GPL-3.0-or-later
"""Texturing from renderings of the Gaussians; low-frequency corrections; rasters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from gaussian_wrapping_addon.core.filters import pyramid
from gaussian_wrapping_addon.core.mesh.depth_buffer import NEAR_DEPTH, depth_buffer
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.atlas import AtlasRaster, raster_atlas, texel_corners
from gaussian_wrapping_addon.core.texture.atlas_colors import GaussianPhotos
from gaussian_wrapping_addon.core.texture.bake import (
    GRID,
    MAX_LOG_CORRECTION,
    solve_low_frequency_correction,
)
from gaussian_wrapping_addon.core.texture.photo_samples import MAX_CLEARANCE_PX, photo_visibility
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh
from tests.core.texture.test_texture_mesh import texels
from tests.core.texture.texture_scenes import FakePhotos, box, joined, look_at, scene_of, sphere
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


PHOTOS, POINTS = 8, 6000


def samples(strength: float, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points at random places of photos, each photo with a gradient of its own."""
    random = np.random.default_rng(3)
    albedo = random.uniform(60.0, 150.0, (POINTS, 1, 3))
    image_positions = random.random((POINTS, PHOTOS, 2)).astype(np.float32)
    slopes = random.normal(size=(PHOTOS, 2))
    slopes -= slopes.mean(axis=0)
    logs = strength * ((image_positions - 0.5) * slopes).sum(axis=2)
    colors = albedo * np.exp(logs + noise * random.normal(size=logs.shape))[..., None]
    valid = random.random((POINTS, PHOTOS)) < 0.4
    return np.rint(colors.clip(0, 255)).astype(np.uint8), valid, image_positions


def corrected_spread(
    colors: np.ndarray, valid: np.ndarray, image_positions: np.ndarray, corrections: np.ndarray
) -> float:
    """Spread of the log colours of a point over the photos that see it."""
    node = np.rint(image_positions * [GRID[1] - 1, GRID[0] - 1]).astype(int)
    factor = corrections[np.arange(PHOTOS)[None], node[..., 1], node[..., 0]]
    logs = np.where(valid[..., None], np.log(np.maximum(colors * factor, 1.0)), np.nan)
    several = valid.sum(axis=1) >= 3
    return float(np.nanstd(logs[several], axis=1).mean())


def corrected(colors: np.ndarray, valid: np.ndarray, image_positions: np.ndarray) -> tuple:
    return solve_low_frequency_correction(colors, valid, image_positions, np.ones((PHOTOS, 3)))


def test_gradients_within_photos_are_evened() -> None:
    sampled = samples(0.2)
    corrections, spread = corrected(*sampled)
    assert corrections.shape == (PHOTOS, *GRID, 3)
    assert spread > 0.03
    before = corrected_spread(*sampled, np.ones_like(corrections))
    assert corrected_spread(*sampled, corrections) < 0.3 * before


def test_a_moving_thing_is_no_brightness() -> None:
    colors, valid, image_positions = samples(0.0)
    passer = ((image_positions[:, 0] - 0.5) ** 2).sum(axis=1) < 0.02
    colors[passer, 0] = 250
    valid[passer, 0] = True
    corrections, _ = corrected(colors, valid, image_positions)
    assert np.abs(np.log(corrections)).max() <= MAX_LOG_CORRECTION
    outside = corrections[0, 0] if corrections.shape[1] > 1 else corrections[0]
    assert np.abs(np.log(outside)).max() < 0.05


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_even_photos_are_left_alone(noise: float) -> None:
    corrections, spread = corrected(*samples(0.0, noise))
    assert (corrections == 1.0).all()
    assert spread < 0.008


def test_points_that_one_photo_sees_say_nothing() -> None:
    colors, valid, image_positions = samples(0.3)
    corrections, spread = corrected(colors, valid & (np.arange(PHOTOS) == 0), image_positions)
    assert (corrections == 1.0).all()
    assert spread == 0.0


SQUARE = np.array(
    [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float32
)  # two triangles, v upwards


def test_a_square_owns_every_texel_once_and_overlaps_are_counted() -> None:
    raster = raster_atlas(SQUARE, 64, 2)
    assert raster.inside.all()
    assert raster.overlaps == 0
    rows, columns = np.mgrid[0:64, 0:64] + 0.5
    assert (raster.face[columns > 64 - rows] == 0).all()  # v < u, strictly
    assert (raster.face[columns < 64 - rows] == 1).all()
    double = np.concatenate([SQUARE, SQUARE[:1] * 0.5 + 0.25])
    expected = 0.5 * 32 * 32
    assert 0.8 * expected < raster_atlas(double, 64, 2).overlaps < 1.2 * expected


def places_of(raster: AtlasRaster, corners: np.ndarray, chosen: np.ndarray) -> tuple:
    """The weights of texels in the one face, and how far from their centres these lead."""
    rows, columns = np.nonzero(chosen)
    bary = raster.bary[rows, columns].astype(float)
    weights = np.concatenate([bary, 1 - bary.sum(1, keepdims=True)], 1)
    places = weights @ texel_corners(corners, len(chosen))[0]
    return weights, places - np.stack([columns + 0.5, rows + 0.5], 1)


def test_bary_leads_back_to_the_texel_or_to_the_border_beside_it() -> None:
    corners = np.random.default_rng(0).uniform(0.1, 0.9, (1, 3, 2)).astype(np.float32)
    raster = raster_atlas(corners, 128, 1)
    weights, away = places_of(raster, corners, raster.inside)
    assert len(away) > 50
    assert np.abs(away).max() < 1e-4
    corners = np.array([[[0.3, 0.3], [0.7, 0.3], [0.3, 0.7]]], np.float32)
    raster = raster_atlas(corners, 50, 2)
    weights, away = places_of(raster, corners, (raster.face >= 0) & ~raster.inside)
    assert (np.abs(weights).min(axis=1) < 1e-6).all()
    assert weights.min() > -1e-6
    assert 0.0 < np.linalg.norm(away, axis=1).max() <= 0.75


def test_a_needle_without_texel_centre_still_owns_texels() -> None:
    needle = np.array([[[0.101, 0.5], [0.9, 0.5], [0.9, 0.5002]]], np.float32)
    raster = raster_atlas(needle, 64, 1)
    assert (raster.face >= 0).sum() >= 50


def test_rasters_do_not_depend_on_threads() -> None:
    corners = np.random.default_rng(3).uniform(0, 1, (60, 3, 2)).astype(np.float32)
    one, many = raster_atlas(corners, 96, 1), raster_atlas(corners, 96, 5)
    assert (one.face == many.face).all()
    assert (one.bary == many.bary).all()
    assert one.overlaps == many.overlaps
    mesh, camera = sphere(3), look_at((3, 1, 1))
    first = depth_buffer(mesh.vertices, mesh.faces, camera, threads=1)
    second = depth_buffer(mesh.vertices, mesh.faces, camera, threads=5)
    assert (first.depth == second.depth).all()
    assert (first.face == second.face).all()


CAMERAS = {
    "outside": look_at((3.0, 1.0, 1.5)),
    "oblique": look_at((0.3, 2.5, -2.0), (0.2, 0, 0), width=151, height=97),
    "inside the box, faces behind the camera": look_at((0.1, 0.2, -0.1), (1.0, 0.3, 0.2)),
    "wide": look_at((0.2, -0.3, 0.1), (-1.0, 0.5, 0.3), focal=40.0),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_depth_agrees_with_ray_casting(name: str) -> None:
    camera: Camera = CAMERAS[name]
    ball = sphere(2, 0.5)
    mesh = joined(
        SurfaceMesh(ball.vertices + np.array([0.9, 0.4, 0.3]), ball.faces),
        box([-2, -2, -2], [2, 2, 2], 1),
    )
    buffer = depth_buffer(mesh.vertices, mesh.faces, camera, threads=2)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    rays = (camera.rays() @ camera.rotation).reshape(-1, 3)
    starts = camera.center + NEAR_DEPTH * rays
    caster = trimesh.ray.ray_triangle.RayMeshIntersector(shape)
    chosen = np.random.default_rng(0).choice(len(rays), 600, replace=False)
    places, ray, _ = caster.intersects_location(starts[chosen], rays[chosen], multiple_hits=True)
    depth = np.full(len(chosen), np.inf)
    np.minimum.at(depth, ray, camera.to_camera(places)[:, 2])
    got = buffer.depth.ravel()[chosen]
    assert (np.isfinite(got) == np.isfinite(depth)).mean() > 0.995
    both = np.isfinite(got) & np.isfinite(depth)
    assert both.sum() > 100
    close = np.abs(got[both] - depth[both]) < 1e-5 * depth[both]
    assert close.mean() > 0.99


def test_clearance_is_the_distance_to_silhouettes() -> None:
    wall = box([-9, 2, -9], [9, 2.5, 9], 0)
    plate = box([-0.5, 0.0, -0.5], [0.5, 0.01, 0.5], 0)
    mesh = joined(wall, plate)
    camera = look_at((0, -3, 0))
    _, clearance = photo_visibility(mesh.vertices, mesh.faces, camera, 1)
    left_edge = camera.cx - 0.5 * camera.fx / 3.0
    row = camera.height // 2
    for column in range(60, 100):
        expected = min(abs(column + 0.5 - left_edge), MAX_CLEARANCE_PX)
        assert abs(float(clearance[row, column]) - expected) <= 1.01


def test_pyramid_halves_exactly() -> None:
    image = np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)
    made = pyramid(image)
    begin, width, height = made.levels[1].tolist()
    assert (width, height) == (27, 19)
    level = made.pixels[begin : begin + width * height].reshape(height, width, 3)
    mean = image[:36, :52].reshape(18, 2, 26, 2, 3).mean(axis=(1, 3))
    assert np.abs(level[:18, :26] - mean).max() <= 0.5
