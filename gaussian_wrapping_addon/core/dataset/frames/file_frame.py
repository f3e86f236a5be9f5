# SPDX-License-Identifier: GPL-3.0-or-later
"""Coordinate frame of an exported file: target frame, axes and offset.

Files of Y-up formats hold (x, z, -y) of the Z-up coordinates, as Blender's own exporters write.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...export_formats import EXPORT_FORMATS
from ..similarity import Similarity

FAR_FROM_ORIGIN = 100.0
"""Further than this many sizes from the origin, float32 rounding exceeds 1e-5 of the size."""

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from Z up to Y up."""


@dataclass(frozen=True)
class FileFrame:
    """The frame of one file."""

    format: str
    """A name of :data:`EXPORT_FORMATS`."""
    target_from_scene: Similarity
    """Transform to the world of the input, or to the scene as placed in Blender."""
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) float64, target frame: offset subtracted from the file's coordinates."""

    @property
    def turn(self) -> np.ndarray:
        """(3, 3) rotation from the target's axes to those of the file."""
        return Y_UP if EXPORT_FORMATS[self.format].y_up else np.eye(3)

    def local(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 3) scene points to the target frame minus the offset, axes not yet turned."""
        return self.target_from_scene.points(points) - self.offset

    def file_from_scene(self) -> Similarity:
        """Return the transform from the scene frame to the file's coordinates."""
        turned = Similarity(1.0, self.turn, -(self.turn @ self.offset))
        return turned.after(self.target_from_scene)

    def to_json(
        self, world_from_scene: Similarity, blender_from_scene: Similarity
    ) -> dict[str, Any]:
        """Return the entries of a sidecar: all transforms from the file's frame, in float64."""
        scene_from_file = self.file_from_scene().inverse()
        up = "+Y" if EXPORT_FORMATS[self.format].y_up else "+Z"
        return {
            "up": up,
            "front": "+Z" if up == "+Y" else "-Y",
            "offset": np.asarray(self.offset, np.float64).tolist(),
            "world_from_file": world_from_scene.after(scene_from_file).to_json(),
            "blender_from_file": blender_from_scene.after(scene_from_file).to_json(),
            "scene_from_file": scene_from_file.to_json(),
            "world_from_scene": world_from_scene.to_json(),
            "blender_from_scene": blender_from_scene.to_json(),
        }


def file_offset(world: np.ndarray) -> np.ndarray:
    """Return the (3,) float64 offset to subtract: 0, or whole units near the centre."""
    low, high = world.min(axis=0), world.max(axis=0)
    size = float((high - low).max())
    centre = 0.5 * (low + high)
    if np.abs(centre).max() <= FAR_FROM_ORIGIN * size:
        return np.zeros(3)
    return np.round(centre) if size > 1.0 else centre
