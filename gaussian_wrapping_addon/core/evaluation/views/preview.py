# SPDX-License-Identifier: GPL-3.0-or-later
"""Preview picture: a photo beside a rendering of the textured mesh from the same camera."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from ...dataset.camera import Camera
from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene
from ...kernels.parallel import default_threads
from ...mesh.depth_buffer import depth_buffer
from ...mesh.textured_mesh import TexturedMesh
from ...mesh.topology import area_vectors
from .side_by_side import write_side_by_side
from .textured_rendering import TexturedRenderer

LONG_SIDE_PX = 900
CHOICE_LONG_SIDE_PX = 120
MAX_CHOICES = 64
CROP_MARGIN = 0.15
MIN_MARGIN_SHARE = 0.02


def choose_view(
    textured: TexturedMesh, photos: PhotoSource, count: int, *, threads: int = 0
) -> int:
    """Return the photo that shows the mesh large, complete, and from the front.

    With 0 threads, every core is used.
    """
    threads = threads or default_threads()
    vertices, faces = textured.mesh.vertices, textured.mesh.faces
    corners = vertices[faces]
    cross = area_vectors(vertices, faces)
    best, best_score = 0, -1.0
    for index in np.unique(np.linspace(0, count - 1, min(count, MAX_CHOICES)).astype(int)).tolist():
        full = photos.camera(index, 1)
        scale = CHOICE_LONG_SIDE_PX / max(full.width, full.height)
        camera = full.resized(max(1, round(full.width * scale)), max(1, round(full.height * scale)))
        hit = depth_buffer(vertices, faces, camera, threads=threads).face
        covered = hit >= 0
        pixels, depth = camera.project(vertices)
        inside = (depth > 0) & (pixels > 0).all(axis=1)
        inside &= (pixels < [camera.width, camera.height]).all(axis=1)
        facing = (cross[hit[covered]] * (corners[hit[covered], 0] - camera.center)).sum(axis=1) < 0
        share = float(facing.sum()) / covered.size
        score = share * float(inside.mean()) ** 2
        if score > best_score:
            best, best_score = index, score
    return best


def _crop(textured: TexturedMesh, camera: Camera, threads: int) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom of the part of the photo that shows the mesh."""
    factor = max(1, max(camera.width, camera.height) // (2 * CHOICE_LONG_SIDE_PX))
    coarse = camera.resized(max(1, camera.width // factor), max(1, camera.height // factor))
    mesh = textured.mesh
    hit = depth_buffer(mesh.vertices, mesh.faces, coarse, threads=threads).face >= 0
    if not hit.any():
        return 0, 0, camera.width, camera.height
    bounds = []
    for axis, side in ((0, camera.width), (1, camera.height)):
        covered = np.flatnonzero(hit.any(axis=axis)) / hit.shape[1 - axis] * side
        margin = CROP_MARGIN * (covered[-1] - covered[0]) + MIN_MARGIN_SHARE * side
        bounds.append((max(0, int(covered[0] - margin)), min(side, int(covered[-1] + margin) + 1)))
    return bounds[0][0], bounds[1][0], bounds[0][1], bounds[1][1]


def write_preview(
    textured: TexturedMesh,
    scene: Scene,
    photos: PhotoSource,
    path: Path,
    *,
    view: int | None = None,
    threads: int = 0,
) -> None:
    """Write a PNG: left the part of a photo that shows the mesh, right its rendering.

    Parameters
    ----------
    textured : TexturedMesh
        Scene frame.
    scene : Scene
        Views of the photos.
    photos : PhotoStore
    path : Path
        Its folder must exist.
    view : int or None
        Photo to show; ``None`` chooses the one that shows the mesh best.
    threads : int
        0 uses every core.

    Raises
    ------
    ResourceError
        The file cannot be written.
    """
    from PIL import Image

    threads = threads or default_threads()
    count = len(scene.views)
    index = choose_view(textured, photos, count, threads=threads) if view is None else view
    full = photos.camera(index, 1)
    left, top, right, bottom = _crop(textured, full, threads)
    part = dataclasses.replace(
        full, width=right - left, height=bottom - top, cx=full.cx - left, cy=full.cy - top
    )
    scale = min(1.0, LONG_SIDE_PX / max(part.width, part.height))
    width, height = max(1, round(part.width * scale)), max(1, round(part.height * scale))
    pixels = photos.photo(index, 1)[top:bottom, left:right]
    resampling = Image.Resampling.LANCZOS
    photo = Image.fromarray(np.ascontiguousarray(pixels)).resize((width, height), resampling)
    rendered = TexturedRenderer(textured, threads=threads).render(part, (width, height)).image
    write_side_by_side(path, np.asarray(photo), rendered)
