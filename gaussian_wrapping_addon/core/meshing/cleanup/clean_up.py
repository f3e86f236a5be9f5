# SPDX-License-Identifier: GPL-3.0-or-later
"""Optional post-processing of a mesh: smoothing and decimation."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ...field.isosurface_residual import isosurface_residuals
from ...mesh.simplification.decimation import decimate
from ...mesh.surface_mesh import SurfaceMesh
from ...progress import Progress
from ...regions.cap_planes import cap_planes
from ...regions.convex_region import Region
from ...report_warning import ReportWarning
from ...settings import MeshingSettings
from .smoothing import smooth

_logger = logging.getLogger(__name__)


class CleanUpResult(NamedTuple):
    """The processed mesh, and the one before decimation if it was decimated."""

    mesh: SurfaceMesh
    dense: SurfaceMesh | None


def clean_up(
    mesh: SurfaceMesh,
    region: Region,
    settings: MeshingSettings,
    vacancy: Any,
    progress: Progress,
) -> CleanUpResult:
    """Smooth, then decimate, as the settings request; otherwise return the mesh unchanged.

    Both keep a closed 2-manifold closed and manifold, with its parts and their genus. They move
    vertices off the isosurface, so ``level_error_*`` of the provenance is measured again, at all
    vertices that are not on the region's boundary.

    Parameters
    ----------
    region : Region
        The region that the mesh was made in, same frame.
    settings : MeshingSettings
        ``target_faces`` and ``smooth_steps`` are used.
    vacancy : VacancyField
        Or any object with ``vacancy(points)``.
    """
    if settings.smooth_steps == 0 and not 0 < settings.target_faces < len(mesh.faces):
        return CleanUpResult(_with_request(mesh, settings), None)
    vertices, faces, colors = mesh.vertices, np.asarray(mesh.faces, np.int64), mesh.colors
    if settings.smooth_steps > 0:
        vertices = smooth(
            vertices, faces, settings.smooth_steps, progress.span(0.0, 0.4), region=region
        )
    notes = list(mesh.provenance.get("notes", []))
    dense = None
    if 0 < settings.target_faces < len(faces):
        dense = SurfaceMesh(vertices, np.asarray(mesh.faces, np.int32))
        result = decimate(
            vertices, faces, settings.target_faces, progress.span(0.4, 0.9), region=region
        )
        vertices, faces = result.vertices, result.faces
        colors = None if colors is None else colors[result.source]
        if not result.reached:
            text = (
                f"{len(faces)} faces are left of {len(mesh.faces)}, more than the "
                f"{settings.target_faces} requested: fewer would fold or tear the mesh."
            )
            notes.append(ReportWarning("more-faces-left", text).to_json())
        _logger.info("Decimated %d faces to %d", len(mesh.faces), len(faces))
    progress.update(0.9, "measuring the mesh")
    capped = (cap_planes(vertices, region).planes >= 0).any(1)
    provenance = {
        **mesh.provenance,
        "notes": notes,
        "smooth_steps": settings.smooth_steps,
        "target_faces": settings.target_faces,
        "faces_before_clean_up": len(mesh.faces),
        **isosurface_residuals(vacancy, vertices[~capped]),
        "vertices_on_surface": int((~capped).sum()),
        "vertices_on_region_boundary": int(capped.sum()),
        "vertices_at_end_of_sight": 0,
        "vertices_moved_apart": 0,
    }
    progress.update(1.0, f"{len(faces)} faces")
    cleaned = SurfaceMesh(vertices, faces.astype(np.int32), colors, provenance)
    return CleanUpResult(cleaned, dense if len(faces) < len(mesh.faces) else None)


def _with_request(mesh: SurfaceMesh, settings: MeshingSettings) -> SurfaceMesh:
    """Add a note if the requested number of faces is not below the present one."""
    if settings.target_faces == 0:
        return mesh
    text = (
        f"The mesh has {len(mesh.faces)} faces, fewer than the {settings.target_faces} requested: "
        "nothing was decimated."
    )
    note = ReportWarning("not-decimated", text).to_json()
    notes = [*mesh.provenance.get("notes", []), note]
    return replace(mesh, provenance={**mesh.provenance, "notes": notes})
