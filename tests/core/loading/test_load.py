# SPDX-License-Identifier: GPL-3.0-or-later
"""Loading complete inputs: every kind, repair and error; few points, and where training starts."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import (
    Cancelled,
    DatasetError,
    MemoryShortageError,
    ParseError,
    WorkerError,
    WrapError,
)
from gaussian_wrapping_addon.core.limits import SCENE_RADIUS
from gaussian_wrapping_addon.core.loading import load as load_module
from gaussian_wrapping_addon.core.loading.check import check_input, coverage_warnings, listed
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.loading.photo_quality import photo_findings
from gaussian_wrapping_addon.core.photos.photo_file import read_photo
from gaussian_wrapping_addon.core.progress import Progress, ReportWarning
from gaussian_wrapping_addon.core.readers.colmap import read_colmap
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity, quaternion_from_rotation
from gaussian_wrapping_addon.core.scene.frames import CENTER_STEP, POINT_STEP
from gaussian_wrapping_addon.core.scene.scene import (
    Scene,
    View,
    evenly_spaced,
    held_out_views,
    load_saved_scene,
    save_scene,
    training_views,
)
from tests.core.readers.model_writers import (
    HEIGHT,
    WIDTH,
    Model,
    ring_model,
    ring_poses,
    write_binary,
    write_photos,
    write_project,
    write_text,
)
from tests.core.readers.real_sets import real_set
from tests.core.training.small_scene import PhotosInMemory, sphere_scene
from tests.poses import look_at_pose


def load(source: Path, work: Path | None = None) -> Scene:
    return load_scene(source, work or source.parent / "work", Progress(), threads=2)


def project(folder: Path, **arguments: object) -> Path:
    write_project(folder / "set", **arguments)  # type: ignore[arg-type]
    return folder / "set"


def errors_of(source: Path) -> list[str]:
    return [f.message for f in check_input(source) if f.severity == "error"]


def test_pinhole_project_is_used_where_it_lies(tmp_path: Path) -> None:
    source = project(tmp_path)
    before = sorted(source.rglob("*"))
    scene = load(source)
    assert [v.photo_path.name for v in scene.views] == [f"p{i:02d}.png" for i in range(5)]
    assert all(v.photo_path.parent == source / "images" for v in scene.views)
    assert sorted(source.rglob("*")) == before
    assert not list((tmp_path / "work" / "images").iterdir())
    assert scene.warnings == ()
    assert scene.facts["kind"] == "COLMAP model"
    assert (scene.facts["views"], scene.facts["points"]) == (5, 120)
    assert errors_of(source) == []
    warnings = [f.message for f in check_input(source) if f.severity == "warning"]
    assert warnings == ["5 photos are smaller than 200 pixels."]


def test_pixels_do_not_change_with_the_frame(tmp_path: Path) -> None:
    """World point -> pixel by the model equals scene point -> pixel by the scene's cameras."""
    source = project(tmp_path)
    scene = load(source)
    world = np.array([[0.1, -0.2, 0.3], [0.4, 0.1, -0.1]])
    points = scene.world_from_scene.inverse().points(world)
    for view, pose in zip(scene.views, ring_poses(5), strict=True):
        local = world @ pose[:, :3].T + pose[:, 3]
        expected = local[:, :2] / local[:, 2:] * [60.0, 61.0] + [WIDTH / 2, HEIGHT / 2]
        pixels, depth = view.camera.project(points)
        # Cameras are moved by up to a step of the grid, whose nearest point is 2 units away.
        np.testing.assert_allclose(pixels, expected, atol=61 * CENTER_STEP / 2)
        size = scene.world_from_scene.scale
        np.testing.assert_allclose(depth * size, local[:, 2], atol=CENTER_STEP * size)


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_huge_offsets_and_scales_give_the_same_scene(tmp_path: Path, scale: float) -> None:
    base = load(project(tmp_path))
    model = ring_model(5, points=120)
    move = Similarity(scale, np.eye(3), np.array([5e5, 4e6, 0.0]))
    for image, pose in zip(model.images, ring_poses(5), strict=True):
        center = move.points((-pose[:, :3].T @ pose[:, 3])[None])[0]
        image.translation = -(pose[:, :3] @ center)
    model.points = [(move.points(np.array([p]))[0].tolist(), *rest) for p, *rest in model.points]
    write_binary(model, tmp_path / "far" / "sparse")
    write_photos(model, tmp_path / "far" / "images")
    scene = load(tmp_path / "far", tmp_path / "far_work")
    # What float64 leaves of the input, and one step where that decides how to round.
    tolerance = 100 * 2**-52 * 4e6 / scale
    np.testing.assert_allclose(scene.points, base.points, atol=tolerance + POINT_STEP)
    tolerance += 2 * CENTER_STEP
    for a, b in zip(scene.cameras, base.cameras, strict=True):
        np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=tolerance)


