# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface samples: uniform, exact, deterministic, and the same at huge coordinates."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.errors import MeshingError, UsageError
from gaussian_wrapping_addon.core.evaluation.surface_scores import (
    SurfaceSamples,
    choose_per_cell,
    face_normals,
    sample_legacy,
    sample_uniformly,
    scan_virtually,
    voxel_downsample,
)
from gaussian_wrapping_addon.core.mesh.depth_buffer import NEAR_DEPTH
from gaussian_wrapping_addon.core.mesh.sampling import distances_to_mesh
from tests.core.evaluation.surface_scenes import (
    ball,
    camera_at,
    cameras_around,
    fanned,
    halves,
    joined,
    moved_camera,
)

OFFSET = np.array([5e5, 4e6, -300.0])
FAR = np.array([2.0**19, 2.0**22, -300.0])
"""Coordinates that are multiples of 2^-24 below 2 stay exact when this is added."""


HALF_DIGIT = 2.0**-31
"""Rounding of a coordinate between 2^22 and 2^23."""


ONE_FACE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])


def same(a: SurfaceSamples, b: SurfaceSamples) -> bool:
    return bool((a.points == b.points).all() and (a.normals == b.normals).all())


def test_uniform_samples_lie_on_their_faces_and_repeat() -> None:
    mesh = ball(3)
    samples = sample_uniformly(*mesh, 5000, seed=3)
    distances, face, _ = distances_to_mesh(samples.points, *mesh)
    assert len(samples) == 5000
    assert distances.max() < 1e-15
    assert (samples.normals == face_normals(*mesh)[0][face]).all()
    assert same(samples, sample_uniformly(*mesh, 5000, seed=3))
    assert not same(samples, sample_uniformly(*mesh, 5000, seed=4))


def test_numbers_follow_the_area_and_not_the_tessellation() -> None:
    upper, lower = halves(ball(3))
    mesh = joined(fanned(upper, 10), (lower[0] * 1.5, lower[1]))
    samples = sample_uniformly(*mesh, 10_000, seed=0)
    # One sample for each of 10 000 equal parts: only the part on the seam is open.
    areas = [face_normals(*half)[1].sum() for half in (upper, lower)]
    expected = 10_000 * areas[0] / (areas[0] + areas[1] * 1.5**2)
    found = int((np.linalg.norm(samples.points, axis=1) < 1.1).sum())
    assert abs(found - expected) <= 1


def test_samples_are_better_spread_over_a_face_than_random_ones() -> None:
    samples = sample_uniformly(*ONE_FACE, 4096, seed=1)
    u, v = (samples.points[:, :2] * 8).T
    upper = (np.modf(u)[0] + np.modf(v)[0]) > 1
    cell = (u.astype(int) * 8 + v.astype(int)) * 2 + upper  # 64 small triangles, 64 samples each
    counts = np.bincount(cell, minlength=128)
    counts = counts[counts > 0]
    assert len(counts) == 64
    # Random points would have a standard deviation of 8.
    assert counts.std() < 4


def test_faces_without_area_get_no_samples_and_alone_are_refused() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [6, 0, 0], [7, 1e-14, 0]])
    faces = np.array([[3, 4, 5], [0, 1, 2], [3, 3, 4], [5, 5, 5]])
    samples = sample_uniformly(vertices, faces, 1000, seed=0)
    assert samples.points[:, 0].max() <= 1.0
    assert (samples.normals == [0, 0, 1]).all()
    with pytest.raises(MeshingError, match="no area"):
        sample_uniformly(vertices, faces[2:], 10, seed=0)
    with pytest.raises(UsageError):
        sample_uniformly(vertices, faces, 0, seed=0)
    with pytest.raises(UsageError):
        scan_virtually(*ONE_FACE, [], step_px=0.5)


@pytest.mark.parametrize(
    "sample",
    [
        lambda v, f: sample_uniformly(v, f, 10, seed=0),
        sample_legacy,
        lambda v, f: scan_virtually(v, f, [camera_at((3, 0, 0))]),
    ],
)
def test_bad_meshes_are_refused(sample: Callable) -> None:
    vertices, faces = ONE_FACE
    for given, error, words in (
        ((vertices, np.zeros((0, 3), int)), MeshingError, "no faces"),
        ((np.where(vertices == 1, np.nan, vertices), faces), MeshingError, "not finite"),
        ((np.where(vertices == 1, np.inf, vertices), faces), MeshingError, "not finite"),
        ((vertices, faces + 1), UsageError, "outside 0 to 2"),
    ):
        with pytest.raises(error, match=words):
            sample(*given)
    # A vertex that no face uses does not matter.
    sample(np.concatenate([vertices, [[np.nan] * 3]]), faces)


