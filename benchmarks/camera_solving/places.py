# SPDX-License-Identifier: GPL-3.0-or-later
"""Two places to photograph: a town of many blocks, and a hall whose four walls look the same."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.dataset.camera import Camera

from ..scenes.cache import CACHE
from ..scenes.colmap_project import write_colmap
from ..scenes.sparse_points import SparsePoints
from .ray_caster import Boxes, render

WIDTH_PX, HEIGHT_PX = 640, 480
FOCAL_PX = 430.0
BLOCKS, PITCH_M, BLOCK_M = 4, 11.0, 6.0
"""Blocks along each side of the town, their distance, and their largest side."""
_EXIF_FOLDER, _FOCAL_35MM = 0x8769, 0xA405


@dataclass(frozen=True)
class Place:
    """Boxes, and who looks at them."""

    boxes: Boxes
    cameras: tuple[Camera, ...]


def town(count: int) -> Place:
    """Return streets between unlike blocks, walked through by somebody who looks to both sides."""
    chance = np.random.default_rng(1)
    half = BLOCKS * PITCH_M / 2
    lower, upper = [[-half - 8, -half - 8, 0.0]], [[half + 8, half + 8, 18.0]]
    for i in range(BLOCKS):
        for j in range(BLOCKS):
            middle = (np.array([i, j]) + 0.5) * PITCH_M - half + chance.uniform(-0.6, 0.6, 2)
            side = chance.uniform(0.6, 1.0, 2) * BLOCK_M / 2
            lower.append([*(middle - side), 0.0])
            upper.append([*(middle + side), chance.uniform(2.5, 7.0)])
            for _ in range(3):  # things along the walls, which stand out
                at = middle + chance.uniform(-1.25, 1.25, 2) * side
                size = chance.uniform(0.2, 0.6, 2)
                lower.append([*(at - size), 0.0])
                upper.append([*(at + size), chance.uniform(0.5, 2.2)])
    looks = np.arange(6 * len(lower)).reshape(-1, 6)
    boxes = Boxes(np.array(lower), np.array(upper), looks)
    return Place(boxes, tuple(_walk(count, half, chance)))


def _walk(count: int, half: float, chance: np.random.Generator) -> list[Camera]:
    """Return cameras along all streets, first one way, then across, and along the first again."""
    streets = [-half + PITCH_M * k for k in range(BLOCKS + 1)]
    ends = (-half, half)
    corners = [(x, y) for k, x in enumerate(streets) for y in ends[:: 1 - k % 2 * 2]]
    corners += [(x, y) for k, y in enumerate(streets[::-1]) for x in ends[:: k % 2 * 2 - 1]]
    corners += [(-half, half), (half, half)]
    path = np.array(corners, float)
    lengths = np.concatenate([[0.0], np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()])
    # The end of the way is where the way began: the loop closes.
    at = np.linspace(0.0, lengths[-3] + np.hypot(2 * half, 2 * half), count)
    spots = np.stack([np.interp(at, lengths, path[:, k]) for k in (0, 1)], 1)
    ahead = np.stack([np.interp(at + 3.0, lengths, path[:, k]) for k in (0, 1)], 1)
    behind = np.stack([np.interp(at - 3.0, lengths, path[:, k]) for k in (0, 1)], 1)
    heading = np.arctan2(*(ahead - behind).T[::-1])
    # Swings from side to side: neighbours share most of what they see.
    heading = heading + np.radians(38.0) * np.sin(2 * np.pi * at / 34.0)
    cameras = []
    for k in range(count):
        height = 1.7 + 0.5 * np.sin(k / 9.0)
        center = np.array([*(spots[k] + chance.uniform(-0.15, 0.15, 2)), height])
        forward = np.array([np.cos(heading[k]), np.sin(heading[k]), 0.05])
        cameras.append(camera_at(k, center, forward))
    return cameras


def hall(count: int) -> Place:
    """Return a square hall whose four walls look the same, with the same crate before each."""
    chance = np.random.default_rng(2)
    half = 5.0
    lower, upper = [[-half, -half, 0.0]], [[half, half, 4.0]]
    looks = [[0, 0, 0, 0, 5, 6]]
    for k in range(4):  # the same crate before each wall
        angle = np.pi / 2 * k
        at = 3.2 * np.array([np.cos(angle), np.sin(angle)])
        lower.append([*(at - 0.5), 0.0])
        upper.append([*(at + 0.5), 1.0])
        looks.append([7, 7, 7, 7, 8, 8])
    boxes = Boxes(np.array(lower), np.array(upper), np.array(looks))
    cameras = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        center = np.array([1.6 * np.cos(angle), 1.6 * np.sin(angle), 1.5])
        center = center + chance.uniform(-0.3, 0.3, 3)
        cameras.append(camera_at(k, center, np.array([np.cos(angle), np.sin(angle), 0.18])))
    return Place(boxes, tuple(cameras))


def camera_at(number: int, center: np.ndarray, forward: np.ndarray) -> Camera:
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
    return Camera(
        f"photo_{number:04d}.jpg", WIDTH_PX, HEIGHT_PX, FOCAL_PX, FOCAL_PX, WIDTH_PX / 2,
        HEIGHT_PX / 2, pose,
    )  # fmt: skip


PLACES: dict[str, Callable[[int], Place]] = {"town": town, "hall": hall}


def ensure_photos(name: str, count: int, *, threads: int = 1, root: Path = CACHE) -> Path:
    """Return a folder with ``images/`` and exact cameras in ``sparse/0``; make it if missing."""
    digest = hashlib.sha256(f"{name} {count}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        if source.name in ("places.py", "ray_caster.py"):
            digest.update(source.read_bytes().replace(b"\r\n", b"\n"))
    folder = root / f"solving-{name}-{count}-{digest.hexdigest()[:12]}"
    if folder.is_dir():
        return folder
    making = folder.with_name(f"{folder.name}.making")
    shutil.rmtree(making, ignore_errors=True)
    (making / "images").mkdir(parents=True)
    place = PLACES[name](count)
    for camera in place.cameras:
        photo = render(place.boxes, camera, threads=threads)
        write_photo(making / "images" / camera.name, photo)
    write_colmap(making / "sparse" / "0", place.cameras, _no_points())
    making.rename(folder)
    return folder


def write_photo(path: Path, photo: np.ndarray) -> None:
    """Write a JPEG with the focal length in EXIF, rounded to millimetres as cameras do."""
    exif = Image.Exif()
    focal_35mm = FOCAL_PX * np.hypot(36.0, 24.0) / np.hypot(WIDTH_PX, HEIGHT_PX)
    exif.get_ifd(_EXIF_FOLDER)[_FOCAL_35MM] = round(focal_35mm)
    Image.fromarray(photo).save(path, quality=95, exif=exif)


def _no_points() -> SparsePoints:
    nothing: Sequence[int] = ()
    whole = np.array(nothing, np.int64)
    return SparsePoints(
        points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8), errors_px=np.zeros(0),
        point_ids=whole, camera_ids=whole, pixels=np.zeros((0, 2)),
    )  # fmt: skip
