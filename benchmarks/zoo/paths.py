# SPDX-License-Identifier: GPL-3.0-or-later
"""Ways of the photographer: where the photos are taken, and where the test views between them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera

from ..scenes.viewpoints import PRINCIPAL_POINT, inside_room, look_at
from .content import Photography

THING_RADIUS = 1.0
"""Half the diagonal of every thing."""
ORBIT, DOME, CLOSE_UP, FORWARD, INSIDE, WALK = (
    "orbit", "dome", "close-up", "forward", "inside", "walk",
)  # fmt: skip
_GOLDEN = 0.618034
_ABOVE_GROUND = 0.15
"""No camera is nearer to the ground of a thing."""
_FOCAL_SHARE = 0.92
"""Of the long side, for things."""

Volume = tuple[np.ndarray, np.ndarray]
"""Opposite corners (3,): of a thing's box, of the free space of a room or street."""

Directions = Callable[[int, float, np.random.Generator], np.ndarray]


def _unit(azimuth: np.ndarray, elevation_degrees: np.ndarray) -> np.ndarray:
    lift = np.radians(elevation_degrees)
    flat = np.cos(lift)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(lift)], 1)


def _orbit(count: int, phase: float, random: np.random.Generator) -> np.ndarray:
    """Two rings, taken in turn."""
    k = np.arange(count)
    azimuth = 2 * np.pi * (k + phase + random.uniform(-0.15, 0.15, count)) / count
    lift = np.where(k % 2 == 0, 10.0, 32.0) if phase == 0 else random.uniform(5.0, 35.0, count)
    return _unit(azimuth, lift + random.uniform(-4, 4, count))


def _dome(count: int, phase: float, random: np.random.Generator) -> np.ndarray:
    """A spiral that rises from the horizon almost to the zenith, evenly over the sphere."""
    share = (np.arange(count) + 0.5) / count
    rise = np.sin(np.radians(4.0)) + share * (np.sin(np.radians(72.0)) - np.sin(np.radians(4.0)))
    azimuth = 2 * np.pi * (_GOLDEN * np.arange(count) + 0.5 * phase)
    azimuth += random.uniform(-0.1, 0.1, count)
    return _unit(azimuth, np.degrees(np.arcsin(rise)) + random.uniform(-2, 2, count))


def _forward(count: int, phase: float, random: np.random.Generator) -> np.ndarray:
    """Rows on one side, towards -y."""
    rows = 3
    k = np.arange(count)
    columns = -(-count // rows)
    across = (k // rows + 0.5 + 0.5 * phase) / columns - 0.5
    azimuth = -np.pi / 2 + np.radians(100.0) * across + random.uniform(-0.03, 0.03, count)
    lift = np.array([4.0, 18.0, 34.0])[k % rows] + random.uniform(-3, 3, count)
    return _unit(azimuth, lift)


_DIRECTIONS: dict[str, Directions] = {
    ORBIT: _orbit, DOME: _dome, CLOSE_UP: _orbit, FORWARD: _forward,
}  # fmt: skip


def _camera(name: str, pose: np.ndarray, shot: Photography, focal_share: float) -> Camera:
    focal = focal_share * max(shot.width, shot.height)
    cx, cy = PRINCIPAL_POINT[0] * shot.width, PRINCIPAL_POINT[1] * shot.height
    return Camera(name, shot.width, shot.height, focal, focal, cx, cy, pose)


def thing_distance(shot: Photography) -> float:
    """Return the distance at which a thing fills the short side of the photo."""
    share = min(shot.width, shot.height) / max(shot.width, shot.height)
    return THING_RADIUS * 0.92 * _FOCAL_SHARE / (share / 2)


def pixel_at_thing(shot: Photography) -> float:
    """Return the length at a thing's middle that one pixel covers."""
    return thing_distance(shot) / (_FOCAL_SHARE * max(shot.width, shot.height))


def _of_thing(
    shot: Photography, count: int, floor_z: float, phase: float, random: np.random.Generator,
    prefix: str,
) -> list[Camera]:  # fmt: skip
    distance = thing_distance(shot)
    cameras = []
    for k, direction in enumerate(_DIRECTIONS[shot.path](count, phase, random)):
        near = shot.path == CLOSE_UP and k % 3 > 0
        away = distance * random.uniform(0.92, 1.08) * (0.6 if near else 1.0)
        target = random.normal(size=3) * (0.25 if near else 0.05)
        center = away * direction + (0.5 * target if near else 0.0)
        center[2] = max(center[2], floor_z + _ABOVE_GROUND)
        pose = look_at(center, target, random.uniform(-3, 3))
        cameras.append(_camera(f"{prefix}_{k:03d}.png", pose, shot, _FOCAL_SHARE))
    return cameras


def _on_walk(
    shot: Photography, count: int, free: Volume, phase: float, random: np.random.Generator,
    prefix: str,
) -> list[Camera]:  # fmt: skip
    """Along a street: the façade is towards +y; there and back, looking across, ahead and back."""
    low, high = free
    cameras = []
    for k in range(count):
        share = (k + 0.5 + 0.5 * phase) / count
        x = 0.85 * (low[0] + share * (high[0] - low[0])) + random.uniform(-0.15, 0.15)
        y = low[1] + (high[1] - low[1]) * (0.15, 0.40, 0.0)[k % 3] + random.uniform(-0.2, 0.2)
        center = np.array([x, y, random.uniform(1.4, 2.0)])
        turn = (0.0, -32.0, 32.0)[k % 3]  # to the right below 0, where x grows
        outward = (share < 0.5) == (turn > 0)
        turn *= 1.0 - abs(2 * share - 1) if outward else 1.0  # nothing stands beyond the ends
        yaw = np.radians(90.0 + turn + random.uniform(-8, 8))
        pitch = np.radians((4.0, 14.0, 0.0, 9.0)[k % 4] + random.uniform(-4, 4))
        gaze = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
        pose = look_at(center, center + np.array(gaze), random.uniform(-3, 3))
        cameras.append(_camera(f"{prefix}_{k:03d}.png", pose, shot, 0.72))
    return cameras


def make_cameras(
    shot: Photography, count: int, free: Volume, random: np.random.Generator, *, tests: bool
) -> tuple[Camera, ...]:
    """Return photos, or test views that stand between them.

    Parameters
    ----------
    free : (low, high)
        Of a thing only ``low[2]`` counts, the height of the ground.
    """
    prefix, phase = ("test", 0.5) if tests else ("photo", 0.0)
    if shot.path == INSIDE:
        size = (shot.width, shot.height)
        return tuple(inside_room(count, *size, *free, random, prefix))
    make = _on_walk if shot.path == WALK else None
    if make is not None:
        return tuple(make(shot, count, free, phase, random, prefix))
    return tuple(_of_thing(shot, count, float(free[0][2]), phase, random, prefix))
