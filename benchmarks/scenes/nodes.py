# SPDX-License-Identifier: GPL-3.0-or-later
"""A short way to write Blender's shader nodes; bpy is imported inside the functions only."""

from __future__ import annotations

import warnings
from typing import Any

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
