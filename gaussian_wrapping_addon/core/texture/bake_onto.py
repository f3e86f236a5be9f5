# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake the photos onto a mesh from elsewhere: its own UVs or new ones, fewer faces if wanted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MeshingError
from ..mesh.components import face_graph, volumes_and_areas
from ..mesh.exchange import FileMesh
from ..mesh.simplification import decimate
from ..mesh.surface_mesh import SurfaceMesh, half_edges
from ..mesh.textured_mesh import FIRST_UDIM, TexturedMesh
from ..progress import Progress, ReportWarning
from ..scene.scene import PhotoSource, Scene
from ..settings import TextureSettings
from .size import side_in_photos
from .texture_mesh import texture_mesh, validate_for_texturing
from .unwrap.unwrap import OwnUvs, overlap_warning, own_uvs

HARDLY_SEEN_SHARE = 0.05
"""A mesh of which photos see less probably lies elsewhere, or its faces point inwards."""
HARDLY_SEEN_SIDE_PX = 16.0
"""The same for a mesh that all photos show so small that a texture of this side would do."""


@dataclass(frozen=True)
class BakeChoices:
    """How a mesh from elsewhere is baked onto."""

    uvs: str = "auto"
    """``"auto"``: its own if it has any, else new ones; ``"own"``; ``"new"``."""
    faces: int = 0
    """Faces to decimate to; 0 keeps the mesh. The detail removed goes into the normal map."""


def bake_onto(
    given: FileMesh, scene: Scene, photos: PhotoSource, settings: TextureSettings,
    choices: BakeChoices, work_folder: Path, progress: Progress, *, threads: int,
    dense: SurfaceMesh | None = None, free_bytes: int = 0,
) -> TexturedMesh:  # fmt: skip
    """Bake photos onto a mesh that was edited, retopologised or made elsewhere.

    Parameters are those of :func:`texture_mesh`, but:

    given : FileMesh
        Scene frame. Its faces, and their order, stay unless they are decimated. New UVs cut no
        polygon that they are parts of, where these are known.
    dense : SurfaceMesh, optional
        Mesh whose detail goes into the normal map, scene frame; by default the mesh itself before
        it is decimated.

    Raises
    ------
    MeshingError
        The mesh cannot be textured or decimated, its faces point inwards, its UVs cannot be used,
        or no photo sees it.
    ResourceError
        A texture of the requested size needs more memory than is available.
    """
    mesh = welded(given)
    validate_for_texturing(mesh)
    winding = _check_winding(mesh)
    own = None
    polygons = None if given.polygons is None else given.polygons.of_faces
    if choices.faces and len(mesh.faces) > choices.faces:
        dense = mesh if dense is None else dense
        progress.update(0.0, "decimating")
        fewer = decimate(mesh.vertices, mesh.faces, choices.faces, progress.span(0.0, 0.15))
        mesh, polygons = SurfaceMesh(fewer.vertices, fewer.faces.astype(np.int32)), None
    elif choices.uvs != "new":
        if given.corner_uvs is not None:
            own = own_uvs(mesh, given.corner_uvs)
        elif choices.uvs == "own":
            raise MeshingError("The mesh has no UVs.", "Unwrap it, or have new UVs made.")
    textured = texture_mesh(
        mesh, scene, photos, settings, work_folder, progress.span(0.15, 1.0),
        threads=threads, dense=dense, free_bytes=free_bytes,
        unwrapped=None if own is None else own.unwrapped, polygons=polygons,
    )  # fmt: skip
    if textured.statistics["texels_seen"] == 0:
        raise MeshingError(
            "No photo sees the mesh: it lies elsewhere, or its faces point away.",
            "Check its place, scale and axes beside the job's own mesh, and recalculate its "
            "normals.",
        )
    side_px = side_in_photos(face_graph(mesh.vertices, mesh.faces), photos, len(scene.views))
    udims = tuple(range(FIRST_UDIM, FIRST_UDIM + len(textured.atlases)))
    if own is not None:
        udims = own.udims
    warnings = (*winding, *_warnings(textured.statistics, own, side_px))
    textured.statistics["warnings"] += [warning.to_json() for warning in warnings]
    return replace(textured, udims=udims if udims != (FIRST_UDIM,) else ())


def welded(mesh: FileMesh) -> SurfaceMesh:
    """Join vertices at the same position, which files repeat for each of their UVs.

    Faces and their order stay.
    """
    vertices, inverse = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return SurfaceMesh(vertices, inverse.ravel()[mesh.faces].astype(np.int32))


def _check_winding(mesh: SurfaceMesh) -> list[ReportWarning]:
    """Refuse a closed mesh whose faces point inwards; warn where faces disagree.

    A photo paints the faces that point to it: it would see through the front of such a mesh.
    """
    hint = "Recalculate its normals to the outside (in Blender's Edit Mode: Shift N)."
    begin, end = half_edges(mesh.faces)
    key = np.stack([begin, end], axis=1).astype(np.int64)
    doubled = len(key) - len(np.unique(key, axis=0))
    if doubled:
        text = f"At {doubled} edges of the mesh, faces point to opposite sides or meet another one."
        return [ReportWarning("uneven-winding", text, hint)]
    closed = len(np.unique(np.sort(key, axis=1), axis=0)) * 2 == len(key)
    whole = np.zeros(len(mesh.faces), np.int64)
    volume = volumes_and_areas(mesh.vertices, mesh.faces.astype(np.int64), whole, 1)[0][0]
    if closed and volume < 0.0:
        raise MeshingError("The faces of the mesh point inwards.", hint)
    return []


def _warnings(
    statistics: dict[str, Any], own: OwnUvs | None, side_px: float
) -> list[ReportWarning]:
    warnings = list(own.warnings) if own is not None else []
    overlap = overlap_warning(statistics["texels_overlapping"], statistics["texels_used"])
    if overlap is not None:
        warnings.append(overlap)
    if statistics["coverage"] < HARDLY_SEEN_SHARE or side_px < HARDLY_SEEN_SIDE_PX:
        text = (
            f"Photos see {100 * statistics['coverage']:.1f} % of the mesh, at most as finely as a "
            f"texture of {side_px:.0f} pixels."
        )
        hint = "Check its place beside the job's own mesh, and that its faces point outwards."
        warnings.append(ReportWarning("hardly-seen", text, hint))
    return warnings
