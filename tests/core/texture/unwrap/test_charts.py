# SPDX-License-Identifier: GPL-3.0-or-later
"""Charts: overlaps, splits, relaxation, stretch, whole polygons, UVs that a mesh has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.limits import MAX_ATLASES
from gaussian_wrapping_addon.core.mesh.components import components, face_graph, uv_charts
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import udim_uvs
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.texture.unwrap.charts import (
    equalise_density,
    flatten_faces,
    relax,
    smooth_vertices,
    texture_stretch,
)
from gaussian_wrapping_addon.core.texture.unwrap.overlaps import (
    find_overlaps,
    join_polygons,
    overlapping_pairs,
    set_cut_apart,
    signed_areas,
    split_overlaps,
)
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import (
    Unwrap,
    own_uvs,
    unwrap,
    uv_area,
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


def test_faces_that_touch_stay_together_and_those_turned_over_leave_their_chart() -> None:
    vertices, faces, _ = strip(20, 1.0)
    graph, flat = face_graph(vertices, faces), vertices[faces][..., :2].copy()
    for labels in (np.zeros(40, np.int32), np.repeat([0, 1], 20).astype(np.int32)):
        assert len(find_overlaps(flat.astype(np.float32) * 1e-4 + 0.9, labels)) == 0
        assert (split_overlaps(flat, labels, graph) == labels).all()
    flat[-1] = flat[-1, [0, 2, 1]]
    split = split_overlaps(flat, np.zeros(len(faces), np.int32), graph)
    assert split.max() >= 1
    turn = np.sign(signed_areas(flat))
    assert all(len(np.unique(turn[split == chart])) == 1 for chart in range(split.max() + 1))
    assert len(find_overlaps(flat, split)) == 0


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


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def uvs_of(points: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    return (points[:, :2] * scale)[FACES].astype(np.float32)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("away", [0.0, 100.0])
def test_an_even_map_has_no_stretch(size: float, away: float) -> None:
    stretch = texture_stretch((SQUARE + away) * size, FACES, uvs_of(SQUARE, (0.25, 0.25)))
    assert (stretch.mean, stretch.p95) == pytest.approx((1.0, 1.0), abs=1e-6)
    assert stretch.collapsed_share == 0.0


def test_stretch_is_weighted_by_area_and_leaves_out_collapsed_faces() -> None:
    # A map twice as wide as high: relative to the mean scale a step moves by sqrt(2), 1 / sqrt(2).
    stretch = texture_stretch(SQUARE, FACES, uvs_of(SQUARE, (0.2, 0.4)))
    assert abs(stretch.mean - np.sqrt((2.0 + 0.5) / 2)) < 1e-6
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    uvs = np.array([[[0, 0], [0.3, 0], [0, 0.3]], [[0, 0], [0.01, 0], [0, 0.01]]], np.float32)
    stretch = texture_stretch(vertices, faces, uvs)
    scale = np.sqrt(10.0 / 0.0901)
    assert abs(stretch.mean - (0.9 * 10 + 0.1 * 100) / scale) < 1e-5
    assert abs(stretch.p95 - 100 / scale) < 1e-5
    uvs = uvs_of(SQUARE, (0.25, 0.25))
    uvs[1] = uvs[0, 0]
    stretch = texture_stretch(SQUARE, FACES, uvs)
    assert abs(stretch.mean - 1.0) < 1e-6
    assert stretch.collapsed_share == 0.5


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


STRIP_FACES = 24
TRIANGLE = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]])


def strip_of_tiles(count: int = STRIP_FACES) -> SurfaceMesh:
    """Separate triangles of equal area."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    vertices = (corners + np.arange(count)[:, None, None] * [2.0, 0, 0]).reshape(-1, 3)
    return SurfaceMesh(vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3))


def test_ordinary_uvs_are_kept_bit_by_bit() -> None:
    uvs = np.broadcast_to(TRIANGLE, (STRIP_FACES, 3, 2)).astype(np.float32)
    own = own_uvs(strip_of_tiles(), uvs)
    assert own.udims == (1001,)
    assert own.warnings == ()
    assert own.unwrapped.face_atlas is None
    assert np.array_equal(own.unwrapped.corner_uvs, uvs)
    assert len(np.unique(own.unwrapped.charts)) == STRIP_FACES
    assert uv_area(uvs) == pytest.approx(STRIP_FACES * 0.32)


def test_tiles_are_numbered_by_column_and_row_and_lead_back() -> None:
    tiles = np.array([[0, 0], [9, 0], [0, 1], [3, 7]])[np.arange(STRIP_FACES) % 4]
    uvs = (TRIANGLE + tiles[:, None]).astype(np.float32)
    own = own_uvs(strip_of_tiles(), uvs)
    assert own.udims == (1001, 1010, 1011, 1074)
    face_atlas = own.unwrapped.face_atlas
    assert face_atlas.tolist() == (np.arange(STRIP_FACES) % 4).tolist()
    inside = own.unwrapped.corner_uvs
    assert inside.min() >= 0.0
    assert inside.max() <= 1.0
    assert np.abs(udim_uvs(inside, face_atlas, own.udims) - uvs).max() < 1e-6


def test_edges_of_tiles_belong_to_the_tile_of_their_face() -> None:
    """From 0 to 1, beyond it by rounding, and faces collapsed to a point of the far edge."""
    whole = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    uvs = np.stack([whole - 5e-5, np.ones((3, 2)), whole + 5e-5] + [whole] * 7)
    own = own_uvs(strip_of_tiles(len(uvs)), uvs)
    assert own.udims == (1001,)
    assert own.unwrapped.corner_uvs.min() == 0.0
    assert own.unwrapped.corner_uvs.max() == 1.0
    (warning,) = own.warnings
    assert warning.code == "uv-flat"
    assert warning.text.startswith("1 of 10 faces have no area in the UV map, 10 %")


@pytest.mark.parametrize(
    ("change", "words"),
    [(np.nan, r"Face 5 of the mesh has UVs that are not finite\."),
     (-1.0, "Face 5 of the mesh has UVs outside of the UDIM tiles"),
     (11.0, "outside of the UDIM tiles"), (0.5, "cross the edge of a tile")],
)  # fmt: skip
def test_uvs_that_cannot_be_used_are_refused_by_face(change: float, words: str) -> None:
    uvs = np.array(np.broadcast_to(TRIANGLE, (STRIP_FACES, 3, 2)))
    uvs[5] += [change, 0.0]
    with pytest.raises(MeshingError, match=words) as caught:
        own_uvs(strip_of_tiles(), uvs)
    assert "--uvs new" in caught.value.hint


def test_maps_that_cannot_be_used_say_how_many_faces_do_so() -> None:
    every = np.arange(STRIP_FACES)[:, None, None]
    tiles = np.concatenate([every % 10, every // 10], axis=2)
    for uvs, words in (
        (3.0 * TRIANGLE + 0 * every, f"as do {STRIP_FACES} faces in all"),
        (np.where(every < 13, 0.25, TRIANGLE), "54 % of the surface have no area"),
        (TRIANGLE + tiles, f"{STRIP_FACES} UDIM tiles; the limit is {MAX_ATLASES}"),
    ):
        with pytest.raises(MeshingError, match=words):
            own_uvs(strip_of_tiles(), uvs)
