# SPDX-License-Identifier: GPL-3.0-or-later
"""Write small COLMAP models and photo sets for tests, straight from the format's description."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.readers.source_model import LENS_NAMES
from gaussian_wrapping_addon.core.scene.camera import quaternion_from_rotation
from tests.poses import look_at_pose

WIDTH, HEIGHT = 64, 48


@dataclass
class ImageRecord:
    """One image of a model to write; any field may be made wrong on purpose."""

    image_id: int
    quaternion: np.ndarray
    translation: np.ndarray
    camera_id: int
    name: str | bytes
    points2d: list[tuple[float, float, int]] = field(default_factory=list)


@dataclass
class Model:
    """A model to write as binary or text."""

    cameras: list[tuple[int, str | int, int, int, list[float]]]
    images: list[ImageRecord]
    points: list[tuple[list[float], list[int], float, list[tuple[int, int]]]]


def ring_poses(count: int, radius: float = 3.0, height: float = 1.0) -> list[np.ndarray]:
    """Return poses on a circle that look at the origin."""
    angles = np.arange(count) * 2 * np.pi / count
    return [
        look_at_pose(np.array([radius * np.cos(a), radius * np.sin(a), height]), np.zeros(3))
        for a in angles
    ]


def ring_model(
    count: int = 3, model: str = "PINHOLE", params: list[float] | None = None, points: int = 4
) -> Model:
    """Return a valid model: cameras on a ring and a few points near the origin."""
    rng = np.random.default_rng(3)
    images = []
    for i, pose in enumerate(ring_poses(count)):
        quaternion = quaternion_from_rotation(pose[:, :3])
        observed = [(10.5 + j, 20.25, j + 1) for j in range(2)]
        images.append(ImageRecord(i + 1, quaternion, pose[:, 3], 1, f"p{i:02d}.png", observed))
    cloud = [
        (rng.normal(size=3).tolist(), [10 * j % 256, 20, 30], 0.5 + j, [(1, j), (2, j)])
        for j in range(points)
    ]
    params = params or [60.0, 61.0, WIDTH / 2, HEIGHT / 2]
    return Model([(1, model, WIDTH, HEIGHT, params)], images, cloud)


def cameras_bytes(model: Model) -> bytes:
    """Return the content of ``cameras.bin``."""
    out = struct.pack("<Q", len(model.cameras))
    for camera_id, kind, width, height, params in model.cameras:
        number = LENS_NAMES.index(kind) if isinstance(kind, str) else kind
        out += struct.pack("<IiQQ", camera_id, number, width, height)
        out += struct.pack(f"<{len(params)}d", *params)
    return out


def images_bytes(model: Model) -> bytes:
    """Return the content of ``images.bin``."""
    out = struct.pack("<Q", len(model.images))
    for image in model.images:
        out += struct.pack("<I4d3dI", image.image_id, *image.quaternion, *image.translation,
                           image.camera_id)  # fmt: skip
        name = image.name if isinstance(image.name, bytes) else image.name.encode()
        out += name + b"\0" + struct.pack("<Q", len(image.points2d))
        for x, y, point in image.points2d:
            out += struct.pack("<ddQ", x, y, point)
    return out


def points_bytes(model: Model) -> bytes:
    """Return the content of ``points3D.bin``."""
    out = struct.pack("<Q", len(model.points))
    for i, (position, color, error, track) in enumerate(model.points):
        out += struct.pack("<Q3d3Bd", i + 1, *position, *color, error)
        out += struct.pack("<Q", len(track))
        for image_id, index in track:
            out += struct.pack("<II", image_id, index)
    return out


def write_binary(model: Model, folder: Path) -> Path:
    """Write the three binary files into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.bin").write_bytes(cameras_bytes(model))
    (folder / "images.bin").write_bytes(images_bytes(model))
    (folder / "points3D.bin").write_bytes(points_bytes(model))
    return folder


def write_text(model: Model, folder: Path, *, second_lines: bool = True, end: str = "\n") -> Path:
    """Write the three text files into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# cameras"]
    for camera_id, kind, width, height, params in model.cameras:
        lines.append(f"{camera_id} {kind} {width} {height} " + " ".join(map(repr, params)))
    (folder / "cameras.txt").write_bytes((end.join(lines) + end).encode())
    lines = ["# images"]
    for image in model.images:
        values = [repr(float(v)) for v in (*image.quaternion, *image.translation)]
        lines.append(f"{image.image_id} {' '.join(values)} {image.camera_id} {image.name}")
        if second_lines:
            lines.append(" ".join(f"{x} {y} {point}" for x, y, point in image.points2d))
    (folder / "images.txt").write_bytes((end.join(lines) + end).encode())
    lines = ["# points"]
    for i, (position, color, error, track) in enumerate(model.points):
        numbers = [*map(repr, position), *map(str, color), repr(error)]
        pairs = [f"{a} {b}" for a, b in track]
        lines.append(" ".join([str(i + 1), *numbers, *pairs]))
    (folder / "points3D.txt").write_bytes((end.join(lines) + end).encode())
    return folder


def write_photos(model: Model, folder: Path, *, seed: int = 0) -> None:
    """Write one noisy photo for each image of the model, at its camera's size."""
    rng = np.random.default_rng(seed)
    sizes = {camera_id: (height, width) for camera_id, _, width, height, _ in model.cameras}
    folder.mkdir(parents=True, exist_ok=True)
    for image in model.images:
        pixels = rng.integers(0, 255, (*sizes[image.camera_id], 3)).astype(np.uint8)
        path = folder / str(image.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(path)


def write_project(folder: Path, count: int = 5, points: int = 120, **arguments: object) -> Model:
    """Write ``images/`` and ``sparse/0`` of a valid project."""
    model = ring_model(count, points=points, **arguments)  # type: ignore[arg-type]
    write_binary(model, folder / "sparse" / "0")
    write_photos(model, folder / "images")
    return model