def test_colmap_wins_over_transforms_and_both_agree(tmp_path: Path) -> None:
    source = project(tmp_path)
    values = {"fl_x": 60.0, "fl_y": 61.0, "w": WIDTH, "h": HEIGHT, "ply_file_path": "points.ply"}
    write_points(source / "points.ply", [p[0] for p in ring_model(5, points=120).points])
    frames = frames_of("./images/p{:02d}", 5)
    (source / "transforms.json").write_text(json.dumps(values | {"frames": frames}))
    scene = load(source)
    assert "transforms.json (not used" in scene.facts["also_present"]
    other = load(source / "transforms.json", tmp_path / "work2")
    assert other.facts["kind"] == "transforms.json"
    np.testing.assert_allclose(other.points, scene.points, atol=1e-9)
    for a, b in zip(other.cameras, scene.cameras, strict=True):
        np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=1e-9)
        assert (a.fx, a.fy, a.cx, a.cy) == (b.fx, b.fy, b.cx, b.cy)


def test_names_that_differ_are_matched_and_counted(tmp_path: Path) -> None:
    source = project(tmp_path, count=6)
    images = source / "images"
    (images / "p00.png").rename(images / "P00.PNG")
    Image.open(images / "p01.png").save(images / "p01.jpg")
    (images / "p01.png").unlink()
    (images / "deep").mkdir()
    (images / "p02.png").rename(images / "deep" / "p02.png")
    (images / "p03.png").unlink()
    scene = load(source)
    names = [v.photo_path.name for v in scene.views]
    assert names == ["P00.PNG", "p01.jpg", "p02.png", "p04.png", "p05.png"]
    text = " ".join(w.text for w in scene.warnings)
    assert "1 of the 6 photos that the COLMAP model names were not found: p03.png" in text
    assert "3 photos were found under a name that differs" in text
    findings = " ".join(f.message for f in check_input(source))
    assert "1 of 6 photos were not found, such as p03.png" in findings


