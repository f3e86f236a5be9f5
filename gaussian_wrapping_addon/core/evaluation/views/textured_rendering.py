# SPDX-License-Identifier: GPL-3.0-or-later
"""Render a textured mesh from a camera: unlit, antialiased, on a plain grey background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...dataset.camera import Camera
from ...imaging.trilinear import Pyramid, pyramid, trilinear
from ...kernels.compiled import kernel
from ...kernels.parallel import default_threads, even_bounds, run_chunks
from ...mesh.depth_buffer import depth_buffer
from ...mesh.textured_mesh import TexturedMesh

BACKGROUND = (92, 92, 94)
SUPERSAMPLING = 3
"""Rays per pixel along each axis."""


@dataclass(frozen=True)
class TexturedView:
    """A rendering and its coverage."""

    image: np.ndarray
    """(h, w, 3) uint8; :data:`BACKGROUND` outside the mesh, blended along silhouettes."""
    coverage: np.ndarray
    """(h, w) float32 in [0, 1]: share of the pixel's rays that meet the mesh."""

    @property
    def covered(self) -> np.ndarray:
        """(h, w) bool: every ray of the pixel meets the mesh."""
        return self.coverage == 1.0

    def on_black(self) -> np.ndarray:
        """Return (h, w, 3) float32, white 1: the same picture on a black background."""
        behind = (1.0 - self.coverage)[..., None] * np.array(BACKGROUND, np.float32)
        return (np.maximum(self.image - behind, 0.0) / 255.0).astype(np.float32)


class TexturedRenderer:
    """Render one textured mesh from many cameras; faces are two-sided.

    Parameters
    ----------
    textured : TexturedMesh
        In the scene frame; surfaces nearer than ``depth_buffer.NEAR_DEPTH`` are clipped.
    threads : int
        0 uses every core; the result does not depend on it.
    """

    def __init__(self, textured: TexturedMesh, *, threads: int = 0) -> None:
        self._threads = threads or default_threads()
        self._vertices = np.ascontiguousarray(textured.mesh.vertices, np.float64)
        self._faces = np.ascontiguousarray(textured.mesh.faces, np.int32)
        self._uvs = np.ascontiguousarray(textured.corner_uvs, np.float64)
        self._textures = [pyramid(atlas.albedo) for atlas in textured.atlases]
        self._atlas = textured.atlas_of_faces

    def render(self, camera: Camera, size: tuple[int, int] | None = None) -> TexturedView:
        """Render from a camera of the scene frame.

        Parameters
        ----------
        camera : Camera
            Of any size; its view is resampled.
        size : (width, height), optional
            Size of the picture in pixels; by default that of the camera.
        """
        width, height = size or (camera.width, camera.height)
        fine = camera.resized(width * SUPERSAMPLING, height * SUPERSAMPLING)
        hit = depth_buffer(self._vertices, self._faces, fine, threads=self._threads).face
        local = fine.to_camera(self._vertices)
        intrinsics = np.array([fine.fx, fine.fy, fine.cx, fine.cy])
        image = np.empty((fine.height, fine.width, 3), np.uint8)
        image[:] = BACKGROUND

        for number, texture in enumerate(self._textures):
            shown = hit
            if len(self._textures) > 1:
                mine = self._atlas[hit.clip(0)] == number
                shown = np.where(mine, hit, hit.dtype.type(-1))

            def band(
                begin: int, end: int, shown: np.ndarray = shown, texture: Pyramid = texture
            ) -> None:
                _shade(
                    shown, begin, end, local, self._faces, self._uvs, intrinsics,
                    texture.pixels, texture.levels, image,
                )  # fmt: skip

            run_chunks(band, even_bounds(fine.height, self._threads), self._threads)
        rays = SUPERSAMPLING**2
        return TexturedView(
            ((_pixel_sums(image) + rays // 2) // rays).astype(np.uint8),
            _pixel_sums(hit >= 0).astype(np.float32) / np.float32(rays),
        )


def _pixel_sums(rays: np.ndarray) -> np.ndarray:
    """Sum over the rays of each pixel: (3 h, 3 w, ...) bool or uint8 to (h, w, ...) uint16."""
    total = rays[::SUPERSAMPLING, ::SUPERSAMPLING].astype(np.uint16)
    for row, column in list(np.ndindex(SUPERSAMPLING, SUPERSAMPLING))[1:]:
        total += rays[row::SUPERSAMPLING, column::SUPERSAMPLING]
    return total


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
