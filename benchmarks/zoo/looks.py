# SPDX-License-Identifier: GPL-3.0-or-later
"""Looks of surfaces: a pattern in world coordinates, colours and a finish, as Blender materials."""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..scenes.nodes import Color, Nodes

MATTE, EVEN, GLAZED, MIRROR, SKY = "matte", "even", "glazed", "mirror", "sky"
"""Finishes. Even: lit the same from everywhere, without shadows or noise."""

WEAK = "plaster"
"""The pattern that is all but plain."""


@dataclass(frozen=True)
class Look:
    """How a surface looks."""

    pattern: str
    """A key of :data:`PATTERNS`."""
    colors: tuple[Color, Color, Color]
    scale: float
    """Of the pattern: features are about one over this many units of length large."""
    finish: str = MATTE


def _patches(n: Nodes, look: Look) -> Any:
    a, b, c = look.colors
    base = n.mix(n.step(n.noise(look.scale, 1.0), 0.47, 0.53), a, b)
    return n.mix(n.step(n.noise(4 * look.scale, 2.0), 0.54, 0.60), base, c)


def _cells(n: Nodes, look: Look) -> Any:
    a, b, c = look.colors
    edge = n.step(n.cells(2 * look.scale, output="Distance"), 0.30, 0.42)
    base = n.mix(n.step(n.noise(look.scale, 2.0), 0.40, 0.60), a, b)
    return n.mix(edge, base, c)


def _waves(n: Nodes, look: Look) -> Any:
    a, b, c = look.colors
    base = n.mix(n.step(n.waves(look.scale, 5.0), 0.45, 0.55), a, b)
    return n.mix(n.step(n.noise(5 * look.scale, 2.0), 0.52, 0.64), base, c)


def _speckles(n: Nodes, look: Look) -> Any:
    a, b, c = look.colors
    base = n.mix(n.noise(look.scale, 2.0), a, b)
    return n.mix(n.step(n.noise(7 * look.scale, 2.0), 0.55, 0.60), base, c)


def _grain(n: Nodes, look: Look) -> Any:
    a, b, c = look.colors
    stretched = n.stretched(n.position, (1.5, 9.0, 9.0))
    base = n.mix(n.step(n.noise(look.scale, 2.0, stretched), 0.3, 0.7), a, b)
    return n.mix(n.step(n.noise(1.3 * look.scale, 2.0), 0.60, 0.70), base, c)


def _plaster(n: Nodes, look: Look) -> Any:
    a, b, _ = look.colors
    return n.mix(n.step(n.noise(look.scale, 2.0), 0.35, 0.70), a, b)


def _bricks(axes: str) -> Callable[[Nodes, Look], Any]:
    def build(n: Nodes, look: Look) -> Any:
        size = (0.8 / look.scale, 0.3 / look.scale)
        wall = n.bricks(n.plane(axes), size, list(look.colors), 0.03 / look.scale)
        dirt = n.step(n.noise(5 * look.scale, 2.0), 0.4, 0.75)
        return n.mix(n.math("MULTIPLY", dirt, 0.45), wall, look.colors[1])

    return build


def _sky(n: Nodes, look: Look) -> Any:
    a, b, c = look.colors
    blue = n.mix(n.step(n.axis("z"), 0.0, 40.0), b, a)
    return n.mix(n.step(n.noise(look.scale, 3.0), 0.50, 0.72), blue, c)


PATTERNS: dict[str, Callable[[Nodes, Look], Any]] = {
    "patches": _patches,
    "cells": _cells,
    "waves": _waves,
    "speckles": _speckles,
    "grain": _grain,
    WEAK: _plaster,
    "bricks_xy": _bricks("xy"),
    "bricks_xz": _bricks("xz"),
    "bricks_yz": _bricks("yz"),
    "sky": _sky,
}

RICH = ("patches", "cells", "waves", "speckles", "grain")
"""Patterns with structure at every place."""


def make_look(name: str, look: Look) -> Any:
    """Return a new Blender material."""
    n = Nodes(name)
    color = PATTERNS[look.pattern](n, look)
    if look.finish == EVEN:
        return n.finish_even(color)
    if look.finish == GLAZED:
        return n.finish_glossy(color, 0.35, 1.0)
    if look.finish == MIRROR:
        shader = n.add("ShaderNodeBsdfAnisotropic", {"Color": color, "Roughness": 0.03})
        return n._finish(shader)
    if look.finish == SKY:
        return n._finish(n.add("ShaderNodeEmission", {"Color": color, "Strength": 1.0}))
    return n.finish_matte(color)


def draw_colors(random: np.random.Generator, *, weak: bool = False) -> tuple[Color, Color, Color]:
    """Draw three colours: far apart in brightness, or all but the same (``weak``)."""
    hue = random.uniform()
    values = np.array([0.52, 0.49, 0.46]) if weak else random.permutation([0.62, 0.33, 0.11])
    colors = []
    for value in values * random.uniform(0.85, 1.1):
        turned = hue if weak else (hue + random.uniform(-0.3, 0.3)) % 1.0
        saturation = random.uniform(0.05, 0.15) if weak else random.uniform(0.15, 0.6)
        colors.append(colorsys.hsv_to_rgb(turned, saturation, min(value, 0.68)))
    return colors[0], colors[1], colors[2]


def draw_look(
    random: np.random.Generator,
    scale: tuple[float, float],
    *,
    patterns: tuple[str, ...] = RICH,
    finish: str = MATTE,
    weak: bool = False,
) -> Look:
    """Draw a look of one of the patterns with a scale of the range."""
    pattern = patterns[int(random.integers(len(patterns)))]
    return Look(pattern, draw_colors(random, weak=weak), float(random.uniform(*scale)), finish)
