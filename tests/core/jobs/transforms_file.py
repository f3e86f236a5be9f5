# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras and sparse points as ``transforms.json`` with a PLY of doubles."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.scene.camera import Camera


def write_transforms(folder: Path, cameras: Iterable[Camera], points: np.ndarray) -> Path:
    """Write both beside ``images/``; return the path of the cameras."""
    frames = []
    for camera in cameras:
        matrix = np.eye(4)
        matrix[:3, :3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = camera.center
        frames.append(
            {
                "file_path": f"images/{camera.name}", "transform_matrix": matrix.tolist(),
                "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy,
                "cx": camera.cx, "cy": camera.cy,
            }
        )  # fmt: skip
    rows = [" ".join(map(repr, point)) for point in points.tolist()]
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    (folder / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
        + "".join(f"{row}\n" for row in rows)
    )
    path = folder / "transforms.json"
    path.write_text(json.dumps({"ply_file_path": "points.ply", "frames": frames}))
    return path
