# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes and truths with known distances, for the tests of surface scores."""

from __future__ import annotations

import dataclasses

import numpy as np
import trimesh

from gaussian_wrapping_addon.core.evaluation.surface_scores import (
    SurfaceSamples,
    Truth,
    sample_uniformly,
)
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from tests.poses import look_at_pose

Mesh = tuple[np.ndarray, np.ndarray]


def ball(subdivisions: int = 4, radius: float = 1.0) -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(shape.vertices, np.float64), np.array(shape.faces, np.int64)


def cylinder(low, high, radius: float, sides: int = 12) -> Mesh:
    shape = trimesh.creation.cylinder(radius, segment=[low, high], sections=sides)
    return np.array(shape.vertices, np.float64), np.array(shape.faces, np.int64)


def joined(*meshes: Mesh) -> Mesh:
    vertices, faces, base = [], [], 0
    for points, triangles in meshes:
        vertices.append(points)
        faces.append(triangles + base)
        base += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def fanned(mesh: Mesh, parts: int) -> Mesh:
    """Cut every face into ``parts`` that lie in it and share its first corner."""
    a, b, c = (mesh[0][mesh[1][:, k]] for k in range(3))
    rim = [b + (c - b) * (k / parts) for k in range(parts + 1)]
    pieces = [np.stack([a, rim[k], rim[k + 1]], 1) for k in range(parts)]
    corners = np.concatenate(pieces).reshape(-1, 3)
    return corners, np.arange(len(corners)).reshape(-1, 3)


def halves(mesh: Mesh) -> tuple[Mesh, Mesh]:
    """Faces whose centre has z > 0, and the others; both keep all vertices."""
    upper = mesh[0][mesh[1]].mean(1)[:, 2] > 0
    return (mesh[0], mesh[1][upper]), (mesh[0], mesh[1][~upper])


def truth_of(mesh: Mesh, count: int = 20_000, seed: int = 5, **labels) -> Truth:
    return Truth(sample_uniformly(*mesh, count, seed=seed), *mesh, **labels)


def exact_sphere(count: int, radius: float = 1.0) -> SurfaceSamples:
    """Points of a golden spiral: exactly on the sphere, even in its height."""
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - height**2)
    normals = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], 1)
    return SurfaceSamples(radius * normals, normals)


def camera_at(eye, target=(0.0, 0.0, 0.0), width: int = 160, focal: float = 200.0) -> Camera:
    return Camera("c", width, width, focal, focal, width / 2, width / 2, look_at_pose(eye, target))


def cameras_around(distance: float = 4.0, width: int = 160) -> list[Camera]:
    """One camera on each half-axis and at each corner of a cube."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
    tilt = np.array([[0.96, -0.28, 0.0], [0.28, 0.96, 0.0], [0.0, 0.0, 1.0]])
    tilt = tilt @ np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
    return [
        camera_at(distance * (tilt @ direction), width=width)
        for direction in np.concatenate([axes, corners])
    ]


def moved_camera(camera: Camera, offset: np.ndarray) -> Camera:
    return camera.moved(Similarity(translation=offset))


def without_mesh(truth: Truth) -> Truth:
    return dataclasses.replace(truth, vertices=None, faces=None)
