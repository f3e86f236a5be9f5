# SPDX-License-Identifier: GPL-3.0-or-later
"""Unwrap: chunks, xatlas in its helper, the fallback, and the guarantees of both."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import (
    Cancelled,
    DatasetError,
    MemoryShortageError,
    ResourceError,
)
from gaussian_wrapping_addon.core.mesh.components import components, face_graph
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas
from gaussian_wrapping_addon.core.texture.unwrap import charts as charts_module
from gaussian_wrapping_addon.core.texture.unwrap import unwrap as unwrap_module
from gaussian_wrapping_addon.core.texture.unwrap.charts import (
    MAX_CHUNK_FACES,
    split_into_chunks,
    texture_stretch,
)
from gaussian_wrapping_addon.core.texture.unwrap.overlaps import find_overlaps
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import Unwrap, unwrap
from tests.core.texture.detail_scenes import grid
from tests.core.texture.texture_scenes import box, joined, sphere


def noisy_sphere() -> SurfaceMesh:
    mesh = sphere(4)
    noise = np.random.default_rng(1).normal(size=mesh.vertices.shape)
    return SurfaceMesh(mesh.vertices + 0.004 * noise, mesh.faces)


def with_flat_faces() -> SurfaceMesh:
    mesh = sphere(2)
    a, b, _ = mesh.faces[0].tolist()
    vertices = np.concatenate([mesh.vertices, mesh.vertices[:1] + 1e-12])
    flat = [[0, 0, 1], [5, 5, 5], [a, b, a], [0, len(vertices) - 1, 1]]
    return SurfaceMesh(vertices, np.concatenate([mesh.faces, flat]).astype(np.int32))


def fan() -> SurfaceMesh:
    """Five faces on one edge: not a manifold."""
    angles = np.arange(5) * 2 * np.pi / 5
    rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(5)], axis=1)
    vertices = np.concatenate([[[0, 0, -1], [0, 0, 1]], rim])
    return SurfaceMesh(vertices, np.array([[0, 1, 2 + k] for k in range(5)], np.int32))


def helix() -> SurfaceMesh:
    """A ramp of three turns: all faces look up, and cover each other from above."""
    steps = np.linspace(0, 6 * np.pi, 120)
    inner = np.stack([np.cos(steps), np.sin(steps), 0.1 * steps], axis=1)
    outer = inner * [2, 2, 1]
    k = np.arange(len(steps) - 1)
    n = len(steps)
    faces = np.concatenate([np.stack([k, k + n, k + 1], 1), np.stack([k + n, k + n + 1, k + 1], 1)])
    return SurfaceMesh(np.concatenate([inner, outer]), faces.astype(np.int32))


def noisy(mesh: SurfaceMesh, share: float) -> SurfaceMesh:
    """Move vertices by a share of the median edge."""
    edges = mesh.vertices[mesh.faces[:, 0]] - mesh.vertices[mesh.faces[:, 1]]
    noise = np.random.default_rng(2).normal(size=mesh.vertices.shape)
    step = share * np.median(np.linalg.norm(edges, axis=1))
    return SurfaceMesh(mesh.vertices + step * noise, mesh.faces)


def bowl(n: int) -> SurfaceMesh:
    return grid(n - 1, lambda xy: 1.2 * (xy**2).sum(axis=1))


def wire(sides: int, rings: int) -> SurfaceMesh:
    """An open tube along a helix, of so many faces around."""
    t = np.linspace(0, 4 * np.pi, rings)
    centre = np.stack([np.cos(t), np.sin(t), 0.2 * t], axis=1)
    along = np.gradient(centre, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    side = np.cross(along, [0, 0, 1])
    side /= np.linalg.norm(side, axis=1)[:, None]
    angles = np.arange(sides) * 2 * np.pi / sides
    ring = (
        np.cos(angles)[:, None] * side[:, None]
        + np.sin(angles)[:, None] * np.cross(along, side)[:, None]
    )
    row = np.arange(len(t) - 1)[:, None] * sides
    k, q = (row + np.arange(sides)).ravel(), (row + (np.arange(sides) + 1) % sides).ravel()
    faces = np.concatenate([np.stack([k, q, q + sides], 1), np.stack([k, q + sides, k + sides], 1)])
    vertices = (centre[:, None] + 0.02 * ring).reshape(-1, 3)
    return SurfaceMesh(vertices, faces.astype(np.int32))


MESHES = {
    "cube": lambda: box([0, 0, 0], [1, 1, 1], 0),
    "noisy sphere": noisy_sphere,
    "two pieces": lambda: joined(sphere(2), box([3, 0, 0], [4, 1, 1], 2)),
    "flat faces": with_flat_faces,
    "five faces on an edge": fan,
    "helix": helix,
    "one triangle": lambda: SurfaceMesh(np.eye(3), np.array([[0, 1, 2]], np.int32)),
    "huge coordinates": lambda: SurfaceMesh(
        sphere(2).vertices * 1e-3 + [5e5, 4e6, 100.0], sphere(2).faces
    ),
}


def assert_usable(mesh: SurfaceMesh, unwrapped: Unwrap, size_px: int, gutter_px: int) -> None:
    uvs = unwrapped.corner_uvs
    assert uvs.shape == (len(mesh.faces), 3, 2)
    assert uvs.dtype == np.float32
    assert np.isfinite(uvs).all()
    assert uvs.min() >= 0.0
    assert uvs.max() <= 1.0
    raster = raster_atlas(uvs, size_px, 2)
    assert raster.overlaps == 0
    areas = face_graph(mesh.vertices, mesh.faces).areas
    edge1, edge2 = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    signed = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
    solid = areas > 1e-6 * areas.max()
    # Seen from outside, no chart is mirrored: text and tangent-space normals read the right way.
    assert (signed[solid] > 0).all()
    assert unwrapped.gutter_px >= gutter_px
    assert smallest_gap(raster.face, raster.inside, unwrapped.charts) >= gutter_px - 1.5


def smallest_gap(face: np.ndarray, inside: np.ndarray, charts: np.ndarray) -> float:
    """Smallest distance between texel centres of different charts, up to 8 texels."""
    label = np.where(inside, charts[face], -1)
    smallest = 8.0
    for dy in range(8):
        for dx in range(-7, 8):
            distance = float(np.hypot(dx, dy))
            if distance >= smallest or (dy == 0 and dx <= 0):
                continue
            moved = np.roll(label, (-dy, -dx), axis=(0, 1))
            moved[label.shape[0] - dy :] = -1
            moved[:, : max(-dx, 0)] = -1
            if dx > 0:
                moved[:, -dx:] = -1
            if ((label >= 0) & (moved >= 0) & (label != moved)).any():
                smallest = distance
    return smallest


@pytest.mark.parametrize("method", ["xatlas", "box"])
@pytest.mark.parametrize("name", MESHES)
def test_uvs_are_finite_inside_and_without_overlap(
    name: str,
    method: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    mesh = MESHES[name]()
    if method == "box":
        monkeypatch.setattr(charts_module, "CHARTS_HELPER", "texture.no_such_helper")
    unwrapped = unwrap(mesh, 512, 4, tmp_path, Progress(), threads=2)
    assert unwrapped.method == method
    assert ("no_such_helper" in unwrapped.reason) == (method == "box")
    assert ("box projection" in caplog.text) == (method == "box")
    assert_usable(mesh, unwrapped, 512, 4)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("noise", [0.0, 0.3, 0.75])
def test_folds_of_a_noisy_bowl_are_cut(noise: float, tmp_path: Path) -> None:
    mesh = noisy(bowl(70), noise)
    unwrapped = unwrap(mesh, 1024, 4, tmp_path, Progress(), threads=2)
    assert unwrapped.method == "xatlas"
    assert_usable(mesh, unwrapped, 1024, 4)
    assert len(find_overlaps(unwrapped.corner_uvs, unwrapped.charts)) == 0


def test_noise_does_not_shatter_the_surface(tmp_path: Path) -> None:
    """Noise of 0.3 edges on the mesh itself made 4000 charts of these 20 000 faces."""
    mesh = noisy(sphere(5), 0.3)
    unwrapped = unwrap(mesh, 1024, 2, tmp_path, Progress(), threads=2)
    assert unwrapped.method == "xatlas"
    assert unwrapped.charts.max() + 1 < 400
    assert raster_atlas(unwrapped.corner_uvs, 1024, 2).inside.mean() > 0.4
    stretch = texture_stretch(mesh.vertices, mesh.faces, unwrapped.corner_uvs)
    assert stretch.mean < 1.1
    assert stretch.collapsed_share == 0.0


@pytest.mark.parametrize(("sides", "rings"), [(3, 600), (4, 300)])
def test_thin_wires_keep_their_tubes(sides: int, rings: int, tmp_path: Path) -> None:
    mesh = wire(sides, rings)
    unwrapped = unwrap(mesh, 1024, 2, tmp_path, Progress(), threads=2)
    assert unwrapped.method == "xatlas"
    assert_usable(mesh, unwrapped, 1024, 2)
    stretch = texture_stretch(mesh.vertices, mesh.faces, unwrapped.corner_uvs)
    assert stretch.mean < 1.1
    assert stretch.collapsed_share == 0.0


def test_a_smoothed_copy_that_xatlas_refuses_is_not_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = charts_module.run_helper
    calls = []

    def helper(module: str, folder: Path, progress: Progress, **options: float) -> None:
        calls.append(module)
        if len(calls) == 1:
            raise ResourceError("took too long")
        run(module, folder, progress, **options)

    monkeypatch.setattr(charts_module, "run_helper", helper)
    mesh = sphere(3)
    unwrapped = unwrap(mesh, 256, 2, tmp_path, Progress())
    assert unwrapped.method == "xatlas"
    assert_usable(mesh, unwrapped, 256, 2)


@pytest.mark.parametrize("bad", ["overlap", "nan", "outside", "missing", "silent"])
def test_bad_answers_of_xatlas_are_refused(
    bad: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the helpers say is checked, not believed."""
    run = charts_module.run_helper

    def helper(module: str, folder: Path, progress: Progress, **options: float) -> None:
        with np.load(folder / "input.npz", allow_pickle=False) as arrays:
            task = {name: arrays[name] for name in arrays.files}
        if module == charts_module.CHARTS_HELPER and bad in ("nan", "missing"):
            uvs = np.tile(np.eye(3, 2, dtype=np.float32), (len(task["corners"]), 1, 1))
            uvs[0 if bad == "nan" else len(uvs) // 2 :] = np.nan
            np.savez(folder / "output.npz", corner_uvs=uvs)
        elif module == charts_module.PACK_HELPER and bad in ("overlap", "outside"):
            points = task["points"] / task["points"].max() + (0.5 if bad == "outside" else 0.0)
            np.savez(folder / "output.npz", points=points, gutter_px=4.0)
        elif bad != "silent":
            run(module, folder, progress, **options)

    monkeypatch.setattr(charts_module, "run_helper", helper)
    mesh = box([0, 0, 0], [1, 1, 1], 2)
    unwrapped = unwrap(mesh, 256, 4, tmp_path, Progress())
    assert unwrapped.method == "box"
    assert_usable(mesh, unwrapped, 256, 4)


def test_a_shortage_of_memory_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same job with enough memory would have another texture."""
    asked = []

    def helper(module: str, *_: object, **__: object) -> None:
        asked.append(module)
        raise MemoryShortageError("memory is short", "Wait.")

    monkeypatch.setattr(charts_module, "run_helper", helper)
    with pytest.raises(MemoryShortageError, match="memory is short"):
        unwrap(sphere(2), 256, 4, tmp_path, Progress())
    assert asked == [charts_module.CHARTS_HELPER]
    assert list(tmp_path.iterdir()) == []


def test_cancelling_leaves_nothing_behind(tmp_path: Path) -> None:
    calls = []

    def cancelled() -> bool:
        calls.append(1)
        return len(calls) > 3

    with pytest.raises(Cancelled):
        unwrap(sphere(5), 512, 4, tmp_path, Progress(is_cancelled=cancelled))
    assert list(tmp_path.iterdir()) == []


def test_meshes_without_area_or_not_finite_are_not_given_to_xatlas(tmp_path: Path) -> None:
    line = SurfaceMesh(np.eye(3)[:1] * np.arange(3)[:, None], np.array([[0, 1, 2]], np.int32))
    far = SurfaceMesh(
        np.where(sphere(2).vertices > 0.9, np.inf, sphere(2).vertices), sphere(2).faces
    )
    for mesh, solid, words in ((line, line, "area"), (far, sphere(2), "finite")):
        graph = face_graph(solid.vertices, solid.faces)
        with pytest.raises(DatasetError, match=words):
            unwrap_module._xatlas(mesh, graph, 64, 2, tmp_path, Progress(), 1)
    assert list(tmp_path.iterdir()) == []


def test_chunks_are_connected_and_bounded() -> None:
    mesh = noisy_sphere()
    graph = face_graph(mesh.vertices, mesh.faces)
    labels = split_into_chunks(graph)
    sizes = np.bincount(labels)
    assert sizes.min() > 0
    assert sizes.max() <= 1.3 * MAX_CHUNK_FACES
    assert len(sizes) <= 2 * len(mesh.faces) / MAX_CHUNK_FACES
    other = np.where(graph.opposite >= 0, graph.opposite // 3, 0)
    parts = components(graph, labels[other] == labels[:, None])
    assert parts.max() + 1 == len(sizes)
    # Many small pieces share chunks.
    dust = joined(*[box([3 * k, 0, 0], [3 * k + 1, 1, 1], 0) for k in range(400)])
    labels = split_into_chunks(face_graph(dust.vertices, dust.faces))
    assert labels.max() + 1 <= 5
    assert np.bincount(labels).max() <= MAX_CHUNK_FACES


def test_a_texture_too_small_for_the_gutter_keeps_what_it_can(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    dust = joined(*[box([3 * k, 0, 0], [3 * k + 1, 1, 1], 0) for k in range(60)])
    with caplog.at_level(logging.WARNING):
        unwrapped = unwrap(dust, 96, 16, tmp_path, Progress())
    assert unwrapped.gutter_px < 16
    assert any("too small" in record.message for record in caplog.records)
    assert np.isfinite(unwrapped.corner_uvs).all()
    assert unwrapped.corner_uvs.min() >= 0
    assert unwrapped.corner_uvs.max() <= 1
