# SPDX-License-Identifier: GPL-3.0-or-later
"""Inputs of the comparison: photos of two patterned balls on a floor, ray traced from closed forms.

The same files come out of every call, with fixed modification times: names of stage folders depend
on them.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

MODIFIED_UNIX_S = 1_700_000_000
BALLS = ((np.array([0.0, 0.0, 0.0]), 1.0), (np.array([0.9, 0.6, -0.45]), 0.55))
"""Center and radius, in the scene's own units; the second one cuts the first."""

FLOOR_Z, FLOOR_RADIUS = -1.0, 6.0
DOME_RADIUS = 7.0
OFFSET, SCALE = np.array([512.0, 4096.0, 16.0]), 3.0
"""world = SCALE * (scene's own units) + OFFSET."""

SAMPLES = 2
"""Rays per pixel and direction."""


@dataclass(frozen=True)
class Lens:
    """A camera's image: size and focal length, pixels, and radial distortion (OpenCV's k1, k2)."""

    width: int
    height: int
    focal_px: float
    k1: float = 0.0
    k2: float = 0.0

    def directions(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return (n, 3) directions, camera frame, of pixel positions."""
        seen = np.stack(
            [
                (columns - self.width / 2) / self.focal_px,
                (rows - self.height / 2) / self.focal_px,
            ],
            1,
        )
        plain = seen.copy()
        for _ in range(30):  # fixed point of distortion(plain) = seen
            square = (plain**2).sum(1, keepdims=True)
            plain = seen / (1.0 + self.k1 * square + self.k2 * square**2)
        return np.concatenate([plain, np.ones((len(plain), 1))], 1)


def write_inputs(folder: Path) -> None:
    """Write every input of the cases below ``folder``."""
    _write_colmap(folder / "colmap", photos=6, lens=Lens(112, 96, 125.0))
    lens = Lens(128, 104, 140.0, -0.06, 0.01)
    _write_transforms(folder / "transforms", photos=12, lens=lens)
    _write_photos(folder / "unposed" / "photos", photos=8, lens=Lens(320, 256, 330.0))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    _write_region(folder / "cut.json", corners * [1.3, 0.55, 1.2] + [0.1, 0.1, 0.3])
    _write_region(folder / "cap.json", corners * [0.6, 0.6, 0.5] + [0.0, 0.0, 0.9])
    wedge = np.array([[1.7, 0, -1.2], [0.2, 0, -1.2], [1.7, 1.5, -1.2], [0.2, 1.5, -1.2]])
    _write_region(folder / "wedge.json", np.concatenate([wedge, [[0.9, 0.6, 0.9]]]))
    _write_truth(folder / "truth.ply")
    _write_splat(folder / "splat.ply", 1000)
    for path in (folder, *sorted(folder.rglob("*"))):
        os.utime(path, (MODIFIED_UNIX_S, MODIFIED_UNIX_S))


def _pattern(points: np.ndarray, seed: int) -> np.ndarray:
    """Return (n, 3) colours in (0, 1): soft waves with a fine checker on top."""
    generator = np.random.default_rng(seed)
    waves = generator.normal(size=(10, 3)) * 2.5
    phases = generator.uniform(0, 2 * np.pi, size=(10, 3))
    amounts = generator.normal(size=(10, 3))
    soft = (np.sin((points @ waves.T)[:, :, None] + phases) * amounts).sum(1)
    cells = np.floor(points * 5.0 + 0.137).astype(np.int64) * [73856093, 19349663, 83492791]
    mixed = np.bitwise_xor.reduce(cells, axis=1) * 2654435761 >> 7
    noise = (mixed % 1009) / 1009.0
    return 0.5 + 0.25 * np.tanh(0.45 * soft) + 0.4 * (noise[:, None] - 0.5)


def _trace(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return (n, 3) colours along rays from one origin."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    along = unit @ origin
    reach = -along + np.sqrt(along**2 - (origin @ origin - DOME_RADIUS**2))
    color = _pattern((origin + reach[:, None] * unit) * 0.25, 4)
    below = np.where(unit[:, 2] < -1e-9, (FLOOR_Z - origin[2]) / unit[:, 2], np.inf)
    floor = origin + np.where(np.isfinite(below), below, 0.0)[:, None] * unit
    on_floor = np.isfinite(below) & (np.hypot(floor[:, 0], floor[:, 1]) < FLOOR_RADIUS)
    color[on_floor] = _pattern(floor[on_floor], 1)
    nearest = np.where(on_floor, below, reach)
    for number, (center, radius) in enumerate(BALLS):
        start = origin - center
        along = unit @ start
        root = along**2 - (start @ start - radius**2)
        at = -along - np.sqrt(np.maximum(root, 0.0))
        hit = (root > 0) & (at > 0) & (at < nearest)
        place = origin + at[:, None] * unit
        shine = np.clip(unit @ np.array([0.3, -0.5, 0.81]), 0.0, 1.0)[:, None] * 0.1
        color[hit] = (_pattern(place, 2 + number) + shine)[hit]
        nearest = np.where(hit, at, nearest)
    return np.clip(color, 0.0, 1.0)


def _pose(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return (3, 3) camera-from-world rotation of an upright camera, COLMAP axes."""
    forward = target - center
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _views(photos: int, arc: float = 2.0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return center and rotation of each camera, on an arc so short that photos have neighbours."""
    views = []
    for index in range(photos):
        angle = arc * index / photos
        center = np.array([3.4 * np.cos(angle), 3.4 * np.sin(angle), 1.6 if index % 2 else 2.3])
        views.append((center, _pose(center, np.array([0.1, 0.1, -0.2]))))
    return views


def _photograph(center: np.ndarray, rotation: np.ndarray, lens: Lens, gain: float) -> np.ndarray:
    """Return a photo, (h, w, 3) uint8."""
    rows, columns = np.mgrid[0 : lens.height, 0 : lens.width].reshape(2, -1)
    total = np.zeros((lens.height * lens.width, 3))
    for down in range(SAMPLES):
        for right in range(SAMPLES):
            rays = lens.directions(columns + (right + 0.5) / SAMPLES, rows + (down + 0.5) / SAMPLES)
            total += _trace(center, rays @ rotation)
    mean = total.reshape(lens.height, lens.width, 3) / SAMPLES**2
    return np.round(255 * np.clip(gain * mean, 0.0, 1.0)).astype(np.uint8)


def _surface_points(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, 3) points of all surfaces and their (n, 3) uint8 colours."""
    generator = np.random.default_rng(7)
    points, colors = [], []
    for number, (center, radius) in enumerate(BALLS):
        ball = generator.normal(size=(count, 3))
        points.append(center + radius * ball / np.linalg.norm(ball, axis=1, keepdims=True))
        colors.append(_pattern(points[-1], 2 + number))
    reach = FLOOR_RADIUS * np.sqrt(generator.uniform(size=count))
    angle = generator.uniform(0, 2 * np.pi, count)
    floor = [reach * np.cos(angle), reach * np.sin(angle), np.full(count, FLOOR_Z)]
    points.append(np.stack(floor, 1))
    colors.append(_pattern(points[-1], 1))
    dome = generator.normal(size=(count, 3))
    dome[:, 2] = np.abs(dome[:, 2])
    points.append(DOME_RADIUS * dome / np.linalg.norm(dome, axis=1, keepdims=True))
    colors.append(_pattern(0.25 * points[-1], 4))
    return np.concatenate(points), np.round(255 * np.concatenate(colors)).astype(np.uint8)


def _write_colmap(folder: Path, *, photos: int, lens: Lens) -> None:
    """Write a COLMAP text model and its photos, exposed differently."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (folder / "images").mkdir()
    lines = []
    for index, (center, rotation) in enumerate(_views(photos)):
        name = f"{index:02d}.png"
        gain = (1.0, 0.85, 1.1)[index % 3]
        image = Image.fromarray(_photograph(center, rotation, lens, gain))
        image.save(folder / "images" / name)
        shift = -(rotation @ (SCALE * center + OFFSET))
        numbers = " ".join(f"{v:.17g}" for v in (*_quaternion(rotation), *shift))
        lines += [f"{index + 1} {numbers} 1 {name}", ""]
    middle = f"{lens.width / 2} {lens.height / 2}"
    camera = f"1 PINHOLE {lens.width} {lens.height} {lens.focal_px} {lens.focal_px} {middle}\n"
    (model / "cameras.txt").write_text(camera)
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    points, colors = _surface_points(250)
    rows = [
        f"{i + 1} {x:.17g} {y:.17g} {z:.17g} {r} {g} {b} 0.5 1 0 2 0 3 0"
        for i, ((x, y, z), (r, g, b)) in enumerate(
            zip(SCALE * points + OFFSET, colors, strict=True)
        )
    ]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")


def _write_transforms(folder: Path, *, photos: int, lens: Lens) -> None:
    """Write a transforms.json of a distorting lens, JPEG photos, and a mask of one corner each."""
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    frames = []
    for index, (center, rotation) in enumerate(_views(photos)):
        name = f"{index:02d}.jpg"
        image = Image.fromarray(_photograph(center, rotation, lens, 1.0))
        image.save(folder / "images" / name, quality=95)
        mask = np.full((lens.height, lens.width), 255, np.uint8)
        mask[: 10 + index, : 14 + index] = 0
        Image.fromarray(mask).save(folder / "masks" / f"{index:02d}.png")
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.T @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = SCALE * center + OFFSET
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
    points, colors = _surface_points(250)
    _write_cloud(folder / "points.ply", SCALE * points + OFFSET, colors)
    values = {
        "camera_model": "OPENCV", "w": lens.width, "h": lens.height,
        "fl_x": lens.focal_px, "fl_y": lens.focal_px, "cx": lens.width / 2, "cy": lens.height / 2,
        "k1": lens.k1, "k2": lens.k2, "p1": 0.0, "p2": 0.0,
        "ply_file_path": "points.ply", "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(values))


def _write_photos(folder: Path, *, photos: int, lens: Lens) -> None:
    """Write photos without cameras, close enough to each other for features to be matched."""
    folder.mkdir(parents=True)
    for index, (center, rotation) in enumerate(_views(photos, arc=0.9)):
        image = Image.fromarray(_photograph(center, rotation, lens, 1.0))
        image.save(folder / f"{index:02d}.png")


def _write_region(path: Path, corners: np.ndarray) -> None:
    """Write a region file of a convex body, given in the scene's own units."""
    values = {
        "class_name": "GaussianWrappingBoundingVolume",
        "version": 1,
        "blender_object_name": path.stem,
        "vertices": (SCALE * corners + OFFSET).tolist(),
        "hull_simplices": None,
    }
    path.write_text(json.dumps(values))


def _write_splat(path: Path, count: int) -> None:
    """Write flat Gaussians on all surfaces, world coordinates, as other programs do."""
    points, colors = _surface_points(count)
    generator = np.random.default_rng(11)
    rest = [f"f_rest_{number}" for number in range(9)]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    names += [*(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    total = len(points)
    normals = np.zeros((total, 3))
    for number, (center, _) in enumerate(BALLS):
        part = slice(number * count, (number + 1) * count)
        normals[part] = points[part] - center
    normals[2 * count : 3 * count] = [0.0, 0.0, 1.0]
    normals[3 * count :] = points[3 * count :]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # The rotation that takes z to the normal, as (w, x, y, z).
    turns = np.stack([1.0 + normals[:, 2], -normals[:, 1], normals[:, 0], 0.0 * normals[:, 0]], 1)
    turns /= np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-9)
    sizes = SCALE * np.repeat([0.07, 0.04, 0.24, 0.4], count)
    scales = np.stack([sizes, sizes, 0.1 * sizes], 1)
    table = np.concatenate(
        [
            SCALE * points + OFFSET, normals, (colors / 255.0 - 0.5) / 0.28209479177387814,
            generator.normal(size=(total, 9)) * 0.01, np.full((total, 1), 3.0),
            np.log(scales), turns,
        ],
        axis=1,
    )  # fmt: skip
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {total}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    path.write_bytes("\n".join(header).encode() + table.astype("<f4").tobytes())


def _write_truth(path: Path) -> None:
    """Write the first ball, world coordinates, as a triangle mesh (PLY, text)."""
    rows, columns = 24, 48
    polar = np.pi * np.arange(1, rows) / rows
    round_ = 2 * np.pi * np.arange(columns) / columns
    ring = np.stack(
        [
            np.outer(np.sin(polar), np.cos(round_)),
            np.outer(np.sin(polar), np.sin(round_)),
            np.repeat(np.cos(polar)[:, None], columns, 1),
        ],
        2,
    ).reshape(-1, 3)
    vertices = SCALE * np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]]) + OFFSET
    top, bottom = len(ring), len(ring) + 1
    faces = []
    for column in range(columns):
        after = (column + 1) % columns
        faces.append((top, column, after))
        last = (rows - 2) * columns
        faces.append((bottom, last + after, last + column))
        for row in range(rows - 2):
            a, b = row * columns + column, row * columns + after
            faces += [(a, a + columns, b), (b, a + columns, b + columns)]
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty double x\n"
        f"property double y\nproperty double z\nelement face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    body = [f"{x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices]
    body += [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text(header + "\n".join(body) + "\n")


def _write_cloud(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write coloured points (PLY, binary)."""
    rows = np.empty(
        len(points),
        [*((n, "<f8") for n in "xyz"), *((n, "u1") for n in ("red", "green", "blue"))],
    )
    for column, name in enumerate("xyz"):
        rows[name] = points[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, column]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property double {n}" for n in "xyz"]
    lines += [f"property uchar {n}" for n in ("red", "green", "blue")]
    path.write_bytes(("\n".join([*lines, "end_header"]) + "\n").encode() + rows.tobytes())


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return (w, x, y, z) of a rotation matrix: the eigenvector of its quaternion matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    vector = np.linalg.eigh(matrix)[1][:, -1]
    return vector * (1.0 if vector[0] >= 0 else -1.0)