def test_scaled_photos_scale_the_intrinsics(tmp_path: Path) -> None:
    source = project(tmp_path)
    for path in (source / "images").iterdir():
        Image.open(path).resize((WIDTH // 2, HEIGHT // 2)).save(path)
    scene = load(source)
    camera = scene.cameras[0]
    assert (camera.width, camera.height) == (WIDTH // 2, HEIGHT // 2)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30.0, 30.5, 16.0, 12.0)
    assert scene.facts["photos_rescaled"] == 5


@pytest.mark.parametrize("upright", [False, True])
def test_exif_rotation_follows_the_camera_size(tmp_path: Path, upright: bool) -> None:
    """A model solved on stored pixels keeps them; one solved on turned photos gets them turned."""
    size = (HEIGHT, WIDTH) if upright else (WIDTH, HEIGHT)
    model = ring_model(4, points=120)
    model.cameras = [(1, "PINHOLE", *size, [60.0, 60.0, size[0] / 2, size[1] / 2])]
    write_binary(model, tmp_path / "set" / "sparse")
    pixels = np.full((HEIGHT, WIDTH, 3), 20, np.uint8)
    pixels[:10, :10] = 220  # a bright corner, upper left as stored
    exif = Image.Exif()
    exif[0x0112] = 6  # turn clockwise: the corner goes to the upper right
    (tmp_path / "set" / "images").mkdir()
    for image in model.images:
        image_path = tmp_path / "set" / "images" / str(image.name)
        Image.fromarray(pixels).save(image_path, exif=exif)
    scene = load(tmp_path / "set")
    view = scene.views[0]
    assert view.photo_path.parent == tmp_path / "work" / "images"
    shown = read_photo(view.photo_path).color
    assert shown.shape[:2] == (view.camera.height, view.camera.width) == size[::-1]
    corner = shown[2, -3] if upright else shown[2, 2]
    assert corner.min() > 200
    assert (shown > 128).any(2).sum() < 130


def test_masks_of_every_name_and_alpha(tmp_path: Path) -> None:
    source = project(tmp_path, count=7)
    masks = source / "masks"
    masks.mkdir()
    half = Image.new("L", (WIDTH, HEIGHT))
    half.paste(255, (0, 0, WIDTH // 2, HEIGHT))
    half.save(masks / "p00.png.png")
    half.convert("RGB").resize((32, 24), Image.Resampling.NEAREST).save(masks / "p01.png")
    Image.new("L", (WIDTH, HEIGHT), 255).save(masks / "p02.png.png")
    Image.new("L", (WIDTH, HEIGHT), 0).save(masks / "p03.png.png")
    Image.new("L", (10, 40)).save(masks / "p04.png.png")
    photo = Image.open(source / "images" / "p05.png")
    photo.putalpha(half)
    photo.save(source / "images" / "p05.png")
    scene = load(source)
    masked = {v.camera.name: v.mask_path for v in scene.views}
    assert [name for name, path in masked.items() if path] == ["p00.png", "p01.png", "p05.png"]
    assert "p03.png" not in masked
    for path in filter(None, masked.values()):
        np.testing.assert_array_equal(np.asarray(Image.open(path)), np.asarray(half))
    text = " ".join(w.text for w in scene.warnings)
    assert "1 masks were not used: Mask p04.png.png is 10 x 40" in text
    assert "1 photos are masked altogether and are not used: p03.png" in text
    assert scene.facts["photos_masked"] == 3


def test_a_photo_that_the_model_names_is_no_mask_of_another(tmp_path: Path) -> None:
    source = project(tmp_path, count=5)
    images = source / "images"
    # p01 becomes "p00_mask.png": the model and the disk know it as a photo.
    for file in (source / "sparse" / "0").iterdir():
        file.write_bytes(file.read_bytes().replace(b"p01.png", b"p00_mask.png"))
    (images / "p01.png").rename(images / "p00_mask.png")
    mask = np.where(np.arange(WIDTH) < WIDTH // 2, 255, 0).astype(np.uint8)
    Image.fromarray(np.tile(mask, (HEIGHT, 1))).save(images / "p02_mask.png")  # not in the model
    scene = load(source)
    masked = {v.camera.name: v.mask_path for v in scene.views}
    assert sorted(masked) == ["p00.png", "p00_mask.png", "p02.png", "p03.png", "p04.png"]
    assert [name for name, path in masked.items() if path] == ["p02.png"]


def test_photos_and_their_masks_are_written_undistorted(tmp_path: Path) -> None:
    source = project(tmp_path, model="OPENCV", params=[60, 60, 32, 24, -0.2, 0.0, 0.0, 0.0])
    (source / "masks").mkdir()
    bright = np.zeros((HEIGHT, WIDTH), np.uint8)
    bright[10:30, 15:50] = 255
    for path in (source / "images").iterdir():
        Image.fromarray(bright).convert("RGB").save(path)
        Image.fromarray(bright).save(source / "masks" / f"{path.name}.png")
    scene = load(source)
    assert scene.facts["photos_undistorted"] == 5
    for i, view in enumerate(scene.views):
        assert view.photo_path == tmp_path / "work" / "images" / f"{i:06d}.jpg"
        photo = read_photo(view.photo_path).color[..., 0]
        mask = np.asarray(Image.open(view.mask_path)) > 0
        assert mask.shape == photo.shape == (view.camera.height, view.camera.width)
        assert ((photo > 128) != mask).mean() < 0.01
        assert mask.mean() != (bright > 0).mean()


def test_few_bad_photos_are_left_out_many_are_refused(tmp_path: Path) -> None:
    source = project(tmp_path, count=10)
    images = source / "images"
    Image.open(images / "p01.png").save(images / "x.jpg")
    data = (images / "x.jpg").read_bytes()
    (images / "x.jpg").unlink()
    (images / "p01.png").write_bytes(data[: len(data) // 2])
    (images / "p02.png").write_bytes(b"")
    scene = load(source)
    assert len(scene.views) == 8
    assert "2 photos cannot be read and are not used" in scene.warnings[0].text
    (images / "p03.png").write_bytes(b"not a photo")
    with pytest.raises(DatasetError, match=r"3 of 10 photos cannot be read\. First: p0"):
        load(source)


def test_one_wild_camera_and_wild_points_are_left_out(tmp_path: Path) -> None:
    model = ring_model(6, points=120)
    pose = look_at_pose(np.array([1e6, 0.0, 0.0]), np.zeros(3))
    model.images[2].translation = pose[:, 3]
    model.points[5] = ([1e9, 0.0, 0.0], *model.points[5][1:])
    model.points[6] = ([0.0, 2e3, 0.0], *model.points[6][1:])  # far, and a point like others
    write_binary(model, tmp_path / "set" / "sparse")
    write_photos(model, tmp_path / "set" / "images")
    scene = load(tmp_path / "set")
    assert [c.name for c in scene.cameras] == [f"p{i:02d}.png" for i in (0, 1, 3, 4, 5)]
    assert len(scene.points) == 119
    far = scene.world_from_scene.points(scene.points)[5]
    step = POINT_STEP * scene.world_from_scene.scale
    assert far == pytest.approx([0.0, 2e3, 0.0], abs=step)
    assert np.linalg.norm(scene.points[5]) > 100 * SCENE_RADIUS
    text = " ".join(w.text for w in scene.warnings)
    assert "1 cameras are far away" in text
    assert "1 of " in text
    assert "farther away than 10000 scene radii" in text
    assert any("1 cameras are far away" in f.message for f in check_input(tmp_path / "set"))


def frames_of(pattern: str, count: int) -> list[dict[str, object]]:
    """Frames of a transforms.json: the ring's cameras, with names as in ``pattern``."""
    frames = []
    for i, pose in enumerate(ring_poses(count)):
        matrix = np.eye(4)
        matrix[:3, :3] = pose[:, :3].T @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = -pose[:, :3].T @ pose[:, 3]
        frames.append({"file_path": pattern.format(i), "transform_matrix": matrix.tolist()})
    return frames


def write_points(path: Path, points: list[list[float]]) -> None:
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{axes}end_header\n"
    path.write_text(head + "\n".join(" ".join(map(repr, point)) for point in points) + "\n")


def _folder_with(folder: Path, count: int, *, model: bool) -> Path:
    write_project(folder, count)
    if not model:
        shutil.rmtree(folder / "sparse")
    return folder


def test_refusals_come_at_once(tmp_path: Path) -> None:
    for name in ("empty", "texts", "phone"):
        (tmp_path / name).mkdir()
    (tmp_path / "texts" / "notes.txt").write_text("no photos here")
    for name in ("IMG_1.HEIC", "IMG_2.dng"):
        (tmp_path / "phone" / name).write_bytes(b"compressed")
    for name in ("a.png", "b.png"):
        Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(tmp_path / "phone" / name)
    (tmp_path / "a.txt").write_text("a file")
    cases = {
        "gone": "does not exist",
        "empty": "holds no photos",
        "texts": "holds no photos",
        "phone": " of 4 photos cannot be read. First: IMG_1.HEIC",
        "a.txt": "is a file, but not a transforms.json",
        "lost": "None of the 5 photos",
        "broken": "images.bin, byte",
    }
    for count, words in ((1, "Only 1 photo is usable"), (2, "Only 2 photos are usable")):
        for posed in (False, True):
            cases[_folder_with(tmp_path / f"{count}-{posed}", count, model=posed).name] = words
    shutil.rmtree(_folder_with(tmp_path / "lost", 5, model=True) / "images")
    path = _folder_with(tmp_path / "broken", 5, model=True) / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:300])
    for name, words in cases.items():
        begun = time.monotonic()
        with pytest.raises(DatasetError) as caught:
            load(tmp_path / name, tmp_path / "work")
        assert words in str(caught.value)
        assert caught.value.hint
        assert caught.value.exit_code == 3
        assert any(words in message for message in errors_of(tmp_path / name)), name
        assert time.monotonic() - begun < 2.0


def test_saved_scene_comes_back_and_moves_with_its_folder(tmp_path: Path) -> None:
    source = project(tmp_path, model="SIMPLE_RADIAL", params=[60.0, 32.0, 24.0, -0.1])
    scene = load(source)
    save_scene(scene, tmp_path / "work")
    shutil.move(tmp_path / "work", tmp_path / "moved")
    loaded = load_saved_scene(tmp_path / "moved")
    np.testing.assert_array_equal(loaded.points, scene.points)
    np.testing.assert_array_equal(loaded.point_colors, scene.point_colors)
    np.testing.assert_array_equal(loaded.world_from_scene.matrix(), scene.world_from_scene.matrix())
    assert (loaded.warnings, loaded.facts) == (scene.warnings, scene.facts)
    for a, b in zip(loaded.views, scene.views, strict=True):
        assert a.photo_path == tmp_path / "moved" / "images" / b.photo_path.name
        assert a.camera.to_json() == b.camera.to_json()
    seen: list[float] = []
    progress = Progress("c", lambda e: seen.append(e.fraction), lambda: len(seen) > 3)
    with pytest.raises(Cancelled):
        load_scene(source, tmp_path / "work", progress)
    assert len(seen) == 4


def test_broken_scene_files_are_refused(tmp_path: Path) -> None:
    source, work = project(tmp_path), tmp_path / "work"
    scene = load(source, work)
    with pytest.raises(ParseError, match="missing"):
        load_saved_scene(tmp_path)
    save_scene(scene, work)
    points, text = (work / "points.npz").read_bytes(), (work / "scene.json").read_text()
    objects = np.empty(1, object)
    objects[0] = {}
    np.savez(work / "points.npz", points=objects, point_colors=objects)
    pickled = (work / "points.npz").read_bytes()
    for broken in (b"", points[:10], points[: len(points) // 2], points[:-10], pickled):
        (work / "points.npz").write_bytes(broken)
        with pytest.raises(ParseError, match=r"points\.npz"):
            load_saved_scene(work)
    (work / "points.npz").write_bytes(points)
    for old, new, words in (
        ('"version": 1', '"version": 99', "version 1 was expected"),
        ('"fx"', '"gx"', "not as expected"),
    ):
        (work / "scene.json").write_text(text.replace(old, new))
        with pytest.raises(ParseError, match=words):
            load_saved_scene(work)
    (work / "scene.json").write_text(text)
    (source / "images" / "p02.png").unlink()
    with pytest.raises(DatasetError, match=r"p02\.png no longer exists"):
        load_saved_scene(work)


def test_checking_needs_numpy_only(tmp_path: Path) -> None:
    """Blender's Python has numpy, but neither Pillow nor scipy, numba, torch or pycolmap."""
    source = project(tmp_path)
    code = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('PIL','scipy','numba','torch','pycolmap','bpy'):\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "from pathlib import Path\n"
        "from gaussian_wrapping_addon.core.loading.check import check_input\n"
        "import gaussian_wrapping_addon.core.loading.load\n"
        "import gaussian_wrapping_addon.core.photos.store\n"
        "import gaussian_wrapping_addon.core.scene.scene\n"
        "for finding in check_input(Path(sys.argv[1])):\n"
        "    sys.stdout.write(f'{finding.severity}: {finding.message}\\n')\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code, str(source)], capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 0, ended.stderr
    assert "fact: 5 posed photos, 120 sparse points." in ended.stdout
    assert "fact: 5 photos: 5 of 64 x 48." in ended.stdout
    assert "error" not in ended.stdout


def test_angle_only_frames_take_the_size_of_the_photo(tmp_path: Path) -> None:
    """NeRF-synthetic: one angle, no extension, transparent background as the mask."""
    source = tmp_path / "set"
    (source / "train").mkdir(parents=True)
    pixels = np.full((40, 80, 4), 200, np.uint8)
    pixels[..., 3] = np.where(np.arange(80) < 20, 0, 255)
    for i in range(4):
        Image.fromarray(pixels).save(source / "train" / f"r_{i}.png")
    write_points(source / "p.ply", np.random.default_rng(0).uniform(-1, 1, (150, 3)).tolist())
    values = {"camera_angle_x": 2 * math.atan(0.4), "ply_file_path": "p.ply"}
    values["frames"] = frames_of("./train/r_{}", 4)
    (source / "transforms_train.json").write_text(json.dumps(values))
    scene = load(source)
    camera = scene.cameras[0]
    assert (camera.width, camera.height, camera.cx, camera.cy) == (80, 40, 40.0, 20.0)
    assert camera.fx == camera.fy == pytest.approx(100.0)
    assert all(view.mask_path is not None for view in scene.views)
    assert len(scene.points) == 150


@pytest.mark.parametrize("name", ["banana", "flowerpot", "fox"])
def test_real_sets_keep_their_reprojection_error(tmp_path: Path, name: str) -> None:
    """Points of the model, projected by the scene's cameras, fall where the model saw them."""
    folder, pycolmap = real_set(name), pytest.importorskip("pycolmap")
    scene = load(folder, tmp_path / "work")
    expected = {"banana": (14, 5486), "flowerpot": (80, 18090), "fox": (50, 12068)}[name]
    assert (len(scene.views), len(scene.points)) == expected
    assert scene.warnings == ()
    assert coverage_warnings(read_colmap(folder)) == []
    native = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    image = next(i for i in native.images.values() if i.name == scene.views[3].camera.name)
    seen = [p for p in image.points2D if p.has_point3D()]
    world = np.array([native.points3D[p.point3D_id].xyz for p in seen])
    slopes = native.cameras[image.camera_id].cam_from_img(np.array([p.xy for p in seen]))
    camera = scene.cameras[3]
    pixels, _ = camera.project(scene.world_from_scene.inverse().points(world))
    observed = slopes * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    assert np.median(np.linalg.norm(pixels - observed, axis=1)) < 0.8


def test_a_failed_triangulation_is_replaced_and_said_but_not_a_shortage_of_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a shortage the training would depend on what else runs."""
    pose = np.hstack([np.eye(3), [[0.0], [0.0], [4.0]]])
    cameras = [Camera(f"{k}.png", 80, 60, 80.0, 80.0, 40.0, 30.0, pose) for k in range(3)]
    views = [View(camera, tmp_path / camera.name) for camera in cameras]
    warnings: list[ReportWarning] = []

    def start_points(error: WrapError) -> tuple[np.ndarray, np.ndarray, str]:
        def fail(*_: object, **__: object) -> None:
            raise error

        monkeypatch.setattr(load_module, "triangulate_points", fail)
        return load_module.make_start_points(
            views, tmp_path, Progress(), warnings, seed=0, threads=1
        )

    points, colors, origin = start_points(WorkerError("crashed"))
    assert len(points) == len(colors) > 1000
    assert origin == "random"
    assert [w.code for w in warnings] == ["points-not-triangulated", "random-start-points"]
    with pytest.raises(MemoryShortageError):
        start_points(MemoryShortageError("short", "Wait."))


COUNT = 8


def model_of(observed: list[int], none: int = 2**64 - 1) -> Model:
    """A ring of cameras, each of which sees so many of 400 points, and as many corners without.

    ``none`` is the number of no point: unsigned in binary files.
    """
    model = ring_model(COUNT, points=400)
    for image, count in zip(model.images, observed, strict=True):
        image.points2d = [(1.5, 2.5, 1 + j) for j in range(count)] + [(3.5, 4.5, none)] * count
    return model


@pytest.mark.parametrize(("write", "none"), [(write_binary, 2**64 - 1), (write_text, -1)])
def test_a_photo_with_few_points_is_named(tmp_path: Path, write: object, none: int) -> None:
    write(model_of([300] * 5 + [25, 300, 31], none), tmp_path / "sparse")  # type: ignore[operator]
    read = read_colmap(tmp_path)
    assert [photo.observed for photo in read.photos] == [300] * 5 + [25, 300, 31]
    (warning,) = coverage_warnings(read)
    assert warning.code == "photos-weak"
    assert warning.text == "p05.png: far fewer sparse points than in the other photos."
    assert warning.hint
    write(model_of([300, 100, 35, 60, 200, 300, 90, 250], none), tmp_path / "sparse")  # type: ignore[operator]
    assert coverage_warnings(read_colmap(tmp_path)) == []


def test_a_photo_that_looks_elsewhere_is_named(tmp_path: Path) -> None:
    model = model_of([300] * COUNT)
    away = look_at_pose(np.array([3.0, 0.0, 1.0]), np.array([9.0, 0.0, 1.0]))
    model.images[2].quaternion = quaternion_from_rotation(away[:, :3])
    model.images[2].translation = away[:, 3]
    source = tmp_path / "set"
    write_binary(model, source / "sparse")
    write_photos(model, source / "images")
    (warning,) = coverage_warnings(read_colmap(source))
    assert warning.code == "photos-elsewhere"
    assert warning.text.startswith("p02.png: ")
    assert "photos-elsewhere" in [w.code for w in load(source).warnings]
    told = photo_findings(source, Progress(), threads=1)
    assert warning.text in [f.message for f in told]
    model.points = model.points[:50]  # too few tell nothing
    assert coverage_warnings(read_colmap(write_binary(model, source / "sparse"))) == []


def test_held_out_photos_are_every_nth_of_the_sorted_names() -> None:
    scene, _ = sphere_scene(views=9, size_px=24)
    assert [held_out_views(scene, n) for n in (8, 4, 0)] == [[0, 8], [0, 4, 8], []]
    backwards = dataclasses.replace(scene, views=scene.views[::-1])
    assert held_out_views(backwards, 3) == [2, 5, 8]
    assert held_out_views(dataclasses.replace(scene, views=scene.views[:5]), 2) == [0]
    assert evenly_spaced("abcdefghi", 3) == ["a", "e", "i"]
    assert evenly_spaced(range(10), 4) == [0, 3, 6, 9]
    assert evenly_spaced(range(40), 1) == [0]
    for count in range(5):
        assert evenly_spaced(range(count), 5) == list(range(count))
    assert listed(["a", "b"]) == "a, b"
    assert listed([str(k) for k in range(9)]) == "0, 1, 2, 3, 4 and 4 others"


def test_photos_covered_by_their_mask_are_not_trained_on() -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    assert training_views(scene, photos, 4) == [1, 2, 3, 5, 6, 7]
    assert training_views(scene, photos, 0) == list(range(9))
    masks = [np.ones((24, 24), np.bool_) for _ in range(9)]
    masks[2][:] = False
    masked = PhotosInMemory(scene, photos.photos, masks)
    assert training_views(scene, masked, 4) == [1, 3, 5, 6, 7]
    assert training_views(scene, masked, 0) == [0, 1, 3, 4, 5, 6, 7, 8]
