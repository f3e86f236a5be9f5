# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes, photos and coordinates that once crashed unwrapping, baking or export.

Cases by their numbers; "handled" is finite UVs in 0 to 1 without overlaps, "refused" a typed error
with a next step and nothing left behind.

| case | what | test |
|---|---|---|
| 46 | empty mesh, NaN vertex | ``test_46_refused`` |
| 46 | one triangle, non-manifold, duplicate vertices, zero-area faces | ``test_46_handled`` |
| 47 | icospheres of 81,920 and 327,680 faces, 82 k noisy | ``test_47_large`` |
| 47 | 1e30 | ``test_47_far`` |
| 47 | Inf, collinear, index out of range | ``test_47_refused`` |
| 47 | time-out of the helper | ``test_47_time_out`` |
| 48 | face that no photo sees, photo behind the surface, photo all mask | ``test_48_photos`` |
| 48 | texture of 1 px, of 16k, larger than memory | ``test_48_sizes``, ``test_48_memory`` |
| 49 | export of NaN, of no faces | ``test_49_refused`` |
| 49 | names of 300 bytes or with "/" | ``test_49_names`` |
| 49 | target folder missing, read-only | ``test_49_places`` |
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError, ResourceError, UsageError
from gaussian_wrapping_addon.core.jobs.commands.export_files import ExportRequest, export_files
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.names import file_stem
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas
from gaussian_wrapping_addon.core.texture.unwrap import charts
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import Unwrap, unwrap
from tests.core.jobs.commands.test_export_files import write_result
from tests.core.texture.test_texture_mesh import run
from tests.core.texture.texture_scenes import look_at, photograph, ring, sphere, sphere_hit, waves
from tests.core.texture.unwrap.test_unwrap import MESHES, noisy
from tests.read_only import read_only

ROOT = Path(__file__).resolve().parents[3]


def assert_handled(mesh: SurfaceMesh, unwrapped: Unwrap, size_px: int) -> None:
    uvs = unwrapped.corner_uvs
    assert uvs.shape == (len(mesh.faces), 3, 2)
    assert np.isfinite(uvs).all()
    assert uvs.min() >= 0.0
    assert uvs.max() <= 1.0
    assert raster_atlas(uvs, size_px, 2).overlaps == 0


def with_vertex(value: float) -> SurfaceMesh:
    mesh = sphere(2)
    vertices = mesh.vertices.copy()
    vertices[3] = value
    return SurfaceMesh(vertices, mesh.faces)


def two_vertices_at_each_place() -> SurfaceMesh:
    """Faces share places, not vertices: each is a piece of its own."""
    mesh = sphere(1)
    faces = np.arange(mesh.faces.size, dtype=np.int32).reshape(-1, 3)
    return SurfaceMesh(mesh.vertices[mesh.faces].reshape(-1, 3), faces)


def refused(mesh: SurfaceMesh, words: str, folder: Path) -> None:
    photos = photograph(ring(2, 3.0, 0.0), [(sphere_hit, waves)])
    with pytest.raises(MeshingError, match=words) as caught:
        run(mesh, photos, folder, 64)
    assert caught.value.hint
    assert list(folder.iterdir()) == []


def test_46_refused(tmp_path: Path) -> None:
    nothing = SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    refused(nothing, "no faces", tmp_path)
    refused(with_vertex(np.nan), "finite", tmp_path)


@pytest.mark.parametrize(
    "case", ["one triangle", "five faces on an edge", "duplicate vertices", "flat faces"]
)
def test_46_handled(case: str, tmp_path: Path) -> None:
    mesh = two_vertices_at_each_place() if case == "duplicate vertices" else MESHES[case]()
    assert_handled(mesh, unwrap(mesh, 256, 2, tmp_path, Progress()), 256)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("splits", "noise"),
    [
        pytest.param(6, 0.0, id="81,920 faces"),
        pytest.param(6, 0.3, id="81,920 noisy faces", marks=pytest.mark.proof),
        pytest.param(7, 0.0, id="327,680 faces", marks=pytest.mark.proof),
    ],
)
def test_47_large(splits: int, noise: float, tmp_path: Path) -> None:
    mesh = noisy(sphere(splits), noise)
    unwrapped = unwrap(mesh, 2048, 2, tmp_path, Progress(), threads=2)
    assert unwrapped.method == "xatlas"
    assert_handled(mesh, unwrapped, 2048)
    assert raster_atlas(unwrapped.corner_uvs, 2048, 2).inside.mean() > 0.3


def test_47_far(tmp_path: Path) -> None:
    """One vertex at 1e30 leaves the others no texel; it neither hangs nor ends the process."""
    mesh = with_vertex(1e30)
    assert_handled(mesh, unwrap(mesh, 256, 2, tmp_path, Progress()), 256)


def test_47_refused(tmp_path: Path) -> None:
    refused(with_vertex(np.inf), "finite", tmp_path)
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    refused(SurfaceMesh(line, np.array([[0, 1, 2], [1, 2, 3]], np.int32)), "area", tmp_path)
    mesh = sphere(1)
    out_of_range = np.where(mesh.faces == 5, len(mesh.vertices), mesh.faces)
    refused(SurfaceMesh(mesh.vertices, out_of_range), "does not exist", tmp_path)


