# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of a scene by Blender: materials, baked colours, light, exposure."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.errors import ResourceError, UsageError
from gaussian_wrapping_addon.core.scene.camera import Camera

from .geometry import SHARP_DEGREES, Part

Color = tuple[float, float, float]
"""Linear red, green, blue, 0 to 1."""

SKY_UP = (0.24, -0.30, 0.92)
"""Where the sky is brightest, about unit."""

SKY_BELOW, SKY_ABOVE = 0.30, 0.46
"""Radiance that a white surface returns of the sky's light, facing away from and towards it."""

EVEN_LIGHT = 0.62
"""Radiance that a white surface returns of light from everywhere."""


class Nodes:
    """The node tree of one material; every pattern method returns an output socket."""

    def __init__(self, name: str, *, unlit: bool = False) -> None:
        import bpy

        self.unlit = unlit
        self.material = bpy.data.materials.new(name)
        with warnings.catch_warnings():
            # Needed up to Blender 4.x; announced to go in 6.0.
            warnings.simplefilter("ignore", DeprecationWarning)
            self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.tree.nodes.clear()
        surface = self.tree.nodes.new("ShaderNodeNewGeometry")
        self.position, self.normal = surface.outputs["Position"], surface.outputs["Normal"]
        # The sky's share is emission, which must not be taken for lamps.
        self.material.cycles.emission_sampling = "NONE"

    def feed(self, socket: Any, value: Any) -> None:
        """Link an output socket, or set a constant; colours are three numbers."""
        if hasattr(value, "is_linked"):
            self.tree.links.new(value, socket)
        elif socket.type == "RGBA":
            socket.default_value = (*value, 1.0)
        else:
            socket.default_value = value

    def add(self, kind: str, values: dict[str, Any], **attributes: Any) -> Any:
        """Add a node with input values by name and attributes, return the node."""
        node = self.tree.nodes.new(kind)
        for name, value in attributes.items():
            setattr(node, name, value)
        for name, value in values.items():
            self.feed(node.inputs[name], value)
        return node

    def plane(self, axes: str) -> Any:
        """Return the world position with two axes ("xz") as the pattern's x and y."""
        split = self.add("ShaderNodeSeparateXYZ", {"Vector": self.position})
        chosen = {"X": split.outputs[axes[0].upper()], "Y": split.outputs[axes[1].upper()]}
        return self.add("ShaderNodeCombineXYZ", chosen).outputs[0]

    def stretched(self, vector: Any, scale: Color) -> Any:
        """Return a vector times constants."""
        node = self.tree.nodes.new("ShaderNodeVectorMath")
        node.operation = "MULTIPLY"
        self.feed(node.inputs[0], vector)
        self.feed(node.inputs[1], scale)
        return node.outputs[0]

    def noise(self, scale: float, detail: float = 2.0, vector: Any = None) -> Any:
        """Return fractal noise, about 0.5."""
        values = {"Vector": vector or self.position, "Scale": scale, "Detail": detail}
        return self.add("ShaderNodeTexNoise", values).outputs[0]

    def cells(self, scale: float, vector: Any = None, output: str = "Color") -> Any:
        """Return Voronoi cells: a random colour a cell, or the distance to its point."""
        values = {"Vector": vector or self.position, "Scale": scale}
        return self.add("ShaderNodeTexVoronoi", values).outputs[output]

    def waves(
        self, scale: float, distortion: float, vector: Any = None, direction: str = "X"
    ) -> Any:
        """Return wavy bands, 0 to 1."""
        values = {"Vector": vector or self.position, "Scale": scale, "Distortion": distortion}
        values["Detail"] = 2.0
        node = self.add("ShaderNodeTexWave", values, bands_direction=direction)
        return node.outputs[1]

    def bricks(
        self, vector: Any, size: tuple[float, float], colors: list[Color], gap: float
    ) -> Any:
        """Return bricks (width, height) in two colours with joints of a third."""
        values = {
            "Vector": vector, "Scale": 1.0, "Brick Width": size[0], "Row Height": size[1],
            "Mortar Size": gap, "Mortar Smooth": 0.2, "Color1": colors[0], "Color2": colors[1],
            "Mortar": colors[2],
        }  # fmt: skip
        return self.add("ShaderNodeTexBrick", values).outputs[0]

    def step(self, value: Any, low: float, high: float) -> Any:
        """Return 0 below ``low``, 1 above ``high``, linear between."""
        values = {"Value": value}
        node = self.add("ShaderNodeMapRange", values)
        for index, number in ((1, low), (2, high)):
            node.inputs[index].default_value = number
        return node.outputs[0]

    def math(self, operation: str, a: Any, b: Any = 0.0) -> Any:
        """Return a function of one or two numbers."""
        node = self.tree.nodes.new("ShaderNodeMath")
        node.operation = operation
        self.feed(node.inputs[0], a)
        self.feed(node.inputs[1], b)
        return node.outputs[0]

    def axis(self, name: str, vector: Any = None) -> Any:
        """Return one coordinate of a vector or of the position."""
        values = {"Vector": vector or self.position}
        return self.add("ShaderNodeSeparateXYZ", values).outputs[name.upper()]

    def mix(self, factor: Any, a: Any, b: Any, blend: str = "MIX") -> Any:
        """Return colour ``a`` at factor 0, ``b`` at 1."""
        node = self.tree.nodes.new("ShaderNodeMix")
        node.data_type = "RGBA"
        node.blend_type = blend
        for index, value in ((0, factor), (6, a), (7, b)):
            self.feed(node.inputs[index], value)
        return node.outputs[2]

    def finish_matte(self, color: Any) -> Any:
        """Make it a material that looks the same from everywhere."""
        if self.unlit:
            return self._finish(self.add("ShaderNodeEmission", {"Color": color}))
        shader = self.add("ShaderNodeBsdfDiffuse", {"Color": color})
        return self._finish(self._with_sky(shader, color))

    def finish_even(self, color: Any) -> Any:
        """Make it matte in light that comes evenly from everywhere: no shadows, no noise."""
        values = {"Color": color, "Strength": EVEN_LIGHT}
        return self._finish(self.add("ShaderNodeEmission", values))

    def finish_glossy(self, color: Any, roughness: float, coat: float) -> Any:
        """Make it a glazed material with a clear coat."""
        values = {
            "Base Color": color,
            "Specular IOR Level": 0.0,  # only the coat reflects: a broad second lobe is grain
            "Roughness": roughness,
            "Coat Weight": coat,
            "Coat Roughness": 0.04,
        }
        shader = self.add("ShaderNodeBsdfPrincipled", values)
        return self._finish(self._with_sky(shader, color))

    def finish_light(self, strength: float) -> Any:
        """Make it shine evenly, 1 is white in the photo."""
        shader = self.add("ShaderNodeEmission", {"Strength": strength})
        return self._finish(shader)

    def _with_sky(self, shader: Any, color: Any) -> Any:
        """Add the light of an even sky, brighter from above, that nothing hides.

        As emission it has no sampling noise: photos stay clean at few samples a pixel.
        """
        node = self.tree.nodes.new("ShaderNodeVectorMath")
        node.operation = "DOT_PRODUCT"
        self.feed(node.inputs[0], self.normal)
        self.feed(node.inputs[1], SKY_UP)
        upward = self.math("MULTIPLY_ADD", node.outputs["Value"], 0.5)
        upward.node.inputs[2].default_value = 0.5  # 0 from below to 1 from above
        strength = self.math("MULTIPLY_ADD", upward, SKY_ABOVE - SKY_BELOW)
        strength.node.inputs[2].default_value = SKY_BELOW
        glow = self.add("ShaderNodeEmission", {"Color": color, "Strength": strength})
        both = self.tree.nodes.new("ShaderNodeAddShader")
        self.tree.links.new(shader.outputs[0], both.inputs[0])
        self.tree.links.new(glow.outputs[0], both.inputs[1])
        return both

    def _finish(self, shader: Any) -> Any:
        output = self.tree.nodes.new("ShaderNodeOutputMaterial")
        self.tree.links.new(shader.outputs[0], output.inputs["Surface"])
        return self.material


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


