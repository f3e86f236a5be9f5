# SPDX-License-Identifier: GPL-3.0-or-later
"""Size of a mesh, its edges and its texels in world units (the units of the input)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...dataset.similarity import Similarity
from ...mesh.components import face_components, volumes_and_areas
from ...mesh.topology import edge_lengths


def sizes_in_world(
    vertices: np.ndarray, faces: np.ndarray, world_from_scene: Similarity, texels: int
) -> dict[str, Any]:
    """Return lengths of a mesh in world units, as plain JSON values.

    Parameters
    ----------
    vertices : (v, 3) float64
        Scene frame.
    faces : (f, 3) int
    world_from_scene : Similarity
    texels : int
        Number of texels on the surface; with 0, the texel density is left out.

    Returns
    -------
    dict
        ``size`` (of the axis-aligned box of the used vertices), ``diagonal``, ``area``,
        ``edge_mean``, ``edge_median`` (each edge once for each of its faces),
        ``texels_per_unit`` and ``texel_size`` (side of a square texel). Empty without faces.
    """
    if len(faces) == 0:
        return {}
    # Rotated but not translated: far from the origin the size would lose digits.
    turned = world_from_scene.scale * world_from_scene.directions(vertices[np.unique(faces)])
    size = np.ptp(turned, axis=0)  # (3,)
    edges = world_from_scene.scale * edge_lengths(np.asarray(vertices, np.float64), faces)
    parts, part = face_components(len(vertices), faces)
    _, areas = volumes_and_areas(vertices, faces, part, parts)
    area = float(areas.sum()) * world_from_scene.scale**2
    figures: dict[str, Any] = {
        "size": size.tolist(),
        "diagonal": float(np.linalg.norm(size)),
        "area": area,
        "edge_mean": float(edges.mean()),
        "edge_median": float(np.median(edges)),
    }
    if texels > 0 and area > 0.0:
        figures["texels_per_unit"] = float(np.sqrt(texels / area))
        figures["texel_size"] = float(np.sqrt(area / texels))
    return figures
