# SPDX-License-Identifier: GPL-3.0-or-later
"""Seams run between the quads of a mesh, not through them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.components import face_graph, uv_charts
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.texture.unwrap.charts import flatten_faces, texture_stretch
from gaussian_wrapping_addon.core.texture.unwrap.overlaps import (
    find_overlaps,
    join_polygons,
    set_cut_apart,
    signed_areas,
)
from gaussian_wrapping_addon.core.texture.unwrap.packing_scale import split_wide_charts
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import Unwrap, unwrap


def quad_torus(around: int, across: int) -> tuple[SurfaceMesh, np.ndarray]:
    """A torus of quads, each of two triangles, and the quad of each triangle."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    ring = 1.0 + 0.3 * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), 0.3 * np.sin(v)], axis=1)
    vertices += np.random.default_rng(0).normal(0.0, 0.02, vertices.shape)
    right, up = (i + 1) % around, (j + 1) % across
    quads = np.stack(
        [i * across + j, right * across + j, right * across + up, i * across + up], axis=1
    )
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32)
    return SurfaceMesh(vertices, faces), np.repeat(np.arange(len(quads)), 2)


def cut_quads(mesh: SurfaceMesh, unwrapped: Unwrap) -> int:
    """Return how many quads have other UVs on either side of their diagonal."""
    uvs = unwrapped.corner_uvs
    if unwrapped.face_atlas is not None:
        uvs = uvs + 2.0 * unwrapped.face_atlas[:, None, None]
    apart = np.abs(uvs[0::2][:, [0, 2]] - uvs[1::2][:, [0, 1]])
    return int((apart > 1e-6).any(axis=(1, 2)).sum())


@pytest.mark.parametrize("atlases", [1, 4])
def test_no_quad_is_cut(atlases: int, tmp_path: Path) -> None:
    mesh, polygons = quad_torus(60, 24)
    found = [
        unwrap(mesh, 512, 4, tmp_path, Progress(), atlases=atlases, polygons=kept)
        for kept in (None, polygons)
    ]
    assert [one.method for one in found] == ["xatlas", "xatlas"]  # and so checked for overlaps
    assert cut_quads(mesh, found[0]) > 20
    assert cut_quads(mesh, found[1]) == 0
    stretch = [texture_stretch(mesh.vertices, mesh.faces, one.corner_uvs).p95 for one in found]
    assert stretch[1] < stretch[0] + 0.01
    charts = [len(np.unique(one.charts)) for one in found]
    assert charts[1] <= 1.1 * charts[0]


def grid(side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat grid of quads: vertices, faces, and the quad of each face."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(side + 1), np.arange(side + 1)))
    vertices = np.stack([x, y, 0 * x], axis=1).astype(float)
    at = np.flatnonzero((x < side) & (y < side))
    quads = np.stack([at, at + 1, at + side + 2, at + side + 1], axis=1)
    return (
        vertices, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), np.repeat(np.arange(len(quads)), 2),
    )  # fmt: skip


def test_triangles_fill_the_notches_of_the_chart_that_they_join() -> None:
    """A border along the diagonals of a row of quads moves to the edges beside them."""
    vertices, faces, polygons = grid(5)
    graph, shapes = face_graph(vertices, faces), flatten_faces(vertices, faces)
    charts = np.where(np.arange(len(faces)) >= 2 * 10 + 1, 1, 0)
    charts[20:30] = np.tile([0, 1], 5)  # the middle row is cut along its diagonals
    flat = vertices[faces][..., :2] + np.where(charts == 1, 100.0, 0.0)[:, None, None]
    joined = join_polygons(flat, charts, faces, shapes, graph, polygons)
    labels = uv_charts(graph, faces, joined)
    assert len(np.unique(labels)) == 2
    assert (labels[0::2] == labels[1::2]).all()
    assert len(find_overlaps(joined, labels)) == 0
    assert np.allclose(signed_areas(joined), 0.5)
    assert np.array_equal(joined[:20], flat[:20])


def test_what_still_is_cut_gets_a_chart_of_its_own() -> None:
    vertices, faces, polygons = grid(3)
    graph, shapes = face_graph(vertices, faces), flatten_faces(vertices, faces)
    charts = np.where(np.arange(len(faces)) >= 9, 1, 0)  # through the middle quad
    flat = vertices[faces][..., :2] + np.where(charts == 1, 100.0, 0.0)[:, None, None]
    apart, labels = set_cut_apart(flat, charts, faces, shapes, graph, polygons)
    assert (labels[0::2] == labels[1::2]).all()
    assert np.flatnonzero(labels == labels[8]).tolist() == [8, 9]
    assert len(np.unique(labels)) == 3
    assert np.array_equal(apart[8][[0, 2]], apart[9][[0, 1]])
    assert np.allclose(signed_areas(apart), 0.5)
    assert len(find_overlaps(apart, labels)) == 0


def test_wide_charts_are_split_between_quads() -> None:
    vertices, faces, polygons = grid(9)
    flat = vertices[faces][..., :2]
    charts = np.zeros(len(faces), np.int32)
    labels = split_wide_charts(flat, charts, 4, polygons)
    assert len(np.unique(labels)) >= 4
    assert (labels[0::2] == labels[1::2]).all()
    without = split_wide_charts(flat, charts, 4)
    assert (without[0::2] != without[1::2]).any()
