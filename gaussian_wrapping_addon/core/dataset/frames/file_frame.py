# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the coordinates of an exported file lie: which frame, turned how, without which offset.

Formats have an axis that their readers take for up. Files of formats with Y
up hold (x, z, -y) of the coordinates that they were made of, as Blender's own exporters do.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...export_formats import EXPORT_FORMATS
from ..similarity import Similarity

FAR_FROM_ORIGIN = 100.0
"""Further than this many sizes from the origin, float32 rounding passes 1e-5 of the size."""

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from Z up to Y up."""


@dataclass(frozen=True)
class FileFrame:
    """The frame of one file."""

    format: str
    """A name of :data:`EXPORT_FORMATS`."""
    target_from_scene: Similarity
    """Leads to the world of the input, or to the scene as placed in Blender."""
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) float64, target frame: what the file's coordinates leave out."""

    @property
    def turn(self) -> np.ndarray:
        """(3, 3) rotation from the target's axes to those of the file."""
        return Y_UP if EXPORT_FORMATS[self.format].y_up else np.eye(3)

    def local(self, points: np.ndarray) -> np.ndarray:
        """Return (n, 3) float64 of points in the scene frame: less the offset, not turned."""
        return self.target_from_scene.points(points) - self.offset

    def file_from_scene(self) -> Similarity:
        """Return what leads to the coordinates as the file has them."""
        turned = Similarity(1.0, self.turn, -(self.turn @ self.offset))
        return turned.after(self.target_from_scene)

    def to_json(
        self, world_from_scene: Similarity, blender_from_scene: Similarity
    ) -> dict[str, Any]:
        """Return what a sidecar says of coordinates: every way out of the file, in double."""
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
    """Return the (3,) float64 offset that files leave out: 0, or whole units near the centre."""
    low, high = world.min(axis=0), world.max(axis=0)
    size = float((high - low).max())
    centre = 0.5 * (low + high)
    if np.abs(centre).max() <= FAR_FROM_ORIGIN * size:
        return np.zeros(3)
    return np.round(centre) if size > 1.0 else centre
