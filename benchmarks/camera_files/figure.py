# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m benchmarks.camera_files.figure``: cameras read back from each program's file.

Twelve cameras on a rising spiral around a cube are written as each program writes them, read by the
package, and drawn with their axes and fields of view. Every panel has to show the same picture.
"""

from __future__ import annotations

import argparse
import logging
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.camera_files import writers
from benchmarks.camera_files.writers import Shots
from gaussian_wrapping_addon.core.dataset.loading.source_kind import read_poses, source_kind
from gaussian_wrapping_addon.core.dataset.readers.source_model import SourceModel

_logger = logging.getLogger(__name__)

WIDTH, HEIGHT = 96, 64
COUNT = 12
OUTPUT = Path("docs/images/camera-files.png")

_PANEL_PX, _FACTOR = 400, 2
_ASPECT = 0.8
_AXES = ((214, 60, 60), (60, 160, 60), (60, 90, 220))
_CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
_FORMATS: tuple[tuple[str, Callable[[Path, Shots], Path], dict[str, float]], ...] = (
    ("RealityScan CSV", writers.write_realityscan_csv, {"f": 32.0, "k1": -0.05}),
    ("RealityScan XMP", writers.write_realityscan_xmp, {"f": 32.0, "k1": -0.05}),
    ("Metashape XML", writers.write_metashape, {"f": 85.0, "k1": -0.05}),
    ("Meshroom SfM", writers.write_meshroom, {"f": 32.0, "k1": -0.05}),
    ("OpenSfM reconstruction", writers.write_opensfm, {"focal_x": 0.9, "focal_y": 0.9}),
    ("ODM shots", writers.write_opendrone_shots, {"focal_x": 0.9, "focal_y": 0.9}),
    ("transforms.json", writers.write_transforms, {"fl_x": 85.0, "fl_y": 85.0, "k1": -0.05}),
    ("Polycam keyframes", writers.write_polycam, {"fx": 85.0, "fy": 85.0, "cx": 48.0, "cy": 32.0}),
)


def spiral() -> list[np.ndarray]:
    """Return (3, 4) poses that look at the origin from a rising spiral, rolled a little more each.

    The first camera is the lowest and has the least roll, so that a mirrored or reversed order
    would show.
    """
    poses = []
    for i in range(COUNT):
        angle = 2 * math.pi * i / COUNT
        eye = np.array([4.0 * math.cos(angle), 4.0 * math.sin(angle), -1.0 + 3.5 * i / COUNT])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        upright = np.stack([right, np.cross(forward, right), forward])
        roll = 0.04 * i
        turn = np.array([
            [math.cos(roll), -math.sin(roll), 0.0],
            [math.sin(roll), math.cos(roll), 0.0],
            [0.0, 0.0, 1.0],
        ])  # fmt: skip
        rotation = turn @ upright
        poses.append(np.concatenate([rotation, -(rotation @ eye)[:, None]], 1))
    return poses


def _seen(points: np.ndarray) -> np.ndarray:
    """Return (n, 2) pixels of world points in a panel: an oblique view without perspective."""
    turn, tilt = math.radians(-35.0), math.radians(30.0)
    x = math.cos(turn) * points[:, 0] - math.sin(turn) * points[:, 1]
    y = math.sin(turn) * points[:, 0] + math.cos(turn) * points[:, 1]
    up = math.cos(tilt) * points[:, 2] + math.sin(tilt) * y
    middle, scale = 0.5 * _PANEL_PX * _FACTOR, 0.11 * _PANEL_PX * _FACTOR
    return np.stack([middle + scale * x, 0.9 * middle - scale * up], 1)


def draw(model: SourceModel, title: str) -> Image.Image:
    """Return the picture of the cube and a model's cameras."""
    side = _PANEL_PX * _FACTOR
    image = Image.new("RGB", (side, round(_ASPECT * side)), "white")
    pen = ImageDraw.Draw(image)

    def line(a: np.ndarray, b: np.ndarray, color: tuple[int, int, int], width: int = 3) -> None:
        ends = _seen(np.stack([a, b]))
        pen.line([tuple(ends[0]), tuple(ends[1])], color, width)

    for a in range(8):
        for b in range(a):
            if np.abs(_CUBE[a] - _CUBE[b]).sum() == 2:
                line(_CUBE[a], _CUBE[b], (120, 120, 120), 4)
    for axis in range(3):
        line(np.zeros(3), 0.9 * np.eye(3)[axis], _AXES[axis], 5)
    for number, photo in enumerate(sorted(model.photos, key=lambda one: one.name)):
        rotation, shift = photo.cam_from_world[:, :3], photo.cam_from_world[:, 3]
        eye = -rotation.T @ shift
        lens = photo.relative.of_size(WIDTH, HEIGHT) if photo.relative else photo.lens
        if lens is None:
            raise ValueError(f"{photo.name} has no lens")
        corners = []
        for u, v in ((0, 0), (WIDTH, 0), (WIDTH, HEIGHT), (0, HEIGHT)):
            (fx, fy), (cx, cy) = lens.focal, lens.principal_point
            ray = np.array([(u - cx) / fx, (v - cy) / fy, 1.0])
            corners.append(eye + rotation.T @ (0.9 * ray))
        for i in range(4):
            line(corners[i], corners[(i + 1) % 4], (170, 170, 170), 2)
            line(eye, corners[i], (200, 200, 200), 2)
        for axis in range(3):
            line(eye, eye + 0.6 * rotation[axis], _AXES[axis], 4)
        at = _seen(eye[None])[0]
        pen.text((at[0] + 8, at[1] - 30), str(number + 1), (0, 0, 0), font_size=24)
    pen.text((24, 16), title, (0, 0, 0), font_size=34)
    return image


def read_back(folder: Path) -> list[tuple[str, SourceModel]]:
    """Write the cameras in every format below ``folder``, and read them again."""
    models = []
    names = [f"IMG_{i + 1:04d}.jpg" for i in range(COUNT)]
    for title, write, lens in _FORMATS:
        place = folder / title.replace(" ", "-")
        place.mkdir()
        shots = Shots(names, spiral(), WIDTH, HEIGHT, lens)
        for name in names:
            Image.new("RGB", (WIDTH, HEIGHT), "grey").save(place / name)
        models.append((title, read_poses(source_kind(write(place, shots)))))
    return models


def figure(models: list[tuple[str, SourceModel]]) -> Image.Image:
    """Return the panels of all formats in one picture, four in a row."""
    columns = 4
    rows = -(-len(models) // columns)
    width, height = _PANEL_PX, round(_ASPECT * _PANEL_PX)
    sheet = Image.new("RGB", (columns * width, rows * height), "white")
    for i, (title, model) in enumerate(models):
        panel = draw(model, title).resize((width, height), Image.Resampling.LANCZOS)
        sheet.paste(panel, (i % columns * width, i // columns * height))
    return sheet


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=OUTPUT)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with tempfile.TemporaryDirectory() as folder:
        figure(read_back(Path(folder))).quantize(64).save(options.out, optimize=True)
    _logger.info("%s", options.out)


if __name__ == "__main__":
    main()
