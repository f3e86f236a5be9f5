# SPDX-License-Identifier: GPL-3.0-or-later
"""How the meshing study judges meshes, and its TSDF fusion, on shapes that are known."""

from __future__ import annotations

import dataclasses
import importlib.util
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from benchmarks import one_mesh as fusion
from benchmarks.meshing_judge import distances, inner, solidity
from benchmarks.one_mesh import depth_in_region, require_open3d
from benchmarks.vacancy_scale import cameras_around
from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.meshing.surface_points import MARGIN_SHARE
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera


def sphere(radius: float) -> SurfaceMesh:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return SurfaceMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))


BOX = Region("box", np.array(list(itertools.product((-1.5, 1.5), repeat=3))))


def test_distances_of_concentric_spheres_are_their_distance() -> None:
    found = distances(sphere(1.01), sphere(1.0), BOX)
    for name in ("mean", "p99", "max", "reference_mean", "hausdorff"):
        value = found[name]
        assert value is not None
        assert value * BOX.diagonal == pytest.approx(0.01, rel=0.12)


def test_a_missing_half_shows_in_one_direction_only() -> None:
    whole = sphere(1.0)
    upper = whole.vertices[whole.faces][:, :, 2].min(1) >= 0
    half = SurfaceMesh(whole.vertices, whole.faces[upper])
    found = distances(half, whole, BOX)
    assert found["mean"] == pytest.approx(0.0, abs=1e-12)
    # The south pole's nearest points are on the equator.
    assert found["reference_max"] == pytest.approx(np.sqrt(2.0) / BOX.diagonal, rel=0.05)
    assert found["hausdorff"] == found["reference_max"]


def test_the_region_s_boundary_is_not_judged() -> None:
    wall = trimesh.creation.box(extents=(3.0, 3.0, 3.0))
    mesh = SurfaceMesh(np.asarray(wall.vertices), np.asarray(wall.faces, np.int32))
    assert not inner(BOX, mesh.vertices).any()
    assert distances(mesh, sphere(1.0), BOX)["mean"] is None
    assert distances(mesh, sphere(1.0), BOX)["hausdorff"] is None


def test_both_checks_see_a_hole_and_an_inverted_solid() -> None:
    ball = sphere(1.0)
    assert solidity(ball)["check"]["good"]
    assert solidity(ball)["trimesh_good"]
    for faces in (ball.faces[1:], ball.faces[:, ::-1]):
        found = solidity(SurfaceMesh(ball.vertices, np.ascontiguousarray(faces)))
        assert not found["check"]["good"]
        assert not found["trimesh_good"]
    assert validate_manifold(ball.vertices, ball.faces).euler == 2


def eyes(count: int) -> list[Camera]:
    """Cameras at distance 4 all around, looking at the origin; the principal point is off."""
    return [dataclasses.replace(view, width=161, height=120, fx=150.0, fy=140.0, cx=84.0, cy=57.5)
            for view in cameras_around(count)]  # fmt: skip


def depth_of_ball(camera: Camera, radius: float) -> np.ndarray:
    """Exact z-depth of a ball at the origin at the centres of the pixels, 0 beside it."""
    rays = camera.rays()  # z = 1
    origin = camera.to_camera(np.zeros((1, 3)))[0]
    along, square = rays @ origin, (rays**2).sum(-1)
    inside = along**2 - square * (origin @ origin - radius**2)
    return np.where(inside > 0, (along - np.sqrt(np.maximum(inside, 0))) / square, 0.0)


@dataclasses.dataclass
class FakeRender:
    depth: torch.Tensor


def test_depth_outside_of_the_region_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = eyes(7)[2]
    exact = depth_of_ball(camera, 1.0)
    monkeypatch.setattr(fusion, "render", lambda *_: FakeRender(torch.from_numpy(exact)))
    assert np.array_equal(depth_in_region(None, camera, BOX, 1), exact.astype(np.float32))
    cap = Region("cap", np.array(list(itertools.product((-1.5, 1.5), (-1.5, 1.5), (0.5, 1.5)))))
    kept = depth_in_region(None, camera, cap, 1)
    points = (camera.rays() * kept[..., None])[kept > 0] @ camera.rotation + camera.center
    assert 0 < len(points) < (exact > 0).sum()
    assert points[:, 2].min() == pytest.approx(0.5 - MARGIN_SHARE * cap.diagonal, abs=0.02)


def test_fused_exact_depth_is_the_ball(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a pixel of difference between the conventions would move it by a fifth of a voxel."""
    pytest.importorskip("open3d", reason="needs Open3D (requirements-benchmarks.txt)")
    cameras = eyes(30)
    monkeypatch.setattr(
        fusion, "render",
        lambda _g, camera, _o: FakeRender(torch.from_numpy(depth_of_ball(camera, 1.0))),
    )  # fmt: skip
    trained = SimpleNamespace(scene=SimpleNamespace(cameras=cameras), region=BOX, gaussians=None)
    vertices, faces = fusion.fuse(trained, 100, threads=1)  # type: ignore[arg-type]
    voxel = BOX.diagonal / 100
    away = np.linalg.norm(vertices, axis=1) - 1.0
    assert len(faces) > 1000
    assert np.abs(vertices.mean(0)).max() < 0.1 * voxel
    assert np.median(np.abs(away)) < 0.1 * voxel
    assert np.quantile(np.abs(away), 0.99) < 0.5 * voxel


def test_a_missing_open3d_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(ResourceError, match="Open3D"):
        require_open3d()
