# SPDX-License-Identifier: GPL-3.0-or-later
"""How scenes of the zoo look: materials, content, what is around them, and their rendering."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera

from ..scenes.geometry import Part, icosphere
from ..scenes.rendering import (
    Color,
    Light,
    Nodes,
    _add_light,
    _configure,
    _mesh_object,
    _place,
    require_bpy,
)

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


@dataclass(frozen=True)
class Subject:
    """What a family draws: the solids whose surface is the truth, and how they look.

    Parts that are not ``surrounding`` are closed; where they overlap, the truth is their union.
    """

    parts: tuple[Part, ...]
    looks: Mapping[str, Look]
    """By the name that the parts have as their material."""
    reflects: bool = False
    """Whether a thing reflects its surroundings."""
    place: bool = False
    """A room or street that the cameras are in; else a thing that stands in surroundings."""
    inner: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """Of a place, opposite corners of the volume that is judged; the region is the whole solid."""


@dataclass(frozen=True)
class Photography:
    """How a scene is photographed."""

    width: int
    height: int
    photos: int
    path: str
    """A way of :mod:`.places`."""
    surroundings: str
    """Of a thing: near, far or open; of a place: empty."""
    exposure: bool
    """Whether exposure and white balance change from photo to photo."""
    pose_noise_px: float
    """Standard deviation of the reprojection that wrong poses cause."""
    point_noise: float
    """Noise of the sparse points beyond that of half a pixel an observation, as a factor."""
    outliers: float
    """Share of the sparse points that lie anywhere."""
    weak_texture: float
    """Slope of the photo (8-bit values a pixel) below which no sparse point is found."""


@dataclass(frozen=True)
class Content:
    """Everything of a scene before it is rendered."""

    subject: Subject
    around: tuple[Part, ...]
    """Ground and walls around a thing, and the sky; open sheets."""
    looks: Mapping[str, Look]
    """Of all parts."""
    region: Region
    crop: Region
    light: Light
    photography: Photography
    cameras: tuple[Camera, ...]
    test_cameras: tuple[Camera, ...]


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


SAMPLES = 4
"""Rays a pixel; the light of the sky is part of the looks and has no noise."""


def render_photos(
    content: Content, cameras: Sequence[Camera], paths: Sequence[Path], threads: int
) -> None:
    """Render one PNG a camera; all cameras have one size.

    Raises
    ------
    ResourceError
        bpy is missing.
    """
    bpy = require_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bounces = int(content.subject.reflects)
    scene = _configure(cameras[0].width, cameras[0].height, SAMPLES, bounces, threads)
    materials = {name: make_look(name, look) for name, look in content.looks.items()}
    for part in (*content.subject.parts, *content.around):
        item = _mesh_object(part, materials[part.material])
        # Looks shine with the sky's share of the light: scattered rays that find them are noise.
        item.visible_diffuse = False
    _add_light(content.light)
    eye = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(eye)
    scene.camera = eye
    for camera, path in zip(cameras, paths, strict=True):
        _place(eye, camera)
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
