# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the photographer stands: rings around a thing, a walk through a room."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera

PRINCIPAL_POINT = (0.507, 0.493)
"""Shares of width and height: not quite the middle, as in real lenses."""

RINGS = ((0.36, 33.0), (0.38, 6.0), (0.26, -17.0))
"""Share of the photos and elevation in degrees of each ring around a thing."""

_GOLDEN = 0.618034


def look_at(center: np.ndarray, target: np.ndarray, roll_degrees: float) -> np.ndarray:
    """Return (3, 4) cam_from_world of a camera that looks at a point; world z is up."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(np.radians(roll_degrees)), np.sin(np.radians(roll_degrees))
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    return np.concatenate([rotation, -(rotation @ center)[:, None]], 1)


def _camera(name: str, pose: np.ndarray, width: int, height: int, focal_share: float) -> Camera:
    focal = focal_share * width
    cx, cy = PRINCIPAL_POINT[0] * width, PRINCIPAL_POINT[1] * height
    return Camera(name, width, height, focal, focal, cx, cy, pose)


def around_thing(
    count: int, width: int, height: int, distance: float, random: np.random.Generator, prefix: str
) -> list[Camera]:
    """Return cameras on rings around 0, each with small errors of a hand.

    Test views ("test" prefix) stand between the rings, elevations as the random numbers say.
    """
    cameras: list[Camera] = []
    if prefix == "test":
        rings = [(count, None)]
    else:
        counts = [round(share * count) for share, _ in RINGS[:-1]]
        counts.append(count - sum(counts))
        rings = [(n, elevation) for n, (_, elevation) in zip(counts, RINGS, strict=True)]
    for ring, (number, elevation) in enumerate(rings):
        for k in range(number):
            angle = 2 * np.pi * (k + _GOLDEN * ring + random.uniform(-0.15, 0.15)) / number
            lift = random.uniform(-8, 24) if elevation is None else elevation
            lift = np.radians(lift + random.uniform(-4, 4))
            direction = np.array(
                [np.cos(lift) * np.cos(angle), np.cos(lift) * np.sin(angle), np.sin(lift)]
            )
            center = direction * distance * random.uniform(0.93, 1.08)
            target = random.normal(size=3) * 0.04 * distance / 2.5
            pose = look_at(center, target, random.uniform(-3, 3))
            name = f"{prefix}_{len(cameras):03d}.png"
            cameras.append(_camera(name, pose, width, height, 0.92))
    return cameras


def inside_room(
    count: int,
    width: int,
    height: int,
    low: np.ndarray,
    high: np.ndarray,
    random: np.random.Generator,
    prefix: str,
) -> list[Camera]:
    """Return cameras on a walk around the room's middle that look across it, up and down."""
    middle, half = (low + high) / 2, (high - low) / 2
    cameras: list[Camera] = []
    phase = 0.5 if prefix == "test" else 0.0
    for k in range(count):
        angle = 2 * np.pi * (k + phase + random.uniform(-0.2, 0.2)) / count
        reach = (0.62, 0.45, 0.56)[k % 3]
        center = np.array([np.cos(angle) * half[0] * reach, np.sin(angle) * half[1] * reach, 0.0])
        center += [middle[0], middle[1], random.uniform(1.15, 1.75)]
        pan = np.radians((0.0, 48.0, -48.0)[k % 3] + random.uniform(-8, 8))
        pitch = np.radians((-15.0, -32.0, -4.0, -22.0, 14.0)[k % 5] + random.uniform(-4, 4))
        # Across the room as the walls stand: the direction to the opposite point of the ellipse.
        yaw = np.arctan2(np.sin(angle) * half[1], np.cos(angle) * half[0]) + np.pi + pan
        direction = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
        pose = look_at(center, center + np.array(direction), random.uniform(-3, 3))
        cameras.append(_camera(f"{prefix}_{k:03d}.png", pose, width, height, 0.62))
    return cameras
