# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender mesh data of plain arrays."""

from __future__ import annotations

import logging

import bpy
import numpy as np

_logger = logging.getLogger(__name__)


def build_mesh(
    name: str, vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray
) -> bpy.types.Mesh:
    """Make mesh data of arrays: smooth shaded, one UV layer."""
    mesh = bpy.data.meshes.new(name)
    count = len(faces)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    mesh.loops.add(3 * count)
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(count, bool))
    layer = mesh.uv_layers.new(name="UVMap", do_init=False)
    layer.uv.foreach_set("vector", corner_uvs.ravel())
    mesh.update(calc_edges=True)
    if mesh.validate():
        _logger.warning("mesh %s: broken faces were removed", name)
    return mesh
