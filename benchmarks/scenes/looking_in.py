# SPDX-License-Identifier: GPL-3.0-or-later
"""The cup once more, with photos that look down into it, as a person who wants its inside takes.

The rings of ``cup`` rise to 33 degrees: 22 % of its surface, the inside, is seen by fewer than two
photos. A module of its own, so that the renderings of all other scenes stay valid (see
:mod:`.cache`).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera

from .build import BuildSize
from .catalogue import SceneContent, SceneKind, scene_content, scene_kind
from .matte_thing import build_matte_thing
from .viewpoints import PRINCIPAL_POINT, around_thing, look_at

CUP_INSIDE = SceneKind(
    "cup_inside", "test", "The cup; a quarter of its photos look steeply into it.", 109
)

STEEP_SHARE = 0.25
"""Of the photos, and of the test views."""

STEEP_DEGREES = (55.0, 70.0)
"""Elevations between which the steep photos are taken, evenly."""

STEEP_FOCAL_SHARE = 0.92
"""Of the width, as that of the rings."""


def cup_inside_content(photos: int, tests: int, size: tuple[int, int]) -> SceneContent:
    """Return the cup's geometry, light and volumes with cameras around and above it."""
    cup = scene_content(scene_kind("cup"), photos, tests, size)
    random = np.random.default_rng(CUP_INSIDE.seed)
    return replace(
        cup,
        cameras=_cameras(photos, size, random, "photo"),
        test_cameras=_cameras(tests, size, random, "test"),
    )


def _cameras(
    count: int, size: tuple[int, int], random: np.random.Generator, prefix: str
) -> tuple[Camera, ...]:
    """Return the rings, then one steep ring; test views stand between the photos of that ring."""
    steep = round(STEEP_SHARE * count)
    distance = CUP_INSIDE.distance
    cameras = around_thing(count - steep, *size, distance, random, prefix)
    width, height = size
    focal = STEEP_FOCAL_SHARE * width
    cx, cy = PRINCIPAL_POINT[0] * width, PRINCIPAL_POINT[1] * height
    phase = 0.5 if prefix == "test" else 0.0
    low, high = STEEP_DEGREES
    for k in range(steep):
        angle = 2 * np.pi * (k + phase + random.uniform(-0.15, 0.15)) / steep
        # Neighbours alternate between both ends, so that no side is seen from one height only.
        lift = low + (high - low) * ((2 * k) % steep + 0.5) / steep
        lift = np.radians(lift + random.uniform(-3, 3))
        direction = np.array(
            [np.cos(lift) * np.cos(angle), np.cos(lift) * np.sin(angle), np.sin(lift)]
        )
        center = direction * distance * random.uniform(0.93, 1.08)
        target = random.normal(size=3) * 0.04 * distance / 2.5
        pose = look_at(center, target, random.uniform(-3, 3))
        name = f"{prefix}_{len(cameras):03d}.png"
        cameras.append(Camera(name, width, height, focal, focal, cx, cy, pose))
    return tuple(cameras)


def build_cup_inside(size: BuildSize, folder: Path) -> None:
    """Make the scene in an empty folder, as :func:`.build.build_scene` makes the others.

    Raises
    ------
    ResourceError
        bpy, trimesh or embreex is missing.
    """
    content = cup_inside_content(size.photos, size.test_views, (size.width, size.height))
    build_matte_thing(CUP_INSIDE, content, size, folder)
