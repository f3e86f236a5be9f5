# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders of the zoo's scenes: sparse points, building, keeping, photos as a camera takes them."""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import ResourceError, WorkerError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.scene.camera import Camera

from ..scenes.build import (
    MIN_TRACK,
    SAMPLES,
    SparsePoints,
    sparse_points,
    truth_samples,
    write_colmap,
)
from ..scenes.cache import CACHE, REPOSITORY
from ..scenes.catalogue import THIN_SHARE
from ..scenes.geometry import RayScene, joined
from ..scenes.rendering import draw_gains, expose, require_bpy, union_of
from .catalogue import ZooScene, draw_content, zoo_scene
from .looks import SKY_NAME, Content, Photography, render_photos
from .shapes import Mesh

POINTS = 5000
"""At most so many are followed."""
_WINDOW_PX = 7
"""The steepest slope in a window of this side decides whether a place has texture."""
_DEPTHS = (0.5, 2.5)
"""Outliers lie on a ray of theirs at such multiples of the true depth."""


def found_points(
    rays: RayScene,
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    shot: Photography,
    seed: int,
) -> SparsePoints:
    """Return the sparse points of a scene.

    Those of :func:`~benchmarks.scenes.build.sparse_points` without what lies where a photo
    has no texture, moved further along what their tracks do not determine, and some anywhere on
    one of their rays.

    Parameters
    ----------
    photos : sequence of (h, w, 3) uint8
    """
    random = np.random.default_rng([seed, 4])
    sparse = _textured(sparse_points(rays, cameras, photos, seed, POINTS), photos, shot)
    moved = sparse.points + shot.point_noise * _uncertain(sparse, cameras, random)
    wrong = random.random(len(moved)) < shot.outliers
    first = np.searchsorted(sparse.point_ids, np.flatnonzero(wrong))
    centers = np.array([cameras[k].center for k in sparse.camera_ids[first]]).reshape(-1, 3)
    stretch = random.uniform(*_DEPTHS, (len(first), 1))
    moved[wrong] = centers + stretch * (moved[wrong] - centers)
    errors = sparse.errors_px * np.hypot(1.0, 0.5 * shot.point_noise)
    errors[wrong] *= random.uniform(1.5, 4.0, len(first))
    return replace(sparse, points=moved, errors_px=errors)


def _textured(
    sparse: SparsePoints, photos: Sequence[np.ndarray], shot: Photography
) -> SparsePoints:
    """Return the observations where the photo has a slope, and the points that keep enough."""
    kept = np.zeros(len(sparse.point_ids), bool)
    for index, photo in enumerate(photos):
        gray = photo.astype(np.float64).mean(2)
        padded = np.pad(gray, 1, mode="edge")
        h, w = gray.shape
        gray = sum(padded[i : i + h, j : j + w] for i in range(3) for j in range(3)) / 9.0
        slope = maximum_filter(np.hypot(*np.gradient(gray)), _WINDOW_PX)
        mine = np.flatnonzero(sparse.camera_ids == index)
        at = sparse.pixels[mine].astype(int)
        kept[mine] = (
            slope[np.clip(at[:, 1], 0, h - 1), np.clip(at[:, 0], 0, w - 1)] > shot.weak_texture
        )
    length = np.bincount(sparse.point_ids[kept], minlength=len(sparse.points))
    stays = length >= MIN_TRACK
    kept &= stays[sparse.point_ids]
    number = np.cumsum(stays) - 1
    return SparsePoints(
        sparse.points[stays],
        sparse.colors[stays],
        sparse.errors_px[stays],
        number[sparse.point_ids[kept]],
        sparse.camera_ids[kept],
        sparse.pixels[kept],
    )


def _uncertain(
    sparse: SparsePoints, cameras: Sequence[Camera], random: np.random.Generator
) -> np.ndarray:
    """Draw shifts (n, 3) from what half a pixel in each observation leaves open."""
    information = np.zeros((len(sparse.points), 3, 3))
    for index, camera in enumerate(cameras):
        ids = sparse.point_ids[sparse.camera_ids == index]
        way = sparse.points[ids] - camera.center
        away = np.linalg.norm(way, axis=1)
        way /= away[:, None]
        across = np.eye(3) - way[:, :, None] * way[:, None]
        weight = (camera.fx / (0.5 * away)) ** 2
        np.add.at(information, ids, weight[:, None, None] * across)
    values, axes = np.linalg.eigh(information)
    steps = random.normal(size=values.shape) / np.sqrt(np.maximum(values, 1e-12))
    return np.einsum("nij,nj->ni", axes, steps)