SAMPLES = 3
_NEVER = ("lamp_panel",)
"""Materials that are even already."""


def group_name(part: Part) -> str:
    """Return the wall that a sheet belongs to: the first word of its name."""
    return part.name.split(" ")[0]


def bake_walls(
    parts: Sequence[Part], folder: Path, pixels_per_unit: float, scene: Any
) -> tuple[list[Part], dict[str, Path]]:
    """Photograph the walls' patterns.

    Parameters
    ----------
    parts : sequence of Part
        Those that are ``surrounding`` and flat are baked, wall by wall.
    pixels_per_unit : float
    scene : Blender scene
        Configured for Cycles; used and left empty.

    Returns
    -------
    parts : list of Part
        The same geometry; baked ones have texture coordinates and the wall's name as material.
    images : dict
        Wall's name -> PNG.
    """
    walls: dict[str, list[Part]] = {}
    for part in parts:
        if part.surrounding and part.material not in _NEVER:
            walls.setdefault(group_name(part), []).append(part)
    images = {name: folder / f"{name}.png" for name in walls}
    result = [part for part in parts if group_name(part) not in walls or not part.surrounding]
    scene.cycles.samples = SAMPLES
    for name, sheets in walls.items():
        result += _bake(name, sheets, images[name], pixels_per_unit, scene)
    return result, images


