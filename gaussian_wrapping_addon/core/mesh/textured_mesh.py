# SPDX-License-Identifier: GPL-3.0-or-later
"""A mesh with UVs per face corner, its texture maps and their coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .surface_mesh import SurfaceMesh


@dataclass(frozen=True)
class AtlasMaps:
    """The maps of one atlas; see the fields of the same names of :class:`TexturedMesh`."""

    albedo: np.ndarray
    normal_map: np.ndarray | None = None
    occlusion: np.ndarray | None = None
    views: np.ndarray | None = None


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh with UVs on face corners, so that the mesh stays closed along UV seams.

    The maps here belong to the first atlas, usually the only one; ``further`` holds the others.
    """

    mesh: SurfaceMesh
    corner_uvs: np.ndarray
    """(f, 3, 2) float32 in [0, 1]; v upwards (OpenGL and Blender)."""
    albedo: np.ndarray
    """(h, w, 3) uint8 sRGB; row 0 is the top of the image (v = 1)."""
    statistics: dict[str, Any] = field(default_factory=dict)
    """Coverage: texels used, seen and filled; number of charts; utilisation."""
    normal_map: np.ndarray | None = None
    """(h, w, 3) uint8 tangent-space normals, +Y, linear; rows as in ``albedo``."""
    occlusion: np.ndarray | None = None
    """(k, k) uint8 ambient occlusion: 255 where unoccluded, 0 where fully occluded."""
    views: np.ndarray | None = None
    """(h, w) uint8 photos blended into each texel, 0 where unseen or between charts."""
    face_atlas: np.ndarray | None = None
    """(f,) uint8 the atlas of each face, from 0; None if there is only one."""
    further: tuple[AtlasMaps, ...] = ()
    """Atlases 1, 2, ...: of the same size, with the same maps."""
    udims: tuple[int, ...] = ()
    """UDIM number of each atlas, which then names its files; empty for numbered atlases."""

    @classmethod
    def of(
        cls,
        mesh: SurfaceMesh,
        corner_uvs: np.ndarray,
        face_atlas: np.ndarray | None,
        maps: Sequence[AtlasMaps],
        statistics: dict[str, Any],
    ) -> TexturedMesh:
        """Build a mesh from its atlases."""
        first, *further = maps
        return cls(
            mesh, corner_uvs, first.albedo, statistics, first.normal_map, first.occlusion,
            first.views, face_atlas, tuple(further),
        )  # fmt: skip

    @property
    def atlases(self) -> tuple[AtlasMaps, ...]:
        """The maps of every atlas."""
        first = AtlasMaps(self.albedo, self.normal_map, self.occlusion, self.views)
        return (first, *self.further)

    @property
    def atlas_of_faces(self) -> np.ndarray:
        """(f,) uint8 the atlas of each face."""
        if self.face_atlas is None:
            return np.zeros(len(self.mesh.faces), np.uint8)
        return self.face_atlas