def disturbed_poses(
    cameras: Sequence[Camera], noise_px: float, distance: float, seed: int
) -> list[Camera]:
    """Return the cameras turned and moved, each so that things shift by ``noise_px`` a axis.

    Parameters
    ----------
    distance : float
        Typical distance of what the photos show.
    """
    random = np.random.default_rng([seed, 5])
    result = []
    for camera in cameras:
        # Half of the variance by turning, half by moving.
        angle = noise_px / camera.fx / np.sqrt(2.0)
        turn = Rotation.from_rotvec(angle * random.normal(size=3)).as_matrix()
        center = camera.center + angle * distance * random.normal(size=3)
        rotation = turn @ camera.rotation
        pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
        result.append(replace(camera, cam_from_world=pose))
    return result


def true_surface(content: Content) -> Mesh:
    """Return the union of the subject's solids.

    Raises
    ------
    ResourceError
        bpy is missing, or its union is not closed.
    """
    parts = content.subject.parts
    vertices, faces = union_of(parts) if len(parts) > 1 else joined(parts)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    if not len(faces) or (counts % 2).any():
        raise ResourceError(
            f"The union of {len(parts)} solids is not closed ({len(faces)} faces).",
            "Use the bpy version of requirements-benchmarks.txt.",
        )
    return vertices, faces


def build_zoo_scene(scene: ZooScene, folder: Path, threads: int, samples: int = SAMPLES) -> None:
    """Make the scene in an empty folder.

    Parameters
    ----------
    samples : int
        Of the true surface.

    Raises
    ------
    ResourceError
        bpy, trimesh or embreex is missing.
    """
    content = draw_content(scene)
    truth = true_surface(content)
    images, tests = folder / "images", folder / "test" / "images"
    images.mkdir(parents=True)
    tests.mkdir(parents=True)
    shot, cameras = content.photography, content.cameras
    paths = [images / c.name for c in cameras] + [tests / c.name for c in content.test_cameras]
    render_photos(content, [*cameras, *content.test_cameras], paths, threads)
    if shot.exposure:
        for path, gain in zip(
            paths[: len(cameras)], draw_gains(len(cameras), scene.seed), strict=True
        ):
            Image.fromarray(expose(_read(path), gain)).save(path)
    solid = joined([p for p in (*content.subject.parts, *content.around) if p.name != SKY_NAME])
    photos = [_read(path) for path in paths[: len(cameras)]]
    sparse = found_points(RayScene(*solid), cameras, photos, shot, scene.seed)
    away = [np.linalg.norm(sparse.points - c.center, axis=1) for c in cameras]
    written = disturbed_poses(cameras, shot.pose_noise_px, float(np.median(away)), scene.seed)
    write_colmap(folder / "sparse" / "0", written, sparse)
    test_cameras = [camera.to_json() for camera in content.test_cameras]
    write_json(folder / "test" / "cameras.json", {"cameras": test_cameras})
    thin_below = THIN_SHARE * content.crop.diagonal
    found = truth_samples(truth, solid, cameras, content.crop, thin_below, scene.seed, samples)
    np.savez_compressed(
        folder / "truth.npz", vertices=truth[0], faces=truth[1], points=found.points,
        normals=found.normals, thin=found.thin, seen=found.seen,
    )  # fmt: skip
    write_region(folder / "region.json", content.region)
    write_region(folder / "crop.json", content.crop)
    write_json(
        folder / "scene.json",
        {
            "version": 1,
            "name": scene.name,
            "role": scene.part,
            "family": scene.family,
            "seed": scene.seed,
            "diagonal": content.crop.diagonal,
            "thin_below": thin_below,
            "photography": asdict(shot),
            "sparse_points": len(sparse.points),
            "bpy": require_bpy().app.version_string,
        },
    )


def _read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


DRAWN = 1
"""Raised whenever a scene comes out otherwise: its records then say that they are older."""
_TAKEN = 1
"""The same of photos as a camera takes them."""

_LAST_WORDS = 1500


def scene_folder(name: str, root: Path | None = None) -> Path:
    """Return where a scene is kept, by the version of what draws it."""
    return (root or CACHE) / f"zoo-{zoo_scene(name).name}-v{DRAWN}"


def ensure_zoo_scene(name: str, threads: int = 1, root: Path | None = None) -> Path:
    """Return the folder of a scene; render it first where it does not exist yet.

    Parameters
    ----------
    root : Path or None
        Where scenes are kept, ``.cache/scenes`` of the repository by default.

    Raises
    ------
    UsageError
        There is no such scene.
    WorkerError
        The rendering process failed; carries its last words.
    """
    target = scene_folder(name, root)
    if target.is_dir():
        return target
    partial = target.with_name(f"{target.name}.rendering.{uuid.uuid4().hex[:8]}")
    partial.mkdir(parents=True)
    try:
        command = [sys.executable, "-m", "benchmarks.zoo", "--build", name]
        command += ["--into", str(partial.resolve()), "--threads", str(threads)]
        done = subprocess.run(
            command, cwd=REPOSITORY, capture_output=True, text=True, errors="replace", check=False
        )
        if done.returncode != 0:
            raise WorkerError(
                f"Rendering scene {name!r} failed with exit code {done.returncode}: "
                f"{(done.stdout + done.stderr)[-_LAST_WORDS:]}",
                f"Run it alone to see more: python -m benchmarks.zoo --render --only {name}.",
            )
        try:
            os.rename(partial, target)
        except OSError:
            if not target.is_dir():  # else another process was first: the same scene
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