def _bake(name: str, sheets: list[Part], path: Path, density: float, scene: Any) -> list[Part]:
    import bpy
    from mathutils import Matrix

    a, b, _, d = sheets[0].vertices  # (3,) corner, its right, opposite, its top
    right, up = (b - a) / np.linalg.norm(b - a), (d - a) / np.linalg.norm(d - a)
    everything = np.concatenate([part.vertices for part in sheets]) - a
    flat = np.stack([everything @ right, everything @ up], 1)  # (v, 2)
    low, high = flat.min(0), flat.max(0)
    size = high - low
    scene.render.resolution_x, scene.render.resolution_y = np.ceil(size * density).astype(int)
    items = []
    for part in sheets:
        mesh = bpy.data.meshes.new(part.name)
        mesh.from_pydata(part.vertices.tolist(), [], part.faces.tolist())
        mesh.materials.append(make_material(part.material, unlit=True))
        items.append(bpy.data.objects.new(part.name, mesh))
    lens = bpy.data.cameras.new("front")
    lens.type, lens.sensor_fit, lens.ortho_scale = "ORTHO", "HORIZONTAL", float(size[0])
    eye = bpy.data.objects.new("front", lens)
    matrix = np.eye(4)
    normal = np.cross(right, up)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = right, up, normal
    middle = (low + high) / 2
    matrix[:3, 3] = a + middle[0] * right + middle[1] * up + normal
    eye.matrix_world = Matrix(matrix.tolist())
    for item in [*items, eye]:
        scene.collection.objects.link(item)
    scene.camera = eye
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    for item in [*items, eye]:
        bpy.data.objects.remove(item)
    hung = []
    for part in sheets:
        local = part.vertices - a
        share = (np.stack([local @ right, local @ up], 1) - low) / size  # (v, 2)
        hung.append(replace(part, corner_uvs=share[part.faces], material=name))
    return hung


SENSOR_MM = 36.0
FILTER_WIDTH_PX = 1.2
"""Width of the pixel filter: a little softer than a box, as lenses are."""

SUN_DEGREES = 14.0
"""Size of the sun: it makes soft shadows."""

_BLENDER_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
"""Blender's cameras look along -z with y up, ours along +z with y down."""