def test_legacy_samples_are_used_vertices_and_centres() -> None:
    vertices, faces = ball(2)
    extra = np.concatenate([vertices, [[9.0, 9.0, 9.0]]])
    samples = sample_legacy(extra, faces)
    assert len(samples) == len(vertices) + len(faces)
    assert (samples.points[: len(vertices)] == vertices).all()
    assert np.allclose(samples.points[len(vertices) :], vertices[faces].mean(1), atol=1e-15)
    assert (samples.normals[: len(vertices)] == 0).all()
    assert np.allclose(np.linalg.norm(samples.normals[len(vertices) :], axis=1), 1)


def test_a_scan_recovers_the_visible_side_of_a_sphere() -> None:
    mesh = ball(5)
    camera = camera_at((0.0, -3.0, 1.0), width=200)
    samples = scan_virtually(*mesh, [camera], threads=2)
    assert distances_to_mesh(samples.points, *mesh)[0].max() < 1e-15
    # Every point is at a pixel's centre, each pixel once.
    pixels, _ = camera.project(samples.points)
    centres = np.floor(pixels) + 0.5
    assert np.abs(pixels - centres).max() < 1e-9
    assert len(np.unique(centres, axis=0)) == len(samples)
    # The pixels are those whose rays meet the sphere, but for the polygons' rim.
    rays = camera.rays() @ camera.rotation
    nearest = np.cross(camera.center, rays)
    miss = np.linalg.norm(nearest, axis=-1) / np.linalg.norm(rays, axis=-1)
    assert (miss < 0.999).sum() <= len(samples) <= (miss < 1.0).sum()
    # A convex body shows the faces that are turned towards the camera, all of each and no other.
    vertices, faces = ball(3)
    coarse = scan_virtually(vertices, faces, [camera])
    hit = np.unique(distances_to_mesh(coarse.points, vertices, faces)[1])
    towards = camera.center - vertices[faces[:, 0]]  # (f, 3)
    turned = (face_normals(vertices, faces)[0] * towards).sum(1) / np.linalg.norm(towards, axis=1)
    assert (turned[hit] > 0).all()
    assert set(np.flatnonzero(turned > 0.2).tolist()) <= set(hit.tolist())
    assert 0.3 * len(faces) < len(hit) < 0.5 * len(faces)


def test_a_scan_from_inside_keeps_the_faces_own_orientation() -> None:
    camera = camera_at((0.1, 0.0, 0.0), target=(1.0, 0.2, 0.1))
    samples = scan_virtually(*ball(3), [camera])
    assert len(samples) == camera.width * camera.height
    assert ((samples.normals * (camera.center - samples.points)).sum(1) < 0).all()


def test_a_scan_has_no_near_plane() -> None:
    near = NEAR_DEPTH / 100
    wall = np.array([[-9.0, -9, near], [9, -9, near], [0, 9, near]]), np.array([[0, 1, 2]])
    camera = dataclasses.replace(
        camera_at((0, 0, -1)), cam_from_world=np.concatenate([np.eye(3), np.zeros((3, 1))], 1)
    )
    samples = scan_virtually(*wall, [camera])
    assert len(samples) == camera.width * camera.height
    assert np.allclose(samples.points[:, 2], near, rtol=1e-12)
    # A floor that runs below the camera and behind it is seen up to the horizon.
    floor = np.array([[-1e3, 1, -1e3], [1e3, 1, -1e3], [0, 1, 1e3]]), np.array([[0, 1, 2]])
    seen = scan_virtually(*floor, [camera])
    below = (np.arange(camera.height) + 0.5 > camera.height / 2).sum() * camera.width
    assert 0.9 * below < len(seen) <= below
    assert np.allclose(seen.points[:, 1], 1, rtol=1e-12)


def test_a_scan_does_not_depend_on_threads_and_thins_by_its_step() -> None:
    mesh, cameras = ball(3), cameras_around()[:3]
    whole = scan_virtually(*mesh, cameras, threads=1)
    assert same(whole, scan_virtually(*mesh, cameras, threads=3))
    coarse = scan_virtually(*mesh, cameras, step_px=2)
    assert len(coarse) == pytest.approx(len(whole) / 4, rel=0.02)
    assert distances_to_mesh(coarse.points, *mesh)[0].max() < 1e-15
    assert len(scan_virtually(*mesh, [camera_at((4, 0, 0), target=(8, 0, 0))])) == 0


def exact(points: np.ndarray) -> np.ndarray:
    return np.round(points * 2.0**24) / 2.0**24


