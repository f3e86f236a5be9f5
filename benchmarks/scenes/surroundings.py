# SPDX-License-Identifier: GPL-3.0-or-later
"""The inside of a room: floor, ceiling, and walls with pictures on them."""

from __future__ import annotations

import numpy as np

from .geometry import Part

_PICTURES = {
    "west": (0.18, 0.42, 0.36, 0.80),
    "east": (0.55, 0.86, 0.40, 0.78),
    "south": (0.30, 0.68, 0.42, 0.84),
    "north": (0.12, 0.40, 0.34, 0.76),
}
"""Shares of a wall's width and height that its picture covers: left, right, bottom, top."""


def _sheet(name: str, corner: np.ndarray, right: np.ndarray, up: np.ndarray, material: str) -> Part:
    """Return one rectangle, seen from the side that ``right x up`` points to."""
    vertices = np.stack([corner, corner + right, corner + right + up, corner + up])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uvs = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float64)
    return Part(name, vertices, faces, material, uvs, surrounding=True, smooth=False)


def _wall(
    name: str, corner: np.ndarray, right: np.ndarray, up: np.ndarray, material: str, picture: str
) -> list[Part]:
    """Return a wall in nine rectangles whose middle one is the picture."""
    if not picture:
        return [_sheet(name, corner, right, up, material)]
    left, end, bottom, top = _PICTURES[name]
    across, along = (0.0, left, end, 1.0), (0.0, bottom, top, 1.0)
    return [
        _sheet(
            f"{name} {i}{j}",
            corner + across[i] * right + along[j] * up,
            (across[i + 1] - across[i]) * right,
            (along[j + 1] - along[j]) * up,
            picture if i == j == 1 else material,
        )
        for i in range(3)
        for j in range(3)
    ]


def room_shell(
    low: np.ndarray,
    high: np.ndarray,
    *,
    floor: str,
    ceiling: str,
    walls: dict[str, tuple[str, str]],
) -> list[Part]:
    """Return the inner surfaces of a room, seen from inside.

    Parameters
    ----------
    low, high : (3,) float64
        Opposite corners of the free space.
    floor, ceiling : str
        Material names.
    walls : dict
        ``west east south north`` -> (material of the wall, material of its picture or "").
    """
    x, y, z = np.diag(np.asarray(high, np.float64) - low)  # edges of the room
    lo, hi = np.array(low, np.float64), np.array(high, np.float64)
    parts = [
        _sheet("floor", lo, x, y, floor),
        _sheet("ceiling", lo + z, y, x, ceiling),
    ]
    parts += _wall("west", lo, y, z, *walls["west"])
    parts += _wall("east", hi - z, -y, z, *walls["east"])
    parts += _wall("south", lo + x, -x, z, *walls["south"])
    parts += _wall("north", lo + y, x, z, *walls["north"])
    return parts


def studio(half_width: float, floor_z: float, height: float) -> list[Part]:
    """Return the room in which single things are photographed, centred at x = y = 0."""
    low = np.array([-half_width, -half_width, floor_z])
    high = np.array([half_width, half_width, floor_z + height])
    return room_shell(
        low,
        high,
        floor="planks",
        ceiling="plaster",
        walls={
            "west": ("wallpaper_yz", "poster_a"),
            "east": ("bricks_yz", "poster_b"),
            "south": ("panels_xz", "poster_c"),
            "north": ("wallpaper_xz", "poster_d"),
        },
    )


def ceiling_lamps(ceiling_z: float) -> list[Part]:
    """Return bright panels just below a ceiling: what shiny things reflect."""
    places = {"lamp 0": (1.3, -1.0, 1.1, 0.5), "lamp 1": (-1.7, 1.4, 0.6, 0.6)}
    return [
        _sheet(
            name,
            np.array([x, y, ceiling_z - 0.03]),
            np.array([0.0, width, 0.0]),
            np.array([depth, 0.0, 0.0]),
            "lamp_panel",
        )
        for name, (x, y, width, depth) in places.items()
    ]
