# SPDX-License-Identifier: GPL-3.0-or-later
"""Things in the furnished room and the glazed gourd, as closed solids.

Solids that touch sink a few millimetres into each other, so that their union is well defined.
"""

from __future__ import annotations

import numpy as np

from .geometry import Part, box, cone, icosphere

ROOM_LOW = np.array([-2.4, -1.9, 0.0])
ROOM_HIGH = np.array([2.4, 1.9, 2.5])
"""Opposite corners of the room's free space, metres."""

WALL_THICKNESS = 0.2
"""Walls, floor and ceiling of the true solid, metres; their outer side is never seen."""

_BOOKS = ("cloth_red", "cloth_blue", "cloth_ochre", "cloth_green", "plaster")


def _table() -> list[Part]:
    parts = [box("table top", (-0.45, -0.65, 0.71), (1.05, 0.25, 0.75), "oak")]
    for k, (x, y) in enumerate([(-0.38, -0.58), (0.93, -0.58), (-0.38, 0.13), (0.93, 0.13)]):
        parts.append(box(f"table leg {k}", (x, y, -0.02), (x + 0.05, y + 0.05, 0.715), "oak"))
    vertices, faces = icosphere(4)
    ball = vertices * 0.17 + np.array([0.05, -0.2, 0.75 + 0.166])
    parts.append(Part("ball", ball, faces, "marble"))
    parts.append(box("book on table", (0.5, -0.42, 0.745), (0.72, -0.12, 0.79), "cloth_red", 18))
    return parts


def _shelf(random: np.random.Generator) -> list[Part]:
    low_x, wall_x = 2.1, ROOM_HIGH[0] + 0.02
    parts = [
        box("shelf side 0", (low_x, -0.60, -0.02), (wall_x, -0.57, 1.62), "walnut"),
        box("shelf side 1", (low_x, 0.57, -0.02), (wall_x, 0.60, 1.62), "walnut"),
    ]
    for k, z in enumerate((0.08, 0.58, 1.08, 1.57)):
        parts.append(
            box(f"shelf {k}", (low_x + 0.005, -0.58, z), (wall_x, 0.58, z + 0.03), "walnut")
        )
        y = -0.54
        while k < 3 and y < 0.38:
            thick, tall = random.uniform(0.04, 0.09), random.uniform(0.22, 0.36)
            if random.random() < 0.75:
                material = _BOOKS[int(random.integers(len(_BOOKS)))]
                low = (low_x + random.uniform(0.03, 0.07), y, z + 0.027)
                parts.append(
                    box(f"book {k} {y:.2f}", low, (wall_x - 0.06, y + thick, z + tall), material)
                )
            # A gap between books: touching covers would make a degenerate union.
            y += thick + random.uniform(0.006, 0.03)
    return parts


def _lamp() -> list[Part]:
    x, y = -1.9, 1.35
    return [
        cone("lamp foot", (x, y, -0.01), (x, y, 0.03), 0.15, 0.14, "dark_metal", 32),
        cone("lamp rod", (x, y, 0.02), (x, y, 1.50), 0.012, 0.012, "dark_metal", 12),
        cone("lamp shade", (x, y, 1.46), (x, y, 1.74), 0.22, 0.13, "linen", 40),
    ]


def _stool() -> list[Part]:
    x, y = -1.05, -1.0
    parts = [cone("stool seat", (x, y, 0.44), (x, y, 0.48), 0.18, 0.18, "oak", 40)]
    for k in range(3):
        a = 2 * np.pi * k / 3 + 0.4
        top = (x + 0.11 * np.cos(a), y + 0.11 * np.sin(a), 0.45)
        foot = (x + 0.19 * np.cos(a), y + 0.19 * np.sin(a), -0.02)
        parts.append(cone(f"stool leg {k}", foot, top, 0.016, 0.016, "dark_metal", 12))
    return parts


def _sofa() -> list[Part]:
    return [
        box("sofa seat", (-0.9, 1.1, 0.1), (0.9, 1.80, 0.42), "cloth_green"),
        box("sofa back", (-0.9, 1.62, 0.3), (0.9, 1.82, 0.85), "cloth_green"),
        box("sofa arm 0", (-1.08, 1.08, 0.1), (-0.88, 1.81, 0.6), "cloth_green"),
        box("sofa arm 1", (0.88, 1.08, 0.1), (1.08, 1.81, 0.6), "cloth_green"),
        box("cushion", (0.3, 1.35, 0.41), (0.75, 1.63, 0.72), "cloth_ochre"),
        *(
            box(f"sofa foot {k}", (x, y, -0.02), (x + 0.06, y + 0.06, 0.11), "walnut")
            for k, (x, y) in enumerate([(-1.0, 1.15), (0.94, 1.15), (-1.0, 1.7), (0.94, 1.7)])
        ),
    ]


def furniture(random: np.random.Generator) -> list[Part]:
    """Return all furniture as closed solids; metres, floor at z = 0."""
    return [
        *_table(),
        *_shelf(random),
        *_lamp(),
        *_stool(),
        *_sofa(),
        box("crate", (-2.1, -1.55, -0.02), (-1.6, -1.05, 0.5), "crate", 24),
        box("skirting", (0.9, -1.92, -0.02), (2.0, -1.86, 0.12), "plaster"),
    ]


def wall_solid() -> Part:
    """Return the room's walls: a closed shell, its inner side facing the free space."""
    inner = box("inner", ROOM_LOW, ROOM_HIGH, "plaster")
    outer = box("outer", ROOM_LOW - WALL_THICKNESS, ROOM_HIGH + WALL_THICKNESS, "plaster")
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)])
    vertices = np.concatenate([outer.vertices, inner.vertices])
    return Part("walls", vertices, faces, "plaster", smooth=False)


def gourd() -> tuple[np.ndarray, np.ndarray]:
    """Return a smooth ribbed closed body with a neck and a dimple: vertices (v, 3), faces."""
    directions, faces = icosphere(5)
    x, y, z = directions.T
    around = np.arctan2(y, x)
    equator = 1.0 - z**2  # 0 at the poles, so that the ribs end smoothly there
    radius = 0.78 + 0.06 * np.cos(7 * around) * equator**2
    radius += 0.55 * np.exp((z - 1.0) / 0.12) * (1 + 0.15 * np.cos(around))  # neck
    radius -= 0.16 * np.exp(-(z + 1.0) / 0.10)  # dimple below
    radius += 0.05 * np.sin(3 * z + 2 * x) * equator
    return directions * radius[:, None], faces
