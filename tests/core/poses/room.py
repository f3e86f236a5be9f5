# SPDX-License-Identifier: GPL-3.0-or-later
"""A room with textured walls, photographed by panoramas with known poses."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

HALF = np.array([3.0, 4.0, 2.0])
"""The room reaches from -HALF to HALF."""
_TEXTURE_PX = 500


@functools.lru_cache(maxsize=1)
def _walls() -> np.ndarray:
    rng = np.random.default_rng(7)
    noise = rng.uniform(size=(6, _TEXTURE_PX, _TEXTURE_PX, 3))
    walls = sum(ndimage.gaussian_filter(noise, (0, s, s, 0)) * s for s in (1, 2, 4, 8))
    scaled: np.ndarray = (walls - walls.min()) / np.ptp(walls) * 255
    return scaled


def poses(count: int) -> list[np.ndarray]:
    """Return (3, 4) poses along a way through the room; frames are x right, y down, z forward."""
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    found = []
    for i in range(count):
        angle = 0.3 * i
        turn = np.array([
            [np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0, 0, 1],
        ])  # fmt: skip
        center = np.array([0.5 * i - 1.0, 0.3 * np.sin(i), 0.1 * i - 0.2])
        rotation = upright @ turn
        found.append(np.concatenate([rotation, -(rotation @ center)[:, None]], 1))
    return found


def color_of(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return (n, 3) colours from 0 to 255 of the walls that (n, 3) rays meet."""
    with np.errstate(divide="ignore"):
        wall = np.where(directions > 0, HALF, -HALF)
        reach = np.where(directions == 0, np.inf, (wall - origin) / directions)
    axis = reach.argmin(1)
    met = origin + directions * reach.min(1)[:, None]
    out = np.zeros((len(directions), 3))
    for a in range(3):
        for side in (0, 1):
            here = (axis == a) & ((directions[:, a] > 0) == bool(side))
            at = (np.delete(met[here], a, 1) / 8.0 + 0.5) * (_TEXTURE_PX - 1)
            for c in range(3):
                wall = _walls()[2 * a + side, ..., c]
                out[here, c] = ndimage.map_coordinates(wall, at.T, order=1)
    return out


def panorama(pose: np.ndarray, width: int) -> np.ndarray:
    """Return the (h, w, 3) uint8 panorama, h = w / 2, of a pose."""
    height = width // 2
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    lon, lat = np.meshgrid(longitude, latitude)
    local = np.stack([np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)], -1)
    rotation, shift = pose[:, :3], pose[:, 3]
    color = color_of(-rotation.T @ shift, local.reshape(-1, 3) @ rotation)
    return color.reshape(height, width, 3).round().astype(np.uint8)


def write_panoramas(folder: Path, count: int, width: int) -> list[str]:
    """Write panoramas and return their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"hall{i}.png" for i in range(count)]
    for name, pose in zip(names, poses(count), strict=True):
        Image.fromarray(panorama(pose, width)).save(folder / name)
    return names
