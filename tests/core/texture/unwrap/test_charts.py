# SPDX-License-Identifier: GPL-3.0-or-later
"""Charts: exact overlaps, splits at folds, relaxation to the true shapes of faces."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.components import components, face_graph
from gaussian_wrapping_addon.core.texture.unwrap.charts import (
    chart_points,
    equalise_density,
    flatten_faces,
    relax,
    smooth_vertices,
)
from gaussian_wrapping_addon.core.texture.unwrap.overlaps import (
    find_overlaps,
    overlapping_pairs,
    signed_areas,
    split_overlaps,
)
from tests.core.texture.texture_scenes import sphere


def strip(n: int, turn: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat strip of quads: vertices in space, faces, and UVs bent by an angle in all."""
    along = np.linspace(0, 1, n + 1)
    angle = turn * along
    inner = np.stack([np.cos(angle), np.sin(angle)], axis=1) * 5.0
    uvs = np.concatenate([1.2 * inner, inner])
    flat = np.concatenate(
        [np.stack([along * 40, 0 * along], 1), np.stack([along * 40, 0 * along + 1], 1)]
    )
    k = np.arange(n)
    faces = np.concatenate(
        [np.stack([k, k + 1, k + n + 2], 1), np.stack([k, k + n + 2, k + n + 1], 1)]
    ).astype(np.int32)
    return np.concatenate([flat, np.zeros((len(flat), 1))], axis=1), faces, uvs[faces]


def test_faces_that_touch_do_not_overlap() -> None:
    vertices, faces, _ = strip(30, 1.0)
    labels = np.zeros(len(faces), np.int32)
    flat = vertices[faces][..., :2]
    assert len(find_overlaps(flat, labels)) == 0
    assert len(find_overlaps(flat.astype(np.float32) * 1e-4 + 0.9, labels)) == 0


def test_overlaps_are_those_of_brute_force() -> None:
    generator = np.random.default_rng(0)
    flat = generator.uniform(0, 6, (60, 1, 2)) + generator.uniform(-1, 1, (60, 3, 2))
    labels = np.arange(60) % 2
    grid = np.stack(np.meshgrid(*[np.arange(-1, 7, 0.02)] * 2), axis=-1).reshape(-1, 2)
    covers = []
    for triangle in flat:
        ahead = np.roll(triangle, -1, axis=0) - triangle
        away = grid[:, None] - triangle
        side = ahead[:, 0] * away[..., 1] - ahead[:, 1] * away[..., 0]
        covers.append((side > 0).all(axis=1) | (side < 0).all(axis=1))
    shared = np.array(covers, np.float32) @ np.array(covers, np.float32).T
    expected = {
        (i, j)
        for i in range(60)
        for j in range(i + 1, 60)
        if labels[i] == labels[j] and shared[i, j] > 0
    }
    found = {(min(pair), max(pair)) for pair in find_overlaps(flat, labels).tolist()}
    assert len(expected) > 10
    assert expected <= found
    # What the grid is too coarse to see still touches.
    for i, j in found - expected:
        low = np.maximum(flat[i].min(axis=0), flat[j].min(axis=0))
        assert (low < np.minimum(flat[i].max(axis=0), flat[j].max(axis=0))).all()
    assert len(found - expected) <= 6


def test_a_strip_that_runs_over_itself_is_cut_once() -> None:
    vertices, faces, uvs = strip(120, 2.5 * np.pi)
    graph = face_graph(vertices, faces)
    labels = np.zeros(len(faces), np.int32)
    assert len(find_overlaps(uvs, labels)) > 0
    split = split_overlaps(uvs, labels, graph)
    assert len(find_overlaps(uvs, split)) == 0
    assert split.max() + 1 <= 3  # from its middle a piece of one turn, and the two ends
    other = np.where(graph.opposite >= 0, graph.opposite // 3, 0)
    parts = components(graph, split[other] == split[:, None])
    assert parts.max() == split.max()  # pieces are connected


def test_faces_turned_over_leave_their_chart() -> None:
    vertices, faces, _ = strip(10, 1.0)
    flat = vertices[faces][..., :2].copy()
    flat[-1] = flat[-1, [0, 2, 1]]
    split = split_overlaps(flat, np.zeros(len(faces), np.int32), face_graph(vertices, faces))
    assert split.max() >= 1
    turn = np.sign(signed_areas(flat))
    assert all(len(np.unique(turn[split == chart])) == 1 for chart in range(split.max() + 1))
    assert len(find_overlaps(flat, split)) == 0


def test_good_charts_stay_as_they_are() -> None:
    vertices, faces, _ = strip(20, 1.0)
    labels = np.repeat([0, 1], 20).astype(np.int32)
    assert (
        split_overlaps(vertices[faces][..., :2], labels, face_graph(vertices, faces)) == labels
    ).all()


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e4])
def test_a_flat_piece_is_relaxed_to_its_shape(scale: float) -> None:
    vertices, faces, uvs = strip(40, 1.5)
    vertices = vertices * scale
    labels = np.zeros(len(faces), np.int32)
    shapes = flatten_faces(vertices, faces)
    flat = equalise_density(uvs, labels, shapes)
    assert signed_areas(flat).sum() == pytest.approx(signed_areas(shapes).sum())

    def error(now: np.ndarray) -> float:
        edges = np.linalg.norm(now - np.roll(now, -1, axis=1), axis=2)
        true = np.linalg.norm(shapes - np.roll(shapes, -1, axis=1), axis=2)
        return float(np.abs(edges / true - 1.0).max())

    turned = flat if signed_areas(flat).sum() > 0 else flat[..., ::-1]
    relaxed = relax(turned, labels, shapes)
    assert error(relaxed) < 0.5 * error(turned)
    assert (signed_areas(relaxed) > 0).all()
    assert len(find_overlaps(relaxed, labels)) == 0


