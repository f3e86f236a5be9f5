# SPDX-License-Identifier: GPL-3.0-or-later
"""The ground plane of a surface: exact where it is distinct, None where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.frames import find_ground_plane

UP = np.array([0.0, 0.0, 1.0])
Faces = tuple[np.ndarray, np.ndarray, np.ndarray]


def sheet(height: float, half: float, normal: tuple[float, float, float], count: int = 40) -> Faces:
    """A square of level faces."""
    line = (np.arange(count) + 0.5) / count * 2 * half - half
    x, y = (g.ravel() for g in np.meshgrid(line, line))
    centers = np.stack([x, y, np.full(len(x), height)], 1)
    return centers, np.tile(normal, (len(x), 1)), np.full(len(x), (2 * half / count) ** 2)


def ball(radius: float, height: float, count: int = 2000) -> Faces:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    areas = np.full(count, 4 * np.pi * radius**2 / count)
    return radius * normals + [0, 0, height], normals, areas


def together(*parts: Faces) -> Faces:
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))  # type: ignore[return-value]


def table() -> Faces:
    """A ball above a slab: its top at 0 is the ground, its bottom faces down."""
    return together(sheet(0.0, 2.0, (0, 0, 1)), sheet(-0.3, 2.0, (0, 0, -1)), ball(0.6, 0.7))


def tilt(faces: Faces, degrees: float) -> tuple[Faces, np.ndarray]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return (faces[0] @ rotation.T, faces[1] @ rotation.T, faces[2]), rotation @ UP


@pytest.mark.parametrize("degrees", [0.0, 2.0, -6.0])
@pytest.mark.parametrize(("scale", "away"), [(1.0, 0.0), (1e-3, 0.0), (1e4, 0.0), (1.0, 1e3)])
def test_a_table_is_found_and_levelled(degrees: float, scale: float, away: float) -> None:
    (centers, normals, areas), true_up = tilt(table(), degrees)
    plane = find_ground_plane(scale * centers + away, normals, scale**2 * areas, UP)
    assert plane is not None
    assert np.degrees(np.arccos(min(plane.normal @ true_up, 1.0))) < 0.2
    assert abs((plane.point - away) @ true_up) < 2e-3 * scale


def test_a_rough_ground_is_found_within_its_noise() -> None:
    centers, normals, areas = table()
    centers = centers + 0.01 * np.random.default_rng(1).normal(size=centers.shape)
    plane = find_ground_plane(centers, normals, areas, UP)
    assert plane is not None
    assert abs(plane.point[2]) < 2e-3
    assert plane.normal[2] > np.cos(np.radians(0.5))


def test_the_cap_of_a_region_that_cuts_through_does_not_count() -> None:
    plane = find_ground_plane(*together(table(), sheet(1.4, 6.0, (0, 0, 1))), UP)
    assert plane is not None
    assert abs(plane.point[2]) < 1e-3


def cube() -> Faces:
    faces = sheet(0.5, 0.5, (0, 0, 1))
    return together(faces, (-faces[0], -faces[1], faces[2]))


@pytest.mark.parametrize(
    "faces",
    [
        ball(1.0, 0.0),
        cube(),
        together(*[sheet(0.2 * k, 1.0, (0, 0, 1), 20) for k in range(5)]),
        sheet(0.0, 1.0, (0, 0, -1)),
        (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)),
        (np.zeros((5, 3)), np.tile(UP, (5, 1)), np.ones(5)),
        (np.full((5, 3), np.nan), np.tile(UP, (5, 1)), np.ones(5)),
    ],
    ids=["ball", "top of a cube", "shelves", "ceiling", "nothing", "one point", "nan"],
)
def test_no_plane_where_none_is_clear(faces: Faces) -> None:
    assert find_ground_plane(*faces, UP) is None
