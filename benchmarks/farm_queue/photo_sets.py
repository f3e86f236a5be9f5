# SPDX-License-Identifier: GPL-3.0-or-later
"""Small photo sets with known cameras: textured boxes in a room, drawn from a seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.regions.convex_region import Region
from gaussian_wrapping_addon.core.regions.region import write_region

from ..blocks.street import seen_points
from ..camera_solving.ray_caster import Boxes, render
from ..scenes.colmap_project import write_colmap
from ..scenes.viewpoints import around_thing

PHOTOS, WIDTH_PX, HEIGHT_PX = 12, 64, 48
DISTANCE = 2.6
"""Of the cameras from the boxes."""
REACH = 0.75
"""The boxes lie within this distance of 0 along each axis."""
_ROOM = 3.2
"""Half a side of the room around them."""
_MOST_BOXES = 3
_POINTS = 4000
"""Sparse points that are tried; those that two photos see are kept."""


def write_photo_sets(folder: Path, count: int, seed: int) -> list[str]:
    """Write photo sets as COLMAP projects into a new folder; return their names in order."""
    names = [f"thing-{number:02d}" for number in range(count)]
    for number, name in enumerate(names):
        _write(folder / name, np.random.default_rng([seed, number]))
    return names


def write_things_region(path: Path) -> Path:
    """Write the region in which the things of all sets lie; return its path."""
    half = np.full(3, REACH + 0.1)
    write_region(path, Region.box(path.stem, -half, half))
    return path


def _write(folder: Path, random: np.random.Generator) -> None:
    (folder / "images").mkdir(parents=True)
    boxes = _draw(random)
    cameras = around_thing(PHOTOS, WIDTH_PX, HEIGHT_PX, DISTANCE, random, "photo")
    photos = [render(boxes, camera) for camera in cameras]
    for camera, photo in zip(cameras, photos, strict=True):
        Image.fromarray(photo).save(folder / "images" / camera.name)
    write_colmap(folder / "sparse" / "0", cameras, seen_points(boxes, cameras, photos, _POINTS))


def _draw(random: np.random.Generator) -> Boxes:
    """Return a room with a few boxes about its middle."""
    lower, upper = [np.full(3, -_ROOM)], [np.full(3, _ROOM)]
    for _ in range(random.integers(1, _MOST_BOXES + 1)):
        half = random.uniform(0.25, 0.45, 3)
        middle = random.uniform(half - REACH, REACH - half)
        lower.append(middle - half)
        upper.append(middle + half)
    first = int(random.integers(1_000_000))
    looks = first + np.arange(6 * len(lower)).reshape(-1, 6)
    return Boxes(np.array(lower), np.array(upper), looks)
