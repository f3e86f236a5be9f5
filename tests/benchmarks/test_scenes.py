# SPDX-License-Identifier: GPL-3.0-or-later
"""Ground-truth scenes: exact cameras, closed truth, honest labels, readable folders."""

from __future__ import annotations

import functools
import importlib.util
import json
import operator
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pytest
from PIL import Image

from benchmarks.scenes.build import (
    CUP_INSIDE,
    PLATE_HEIGHT,
    PLATE_SHARE,
    PLATE_WIDTH,
    RING_RADIUS,
    TUBE_RADIUS,
    BuildSize,
    build_cup_inside,
    build_scene,
    cup_inside_content,
    torus_content,
    truth_samples,
)
from benchmarks.scenes.cache import kind_named
from benchmarks.scenes.catalogue import KINDS, scene_content, scene_kind
from benchmarks.scenes.geometry import joined
from benchmarks.scenes.rendering import Light, render_photos
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.mesh.depth_buffer import depth_buffer
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.scene_regions import read_region
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.proofs import first_then_proofs

for _module in ("bpy", "embreex"):
    if importlib.util.find_spec(_module) is None:
        pytest.skip(f"the module {_module} is not installed", allow_module_level=True)

SIZE = BuildSize(photos=4, test_views=2, width=64, height=48, truth_samples=4000)
THINGS = ("spot", "wheel", "cup", "fence", "glossy")


_render_masks = functools.partial(
    render_photos, light=Light(sun=1.0), samples=16, mask_of=operator.attrgetter("surrounding")
)


def _apart(function: Callable[..., Any], *arguments: Any) -> Any:
    """Run in a fresh process: Blender's state is global, and other tests use it too.

    A process that has imported bpy has its scripts on the path, and hands the path on: another
    ``bpy`` lies there, which works inside of Blender only.
    """
    own = [entry for entry in sys.path if "bpy" not in Path(entry).parts]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", own)
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            return pool.submit(function, *arguments).result()


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return tiny folders of a thing, of its two variants and of the room."""
    root = tmp_path_factory.mktemp("scenes")
    for name in ("spot", "spot_far", "spot_exposure", "room"):
        kind = scene_kind(name)
        base = root / kind.derived_from if kind.derived_from else None
        _apart(build_scene, kind, SIZE, root / name, base)
    return {path.name: path for path in root.iterdir()}


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the volume enclosed by a closed mesh, > 0 where faces are seen from outside."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def open_edges(faces: np.ndarray) -> int:
    """Return the number of edges that are not met once in each direction."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)  # (3f, 2)
    count: dict[tuple[int, int], int] = {}
    for a, b in edges.tolist():
        key = (min(a, b), max(a, b))
        count[key] = count.get(key, 0) + (1 if a < b else -1)
    return sum(1 for value in count.values() if value)


@pytest.mark.parametrize("name", THINGS)
def test_true_meshes_of_things_are_closed_and_lie_in_their_region(name: str) -> None:
    content = scene_content(scene_kind(name), 4, 2, (64, 48))
    vertices, faces = content.truth
    assert open_edges(faces) == 0
    assert signed_volume(vertices, faces) > 0
    assert content.crop.contains(vertices).all()
    assert content.region.contains(content.crop.vertices).all()
    # Nothing else is in the region: only the thing is to be meshed.
    others, _ = joined([part for part in content.parts if part.surrounding])
    assert not content.region.contains(others).any()


@pytest.mark.proof
def test_the_rooms_truth_is_one_closed_solid_around_its_free_space(
    folders: dict[str, Path],
) -> None:
    with np.load(folders["room"] / "truth.npz") as truth:
        vertices, faces, points = truth["vertices"], truth["faces"], truth["points"]
    assert open_edges(faces) == 0
    shell = 5.2 * 4.2 * 2.9 - 4.8 * 3.8 * 2.5
    assert shell < signed_volume(vertices, faces) < 1.15 * shell
    # Free space is outside of the solid, a wall and the table top are inside.
    asked = np.array([[0.0, 0.8, 1.5], [0.0, 0.0, -0.1], [0.9, 0.0, 0.73], [-2.5, 0.0, 1.0]])
    winding = igl.fast_winding_number(vertices, faces, asked)
    np.testing.assert_allclose(winding, [0, 1, 1, 1], atol=0.02)
    region, crop = (read_region(folders["room"] / f"{n}.json") for n in ("region", "crop"))
    assert region.contains(vertices, 1e-5).all()
    assert crop.contains(points).all()
    assert not crop.contains(vertices).all()  # the outer side of the walls is not judged


