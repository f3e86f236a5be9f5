# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene: undistorted views, sparse points, and the transform from the scene frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..report_warning import ReportWarning
from ..tolerances import POINT_REACH
from .camera import Camera
from .similarity import Similarity


def usable_points(points: np.ndarray) -> np.ndarray:
    """Tell which sparse points (n, 3), scene frame, are finite and within reach, (n,) bool.

    The reach is ``tolerances.POINT_REACH``.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return np.linalg.norm(points, axis=1) <= POINT_REACH


BACKGROUND_SHARE = 0.75
"""Share of the photos whose mask was made, of what turns or of an object, for masks to mean
background."""
MASKS_MADE = "photos_masked_to_object"
"""Fact of a scene: photos with a mask made of a region or by a model."""


@dataclass(frozen=True)
class View:
    """One photo that matches its pinhole camera pixel for pixel."""

    camera: Camera
    photo_path: Path
    mask_path: Path | None = None
    """Greyscale image of the same size; black pixels are ignored."""


@dataclass(frozen=True)
class Scene:
    """Views and sparse points in the scene frame.

    The scene frame is Z-up (automatic up direction), has the mean of the camera centres at 0, and
    is scaled so that 1.1 x the largest camera distance to 0 is ``tolerances.SCENE_RADIUS``.
    ``world_from_scene`` maps back to the frame of the input, in float64.
    """

    views: tuple[View, ...]
    points: np.ndarray
    """(n, 3) float64 sparse points, scene frame; may be empty."""
    point_colors: np.ndarray
    """(n, 3) uint8."""
    world_from_scene: Similarity
    warnings: tuple[ReportWarning, ...] = ()
    """Warnings for the user."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Kind of input and counts, for the report."""

    def mask_mode(self, chosen: str) -> Literal["ignore", "background"]:
        """Return what the masks exclude, for a setting of :class:`~..settings.TrainingSettings`."""
        if chosen == "auto":
            turning = self.facts.get("photos_masked_as_turning") or 0
            masked = max(turning, self.facts.get(MASKS_MADE) or 0)
            return "background" if masked > BACKGROUND_SHARE * len(self.views) else "ignore"
        return "background" if chosen == "background" else "ignore"

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of all views, in order."""
        return [view.camera for view in self.views]
