# SPDX-License-Identifier: GPL-3.0-or-later
"""A tilted plane with a smooth pattern, seen by a few cameras; all in closed form."""

from __future__ import annotations

import functools

import numpy as np

from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.matching import MatchingLevel
from tests.synthetic import look_at

WIDTH, HEIGHT = 64, 48
NORMAL = np.array([0.36, 0.48, 0.8])
"""Of the plane through the origin; the cameras are on its positive side."""


def cameras(count: int = 3) -> list[Camera]:
    """Return cameras 4 units above the plane, 0.6 apart."""
    places = [(0.6 * i, -2.0 + 0.3 * (i % 2), 3.5) for i in range(count)]
    return [
        look_at(np.array(place), np.zeros(3), f"{i}.png", WIDTH, HEIGHT, 80.0)
        for i, place in enumerate(places)
    ]


def true_planes(camera: Camera) -> np.ndarray:
    """Return the (h, w, 3) planes (w, a, b) of the pixels."""
    normal = camera.rotation @ NORMAL
    distance = normal @ camera.cam_from_world[:, 3]  # n . x of the plane's points
    w = camera.rays() @ normal / distance
    slopes = [normal[0] / camera.fx / distance, normal[1] / camera.fy / distance]
    return np.stack([w, *(np.full_like(w, slope) for slope in slopes)], -1)


def grey_photo(camera: Camera) -> np.ndarray:
    """Return the (h, w) uint8 photo."""
    rays = camera.rays() / true_planes(camera)[..., :1]
    points = (rays - camera.cam_from_world[:, 3]) @ camera.rotation
    random = np.random.default_rng(2)
    waves = random.normal(size=(20, 3)) * 9.0
    phases = random.uniform(0, 2 * np.pi, 20)
    value = np.sin(points @ waves.T + phases).sum(-1) / 20**0.5
    return np.round(128 + 50 * np.clip(value, -2.2, 2.2)).astype(np.uint8)


def level_of(photos: list[np.ndarray], given: list[Camera]) -> MatchingLevel:
    """Return the level of these photos, each matched with all others."""
    count = len(given)
    sources = [np.array([j for j in range(count) if j != i]) for i in range(count)]
    return MatchingLevel(given, photos, sources, np.tile([0.03, 0.6], (count, 1)))


@functools.cache
def plane_photos() -> tuple[tuple[Camera, ...], tuple[np.ndarray, ...]]:
    """Return three cameras and their photos."""
    given = cameras()
    return tuple(given), tuple(grey_photo(camera) for camera in given)