_SOFTNESS_PX = (0.3, 0.6)
"""Range of the standard deviation of the Gaussian that lens and sensor make of a point."""
_NOISE_LEVELS = (0.7, 2.5)
"""Range of the standard deviation of the noise at :data:`_MIDDLE`, of each channel."""
_MIDDLE, _NOISE_IN_THE_DARK = 128.0, 0.3
"""Grey level at which noise is as drawn, and share of its power that does not come from light."""
_QUALITIES = (85, 96)
"""Least quality of the JPEG files, and one more than the largest."""


def taken_folder(name: str, root: Path | None = None) -> Path:
    """Return where a scene with photos as taken is kept."""
    clean = scene_folder(name, root)
    return clean.with_name(f"{clean.name}-taken-v{_TAKEN}")


def ensure_taken_scene(name: str, threads: int = 1, root: Path | None = None) -> Path:
    """Return the folder of a scene with photos as taken; make it where it does not exist yet.

    Test views, truth and cameras are those of :func:`ensure_zoo_scene`, whose errors it raises.
    """
    target = taken_folder(name, root)
    if target.is_dir():
        return target
    clean = ensure_zoo_scene(name, threads, root)
    partial = target.with_name(f"{target.name}.making.{uuid.uuid4().hex[:8]}")
    try:
        shutil.copytree(clean, partial)
        random = np.random.default_rng([zoo_scene(name).seed, 3])
        softness, noise = random.uniform(*_SOFTNESS_PX), random.uniform(*_NOISE_LEVELS)
        quality = int(random.integers(*_QUALITIES))
        for path in sorted((partial / "images").iterdir()):
            with Image.open(path) as image:
                photo = np.asarray(image.convert("RGB"))
            Image.fromarray(taken(photo, softness, noise, quality, random)).save(path)
        try:
            os.rename(partial, target)
        except OSError:
            if not target.is_dir():  # else another process was first: the same photos
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def taken(
    photo: np.ndarray, softness_px: float, noise: float, quality: int, random: np.random.Generator
) -> np.ndarray:
    """Return a photo (h, w, 3) uint8 as a camera takes it.

    Parameters
    ----------
    softness_px : float
        Standard deviation of a point.
    noise : float
        Standard deviation in the middle between black and white, grey levels of each channel.
    quality : int
        Of the JPEG.
    """
    soft = ndimage.gaussian_filter(photo.astype(np.float32), (softness_px, softness_px, 0))
    power = _NOISE_IN_THE_DARK + (1.0 - _NOISE_IN_THE_DARK) * soft / _MIDDLE
    noisy = soft + noise * np.sqrt(power) * random.normal(size=photo.shape)
    return compressed(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), quality)


def compressed(photo: np.ndarray, quality: int) -> np.ndarray:
    """Return what a JPEG of a quality leaves of a photo."""
    file = io.BytesIO()
    Image.fromarray(photo).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))


_CELL = (240, 180)
_CAPTION_PX = 14
_SCENES_A_ROW = 3
_SHARES = (0.1, 0.6)
"""Which two of a scene's photos are shown: these shares of the way through them."""


def draw_sheet(names: Sequence[str], path: Path, threads: int) -> None:
    """Write a PNG of the scenes, captioned by name, surroundings, path and size.

    Raises
    ------
    ResourceError
        bpy is missing.
    """
    width, height = 2 * _CELL[0] + 4, _CELL[1] + _CAPTION_PX
    rows = -(-len(names) // _SCENES_A_ROW)
    sheet = Image.new("RGB", (_SCENES_A_ROW * width, rows * height), "white")
    pen = ImageDraw.Draw(sheet)
    for index, name in enumerate(names):
        row, column = divmod(index, _SCENES_A_ROW)
        x, y = column * width, row * height
        content = draw_content(zoo_scene(name))
        shot = content.photography
        words = (
            f"{name}  {shot.surroundings} {shot.path}  {shot.photos} x {shot.width}x{shot.height}"
        )
        pen.text((x + 4, y + 1), words, fill="black")
        scale = min(_CELL[0] / shot.width, _CELL[1] / shot.height)
        size = (round(shot.width * scale), round(shot.height * scale))
        cameras = [content.cameras[int(share * shot.photos)].resized(*size) for share in _SHARES]
        with tempfile.TemporaryDirectory(prefix="zoo-sheet-") as folder:
            paths = [Path(folder) / camera.name for camera in cameras]
            render_photos(content, cameras, paths, threads)
            for k, photo in enumerate(paths):
                with Image.open(photo) as image:
                    sheet.paste(image, (x + k * _CELL[0], y + _CAPTION_PX))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path)
