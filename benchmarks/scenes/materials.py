# SPDX-License-Identifier: GPL-3.0-or-later
"""Procedural materials in world coordinates: moderately rich, with honest plain areas."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import UsageError

from .nodes import Color, Nodes

SPOT_TEXTURE = Path(__file__).parents[1] / "meshes" / "spot_texture.png"


def _spot(n: Nodes) -> Any:
    import bpy

    image = bpy.data.images.load(str(SPOT_TEXTURE))
    node = n.add("ShaderNodeTexImage", {}, image=image)
    # The drawing's white is 1.0: real hide reflects less, and photos must not clip.
    return n.finish_matte(n.mix(1.0, node.outputs["Color"], (0.80, 0.77, 0.72), "MULTIPLY"))


def _painted_metal(n: Nodes) -> Any:
    paint = n.mix(n.step(n.noise(1.3, 1.0), 0.49, 0.51), (0.05, 0.26, 0.30), (0.62, 0.40, 0.08))
    paint = n.mix(n.step(n.noise(9.0, 2.0), 0.35, 0.75), paint, (0.10, 0.10, 0.11))
    worn = n.step(n.noise(22.0, 2.0), 0.60, 0.63)
    return n.finish_matte(n.mix(worn, paint, (0.52, 0.51, 0.49)))


def _rusty_wire(n: Nodes) -> Any:
    zinc = n.mix(n.noise(30.0, 2.0), (0.28, 0.30, 0.31), (0.55, 0.56, 0.55))
    rust = n.mix(n.noise(50.0, 2.0), (0.11, 0.035, 0.015), (0.36, 0.13, 0.04))
    return n.finish_matte(n.mix(n.step(n.noise(5.0, 2.0), 0.50, 0.56), zinc, rust))


def _ceramic(n: Nodes) -> Any:
    plain = n.mix(n.step(n.noise(3.0, 2.0), 0.4, 0.7), (0.66, 0.62, 0.54), (0.58, 0.53, 0.44))
    speckles = n.step(n.cells(26.0, output="Distance"), 0.20, 0.14)
    plain = n.mix(n.math("MULTIPLY", speckles, 0.55), plain, (0.20, 0.13, 0.08))
    height = n.axis("z")
    band = n.step(n.math("ABSOLUTE", n.math("SUBTRACT", height, 0.16)), 0.14, 0.135)
    leaves = n.step(n.waves(2.6, 7.0), 0.50, 0.56)
    painted = n.mix(leaves, (0.03, 0.09, 0.30), (0.55, 0.60, 0.62))
    color = n.mix(band, plain, painted)
    line = n.step(n.math("ABSOLUTE", n.math("SUBTRACT", height, -0.16)), 0.022, 0.018)
    return n.finish_matte(n.mix(line, color, (0.30, 0.06, 0.03)))


def _glaze(n: Nodes) -> Any:
    base = n.mix(n.step(n.noise(2.0, 2.0), 0.38, 0.62), (0.42, 0.09, 0.03), (0.50, 0.30, 0.06))
    drops = n.step(n.cells(7.0, output="Distance"), 0.28, 0.24)
    base = n.mix(n.math("MULTIPLY", drops, 0.8), base, (0.05, 0.14, 0.12))
    fine = n.step(n.noise(28.0, 2.0), 0.55, 0.66)
    return n.finish_glossy(n.mix(n.math("MULTIPLY", fine, 0.5), base, (0.6, 0.5, 0.3)), 0.35, 1.0)


def _planks(n: Nodes) -> Any:
    plane = n.plane("xy")
    grain = n.noise(3.0, 2.0, n.stretched(plane, (1.5, 16.0, 1.0)))
    wood = n.mix(n.step(grain, 0.3, 0.7), (0.20, 0.105, 0.05), (0.40, 0.24, 0.125))
    boards = n.bricks(
        plane, (1.3, 0.19), [(1.0, 0.95, 0.9), (0.62, 0.6, 0.6), (0.2, 0.2, 0.2)], 0.006
    )
    color = n.mix(1.0, wood, boards, "MULTIPLY")
    return n.finish_matte(n.mix(n.step(n.noise(1.1, 2.0), 0.55, 0.8), color, (0.25, 0.2, 0.16)))


def _plain(color: Color, shade: Color, scale: float = 1.2) -> Callable[[Nodes], Any]:
    def build(n: Nodes) -> Any:
        return n.finish_matte(n.mix(n.step(n.noise(scale, 2.0), 0.35, 0.7), color, shade))

    return build


def _wallpaper(axes: str) -> Callable[[Nodes], Any]:
    def build(n: Nodes) -> Any:
        plane = n.plane(axes)
        stripes = n.step(n.waves(1.6, 0.0, plane), 0.45, 0.55)
        ground = n.mix(stripes, (0.48, 0.50, 0.42), (0.36, 0.42, 0.38))
        flowers = n.step(n.cells(5.5, plane, "Distance"), 0.26, 0.20)
        dyes = n.mix(n.noise(0.9, 1.0), (0.42, 0.14, 0.12), (0.10, 0.17, 0.26))
        ground = n.mix(n.math("MULTIPLY", flowers, 0.8), ground, dyes)
        return n.finish_matte(
            n.mix(n.math("MULTIPLY", n.noise(2.0, 2.0), 0.25), ground, (0.2, 0.2, 0.2))
        )

    return build


def _bricks(axes: str) -> Callable[[Nodes], Any]:
    def build(n: Nodes) -> Any:
        plane = n.plane(axes)
        stones = [(0.40, 0.16, 0.10), (0.26, 0.10, 0.07), (0.45, 0.42, 0.38)]
        wall = n.bricks(plane, (0.26, 0.085), stones, 0.008)
        dirt = n.step(n.noise(14.0, 2.0), 0.4, 0.75)
        return n.finish_matte(n.mix(n.math("MULTIPLY", dirt, 0.5), wall, (0.46, 0.33, 0.26)))

    return build


def _panels(axes: str) -> Callable[[Nodes], Any]:
    def build(n: Nodes) -> Any:
        plane = n.plane(axes)
        grain = n.noise(2.5, 2.0, n.stretched(plane, (16.0, 1.2, 1.0)))
        wood = n.mix(n.step(grain, 0.3, 0.7), (0.26, 0.15, 0.08), (0.46, 0.31, 0.18))
        boards = n.bricks(
            plane, (0.30, 9.0), [(1.0, 1.0, 1.0), (0.75, 0.72, 0.7), (0.25, 0.22, 0.2)], 0.008
        )
        return n.finish_matte(n.mix(1.0, wood, boards, "MULTIPLY"))

    return build


def _poster(scale: float, low: Color, high: Color, swirl: float) -> Callable[[Nodes], Any]:
    def build(n: Nodes) -> Any:
        shapes = n.mix(0.72, n.cells(scale), n.mix(n.waves(scale * 0.5, swirl), low, high))
        ink = n.step(n.noise(scale * 2.2, 2.0), 0.56, 0.58)
        picture = n.mix(n.math("MULTIPLY", ink, 0.8), shapes, (0.06, 0.05, 0.08))
        return n.finish_matte(n.mix(1.0, picture, (0.72, 0.72, 0.72), "MULTIPLY"))

    return build


def _wood(dark: Color, light: Color) -> Callable[[Nodes], Any]:
    def build(n: Nodes) -> Any:
        grain = n.noise(4.0, 2.0, n.stretched(n.position, (2.0, 14.0, 14.0)))
        knots = n.step(n.noise(2.4, 2.0), 0.62, 0.72)
        return n.finish_matte(n.mix(knots, n.mix(n.step(grain, 0.3, 0.7), dark, light), dark))

    return build


def _cloth(color: Color) -> Callable[[Nodes], Any]:
    def build(n: Nodes) -> Any:
        weave = n.step(n.noise(34.0, 2.0), 0.35, 0.65)
        darker = (color[0] * 0.62, color[1] * 0.62, color[2] * 0.62)
        folded = n.mix(weave, darker, color)
        return n.finish_matte(n.mix(n.step(n.noise(3.0, 2.0), 0.5, 0.7), folded, darker))

    return build


def _crate(n: Nodes) -> Any:
    paint = n.mix(n.step(n.noise(4.0, 2.0), 0.47, 0.52), (0.10, 0.20, 0.36), (0.55, 0.53, 0.48))
    scratches = n.step(n.noise(26.0, 2.0, n.stretched(n.position, (1.0, 1.0, 4.0))), 0.6, 0.64)
    return n.finish_matte(n.mix(scratches, paint, (0.34, 0.22, 0.12)))


def _marble(n: Nodes) -> Any:
    veins = n.step(n.waves(4.0, 9.0), 0.75, 0.95)
    return n.finish_matte(n.mix(veins, (0.62, 0.60, 0.56), (0.12, 0.16, 0.17)))


_BUILDERS: dict[str, Callable[[Nodes], Any]] = {
    "spot": _spot,
    "painted_metal": _painted_metal,
    "rusty_wire": _rusty_wire,
    "ceramic": _ceramic,
    "glaze": _glaze,
    "planks": _planks,
    "plaster": _plain((0.60, 0.58, 0.53), (0.54, 0.52, 0.48)),
    "limewash": _plain((0.55, 0.50, 0.40), (0.50, 0.45, 0.36), 0.8),
    "wallpaper_xz": _wallpaper("xz"),
    "wallpaper_yz": _wallpaper("yz"),
    "bricks_xz": _bricks("xz"),
    "bricks_yz": _bricks("yz"),
    "panels_xz": _panels("xz"),
    "poster_a": _poster(2.1, (0.7, 0.25, 0.1), (0.75, 0.7, 0.5), 5.0),
    "poster_b": _poster(3.3, (0.1, 0.3, 0.5), (0.7, 0.72, 0.6), 2.0),
    "poster_c": _poster(2.6, (0.15, 0.4, 0.2), (0.7, 0.6, 0.3), 8.0),
    "poster_d": _poster(4.0, (0.5, 0.1, 0.3), (0.6, 0.7, 0.75), 3.0),
    "lamp_panel": lambda n: n.finish_light(18.0),
    "oak": _wood((0.24, 0.13, 0.06), (0.45, 0.30, 0.17)),
    "walnut": _wood((0.09, 0.045, 0.025), (0.20, 0.11, 0.06)),
    "dark_metal": _plain((0.08, 0.08, 0.085), (0.12, 0.11, 0.11), 12.0),
    "linen": _cloth((0.62, 0.55, 0.42)),
    "cloth_red": _cloth((0.40, 0.07, 0.06)),
    "cloth_blue": _cloth((0.07, 0.14, 0.34)),
    "cloth_ochre": _cloth((0.55, 0.34, 0.08)),
    "cloth_green": _cloth((0.13, 0.26, 0.15)),
    "crate": _crate,
    "marble": _marble,
}


def make_material(name: str, *, unlit: bool = False) -> Any:
    """Return a new Blender material; ``unlit`` shows its plain colour.

    Raises
    ------
    UsageError
        The name is not known.
    """
    if name not in _BUILDERS:
        raise UsageError(f"There is no material {name!r}.", f"Known: {', '.join(_BUILDERS)}.")
    return _BUILDERS[name](Nodes(name, unlit=unlit))


def make_picture_material(path: Path, *, shadows: bool) -> Any:
    """Return a matte material that shows an image by texture coordinates."""
    import bpy

    n = Nodes(path.stem)
    image = bpy.data.images.load(str(path))
    node = n.add("ShaderNodeTexImage", {}, image=image, extension="EXTEND")
    color = node.outputs["Color"]
    return n.finish_matte(color) if shadows else n.finish_even(color)


def make_mask_material(seen: bool) -> Any:
    """Return a material that is evenly white (``seen``) or black in any light."""
    return Nodes("mask").finish_light(1.0 if seen else 0.0)
