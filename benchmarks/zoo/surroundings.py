# SPDX-License-Identifier: GPL-3.0-or-later
"""What stands around a thing: ground, walls near or far, and the sky."""

from __future__ import annotations

import numpy as np

from ..scenes.geometry import Part, icosphere
from .looks import EVEN, RICH, SKY, WEAK, Look, draw_look

NEAR, FAR, OPEN = "near", "far", "open"
"""A room, a walled court under the sky, open ground with one wall."""

SKY_NAME = "sky"
SKY_RADIUS = 80.0
_HALF_WIDTHS = {NEAR: (3.4, 4.2), FAR: (7.0, 11.0), OPEN: (16.0, 24.0)}
_HEIGHTS = {NEAR: (3.4, 4.2), FAR: (3.0, 6.0), OPEN: (2.0, 5.0)}
"""Of the walls."""


def _sheet(name: str, corner: np.ndarray, right: np.ndarray, up: np.ndarray) -> Part:
    """Return one rectangle, seen from the side that ``right x up`` points to."""
    vertices = np.stack([corner, corner + right, corner + right + up, corner + up])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Part(name, vertices, faces, name, surrounding=True, smooth=False)


def sky(random: np.random.Generator) -> tuple[Part, Look]:
    """Return a dome around everything, blue with clouds or overcast."""
    vertices, faces = icosphere(3)
    part = Part(SKY_NAME, SKY_RADIUS * vertices, faces[:, ::-1], SKY_NAME, surrounding=True)
    clouds = random.uniform(0.55, 0.85)
    blue = (0.20, 0.36, 0.62) if random.random() < 0.7 else (0.52, 0.55, 0.60)
    return part, Look("sky", (blue, (0.55, 0.62, 0.70), (clouds,) * 3), 0.04, SKY)


def around(
    kind: str, floor_z: float, random: np.random.Generator
) -> tuple[list[Part], dict[str, Look]]:
    """Return the surroundings of a thing at x = y = 0 and their looks."""
    half = random.uniform(*_HALF_WIDTHS[kind])
    height = random.uniform(*_HEIGHTS[kind])
    low = np.array([-half, -half, floor_z])
    x, y, z = np.diag([2 * half, 2 * half, height])
    opposite = low + x + y
    # Away from the thing patterns are seen smaller.
    scale = (1.2, 2.5) if kind == NEAR else (0.7, 1.5)
    parts = [_sheet("ground", low, x, y)]
    walls = {
        "west": (low, y, z), "east": (opposite, -y, z),
        "south": (low + x, -x, z), "north": (opposite - x, x, z),
    }  # fmt: skip
    standing = [str(random.choice(list(walls)))] if kind == OPEN else list(walls)
    parts += [_sheet(name, *walls[name]) for name in standing]
    looks = {}
    for part in parts:
        axes = {"ground": "xy", "west": "yz", "east": "yz"}.get(part.name, "xz")
        plain = random.random() < 0.25
        patterns = (WEAK,) if plain else (*RICH, f"bricks_{axes}", f"bricks_{axes}")
        looks[part.name] = draw_look(
            random, scale, patterns=patterns, finish=EVEN, weak=plain
        )  # fmt: skip
    if kind == NEAR:
        parts.append(_sheet("ceiling", low + z, y, x))
        looks["ceiling"] = draw_look(random, (0.8, 1.5), patterns=(WEAK,), finish=EVEN, weak=True)
    else:
        dome, looks[SKY_NAME] = sky(random)
        parts.append(dome)
    return parts, looks
