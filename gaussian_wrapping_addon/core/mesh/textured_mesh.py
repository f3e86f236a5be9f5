# SPDX-License-Identifier: GPL-3.0-or-later
"""Textured meshes: UVs, atlases, UDIMs, polygons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..array_file import read_arrays, write_arrays
from ..errors import ParseError
from .surface_mesh import SurfaceMesh

# -- UDIM tiles: several textures side by side in one UV map. Needs numpy only --------------------

TILE_COLUMNS, TILE_ROWS = 10, 100
FIRST_UDIM = 1001  # UDIM tiles are 1001 + column + 10 row
LAST_UDIM = FIRST_UDIM + TILE_COLUMNS * TILE_ROWS - 1


def udim_uvs(
    corner_uvs: np.ndarray, face_atlas: np.ndarray | None, udims: Sequence[int]
) -> np.ndarray:
    """Return (f, 3, 2) float32 UVs in the UDIM tiles of their atlases, from UVs in [0, 1]."""
    of_faces = np.zeros(len(corner_uvs), np.int64) if face_atlas is None else face_atlas
    number = np.asarray(udims, np.int64)[of_faces] - FIRST_UDIM
    shift = np.stack([number % TILE_COLUMNS, number // TILE_COLUMNS], axis=1)
    moved: np.ndarray = (corner_uvs + shift[:, None]).astype(np.float32)
    return moved


# -- A mesh with UVs per face corner, its texture maps and their coverage -------------------------


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
    corner_uvs: np.ndarray  # (f, 3, 2) float32 in [0, 1]; v upwards (OpenGL and Blender)
    albedo: np.ndarray  # (h, w, 3) uint8 sRGB; row 0 is the top of the image (v = 1)
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
    further: tuple[AtlasMaps, ...] = ()  # atlases 1, 2, ...: of the same size, with the same maps
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


# -- Polygons that were handed over as triangles: their file beside a bake, and how they are
#    joined
#
# Needs numpy only.

POLYGONS_FILE = "polygons.npz"
MAX_BYTES = 4 * 2**30
SAME_UV = 1e-6  # UVs of one corner in two triangles that differ by less are the same
_HINT = "Bake the photos again."


@dataclass(frozen=True)
class Polygons:
    """How triangles are parts of polygons."""

    of_faces: np.ndarray  # (f,) int64 polygon of each triangle
    loops: np.ndarray
    """(f, 3) int64 loop at each corner. The loops of a polygon have numbers of their own, which
    ascend counter-clockwise."""


@dataclass(frozen=True)
class JoinedMesh:
    """Polygons as Blender holds them."""

    corners: np.ndarray  # (c,) int64 vertices, polygon after polygon
    starts: np.ndarray  # (p,) int64 first corner of each polygon
    uvs: np.ndarray  # (c, 2) float32


def write_polygons(path: Path, polygons: Polygons) -> None:
    """Write the polygons of a mesh beside it. Raises OSError: the file cannot be written."""
    write_arrays(path, polygons=polygons.of_faces, loops=polygons.loops)


def read_polygons(path: Path, faces: int) -> Polygons:
    """Read the polygons of a mesh with this many triangles; ParseError if they are not its own."""
    arrays = read_arrays(path, ("polygons", "loops"), most_bytes=MAX_BYTES, hint=_HINT)
    try:
        return checked_polygons(arrays["polygons"], arrays["loops"], faces)
    except ValueError as error:
        raise ParseError(path, "whole file", f"not of this mesh ({error}).", _HINT) from None


def checked_polygons(of_faces: np.ndarray, loops: np.ndarray, faces: int) -> Polygons:
    """Return polygons from arrays of a file.

    Raises ValueError: shapes, types or numbers are not those of this many triangles.
    """
    for name, values, shape in (("polygons", of_faces, (faces,)), ("loops", loops, (faces, 3))):
        if values.shape != shape or values.dtype.kind not in "iu":
            raise ValueError(f"{name} are not integers of shape {shape}")
        # A triangle adds a polygon at most, and three loops.
        if faces and not (values.min() >= 0 and values.max() < 3 * faces):
            raise ValueError(f"{name} are out of range")
    return Polygons(of_faces.astype(np.int64), loops.astype(np.int64))


def join_triangles(faces: np.ndarray, corner_uvs: np.ndarray, polygons: Polygons) -> JoinedMesh:
    """Join triangles to the polygons that they were cut from.

    Polygons whose triangles disagree stay triangles: where a seam of the UVs cuts them, or where
    vertices were welded to one. Triangles with a vertex twice are left out. ``faces`` (f, 3) hold
    indices within range; ``corner_uvs`` are (f, 3, 2).
    """
    loops, of_faces = polygons.loops, polygons.of_faces
    count = int(loops.max()) + 1
    vertex, owner = np.full(count, -1), np.full(count, -1)
    uvs = np.zeros((count, 2), np.float32)
    vertex[loops.ravel()], owner[loops.ravel()] = faces.ravel(), np.repeat(of_faces, 3)
    uvs[loops.ravel()] = corner_uvs.reshape(-1, 2)
    agree = (vertex[loops] == faces).all(axis=1) & (owner[loops] == of_faces[:, None]).all(axis=1)
    agree &= (np.abs(uvs[loops] - corner_uvs) <= SAME_UV).all(axis=(1, 2))
    # Numbers of loops ascend, from whichever corner on.
    agree &= (np.roll(loops, -1, axis=1) > loops).sum(axis=1) == 2
    number = int(of_faces.max()) + 1
    whole = np.bincount(of_faces, ~agree, number) == 0
    used = np.flatnonzero(owner >= 0)
    sides = np.bincount(owner[used], minlength=number)
    whole &= sides == np.bincount(of_faces, minlength=number) + 2  # one fan of triangles
    pairs = np.unique(np.stack([owner[used], vertex[used]], axis=1), axis=0)
    whole &= np.bincount(pairs[:, 0], minlength=number) == sides  # no vertex twice
    kept = used[whole[owner[used]]]
    kept = kept[np.lexsort((kept, owner[kept]))]
    apart = ~whole[of_faces] & (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    sides = np.append(sides[whole & (sides > 0)], np.full(apart.sum(), 3))
    return JoinedMesh(
        np.concatenate([vertex[kept], faces[apart].ravel()]).astype(np.int64),
        (np.cumsum(sides) - sides).astype(np.int64),
        np.concatenate([uvs[kept], corner_uvs[apart].reshape(-1, 2).astype(np.float32)]),
    )
