# SPDX-License-Identifier: GPL-3.0-or-later
"""A result folder as a finished job leaves it, of a closed cube with known colours."""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.regions.box import CUBE_CORNERS, CUBE_TRIANGLES
from gaussian_wrapping_addon.core.regions.files import region_to_json
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity


def rotation_about(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


WORLD_FROM_SCENE = Similarity(
    2.5, rotation_about((1, 2, 3), 0.7), np.array([500_000.25, 4_000_000.5, 30.0])
)

# Landscape, portrait with the principal point far off, and pixels that are not square.
CAMERAS = tuple(
    Camera(name, *lens, np.concatenate([rotation_about(axis, angle), [[0.1], [-0.2], [6.0]]], 1))
    for name, lens, axis, angle in (
        ("wide.jpg", (640, 480, 500.0, 500.0, 320.0, 240.0), (0, 1, 0), 0.4),
        ("tall.jpg", (300, 500, 420.0, 420.0, 190.0, 180.0), (1, 1, 0), -0.8),
        ("flat pixels.png", (400, 380, 300.0, 360.0, 230.0, 150.0), (1, 0, 1), 2.0),
        ("tall pixels.png", (400, 380, 360.0, 300.0, 180.0, 222.0), (1, 0.2, 1), 1.0),
    )
)

BOX_SCENE = (
    np.array([1.2, 0.9, 0.7]) * CUBE_CORNERS @ rotation_about((0, 0, 1), 0.3).T
    + np.array([0.2, -0.1, 0.4])
)  # fmt: skip


def npy_bytes(values: np.ndarray) -> bytes:
    """Return an array as the bytes of a NumPy file."""
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def png_bytes(pixels: np.ndarray) -> bytes:
    """Encode (h, w, 3) uint8 as PNG."""
    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + pixels[y].tobytes() for y in range(height))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )  # fmt: skip


def cube_mesh(half: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Closed cube: (8, 3) vertices, (12, 3) faces, (12, 3, 2) UVs, one tile a face."""
    vertices = half * CUBE_CORNERS
    faces = np.array(CUBE_TRIANGLES, np.int32)
    tile = np.arange(12)
    corners = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]])
    origin = np.stack([tile % 4, tile // 4], 1)  # (12, 2)
    uvs = (origin[:, None] + corners[None]) / 4.0
    return vertices, faces, uvs.astype(np.float32)


def write_region_result(folder: Path, *, half: float = 0.5, box: np.ndarray = BOX_SCENE) -> None:
    """Write one region's folder."""
    folder.mkdir(parents=True, exist_ok=True)
    vertices, faces, corner_uvs = cube_mesh(half)
    np.savez(folder / "mesh.npz", vertices=vertices, faces=faces, corner_uvs=corner_uvs)
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:8] = (200, 30, 40)  # top of the image, v > 0.5
    pixels[8:] = (20, 120, 220)
    (folder / "albedo.png").write_bytes(png_bytes(pixels))
    body = region_to_json(folder.name, WORLD_FROM_SCENE.points(box), None)
    (folder / "region.json").write_text(json.dumps(body))


def write_result(job: Path, *, regions: tuple[str, ...] = ("auto",)) -> Path:
    """Write ``job/result`` and return it."""
    result = job / "result"
    for name in regions:
        write_region_result(result / name)
    scene = {
        "version": 1,
        "world_from_scene": WORLD_FROM_SCENE.to_json(),
        "radius": 5.0,
        "cameras": [
            {**camera.to_json(), "photo": os.fspath(job / "photos" / camera.name)}
            for camera in CAMERAS
        ],
    }
    (result / "scene.json").write_text(json.dumps(scene))
    region = {"statistics": {"faces": 12, "closed": True}, "texture": {"coverage": 0.875}}
    report = {
        "wall_seconds": 83.2,
        "training": {"gaussians": 4321, "held_out": [{"name": "x"}], "held_out_psnr": 27.25},
        "regions": dict.fromkeys(regions, region),
    }
    (result / "report.json").write_text(json.dumps(report))
    return result