def test_samples_are_the_same_at_huge_coordinates() -> None:
    vertices, faces = exact(ball(3)[0]), ball(3)[1]
    there = vertices + FAR
    cameras = cameras_around()[:2]
    for sample in (lambda v, f: sample_uniformly(v, f, 2000, seed=0), sample_legacy):
        here, far = sample(vertices, faces), sample(there, faces)
        # What a coordinate of this size can hold, and no error of calculation besides.
        assert np.abs(far.points - FAR - here.points).max() <= HALF_DIGIT
        assert (far.normals == here.normals).all()
    here = scan_virtually(vertices, faces, cameras)
    far = scan_virtually(there, faces, [moved_camera(camera, FAR) for camera in cameras])
    assert len(far) == pytest.approx(len(here), abs=20)
    assert distances_to_mesh(far.points, there, faces)[0].max() < 2 * HALF_DIGIT


def test_distances_are_exactly_the_same_at_huge_coordinates() -> None:
    vertices, faces = exact(ball(4)[0]), ball(4)[1]
    points = exact(np.random.default_rng(0).uniform(-1.9, 1.9, (3000, 3)))
    here, far = (
        distances_to_mesh(points + offset, vertices + offset, faces)[0] for offset in (0.0, FAR)
    )
    assert here.max() > 1
    # Centring is exact in both frames, but not around the same point.
    assert np.abs(far - here).max() < 1e-15


def test_thinning_takes_the_mean_of_each_cell() -> None:
    rng = np.random.default_rng(0)
    points, voxel = rng.uniform(-1, 1, (500, 3)), 0.4
    cells: dict[tuple[int, ...], list[int]] = {}
    for row, point in enumerate(points):
        cell = np.floor((point - points.min(0) + voxel / 2) / voxel).astype(int)
        cells.setdefault(tuple(cell.tolist()), []).append(row)
    expected = np.array([points[rows].mean(0) for _, rows in sorted(cells.items())])
    thin = voxel_downsample(points, voxel)
    assert np.allclose(thin, expected, atol=1e-14)
    assert np.allclose(voxel_downsample(points[rng.permutation(500)], voxel), thin, atol=1e-14)
    assert np.abs(voxel_downsample(points + OFFSET, voxel) - OFFSET - thin).max() < 2e-9
    assert len(voxel_downsample(np.zeros((0, 3)), 1.0)) == 0
    apart = np.array([[0.0, 0, 0], [1, 1, 1]])
    assert len(voxel_downsample(apart, 1e-3)) == 2
    for size in (0.0, -1.0, np.nan, np.inf, 1e-9):
        with pytest.raises(UsageError):
            voxel_downsample(apart, size)


def test_the_chosen_sample_is_the_nearest_to_the_mean_of_its_cell() -> None:
    rng = np.random.default_rng(2)
    points = np.repeat(rng.uniform(-1, 1, (300, 3)), 2, 0)  # each twice: ties
    samples = SurfaceSamples(points, np.arange(1800.0).reshape(600, 3))
    means, chosen = voxel_downsample(points, 0.5), choose_per_cell(samples, 0.5)
    assert len(chosen) == len(means) < 200
    cell = np.floor((points - points.min(0)) / 0.5 + 0.5)
    for mean, point, normal in zip(means, chosen.points, chosen.normals, strict=True):
        row = int(normal[0]) // 3
        assert (points[row] == point).all()
        assert row % 2 == 0
        others = (cell == cell[row]).all(1)
        nearest = np.linalg.norm(points[others] - mean, axis=1).min()
        assert np.linalg.norm(point - mean) == pytest.approx(nearest, abs=1e-12)
    assert len(choose_per_cell(SurfaceSamples.empty(), 0.5)) == 0


def test_distances_to_a_cube_match_the_closed_form() -> None:
    shape = trimesh.creation.box(extents=(2, 2, 2)).subdivide()
    points = np.random.default_rng(0).uniform(-3, 3, (3000, 3))
    beyond = np.abs(points) - 1.0
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    exact = np.where(beyond.max(1) > 0, outside, -beyond.max(1))
    distances, face, closest = distances_to_mesh(points, shape.vertices, shape.faces)
    assert np.abs(distances - exact).max() < 1e-14
    assert np.allclose(np.linalg.norm(points - closest, axis=1), exact, atol=1e-14)
    on_face = distances_to_mesh(closest, shape.vertices, shape.faces[np.unique(face)])[0]
    assert on_face.max() < 1e-14


def test_distances_to_degenerate_faces_and_to_nothing() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [np.nan] * 3])
    points = np.array([[0.5, 1.0, 0.0], [4.0, 0.0, 0.0]])
    for faces in ([[0, 1, 2]], [[0, 2, 2]]):
        assert distances_to_mesh(points, vertices, np.array(faces))[0].tolist() == [1.0, 2.0]
    distances, face, closest = distances_to_mesh(points, vertices, np.zeros((0, 3), int))
    assert np.isinf(distances).all()
    assert (face == -1).all()
    assert np.isinf(closest).all()
    assert len(distances_to_mesh(points[:0], vertices, np.array([[0, 1, 2]]))[0]) == 0
