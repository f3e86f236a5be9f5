# SPDX-License-Identifier: GPL-3.0-or-later
"""A torus beside a thin plate: what has to keep its hole, and what has to keep both its sides.

A module of its own, so that the renderings of all other scenes stay valid (see :mod:`.cache`).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.regions.convex_region import Region

from .build import BuildSize
from .catalogue import SceneContent, SceneKind, scene_content, scene_kind
from .geometry import Part, box, joined
from .matte_thing import build_matte_thing
from .viewpoints import around_thing

TORUS = SceneKind("torus", "test", "A torus and a thin plate beside it, matte.", 110, distance=2.6)

RING_RADIUS, TUBE_RADIUS = 0.40, 0.15
"""Of the torus, whose axis is horizontal."""
RING_STEPS, TUBE_STEPS = 192, 72

PLATE_WIDTH, PLATE_HEIGHT, PLATE_SHARE = 0.8, 1.0, 0.005
"""The plate's thickness is this share of the region's diagonal."""

PLATE_TURN_DEGREES = 15.0

MIDDLE_X = 0.55
"""Of the plate, and of the torus on the other side."""
MARGIN = 0.1
"""Of the region around both; the crop's margin is three fifths of it."""


def torus(ring_radius: float, tube_radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed torus around the y axis: vertices (v, 3), faces (f, 3)."""
    around, across = np.meshgrid(
        2 * np.pi * np.arange(RING_STEPS) / RING_STEPS,
        2 * np.pi * np.arange(TUBE_STEPS) / TUBE_STEPS,
        indexing="ij",
    )
    radius = ring_radius + tube_radius * np.cos(across)
    vertices = np.stack(
        [radius * np.cos(around), tube_radius * np.sin(across), radius * np.sin(around)], -1
    ).reshape(-1, 3)
    ids = np.arange(len(vertices)).reshape(RING_STEPS, TUBE_STEPS)
    a, b = ids, np.roll(ids, -1, 0)
    c, d = np.roll(b, -1, 1), np.roll(a, -1, 1)
    faces = np.concatenate(
        [np.stack([a, d, c], -1).reshape(-1, 3), np.stack([a, c, b], -1).reshape(-1, 3)]
    )
    return vertices, faces.astype(np.int32)


def torus_content(photos: int, tests: int, size: tuple[int, int]) -> SceneContent:
    """Return both things in the studio of the cup, with cameras around them."""
    studio = scene_content(scene_kind("cup"), photos, tests, size)
    random = np.random.default_rng(TORUS.seed)
    vertices, faces = torus(RING_RADIUS, TUBE_RADIUS)
    ring = Part("torus", vertices - (MIDDLE_X, 0.0, 0.0), faces, "painted_metal")
    middle = np.array([MIDDLE_X, 0.0, 0.0])
    sides = np.array([PLATE_WIDTH, 0.0, PLATE_HEIGHT])
    low = np.minimum(ring.vertices.min(0), middle - sides / 2) - MARGIN
    high = np.maximum(ring.vertices.max(0), middle + sides / 2) + MARGIN
    sides[1] = PLATE_SHARE * np.linalg.norm(high - low)
    plate = box(
        "plate", middle - sides / 2, middle + sides / 2, "painted_metal", PLATE_TURN_DEGREES
    )
    things = [ring, plate]
    return replace(
        studio,
        parts=(*things, *(part for part in studio.parts if part.surrounding)),
        truth=joined(things),
        region=Region.box("region", low, high),
        crop=Region.box("crop", low + 0.4 * MARGIN, high - 0.4 * MARGIN),
        cameras=tuple(around_thing(photos, *size, TORUS.distance, random, "photo")),
        test_cameras=tuple(around_thing(tests, *size, TORUS.distance, random, "test")),
    )


def build_torus(size: BuildSize, folder: Path) -> None:
    """Make the scene in an empty folder.

    Raises
    ------
    ResourceError
        bpy, trimesh or embreex is missing.
    """
    content = torus_content(size.photos, size.test_views, (size.width, size.height))
    build_matte_thing(TORUS, content, size, folder)