@pytest.mark.parametrize("name", first_then_proofs(["spot", "room"]))
def test_photos_show_the_geometry_where_the_cameras_say(name: str, tmp_path: Path) -> None:
    content = _apart(scene_content, scene_kind(name), 4, 2, (320, 240))
    shown = [not part.surrounding for part in content.parts]
    paths = [tmp_path / camera.name for camera in content.cameras]
    _apart(_render_masks, content.parts, content.cameras, paths)
    owner = np.repeat(shown, [len(part.faces) for part in content.parts])
    counted = 0
    for camera, path in zip(content.cameras, paths, strict=True):
        face = depth_buffer(*joined(content.parts), camera).face
        wanted = (face >= 0) & owner[face]
        with Image.open(path) as image:
            found = np.asarray(image.convert("L")) < 128  # what is not the room around
        if wanted.mean() < 0.02:
            continue
        counted += 1

        def agreement(mask: np.ndarray, found: np.ndarray = found) -> float:
            return float((mask & found).sum() / (mask | found).sum())

        assert agreement(wanted) > 0.99
        # A camera that is half a pixel off would agree with a shifted mask as well.
        for axis in (0, 1):
            there, back = (agreement(np.roll(wanted, k, axis)) for k in (1, -1))
            assert agreement(wanted) > max(there, back)
            assert abs(there - back) < 0.3 * (1 - min(there, back))
    assert counted >= 3


@pytest.mark.parametrize("name", ["spot", "room"])
def test_samples_lie_on_the_truth_and_are_labelled_as_rays_say(
    name: str, folders: dict[str, Path]
) -> None:
    folder = folders[name]
    with np.load(folder / "truth.npz") as truth:
        values = {key: truth[key] for key in truth.files}
    assert set(values) == {"vertices", "faces", "points", "normals", "thin", "seen"}
    points, normals = values["points"], values["normals"]
    assert abs(len(points) - SIZE.truth_samples) <= 0.03 * SIZE.truth_samples
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    squared, _, _ = igl.point_mesh_squared_distance(points, values["vertices"], values["faces"])
    assert np.sqrt(squared).max() < 1e-7
    content = _apart(scene_content, scene_kind(name), SIZE.photos, SIZE.test_views, (64, 48))
    vertices, faces = joined(content.parts)
    corners = vertices[faces]  # (f, 3, 3)
    random = np.random.default_rng(5)
    chosen = random.choice(len(points), 60, replace=False)
    for index in chosen.tolist():
        point, normal = points[index], normals[index]
        start = point + 1e-4 * normal
        seen = 0
        for camera in content.cameras:
            pixel, depth = camera.project(point[None])
            shown = depth[0] > 0 and (pixel[0] >= 0).all() and (pixel[0] < (64, 48)).all()
            if shown and normal @ (camera.center - point) > 0:
                seen += not _blocked(start, camera.center, corners)
        assert values["seen"][index] == seen, (index, point)
        bound = json.loads((folder / "scene.json").read_text())["thin_below"]
        inside = point - 1e-4 * normal
        true_corners = values["vertices"][values["faces"]]
        assert values["thin"][index] == _blocked(inside, point - bound * normal, true_corners)


def _blocked(start: np.ndarray, end: np.ndarray, corners: np.ndarray) -> bool:
    """Tell by Moeller and Trumbore's test in float64 whether a triangle cuts the segment."""
    way = end - start
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(way, ac)
    area = np.einsum("ij,ij->i", ab, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("ij,ij->i", start - a, p) / area
        q = np.cross(start - a, ab)
        v = q @ way / area
        t = np.einsum("ij,ij->i", ac, q) / area
        return bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)).any())


@pytest.mark.parametrize("name", ["spot", "spot_far", "spot_exposure", "room"])
def test_folders_load_like_any_project(name: str, folders: dict[str, Path], tmp_path: Path) -> None:
    folder = folders[name]
    scene = load_scene(folder, tmp_path, Progress())
    assert len(scene.views) == SIZE.photos
    assert scene.facts["kind"] == "COLMAP model"
    described = json.loads((folder / "scene.json").read_text())
    assert (described["version"], described["name"]) == (1, name)
    assert described["role"] == KINDS[name].role
    crop = read_region(folder / "crop.json")
    assert described["diagonal"] == pytest.approx(crop.diagonal)
    tests = json.loads((folder / "test" / "cameras.json").read_text())["cameras"]
    cameras = [Camera.from_json(values) for values in tests]
    assert len(cameras) == SIZE.test_views
    for camera in cameras:
        with Image.open(folder / "test" / "images" / camera.name) as image:
            assert image.size == (camera.width, camera.height)


def test_the_far_scene_is_the_near_one_moved(folders: dict[str, Path]) -> None:
    near, far = (dict(np.load(folders[name] / "truth.npz")) for name in ("spot", "spot_far"))
    offset = np.array([5e5, 4e6, 100.0])
    for key in ("points", "vertices"):
        np.testing.assert_allclose((far[key] - offset) / 20, near[key], atol=1e-9)
    for key in ("faces", "normals", "thin", "seen"):
        np.testing.assert_array_equal(far[key], near[key])
    a, b = (read_region(folders[name] / "region.json") for name in ("spot", "spot_far"))
    np.testing.assert_allclose((b.vertices - offset) / 20, a.vertices, atol=1e-9)


