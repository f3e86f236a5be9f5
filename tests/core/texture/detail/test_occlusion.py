# SPDX-License-Identifier: GPL-3.0-or-later
"""Ambient occlusion against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.tangent_frame import shading_normals
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas, texel_points
from gaussian_wrapping_addon.core.texture.dense_detail import (
    REACH_SHARE,
    DenseSurface,
    bake_occlusion,
    sky_visibility,
    smoothed,
)
from tests.core.texture.detail_scenes import flat_uvs, grid
from tests.core.texture.texture_scenes import joined, mesh_of, sphere

NOISE = 0.03
"""Two steps of the 64 rays."""


def open_at(mesh: SurfaceMesh, points: np.ndarray, reach: float) -> np.ndarray:
    surface = DenseSurface(mesh)
    matches, distance = surface.nearest(points)
    assert distance.max() < 1e-9
    return sky_visibility(surface, matches, reach, np.arange(len(points)) * 7919, 64)


def turned(mesh: SurfaceMesh, matrix: np.ndarray, offset: np.ndarray) -> SurfaceMesh:
    return SurfaceMesh(mesh.vertices @ matrix.T + offset, mesh.faces)


def test_an_open_plane_and_a_ball_see_everything() -> None:
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (200, 3)) * [1, 1, 0]
    assert (open_at(grid(6), points, 10.0) == 1.0).all()
    ball = sphere(3)
    assert (open_at(ball, ball.vertices[ball.faces].mean(axis=1), 10.0) == 1.0).all()


def test_a_right_angle_sees_half() -> None:
    wall = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # turned up about y, looks along -x
    corner = joined(grid(2, side=50.0), turned(grid(2, side=50.0), wall, np.array([1e-3, 0, 0])))
    points = np.zeros((400, 3))
    points[:, 1] = np.linspace(-1, 1, 400)
    values = open_at(corner, points, 200.0)
    assert values.mean() == pytest.approx(0.5, abs=0.005)
    assert values.std() < NOISE
    # At a height h above a wall of h, cosine-weighted: (1 + cos 45 degrees) / 2 stay open.
    low = turned(grid(2, side=0.5), wall, np.array([1.0, 0, 0.5]))
    wide = SurfaceMesh(low.vertices * [1, 200, 1], low.faces)
    values = open_at(joined(grid(2, side=50.0), wide), points, 1000.0)
    assert values.mean() == pytest.approx((1 + np.cos(np.pi / 4)) / 2, abs=0.005)


def test_the_bottom_of_a_deep_hole_is_dark() -> None:
    depth, radius = 4.0, 0.4
    pipe = mesh_of(trimesh.creation.cylinder(radius=radius, height=depth, sections=64))
    up = np.cross(
        *(pipe.vertices[pipe.faces[:, k]] - pipe.vertices[pipe.faces[:, 0]] for k in (1, 2))
    )
    kept = pipe.faces[up[:, 2] <= 1e-9][:, ::-1]  # without its lid, seen from inside
    hole = SurfaceMesh(pipe.vertices, np.ascontiguousarray(kept))
    bottom = np.tile([[0.0, 0.0, -depth / 2]], (200, 1))
    values = open_at(hole, bottom, 100.0)
    assert values.mean() == pytest.approx(radius**2 / (radius**2 + depth**2), abs=0.01)
    # What is further away than the reach hides nothing.
    assert (open_at(hole, bottom, 0.3) == 1.0).all()


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-3, 0.0), (1e4, 4e6)])
def test_the_map_darkens_under_a_roof_alone(scale: float, offset: float) -> None:
    light = grid(8)
    roof = grid(2, side=0.25, z=0.1)
    dense = joined(light, SurfaceMesh(roof.vertices, roof.faces[:, ::-1].copy()))
    move = offset * np.array([1.0, 0.5, -1.0])
    light = SurfaceMesh(light.vertices * scale + move, light.faces)
    dense = SurfaceMesh(dense.vertices * scale + move, dense.faces)
    uvs = flat_uvs(grid(8))
    raster = raster_atlas(uvs, 64, 2)
    result = bake_occlusion(light, raster, DenseSurface(dense), 2, Progress())
    assert result.image.shape == (64, 64)
    assert result.image.dtype == np.uint8
    assert result.image[30:34, 30:34].mean() < 60
    assert (result.image[:14] == 255).all()  # smoothing reaches two texels further
    again = bake_occlusion(light, raster, DenseSurface(dense), 2, Progress())
    assert (again.image == result.image).all()


def test_few_rays_without_noise_are_as_good_as_many() -> None:
    """A bumpy plane under a roof: beside 1024 rays, the map is nearer than 64 rays alone are."""
    plane = grid(48)
    bumps = 0.03 * np.sin(17.0 * plane.vertices[:, 0]) * np.sin(13.0 * plane.vertices[:, 1])
    light = SurfaceMesh(plane.vertices + bumps[:, None] * [0.0, 0.0, 1.0], plane.faces)
    roof = grid(2, side=0.5, z=0.25)
    dense = DenseSurface(joined(light, SurfaceMesh(roof.vertices, roof.faces[:, ::-1].copy())))
    raster = raster_atlas(flat_uvs(plane), 128, 1)
    baked = bake_occlusion(light, raster, dense, 2, Progress()).image / 255.0
    texels = np.flatnonzero(raster.face.ravel() >= 0)
    at = texel_points(light, raster, texels, shading_normals(light.vertices, light.faces))
    matches = dense.correspondences(at.points, at.normals, 1e-3)
    reach = REACH_SHARE * dense.size
    truth, many = (sky_visibility(dense, matches, reach, texels, rays) for rays in (1024, 64))
    few = baked.ravel()[texels]
    assert truth.min() < 0.65
    assert np.sqrt(((few - truth) ** 2).mean()) < np.sqrt(((many - truth) ** 2).mean())
    assert np.abs(few - truth).mean() < np.abs(many - truth).mean()


def test_smoothing_stops_at_creases_and_charts() -> None:
    """Two flat halves at a right angle, and one that lies elsewhere, side by side in the atlas."""
    y, x = np.mgrid[0:8, 0:24]
    bent = np.stack([np.minimum(x, 8), y, -np.maximum(x - 8, 0)], axis=-1).astype(float)
    bent[:, 16:] = np.stack([x[:, 16:], y[:, 16:], np.zeros((8, 8))], axis=-1)
    normals = np.zeros((8, 24, 3))
    normals[:, :8, 2] = normals[:, 16:, 2] = normals[:, 8:16, 0] = 1.0
    values = np.repeat([0.0, 1.0, 0.5], 8)[None].repeat(8, axis=0).astype(np.float32)
    texels = (y * 32 + x).ravel()
    found = smoothed(values.ravel(), bent.reshape(-1, 3), normals.reshape(-1, 3), texels, 32)
    assert (found == values.ravel()).all()
