# SPDX-License-Identifier: GPL-3.0-or-later
"""Any number of large JPEGs of a box: a few rendered pictures, each in many files."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.files import write_bytes

from .blocks.street import seen_points
from .camera_solving.ray_caster import Boxes, render
from .scenes.colmap_project import write_colmap
from .scenes.sparse_points import SparsePoints
from .scenes.viewpoints import look_at

PICTURES = 8
"""Pictures that are rendered."""
RENDERED_SHARE = 2
"""They are rendered at a half of the photos' size: rays cost more than photos of this size need."""
NOISE = 3.0
"""Grey levels of noise, which gives JPEGs the size of photographs."""
POINTS = 3000
BOX_HALF_M, ROOM_HALF_M, DISTANCE_M = 0.6, 4.0, 2.4


def make_scene(folder: Path, photos: int, side_px: int) -> Path:
    """Write a COLMAP project in a new folder, unless it is there; return it."""
    target = folder / f"box-{photos}-{side_px}"
    if target.is_dir():
        return target
    making = target.with_name(f"{target.name}.making")
    shutil.rmtree(making, ignore_errors=True)
    (making / "images").mkdir(parents=True)
    pictures = make_pictures(folder, side_px)
    around = [camera_at(k, side_px) for k in range(PICTURES)]
    cameras = []
    for number in range(photos):
        name = f"{number:04d}.jpg"
        cameras.append(dataclasses.replace(around[number % PICTURES], name=name))
        data = pictures[number % PICTURES].read_bytes()
        # A comment behind the first marker: no two files are the same.
        text = f"photo {number}".encode()
        comment = b"\xff\xfe" + (len(text) + 2).to_bytes(2, "big") + text
        write_bytes(making / "images" / name, data[:2] + comment + data[2:])
    write_colmap(making / "sparse" / "0", cameras, _repeated(_sparse(around, pictures), photos))
    making.rename(target)
    return target


def make_pictures(folder: Path, side_px: int) -> list[Path]:
    """Render the pictures as JPEGs, those that are not there yet."""
    from PIL import Image

    places = []
    for number in range(PICTURES):
        places.append(folder / f"picture-{side_px}-{number}.jpg")
        if places[-1].is_file():
            continue
        camera = camera_at(number, side_px)
        size = (camera.width, camera.height)
        small = camera.resized(*(side // RENDERED_SHARE for side in size))
        image = Image.fromarray(render(boxes(), small)).resize(size, Image.Resampling.BILINEAR)
        noise = np.random.default_rng(number).normal(0.0, NOISE, (camera.height, camera.width, 1))
        noisy = np.clip(np.asarray(image) + noise, 0.0, 255.0).astype(np.uint8)
        folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(noisy).save(places[-1], quality=92)
    return places


def boxes() -> Boxes:
    """Return a room and a box in it."""
    half = np.array([[ROOM_HALF_M], [BOX_HALF_M]]) * np.ones((2, 3))
    return Boxes(-half, half, np.arange(12).reshape(2, 6))


def camera_at(number: int, side_px: int) -> Camera:
    """Return the camera of a picture, on a circle around the box."""
    angle = 2.0 * np.pi * number / PICTURES
    height = 0.5 + 0.3 * (number % 2)
    center = DISTANCE_M * np.array([np.cos(angle), np.sin(angle), height])
    pose = look_at(center, np.zeros(3), 0.0)
    width, high = side_px, side_px * 3 // 4
    return Camera(f"{number}.jpg", width, high, 0.9 * width, 0.9 * width, width / 2, high / 2, pose)


def _sparse(cameras: Sequence[Camera], pictures: Sequence[Path]) -> SparsePoints:
    from PIL import Image

    images = [np.asarray(Image.open(path)) for path in pictures]
    return seen_points(boxes(), cameras, images, POINTS)


def _repeated(sparse: SparsePoints, photos: int) -> SparsePoints:
    """Return the points as seen by every photo of each camera."""
    ids, cameras, pixels = [], [], []
    for first in range(0, photos, PICTURES):
        known = sparse.camera_ids + first < photos
        ids.append(sparse.point_ids[known])
        cameras.append(sparse.camera_ids[known] + first)
        pixels.append(sparse.pixels[known])
    point_ids = np.concatenate(ids)
    order = np.argsort(point_ids, kind="stable")
    return dataclasses.replace(
        sparse,
        point_ids=point_ids[order],
        camera_ids=np.concatenate(cameras)[order],
        pixels=np.concatenate(pixels)[order],
    )