def test_points_of_charts_are_not_shared() -> None:
    _, faces, uvs = strip(5, 1.0)
    labels = np.repeat([0, 1], 5)
    corners, first = chart_points(uvs.astype(np.float32), labels)
    assert (uvs.astype(np.float32).reshape(-1, 2)[first][corners] == uvs.astype(np.float32)).all()
    assert not set(corners[:5].ravel()) & set(corners[5:].ravel())
    assert len(first) == len(np.unique(faces[:5])) + len(np.unique(faces[5:]))


def test_smoothing_moves_nothing_further_than_half_an_edge() -> None:
    mesh = sphere(3)
    far = mesh.vertices * 1e-3 + [5e3, -2e4, 10.0]
    noise = np.random.default_rng(0).normal(size=far.shape) * 1e-4
    moved = np.linalg.norm(smooth_vertices(far + noise, mesh.faces) - far - noise, axis=1)
    corners = (far + noise)[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max()
    assert 0.0 < moved.max() <= 0.5 * longest


def quads(columns: int, rows: int, width: float = 1.0, height: float = 1.0) -> np.ndarray:
    """A sheet of quads, two faces each, as (f, 3, 2)."""
    x, y = np.meshgrid(np.arange(columns) * width, np.arange(rows) * height)
    corner = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    lower = np.array([[0, 0], [width, 0], [width, height]])
    upper = np.array([[0, 0], [width, height], [0, height]])
    return np.concatenate([corner + lower, corner + upper])


def crossed_combs(n: int) -> np.ndarray:
    """Long thin faces along x beside long thin faces along y: each alone is a bad case."""
    lying = quads(1, n, n, 1.0)
    return np.concatenate([lying, lying[..., ::-1] + [n + 1.0, 0.0]])


SHEETS = {
    "a row": lambda n: quads(n, 1),
    "a column": lambda n: quads(1, n),
    "a square": lambda n: quads(round(n**0.5), round(n**0.5)),
    "slivers that lie on each other": lambda n: quads(1, n, 1.0, 1e-3),
    "slivers beside each other": lambda n: quads(n, 1, 1e-3, 1.0),
    "crossed combs": lambda n: crossed_combs(n // 2),
}


@pytest.mark.parametrize("name", SHEETS)
def test_pairs_that_are_looked_at_grow_with_the_faces(name: str) -> None:
    """A sweep in x alone looks at n^2 / 2 pairs of a column."""
    for n in (400, 3600):
        flat = SHEETS[name](n)
        pairs, candidates = overlapping_pairs(flat, np.zeros(len(flat), np.int64), 1e-4)
        assert len(pairs) == 0
        assert candidates <= 16 * len(flat)


def test_pairs_of_boxes_of_all_shapes_are_those_of_brute_force() -> None:
    """Upright boxes as pairs of faces: that they meet is seen by their borders."""
    generator = np.random.default_rng(5)
    low = generator.uniform(-3, 3, (300, 2))
    size = 10.0 ** generator.uniform(-3, 0.7, (300, 2))
    corner = np.array([[0, 0], [1, 0], [1, 1]])
    # Two faces of a box: what meets the box meets one of them.
    faces = np.concatenate([low[:, None] + size[:, None] * c for c in (corner, corner[:, ::-1])])
    labels = np.tile(np.arange(300) % 3, 2)
    pairs, candidates = overlapping_pairs(faces, labels, 1e-9)
    ends = pairs % 300
    found = {(min(a, b), max(a, b)) for a, b in ends.tolist() if a != b}
    assert len({(min(a, b), max(a, b)) for a, b in pairs.tolist()}) == len(pairs)
    meets = np.all((low[:, None] + size[:, None] > low) & (low + size > low[:, None]), axis=2) & (
        labels[:300, None] == labels[:300]
    )
    wanted = {(a, b) for a, b in np.argwhere(meets).tolist() if a < b}
    assert found == wanted
    assert len(wanted) > 300
    assert candidates < 0.5 * len(faces) ** 2 / 6