@dataclass(frozen=True)
class Light:
    """A soft sun; the sky's even light is part of the materials."""

    sun: float
    """Irradiance; a white matte surface that faces it returns this / pi."""
    direction: tuple[float, float, float] = (-0.4, 0.5, -0.9)
    """From the sun to the scene."""


def require_bpy() -> Any:
    """Import bpy.

    Raises
    ------
    ResourceError
        It is not installed.
    """
    try:
        import bpy
    except ModuleNotFoundError:
        raise ResourceError(
            "The ground-truth scenes are rendered by Blender's Python module, which is missing.",
            "Install it into this Python: pip install bpy==5.0.1 (Python 3.11).",
        ) from None
    return bpy


def _mesh_object(part: Part, material: Any) -> Any:
    import bpy

    mesh = bpy.data.meshes.new(part.name)
    mesh.from_pydata(part.vertices.tolist(), [], part.faces.tolist())
    if part.corner_uvs is not None:
        layer = mesh.uv_layers.new(name="uv")
        layer.data.foreach_set("uv", part.corner_uvs.reshape(-1).astype(np.float32))
    if part.smooth:
        mesh.shade_smooth()
        mesh.set_sharp_from_angle(angle=math.radians(SHARP_DEGREES))
    mesh.materials.append(material)
    item = bpy.data.objects.new(part.name, mesh)
    bpy.context.scene.collection.objects.link(item)
    if part.surrounding:
        item.visible_shadow = False
        item.visible_diffuse = False  # so that scattered rays do not find its lamps by chance
    return item


def _add_light(light: Light) -> None:
    import bpy
    from mathutils import Vector

    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle = light.sun, math.radians(SUN_DEGREES)
    item = bpy.data.objects.new("sun", sun)
    item.rotation_euler = Vector(light.direction).to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(item)


def _configure(width: int, height: int, samples: int, glossy_bounces: int, threads: int) -> Any:
    import bpy

    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.seed = 0
    scene.cycles.use_denoising = False
    scene.cycles.max_bounces = glossy_bounces
    scene.cycles.diffuse_bounces = 0
    scene.cycles.glossy_bounces = glossy_bounces
    scene.cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    scene.cycles.filter_width = FILTER_WIDTH_PX
    scene.render.threads_mode = "FIXED"
    scene.render.threads = threads or os.cpu_count() or 1
    scene.render.use_persistent_data = True
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1.0
    scene.render.dither_intensity = 0.0
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.color_depth = "8"
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    return scene


def blender_camera_values(camera: Camera) -> tuple[float, float, float]:
    """Return Blender's focal length (mm), shift_x and shift_y of a camera with fx = fy.

    Blender measures shifts in shares of the fitted (horizontal) size, from the image's middle;
    y points up there.
    """
    lens = camera.fx * SENSOR_MM / camera.width
    shift_x = (camera.width / 2 - camera.cx) / camera.width
    shift_y = (camera.cy - camera.height / 2) / camera.width
    return lens, shift_x, shift_y


def _place(item: Any, camera: Camera) -> None:
    from mathutils import Matrix

    lens, shift_x, shift_y = blender_camera_values(camera)
    item.data.sensor_fit = "HORIZONTAL"
    item.data.sensor_width = SENSOR_MM
    item.data.lens, item.data.shift_x, item.data.shift_y = lens, shift_x, shift_y
    item.data.clip_start, item.data.clip_end = 0.01, 1000.0
    matrix = np.eye(4)
    matrix[:3, :3] = camera.rotation.T @ _BLENDER_FROM_CAMERA
    matrix[:3, 3] = camera.center
    item.matrix_world = Matrix(matrix.tolist())