def test_exposures_are_recorded_as_they_were_applied(folders: dict[str, Path]) -> None:
    facts = json.loads((folders["spot_exposure"] / "scene.json").read_text())
    assert len(facts["gains"]) == SIZE.photos
    for name, gains in facts["gains"].items():
        pair = [
            np.asarray(Image.open(folders[scene] / "images" / name).convert("RGB")) / 255.0
            for scene in ("spot", "spot_exposure")
        ]
        before, after = (((photo + 0.055) / 1.055) ** 2.4 for photo in pair)
        good = (pair[0] > 0.2).all(2) & (pair[1] < 0.97).all(2)
        found = after[good].sum(0) / before[good].sum(0)
        np.testing.assert_allclose(found, gains, rtol=0.01)
        assert 1 / 1.35 <= gains[1] <= 1.35
    for kept in ("test_000.png", "test_001.png"):
        a, b = (folders[n] / "test" / "images" / kept for n in ("spot", "spot_exposure"))
        assert a.read_bytes() == b.read_bytes()


def test_truth_is_the_same_every_time(folders: dict[str, Path], tmp_path: Path) -> None:
    again = tmp_path / "again"
    _apart(build_scene, scene_kind("room"), SIZE, again, None)
    for name in ("truth.npz", "sparse/0/points3D.txt", "sparse/0/images.txt", "test/cameras.json"):
        assert (again / name).read_bytes() == (folders["room"] / name).read_bytes(), name
    for photo in sorted((again / "images").iterdir()):
        first = np.asarray(Image.open(folders["room"] / "images" / photo.name))
        np.testing.assert_array_equal(np.asarray(Image.open(photo)), first)


def test_thickness_and_views_of_a_plate() -> None:
    from benchmarks.scenes.geometry import box, look_at
    from gaussian_wrapping_addon.core.regions.shapes import Region

    plate = box("plate", (-1, -1, 0), (1, 1, 0.1), "oak")
    mesh = (plate.vertices, plate.faces)
    pose = look_at(np.array([0.1, 0.2, 4.0]), np.zeros(3), 0.0)
    camera = Camera("a", 400, 400, 200.0, 200.0, 200.0, 200.0, pose)
    crop = Region.box("crop", np.full(3, -2.0), np.full(3, 2.0))
    samples = truth_samples(mesh, mesh, [camera], crop, 0.11, 3, 5000)
    upper = samples.normals[:, 2] > 0.5
    np.testing.assert_array_equal(samples.thin, np.abs(samples.normals[:, 2]) > 0.5)
    np.testing.assert_array_equal(samples.seen[upper], 1)
    np.testing.assert_array_equal(samples.seen[samples.normals[:, 2] < -0.5], 0)
    # Uniform by area: both large sides together 8 of 8.8.
    assert np.mean(np.abs(samples.normals[:, 2]) > 0.5) == pytest.approx(8 / 8.8, abs=2e-3)


def test_the_inside_of_the_cup_is_photographed() -> None:
    """Of ``cup`` a fifth is seen by fewer than two photos; of ``cup_inside`` hardly anything."""
    size = (64, 48)
    inside, cup = cup_inside_content(40, 8, size), scene_content(scene_kind("cup"), 40, 8, size)
    assert len(inside.cameras) == 40
    assert len({camera.name for camera in (*inside.cameras, *inside.test_cameras)}) == 48
    everything = joined(inside.parts)
    hidden = []
    for content in (inside, cup):
        samples = truth_samples(
            content.truth, everything, content.cameras, content.crop, 0.03, 1, 4000
        )
        hidden.append(np.mean(samples.seen < 2))
    assert hidden[0] < 0.01
    assert hidden[1] > 0.15
    np.testing.assert_array_equal(inside.crop.vertices, cup.crop.vertices)


def test_torus_and_plate_are_what_they_say() -> None:
    content = torus_content(12, 4, (64, 48))
    vertices, faces = content.truth
    checked = validate_manifold(vertices, faces)
    assert checked.good
    assert sorted(part.euler for part in checked.parts) == [0, 2]
    ring, tube = RING_RADIUS, TUBE_RADIUS
    parts = sorted(part.volume for part in checked.parts)
    assert parts[1] == pytest.approx(2 * np.pi**2 * ring * tube**2, rel=2e-3)
    plate = PLATE_WIDTH * PLATE_HEIGHT * PLATE_SHARE * content.region.diagonal
    assert parts[0] == pytest.approx(plate, rel=1e-9)
    assert content.crop.contains(vertices, 0.0).all()
    assert content.region.contains(content.crop.vertices, 0.0).all()


def test_a_scene_of_its_own_module_is_built_like_the_others(
    tmp_path: Path, folders: dict[str, Path]
) -> None:
    folder = tmp_path / CUP_INSIDE.name
    _apart(build_cup_inside, SIZE, folder)
    files = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    wanted = {
        path.relative_to(folders["spot"]) for path in folders["spot"].rglob("*") if path.is_file()
    }
    assert files == wanted
    described = json.loads((folder / "scene.json").read_text())
    assert (described["name"], described["role"]) == ("cup_inside", "test")


def test_unknown_scenes_are_named() -> None:
    for find in (scene_kind, kind_named):
        with pytest.raises(UsageError, match="teapot"):
            find("teapot")