def test_47_time_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(charts, "DEADLINE_BASE_S", 0.0)
    monkeypatch.setattr(charts, "DEADLINE_PER_FACE_S", 0.0)
    mesh = sphere(2)
    unwrapped = unwrap(mesh, 256, 2, tmp_path, Progress())
    assert unwrapped.method == "box"
    assert "took longer" in unwrapped.reason
    assert_handled(mesh, unwrapped, 256)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("case", ["unseen face", "photo behind the surface", "photo all mask"])
def test_48_photos(case: str, tmp_path: Path) -> None:
    good = [look_at((0.0, 0.0, 3.0)), look_at((0.5, 0.0, 3.0))]
    if case == "photo behind the surface":  # it stands inside, and sees back faces alone
        good.append(look_at((0.0, 0.0, 0.1), target=(0.0, 0.0, 1.0)))
    photos = photograph(good, [(sphere_hit, waves)])
    if case == "photo all mask":
        photos.masks = [np.ones(i.shape[:2], bool) for i in photos.images]
        photos.masks[1][:] = False
    elif case == "photo behind the surface":
        photos.images[2] = np.full_like(photos.images[2], 255)
    textured = run(sphere(2), photos, tmp_path, 128)
    figures = textured.statistics
    assert 0.1 < figures["coverage"] < 0.7  # the back is seen by no photo: filled, and counted
    assert figures["texels_filled"] > 0
    if case == "photo behind the surface":
        assert (textured.albedo.min(axis=2) < 250).all()  # nothing of its white


@pytest.mark.parametrize("side_px", [1, 16384])
def test_48_sizes(side_px: int, tmp_path: Path) -> None:
    photos = photograph(ring(2, 3.0, 0.0), [(sphere_hit, waves)])
    if side_px > 1:
        with pytest.raises(UsageError, match="16384") as caught:
            run(sphere(1), photos, tmp_path, side_px)
        assert "8192" in caught.value.hint
    else:
        textured = run(sphere(1), photos, tmp_path, side_px, gutter_px=1)
        assert textured.albedo.shape == (1, 1, 3)
        assert np.isfinite(textured.corner_uvs).all()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is limited on Linux alone")
def test_48_memory(tmp_path: Path) -> None:
    script = (
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from gaussian_wrapping_addon.core.jobs.commands.run_in_worker import run_command\n"
        "from tests.core.texture.test_texture_mesh import run\n"
        "from tests.core.texture.texture_scenes import *\n"
        "photos = photograph(ring(2, 3.0, 0.0), [(sphere_hit, waves)])\n"
        "folder = Path(sys.argv[1])\n"
        "pages = int(open('/proc/self/statm').read().split()[0])\n"
        "limit = pages * resource.getpagesize() + 300 * 2**20\n"
        "def work():\n"
        "    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))\n"
        "    run(sphere(1), photos, folder, 8192)\n"
        "    return []\n"
        "sys.exit(run_command(work))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip
    assert done.returncode == ResourceError.exit_code, done.stderr[-2000:]
    assert "Not enough memory" in done.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("case", ["NaN", "no faces"])
@pytest.mark.parametrize("format", ["glb", "obj", "ply"])
def test_49_refused(case: str, format: str, tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    path = result / "auto" / "mesh.npz"
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    if case == "NaN":
        arrays["vertices"][2, 1] = np.nan
    else:
        arrays["faces"], arrays["corner_uvs"] = arrays["faces"][:0], arrays["corner_uvs"][:0]
    np.savez(path, **arrays)
    with pytest.raises(MeshingError, match="auto"):
        list(export_files(ExportRequest(result, tmp_path / "out", (format,))))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["x" * 300, "é" * 150, "a/b", "../a", "a\\b", "/", "a:b", "NUL"])
def test_49_names(name: str, tmp_path: Path) -> None:
    stem = file_stem(name, 1)
    path = tmp_path / f"{stem}-occlusion.png.json.writing.12345678"
    path.write_text("")
    assert list(tmp_path.iterdir()) == [path]
    assert not set(stem) & set('/\\:*?"<>| ')
    assert stem.split(".")[0].upper() != "NUL"


@pytest.mark.parametrize("case", ["missing", "under a file", "read-only"])
def test_49_places(case: str, tmp_path: Path) -> None:
    result = write_result(tmp_path / "job")
    request = ExportRequest(result, tmp_path / "deep" / "out", ("glb",))
    if case == "missing":  # is made
        assert [path.name for path in export_files(request)] == ["auto.glb"]
        return
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "out"
    closed: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
    if case == "read-only":
        out = tmp_path / "closed"
        out.mkdir()
        closed = read_only(out)
    with closed, pytest.raises(ResourceError, match="cannot be written") as caught:
        list(export_files(replace(request, out=out)))
    assert caught.value.hint
