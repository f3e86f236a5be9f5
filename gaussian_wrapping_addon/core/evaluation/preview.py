# SPDX-License-Identifier: GPL-3.0-or-later
"""Preview picture: a photo beside the textured mesh seen from the same camera."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np

from ..compiled import kernel
from ..dataset.camera import Camera
from ..dataset.scene import Scene
from ..errors import ResourceError
from ..files import write_bytes
from ..parallel import default_threads, even_bounds, run_chunks
from ..texture.bake import Photos
from ..texture.depth_buffer import depth_buffer
from ..texture.sampling import pyramid, trilinear
from ..texture.textured_mesh import TexturedMesh

BACKGROUND = (92, 92, 94)
SUPERSAMPLING = 3
LONG_SIDE_PX = 900
GAP_PX = 12
CHOICE_LONG_SIDE_PX = 120
MAX_CHOICES = 64
CROP_MARGIN = 0.15
MIN_MARGIN_SHARE = 0.02


def render_textured(
    textured: TexturedMesh, camera: Camera, size: tuple[int, int], *, threads: int = 0
) -> np.ndarray:
    """Render the mesh with its texture, unlit and antialiased, on plain grey.

    Parameters
    ----------
    textured : TexturedMesh
        In the camera's world frame.
    camera : Camera
        Any size; its view is resampled.
    size : (width, height)
        Of the picture, pixels.
    threads : int
        0 uses every core.

    Returns
    -------
    (height, width, 3) uint8
    """
    width, height = size
    fine = camera.resized(width * SUPERSAMPLING, height * SUPERSAMPLING)
    threads = threads or default_threads()
    vertices = np.ascontiguousarray(textured.mesh.vertices, np.float64)
    faces = np.ascontiguousarray(textured.mesh.faces, np.int32)
    hit = depth_buffer(vertices, faces, fine, threads=threads).face
    texture = pyramid(textured.albedo)
    local = fine.to_camera(vertices)
    intrinsics = np.array([fine.fx, fine.fy, fine.cx, fine.cy])
    uvs = np.ascontiguousarray(textured.corner_uvs, np.float64)
    image = np.empty((fine.height, fine.width, 3), np.uint8)
    image[:] = BACKGROUND

    def band(begin: int, end: int) -> None:
        _shade(
            hit, begin, end, local, faces, uvs, intrinsics, texture.pixels, texture.levels, image
        )

    run_chunks(band, even_bounds(fine.height, threads), threads)
    blocks = image.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 3)
    total = blocks.sum(axis=(1, 3), dtype=np.uint32)
    return ((total + SUPERSAMPLING**2 // 2) // SUPERSAMPLING**2).astype(np.uint8)


@kernel(fast=False)
def _shade(
    hit: Any,
    begin: int,
    end: int,
    local: Any,
    faces: Any,
    uvs: Any,
    intrinsics: Any,
    pixels: Any,
    levels: Any,
    image: Any,
) -> None:
    side_x, side_y = float(levels[0, 1]), float(levels[0, 2])
    normal = np.empty(3)
    for row in range(begin, end):
        for column in range(hit.shape[1]):
            face = hit[row, column]
            if face < 0:
                continue
            a, b, c = local[faces[face, 0]], local[faces[face, 1]], local[faces[face, 2]]
            e0, e1, e2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            g0, g1, g2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            normal[0] = e1 * g2 - e2 * g1
            normal[1] = e2 * g0 - e0 * g2
            normal[2] = e0 * g1 - e1 * g0
            double_area2 = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
            dx = (column + 0.5 - intrinsics[2]) / intrinsics[0]
            dy = (row + 0.5 - intrinsics[3]) / intrinsics[1]
            slope = normal[0] * dx + normal[1] * dy + normal[2]
            if double_area2 <= 0.0 or slope == 0.0:
                continue
            z = (normal[0] * a[0] + normal[1] * a[1] + normal[2] * a[2]) / slope
            p0, p1, p2 = z * dx - a[0], z * dy - a[1], z - a[2]
            # Barycentric weights from areas of the sub-triangles, signed along the normal.
            wc = (
                normal[0] * (e1 * p2 - e2 * p1)
                + normal[1] * (e2 * p0 - e0 * p2)
                + normal[2] * (e0 * p1 - e1 * p0)
            ) / double_area2
            wb = (
                normal[0] * (p1 * g2 - p2 * g1)
                + normal[1] * (p2 * g0 - p0 * g2)
                + normal[2] * (p0 * g1 - p1 * g0)
            ) / double_area2
            wb = min(max(wb, 0.0), 1.0)
            wc = min(max(wc, 0.0), 1.0 - wb)
            wa = 1.0 - wb - wc
            uv = uvs[face]
            u = (wa * uv[0, 0] + wb * uv[1, 0] + wc * uv[2, 0]) * side_x
            v = (1.0 - (wa * uv[0, 1] + wb * uv[1, 1] + wc * uv[2, 1])) * side_y
            # Texels of this face in one pixel: ratio of its areas in the texture and in space.
            uv_area = abs(
                (uv[1, 0] - uv[0, 0]) * (uv[2, 1] - uv[0, 1])
                - (uv[2, 0] - uv[0, 0]) * (uv[1, 1] - uv[0, 1])
            )
            texels = uv_area * side_x * side_y / np.sqrt(double_area2)
            footprint = (z / intrinsics[0]) ** 2
            level = 0.5 * np.log2(max(texels * footprint, 1.0))
            red, green, blue = trilinear(pixels, levels, level, u, v)
            image[row, column, 0] = int(red + 0.5)
            image[row, column, 1] = int(green + 0.5)
            image[row, column, 2] = int(blue + 0.5)


def choose_view(textured: TexturedMesh, photos: Photos, count: int, *, threads: int = 0) -> int:
    """Return the photo in which the mesh is large, whole, and seen from its front.

    0 threads uses every core.
    """
    threads = threads or default_threads()
    vertices, faces = textured.mesh.vertices, textured.mesh.faces
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
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
    """Return left, top, right, bottom of the part of the photo that is worth showing."""
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
    photos: Photos,
    path: Path,
    *,
    view: int | None = None,
    threads: int = 0,
) -> None:
    """Write a PNG: left the part of a photo that shows the mesh, right the mesh from its camera.

    Parameters
    ----------
    textured : TexturedMesh
        Scene frame.
    scene : Scene
        Whose views the photos are.
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
    rendered = render_textured(textured, part, (width, height), threads=threads)
    canvas = np.empty((height, 2 * width + GAP_PX, 3), np.uint8)
    canvas[:] = BACKGROUND
    canvas[:, :width] = np.asarray(photo)
    canvas[:, width + GAP_PX :] = rendered
    stream = io.BytesIO()
    Image.fromarray(canvas).save(stream, format="PNG")
    try:
        write_bytes(path, stream.getvalue())
    except OSError as error:
        raise ResourceError(
            f"{path} cannot be written: {error.strerror or error}.",
            "Check that the folder exists, is not read-only, and that the disk has room.",
        ) from error
