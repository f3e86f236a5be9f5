# SPDX-License-Identifier: GPL-3.0-or-later
"""What a scene of the zoo consists of, before it is rendered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.regions.convex_region import Region

from ..scenes.geometry import Part
from ..scenes.rendering import Light
from .looks import Look


@dataclass(frozen=True)
class Subject:
    """What a family draws: the solids whose surface is the truth, and how they look.

    Parts that are not ``surrounding`` are closed; where they overlap, the truth is their union.
    """

    parts: tuple[Part, ...]
    looks: Mapping[str, Look]
    """By the name that the parts have as their material."""
    reflects: bool = False
    """Whether a thing reflects its surroundings."""
    place: bool = False
    """A room or street that the cameras are in; else a thing that stands in surroundings."""
    inner: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """Of a place, opposite corners of the volume that is judged; the region is the whole solid."""


@dataclass(frozen=True)
class Photography:
    """How a scene is photographed."""

    width: int
    height: int
    photos: int
    path: str
    """A way of :mod:`.paths`."""
    surroundings: str
    """Of a thing: near, far or open (:mod:`.surroundings`); of a place: empty."""
    exposure: bool
    """Whether exposure and white balance change from photo to photo."""
    pose_noise_px: float
    """Standard deviation of the reprojection that wrong poses cause."""
    point_noise: float
    """Noise of the sparse points beyond that of half a pixel an observation, as a factor."""
    outliers: float
    """Share of the sparse points that lie anywhere."""
    weak_texture: float
    """Slope of the photo (8-bit values a pixel) below which no sparse point is found."""


@dataclass(frozen=True)
class Content:
    """Everything of a scene before it is rendered."""

    subject: Subject
    around: tuple[Part, ...]
    """Ground and walls around a thing, and the sky; open sheets."""
    looks: Mapping[str, Look]
    """Of all parts."""
    region: Region
    crop: Region
    light: Light
    photography: Photography
    cameras: tuple[Camera, ...]
    test_cameras: tuple[Camera, ...]
