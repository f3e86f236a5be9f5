# SPDX-License-Identifier: GPL-3.0-or-later
"""A triangle mesh in the scene frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles with shared vertices; face normals point to the empty side."""

    vertices: np.ndarray
    """(v, 3) float64, scene frame."""
    faces: np.ndarray
    """(f, 3) int32, counter-clockwise seen from outside."""
    colors: np.ndarray | None = None
    """(v, 3) uint8, optional."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """How the mesh was made and what was measured, plain JSON values."""