def render_photos(
    parts: Sequence[Part],
    cameras: Sequence[Camera],
    paths: Sequence[Path],
    light: Light,
    *,
    samples: int = 5,
    wall_density: float = 140.0,
    wall_shadows: bool = False,
    glossy_bounces: int = 0,
    threads: int = 0,
    mask_of: Callable[[Part], bool] | None = None,
    done: Callable[[int], None] | None = None,
) -> None:
    """Render one PNG a camera.

    Parameters
    ----------
    samples : int
        Rays a pixel; the seed is fixed.
    wall_density : float
        Pixels per unit of length of the pictures that walls are hung with.
    wall_shadows : bool
        Whether the sun reaches the walls and floor; else they are lit evenly, which is quicker.
    glossy_bounces : int
        0 for matte scenes, 1 where things reflect their room.
    mask_of : function or None
        Instead of photos, write masks that are white where a part of these is seen.
    done : function or None
        Called with the number of finished photos.

    Raises
    ------
    ResourceError
        bpy is missing.
    """
    bpy = require_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = _configure(cameras[0].width, cameras[0].height, samples, glossy_bounces, threads)
    if mask_of is not None:
        masks = {seen: make_mask_material(seen) for seen in (False, True)}
        scene.view_settings.view_transform = "Raw"
    materials: dict[str, Any] = {}
    if mask_of is None:
        folder = Path(tempfile.mkdtemp(prefix="walls-"))
        parts, pictures = bake_walls(parts, folder, wall_density, scene)
        materials = {
            name: make_picture_material(path, shadows=wall_shadows)
            for name, path in pictures.items()
        }
        _configure(cameras[0].width, cameras[0].height, samples, glossy_bounces, threads)
    for part in parts:
        if mask_of is not None:
            material = masks[bool(mask_of(part))]
        else:
            if part.material not in materials:
                materials[part.material] = make_material(part.material)
            material = materials[part.material]
        _mesh_object(part, material)
    _add_light(light)
    eye = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(eye)
    scene.camera = eye
    for index, (camera, path) in enumerate(zip(cameras, paths, strict=True)):
        _place(eye, camera)
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        if done is not None:
            done(index + 1)
    if mask_of is None:
        shutil.rmtree(folder)


def union_of(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (v, 3) and faces (f, 3) of the exact union of closed solids.

    Raises
    ------
    ResourceError
        bpy is missing.
    """
    bpy = require_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    material = bpy.data.materials.new("any")
    items = [_mesh_object(part, material) for part in parts]
    base = items[0]
    for item in items[1:]:
        modifier = base.modifiers.new(item.name, "BOOLEAN")
        modifier.operation, modifier.solver, modifier.object = "UNION", "MANIFOLD", item
    graph = bpy.context.evaluated_depsgraph_get()
    mesh = base.evaluated_get(graph).to_mesh()
    mesh.calc_loop_triangles()
    vertices = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", vertices)
    faces = np.empty(len(mesh.loop_triangles) * 3, np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces)
    return vertices.reshape(-1, 3).astype(np.float64), faces.reshape(-1, 3)


LARGEST_GAIN = 1.35
"""Exposures vary between 1 / this and this."""

WHITE_BALANCE = 0.05
"""Red and blue vary by at most this share against green."""


def draw_gains(count: int, seed: int) -> np.ndarray:
    """Return (count, 3) linear gains of red, green, blue."""
    random = np.random.default_rng([seed, 3])
    exposure = np.exp(random.uniform(-1, 1, count) * np.log(LARGEST_GAIN))
    balance = 1.0 + WHITE_BALANCE * random.uniform(-1, 1, (count, 2))
    return exposure[:, None] * np.stack([balance[:, 0], np.ones(count), balance[:, 1]], 1)


def expose(photo: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return the photo (h, w, 3) uint8 sRGB with its linear light times ``gains`` (3,)."""
    coded = np.arange(256) / 255.0
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    result = np.empty_like(photo)
    for channel in range(3):
        light = np.minimum(linear * gains[channel], 1.0)
        back = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
        table = np.rint(back * 255).astype(np.uint8)  # (256,)
        result[..., channel] = table[photo[..., channel]]
    return result
