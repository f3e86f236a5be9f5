# SPDX-License-Identifier: GPL-3.0-or-later
"""Normal maps and ambient occlusion against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.tangent_frame import shading_normals, tangent_frames
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.texture.atlas import AtlasRaster, raster_atlas, texel_points
from gaussian_wrapping_addon.core.texture.dense_detail import (
    BY_NEAREST,
    BY_RAY,
    FLAT,
    NO_HIT,
    REACH_SHARE,
    DenseSurface,
    DetailMap,
    bake_normal_map,
    bake_occlusion,
    cage_distance,
    sky_visibility,
    smoothed,
)
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import unwrap
from tests.core.texture.detail_scenes import (
    bumpy_ball,
    bumpy_normals,
    degrees_between,
    flat_uvs,
    grid,
)
from tests.core.texture.texture_scenes import box, joined, mesh_of, sphere

THREADS = 2
GUTTER_PX = 3


def bake(light: SurfaceMesh, uvs: np.ndarray, dense: SurfaceMesh, size_px: int = 256):
    raster = raster_atlas(uvs, size_px, THREADS)
    result = bake_normal_map(light, uvs, raster, DenseSurface(dense), GUTTER_PX, Progress())
    return result, raster


def decoded(
    light: SurfaceMesh, uvs: np.ndarray, result: DetailMap, raster: AtlasRaster
) -> tuple[np.ndarray, np.ndarray]:
    """Read the map as a renderer does: positions and unit normals of the texels."""
    inside = raster.inside
    frames = tangent_frames(light.vertices, light.faces, uvs)
    face = raster.face[inside]
    bary = raster.bary[inside].astype(float)
    weights = np.concatenate([bary, 1.0 - bary.sum(axis=1, keepdims=True)], axis=1)
    corners = light.faces[face]
    points = np.einsum("nc,ncx->nx", weights, light.vertices[corners])
    normal = np.einsum("nc,ncx->nx", weights, frames.normals[corners])
    tangent = np.einsum("nc,ncx->nx", weights, frames.tangents[face])
    bitangent = frames.signs[face][:, None] * np.cross(normal, tangent)
    x, y, z = (result.image[inside].astype(float) / 255.0 * 2.0 - 1.0).T[..., None]
    world = x * tangent + y * bitangent + z * normal
    return points, world / np.linalg.norm(world, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def light_ball(tmp_path_factory) -> tuple[SurfaceMesh, np.ndarray]:
    mesh = bumpy_ball(10, 0.0)
    folder: Path = tmp_path_factory.mktemp("unwrap")
    return mesh, unwrap(mesh, 256, GUTTER_PX, folder, Progress()).corner_uvs


@pytest.mark.parametrize("mirrored", [False, True])
def test_detail_comes_back(light_ball: tuple[SurfaceMesh, np.ndarray], mirrored: bool) -> None:
    light, uvs = light_ball
    if mirrored:
        uvs = uvs * np.float32([-1, 1]) + np.float32([1, 0])
    result, raster = bake(light, uvs, bumpy_ball(120))
    points, normals = decoded(light, uvs, result, raster)
    wrong = degrees_between(normals, bumpy_normals(points))
    plain = degrees_between(points / np.linalg.norm(points, axis=1)[:, None], bumpy_normals(points))
    # The light ball's rays lean a little: the same bump is met beside where it is looked up.
    assert wrong.mean() < 1.0
    assert plain.mean() > 8.0
    assert result.statistics["by_ray_share"] > 0.99
    assert result.statistics["flat_share"] == 0.0


@pytest.mark.parametrize(("scale", "offset"), [(1e4, 0.0), (1.0, 4e6), (1e-3, 5e3)])
def test_place_and_size_do_not_matter(
    light_ball: tuple[SurfaceMesh, np.ndarray], scale: float, offset: float
) -> None:
    light, uvs = light_ball
    dense = bumpy_ball(40)
    near, _ = bake(light, uvs, dense, 128)
    far, _ = bake(moved(light, scale, offset), uvs, moved(dense, scale, offset), 128)
    assert np.abs(near.image.astype(int) - far.image).max() <= 1


def moved(mesh: SurfaceMesh, scale: float, offset: float) -> SurfaceMesh:
    return SurfaceMesh(mesh.vertices * scale + offset * np.array([1.0, -0.5, 0.25]), mesh.faces)


def test_y_points_up_and_x_right_and_gutters_continue_the_charts() -> None:
    # A sheet with UVs along x and y: the slope's own numbers stand in the map.
    light, slope = grid(4), np.array([0.3, -0.2])
    result, raster = bake(light, flat_uvs(light), grid(20, lambda xy: xy @ slope))
    wanted = np.array([-0.3, 0.2, 1.0]) / np.sqrt(1.13)
    seen = result.image[raster.inside] / 255.0 * 2.0 - 1.0
    assert np.abs(seen - wanted).max() <= 1.01 / 255.0
    row, column = int(np.flatnonzero((raster.face >= 0).any(axis=1))[0]), 128
    assert (result.image[row - GUTTER_PX : row, column] == result.image[row, column]).all()
    assert (result.image[row - GUTTER_PX - 1, column] == FLAT).all()


def test_a_mesh_on_itself_is_flat_and_the_rest_is_the_neutral_colour(
    light_ball: tuple[SurfaceMesh, np.ndarray],
) -> None:
    light, uvs = light_ball
    result, raster = bake(light, uvs, light)
    assert np.abs(result.image[raster.inside].astype(int) - FLAT).max() <= 1
    near = ndimage.binary_dilation(raster.face >= 0, np.ones((2 * GUTTER_PX + 1,) * 2))
    assert not near.all()
    assert (result.image[~near] == FLAT).all()


def test_the_other_side_of_a_plate_is_not_taken() -> None:
    # Plates of 0.02, their sides 0.01 off those of the light one: the wrong side is as near.
    light = box([-1, -1, -0.01], [1, 1, 0.01], 2)
    dense = box([-1, -1, -0.02], [1, 1, 0.0], 5)
    points = np.random.default_rng(1).uniform(-0.9, 0.9, (500, 3))
    points[:, 2] = np.where(points[:, 2] > 0, 0.01, -0.01)
    normals = np.array([0, 0, 1.0]) * np.sign(points[:, 2:])
    surface = DenseSurface(dense)
    cage = cage_distance(light, surface)
    assert 0.01 <= cage < 0.03
    matches = surface.correspondences(points, normals, cage)
    assert (matches.method == BY_RAY).all()
    assert surface.normals(matches) == pytest.approx(normals, abs=1e-9)
    assert surface.points(matches)[:, 2] == pytest.approx(points[:, 2] - 0.01, abs=1e-7)


def test_where_rays_miss_the_nearest_point_serves_and_else_the_own_normal() -> None:
    dense = joined(grid(4), grid(4, z=5.0))
    surface = DenseSurface(dense)
    points = np.array([[0.1, 0.2, 0.3], [1.2, 0.0, 0.1], [0.0, 0.0, -0.2]])
    normals = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, -1]])
    matches = surface.correspondences(points, normals, 1.0)
    assert matches.method.tolist() == [BY_RAY, BY_NEAREST, NO_HIT]
    assert matches.face[2] == -1
    assert surface.points(matches)[:2] == pytest.approx(np.array([[0.1, 0.2, 0], [1, 0, 0]]))


def test_faces_without_area_or_uvs_do_no_harm() -> None:
    mesh = grid(4)
    vertices = np.concatenate([mesh.vertices, [[9.0, 9.0, 9.0]]])
    faces = np.concatenate([mesh.faces, [[0, 0, 1], [3, 3, 3]]]).astype(np.int32)
    uvs = np.concatenate([flat_uvs(mesh), np.full((2, 3, 2), 0.5, np.float32)])
    frames = tangent_frames(vertices, faces, uvs)
    assert np.isfinite(frames.tangents).all()
    assert np.linalg.norm(frames.tangents, axis=2) == pytest.approx(1.0)
    assert frames.normals[-1].tolist() == [0, 0, 1]
    assert frames.normals[:-1] == pytest.approx(np.tile([0.0, 0, 1], (len(vertices) - 1, 1)))
    result, raster = bake(SurfaceMesh(vertices, faces), uvs, grid(8))
    assert np.abs(result.image[raster.inside].astype(int) - FLAT).max() <= 1


def test_smooth_normals_are_weighted_by_angle() -> None:
    # A cube's corner: sides cut in one, or two, triangles there count the same.
    cube = box([-1, -1, -1], [1, 1, 1], 0)
    normals = shading_normals(cube.vertices, cube.faces)
    assert normals == pytest.approx(cube.vertices / np.sqrt(3), abs=1e-12)
    ball = sphere(3)
    assert degrees_between(shading_normals(ball.vertices, ball.faces), ball.vertices).max() < 0.5


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


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e4, 4e6)])
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


@pytest.mark.proof
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
