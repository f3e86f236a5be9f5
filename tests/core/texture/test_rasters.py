# SPDX-License-Identifier: GPL-3.0-or-later
"""Atlas and depth rasters against definitions and an independent ray caster."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.filters import pyramid
from gaussian_wrapping_addon.core.mesh.depth_buffer import NEAR_DEPTH, depth_buffer
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas, texel_corners
from gaussian_wrapping_addon.core.texture.photo_samples import MAX_CLEARANCE_PX, photo_visibility
from tests.core.texture.texture_scenes import box, joined, look_at, sphere

SQUARE = np.array(
    [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float32
)  # two triangles, v upwards


def test_a_square_owns_every_texel_once() -> None:
    raster = raster_atlas(SQUARE, 64, 2)
    assert raster.inside.all()
    assert raster.overlaps == 0
    rows, columns = np.mgrid[0:64, 0:64] + 0.5
    lower = columns > 64 - rows  # v < u, strictly
    assert (raster.face[lower] == 0).all()
    assert (raster.face[columns < 64 - rows] == 1).all()


def test_bary_leads_back_to_the_texel() -> None:
    corners = np.random.default_rng(0).uniform(0.1, 0.9, (1, 3, 2)).astype(np.float32)
    raster = raster_atlas(corners, 128, 1)
    rows, columns = np.nonzero(raster.inside)
    assert len(rows) > 50
    bary = raster.bary[rows, columns].astype(float)
    weights = np.concatenate([bary, 1 - bary.sum(1, keepdims=True)], 1)
    places = weights @ texel_corners(corners, 128)[0]
    assert np.abs(places - np.stack([columns + 0.5, rows + 0.5], 1)).max() < 1e-4


def test_touched_texels_surround_the_triangle_and_take_its_border() -> None:
    corners = np.array([[[0.3, 0.3], [0.7, 0.3], [0.3, 0.7]]], np.float32)
    raster = raster_atlas(corners, 50, 2)
    touched = (raster.face >= 0) & ~raster.inside
    assert touched.any()
    bary = raster.bary[touched].astype(float)
    weights = np.concatenate([bary, 1 - bary.sum(1, keepdims=True)], 1)
    assert (np.abs(weights).min(axis=1) < 1e-6).all()
    assert weights.min() > -1e-6
    rows, columns = np.nonzero(touched)
    places = weights @ texel_corners(corners, 50)[0]
    distance = np.linalg.norm(places - np.stack([columns + 0.5, rows + 0.5], 1), axis=1)
    assert distance.max() <= 0.75


def test_a_needle_without_texel_centre_still_owns_texels() -> None:
    needle = np.array([[[0.101, 0.5], [0.9, 0.5], [0.9, 0.5002]]], np.float32)
    raster = raster_atlas(needle, 64, 1)
    assert (raster.face >= 0).sum() >= 50


def test_overlaps_are_counted() -> None:
    double = np.concatenate([SQUARE, SQUARE[:1] * 0.5 + 0.25])
    raster = raster_atlas(double, 64, 2)
    expected = 0.5 * 32 * 32
    assert 0.8 * expected < raster.overlaps < 1.2 * expected


@pytest.mark.parametrize("threads", [2, 5])
def test_rasters_do_not_depend_on_threads(threads: int) -> None:
    corners = np.random.default_rng(3).uniform(0, 1, (60, 3, 2)).astype(np.float32)
    one, many = raster_atlas(corners, 96, 1), raster_atlas(corners, 96, threads)
    assert (one.face == many.face).all()
    assert (one.bary == many.bary).all()
    assert one.overlaps == many.overlaps
    mesh, camera = sphere(3), look_at((3, 1, 1))
    first = depth_buffer(mesh.vertices, mesh.faces, camera, threads=1)
    second = depth_buffer(mesh.vertices, mesh.faces, camera, threads=threads)
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
    seen = photo_visibility(mesh.vertices, mesh.faces, camera, 1)
    left_edge = camera.cx - 0.5 * camera.fx / 3.0
    row = camera.height // 2
    for column in range(60, 100):
        expected = min(abs(column + 0.5 - left_edge), MAX_CLEARANCE_PX)
        assert abs(float(seen.clearance[row, column]) - expected) <= 1.01


def test_pyramid_halves_exactly() -> None:
    image = np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)
    made = pyramid(image)
    begin, width, height = made.levels[1].tolist()
    assert (width, height) == (27, 19)
    level = made.pixels[begin : begin + width * height].reshape(height, width, 3)
    mean = image[:36, :52].reshape(18, 2, 26, 2, 3).mean(axis=(1, 3))
    assert np.abs(level[:18, :26] - mean).max() <= 0.5
