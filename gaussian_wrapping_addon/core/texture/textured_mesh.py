# SPDX-License-Identifier: GPL-3.0-or-later
"""A mesh with UVs per face corner, its texture image, and how much of it photos have seen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..meshing.surface_mesh import SurfaceMesh


@dataclass(frozen=True)
class TexturedMesh:
    """UVs live on face corners, so that the mesh itself stays closed along UV seams."""

    mesh: SurfaceMesh
    corner_uvs: np.ndarray
    """(f, 3, 2) float32 in [0, 1]; v upwards (OpenGL and Blender)."""
    albedo: np.ndarray
    """(h, w, 3) uint8 sRGB; row 0 is the top of the image (v = 1)."""
    statistics: dict[str, Any] = field(default_factory=dict)
    """Coverage: texels used, seen, filled; number of charts, utilisation."""
    normal_map: np.ndarray | None = None
    """(h, w, 3) uint8 tangent-space normals, +Y, no sRGB; rows as in ``albedo``."""
    occlusion: np.ndarray | None = None
    """(k, k) uint8: 255 where nothing is near, 0 where nothing of the surroundings is seen."""
    views: np.ndarray | None = None
    """(h, w) uint8 photos blended into each texel, 0 where unseen or between charts."""
