# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthetic job folders and ground-truth folders in the layouts that ``evaluate`` reads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import trimesh
from scipy.io import savemat

from gaussian_wrapping_addon.core.evaluation.surface_scores import sample_uniformly
from gaussian_wrapping_addon.core.names import JOB_MARKER
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.texture.file_checks import write_mesh_ply

Mesh = tuple[np.ndarray, np.ndarray]


def rotation_about(axis: list[float], degrees: float) -> np.ndarray:
    a = np.array(axis) / np.linalg.norm(axis)
    k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


JOB_FROM_TRUTH = Similarity(3.7, rotation_about([1, 2, -1], 131.0), np.array([50.0, -2.0, 7.0]))


WORLD_FROM_SCENE = Similarity(2.0, rotation_about([0, 1, 0.3], 20.0), np.array([9.0, 1.0, -4.0]))


def bumpy_sphere(radius: float, subdivisions: int = 5) -> Mesh:
    """A closed mesh without symmetry around 0."""
    ball = trimesh.creation.icosphere(subdivisions)
    d = np.asarray(ball.vertices, np.float64)
    bumps = 1 + 0.15 * np.sin(3 * d[:, 0]) + 0.1 * np.cos(4 * d[:, 1] + 1) + 0.2 * d[:, 2] ** 3
    return d * (radius * bumps)[:, None], np.asarray(ball.faces, np.int64)


def ring_of_cameras(names: list[str], distance: float, middle: np.ndarray) -> list[Camera]:
    """Cameras that look at ``middle`` from changing heights."""
    cameras = []
    for i, name in enumerate(names):
        angle = 2 * np.pi * i / len(names)
        away = np.array([np.cos(angle), np.sin(angle), 0.8 * np.sin(2.3 * i)])
        away /= np.linalg.norm(away)
        right = np.cross(away, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-away, right), -away])
        center = middle + distance * away
        pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
        cameras.append(Camera(name, 96, 96, 130.0, 130.0, 48.0, 48.0, pose))
    return cameras


def write_job(folder: Path, mesh: Mesh, cameras: list[Camera], job_from_truth: Similarity) -> Path:
    """Write the results that a job would leave, of a mesh and cameras of the truth's frame."""
    (folder / "result" / "auto").mkdir(parents=True)
    (folder / JOB_MARKER).touch()
    colors = np.full((len(mesh[0]), 3), 128, np.uint8)
    path = folder / "result" / "auto" / "mesh.ply"
    write_mesh_ply(path, job_from_truth.points(mesh[0]), mesh[1].astype(np.int32), colors)
    scene_from_world = WORLD_FROM_SCENE.inverse()
    moved = [camera.moved(job_from_truth).moved(scene_from_world) for camera in cameras]
    values = {
        "version": 1,
        "world_from_scene": WORLD_FROM_SCENE.to_json(),
        "radius": 1.0,
        "cameras": [{**camera.to_json(), "photo": camera.name} for camera in moved],
    }
    (folder / "result" / "scene.json").write_text(json.dumps(values))
    return folder


def write_cloud(path: Path, points: np.ndarray) -> None:
    header = "ply\nformat binary_little_endian 1.0\n"
    header += f"element vertex {len(points)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(header.encode() + np.ascontiguousarray(points, "<f8").tobytes())


def write_tanks(
    folder: Path, name: str, mesh: Mesh, cameras: list[Camera], *, samples: int, noise: float
) -> Path:
    """Write a scene of Tanks and Temples around a mesh of about 0.7 size at 0."""
    folder.mkdir()
    rng = np.random.default_rng(7)
    points = sample_uniformly(*mesh, samples, seed=11).points
    debris = rng.uniform(3.0, 4.0, (500, 3))  # scanned, but outside of the crop
    write_cloud(folder / f"{name}.ply", np.concatenate([points, debris]))
    corners = [[-1, -1], [2.5, -1], [2.5, 1], [0.9, 1], [0.9, 1.4], [0.5, 1.4], [0.5, 1], [-1, 1]]
    crop = {
        "class_name": "SelectionPolygonVolume",
        "version_major": 1,
        "version_minor": 0,
        "orthogonal_axis": "Z",
        "axis_min": -1.0,
        "axis_max": 1.0,
        "bounding_polygon": [[x, y, 0.0] for x, y in corners],
    }
    (folder / f"{name}.json").write_text(json.dumps(crop))
    truth_from_log = Similarity(0.4, rotation_about([3, 1, 1], 77.0), np.array([0.3, 5.0, -1.0]))
    np.savetxt(folder / f"{name}_trans.txt", truth_from_log.matrix())
    lines = []
    log_from_truth = truth_from_log.inverse()
    for i, camera in enumerate(sorted(cameras, key=lambda c: c.name)):
        pose = np.eye(4)
        moved = camera.moved(log_from_truth)
        pose[:3, :3], pose[:3, 3] = moved.rotation.T, moved.center
        pose[:3, 3] += rng.normal(size=3) * noise / 0.4
        if i % 7 == 3:  # some of the reference poses are wrong
            pose[:3, 3] += 8.0
        lines += [f"{i} {i} 0", *(" ".join(f"{v:.12g}" for v in row) for row in pose)]
    (folder / f"{name}_COLMAP_SfM.log").write_text("\n".join(lines) + "\n")
    return folder


def write_dtu(
    folder: Path, scan: int, points: np.ndarray, cameras: list[Camera], *, middle: np.ndarray
) -> Path:
    """Write a DTU folder with cal18 cameras; only x >= middle - 18 counts as observed."""
    for name in ("Points/stl", "ObsMask", "Calibration/cal18"):
        (folder / name).mkdir(parents=True)
    write_cloud(folder / "Points" / "stl" / f"stl{scan:03}_total.ply", points)
    low, resolution = middle - 30.0, 1.0
    volume = np.ones((61, 61, 61), np.uint8)
    volume[:12] = 0
    box = np.stack([low, low + 60.0])
    observed = {"ObsMask": volume, "BB": box, "Res": resolution}
    savemat(folder / "ObsMask" / f"ObsMask{scan}_10.mat", observed)
    # Ground 10 below the middle: what is further down is not asked for.
    plane = np.array([[0.0], [0.0], [1.0], [-(middle[2] - 10.0)]])
    savemat(folder / "ObsMask" / f"Plane{scan}.mat", {"P": plane})
    for i, camera in enumerate(cameras, 1):
        k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        projection = -3.0 * k @ camera.cam_from_world  # of any scale and sign
        np.savetxt(folder / "Calibration" / "cal18" / f"pos_{i:03}.txt", projection)
    return folder
