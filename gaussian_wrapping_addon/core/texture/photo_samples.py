# SPDX-License-Identifier: GPL-3.0-or-later
"""Which photos see a texel, and what colour they have there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..compiled import inline, kernel
from ..filters import Pyramid, trilinear
from ..mesh.components import vertex_normals
from ..mesh.depth_buffer import depth_buffer
from ..parallel import even_bounds, run_chunks
from ..scene.camera import Camera

# -- Visibility of surface points in a photo, and their distance to silhouettes -------------------
#
# One depth buffer per photo serves millions of texels. The test compares the buffer with the
# plane of the texel's face at every pixel of the bilinear look-up, so that slopes need no
# tolerance and an occluder's colour never bleeds onto the surface behind it.


BIAS_PX = 1.5
"""Depth tolerance in pixel footprints: creases deviate from the plane by about one."""
BIAS_RELATIVE = 1e-5
"""Relative rounding of float32 depths, with margin."""
JUMP_PX = 12.0
"""Neighbouring depths that differ by more footprints are a silhouette (slope above 85 degrees)."""
MAX_CLEARANCE_PX = 16


def photo_visibility(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and clearance of each pixel, as in :class:`PhotoView`."""
    depth = depth_buffer(vertices, faces, camera, threads=threads).depth
    return depth, _clearance(depth, JUMP_PX / min(camera.fx, camera.fy))


@kernel(fast=False)
def _clearance(depth: Any, jump: float) -> np.ndarray:
    """Return chamfer distances to silhouettes by two sweeps (3-4 weights, thirds of a pixel)."""
    height, width = depth.shape
    far = 3 * MAX_CLEARANCE_PX
    distance = np.full((height, width), far, np.int32)
    for y in range(height):
        for x in range(width):
            here = depth[y, x]
            for k in range(2):
                v, u = y + (k == 0), x + (k == 1)
                if v >= height or u >= width:
                    continue
                there = depth[v, u]
                if np.isinf(here) and np.isinf(there):
                    continue
                if abs(here - there) > jump * min(here, there):
                    distance[y, x] = 0
                    distance[v, u] = 0
    for y in range(height):
        for x in range(width):
            best = distance[y, x]
            if x > 0:
                best = min(best, distance[y, x - 1] + 3)
            if y > 0:
                best = min(best, distance[y - 1, x] + 3)
                if x > 0:
                    best = min(best, distance[y - 1, x - 1] + 4)
                if x + 1 < width:
                    best = min(best, distance[y - 1, x + 1] + 4)
            distance[y, x] = best
    out = np.empty((height, width), np.uint8)
    for y in range(height - 1, -1, -1):
        for x in range(width - 1, -1, -1):
            best = distance[y, x]
            if x + 1 < width:
                best = min(best, distance[y, x + 1] + 3)
            if y + 1 < height:
                best = min(best, distance[y + 1, x] + 3)
                if x + 1 < width:
                    best = min(best, distance[y + 1, x + 1] + 4)
                if x > 0:
                    best = min(best, distance[y + 1, x - 1] + 4)
            distance[y, x] = best
            out[y, x] = best // 3
    return out


@inline
def hidden_pixels(
    depth: Any, x: float, y: float, intrinsics: Any,
    nx: float, ny: float, nz: float, plane: float, z: float,
) -> int:  # fmt: skip
    """Count the pixels around a position (0 to 4) at which the plane ``n . p = plane`` is occluded.

    The plane is that of a face in camera coordinates, its normal points towards the camera; x, y
    are pixels, z the depth of the point, and the intrinsics fx, fy, cx, cy.
    """
    height, width = depth.shape
    tolerance = z * (BIAS_RELATIVE + BIAS_PX / min(intrinsics[0], intrinsics[1]))
    ix = int(np.floor(x - 0.5))
    iy = int(np.floor(y - 0.5))
    hidden = 0
    for k in range(4):
        u = min(max(ix + (k & 1), 0), width - 1)
        v = min(max(iy + (k >> 1), 0), height - 1)
        ray_x = (u + 0.5 - intrinsics[2]) / intrinsics[0]
        ray_y = (v + 0.5 - intrinsics[3]) / intrinsics[1]
        slope = nx * ray_x + ny * ray_y + nz
        expected = plane / slope if slope < 0.0 else z
        # Beyond the horizon of a grazing plane, the depth of the point is a better estimate.
        expected = expected if 0.0 < expected < 2.0 * z else z
        if depth[v, u] < expected - tolerance:
            hidden += 1
    return hidden


# -- Sample one photo at many surface points, with tests of facing, frame, mask and occlusion -----


MIN_COSINE = 0.2
"""Views at more than 78 degrees from the normal are a last resort."""
LAST_COSINE = 0.003
"""Beyond 89.8 degrees, even the side that faces the camera is uncertain."""
LAST_RESORT = 1e-20
"""Weight factor of last-resort views: far below all others, so one number encodes both."""
LAST_RESORT_BELOW = 1e-15
"""Last-resort views have less; the smallest other weight is (0.2 x 0.01 px)^2 x floors = 3e-11."""
CLEAR_PX = 4.0
"""Full weight from this distance to a silhouette, where pose errors mix two surfaces."""
CLEAR_FLOOR = 0.02
"""Minimum factor, so that thinner parts still use the best views available."""
BORDER_SHARE = 0.04
"""Weights decrease over this share of the image side towards its border."""
BORDER_FLOOR = 0.02
CLIPPED_FROM, CLIPPED_RANGE = 254.0, 40.0
"""Weights decrease over this range below white: a clipped pixel is a lower bound, which becomes a
flat grey after correction to another exposure, and camera response curves bend long before. With
14 levels, the white paper of the flowerpot set had grey patches. Highlights vanish if another view
has none."""
CLIPPED_FLOOR = 0.02
MAX_USEFUL_PX = 1.5
"""More pixels per texel than this do not improve a view."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points on faces of a mesh."""

    face: np.ndarray  # (n,) int32
    bary: np.ndarray  # (n, 2) float32 weights of the first two corners

    def __len__(self) -> int:
        return len(self.face)

    def part(self, rows: Any) -> SurfacePoints:
        """Return a subset of the points."""
        return SurfacePoints(self.face[rows], self.bary[rows])


@dataclass(frozen=True)
class SurfaceArrays:
    """Arrays of a mesh for the kernels."""

    vertices: np.ndarray  # (v, 3) float64
    faces: np.ndarray  # (f, 3) int32
    face_normals: np.ndarray  # (f, 3) float64
    vertex_normals: np.ndarray  # (v, 3) float64
    texel_size: float  # Side of a texel on the surface, scene units

    @classmethod
    def of(
        cls, vertices: np.ndarray, faces: np.ndarray, face_normals: np.ndarray, texel_size: float
    ) -> SurfaceArrays:
        """Construct with vertex normals computed."""
        vertices = np.ascontiguousarray(vertices, np.float64)
        faces = np.ascontiguousarray(faces, np.int32)
        return cls(vertices, faces, face_normals, vertex_normals(vertices, faces), texel_size)


@dataclass(frozen=True)
class PhotoView:
    """One photo at one level, prepared for sampling."""

    camera: Camera
    focal_px: float
    """Focal length at full resolution, which limits the detail of the photo."""
    image: Pyramid
    mask: np.ndarray
    """(h, w) bool; (1, 1) true without a mask."""
    depth: np.ndarray
    """(h, w) float32 z-depth of the mesh, infinite where it is not hit."""
    clearance: np.ndarray
    """(h, w) uint8 distance to the nearest silhouette, pixels, up to :data:`MAX_CLEARANCE_PX`."""


def sample_photo(
    points: SurfacePoints, surface: SurfaceArrays, view: PhotoView, factors: np.ndarray,
    weights: np.ndarray, colors: np.ndarray, best_clearance: np.ndarray, threads: int,
) -> None:  # fmt: skip
    """Sample the photo at every point; each point keeps its k best views.

    Parameters
    ----------
    factors : (gh, gw, 3) float64
        Factors of the photo's channels, on a grid whose outer nodes are the image corners.
    weights : (n, k) float32
        Modified in place; 0 marks a free slot.
    colors : (n, k, 3) uint8
        Modified in place.
    best_clearance : (n,) uint8
        Modified in place to the largest distance to a silhouette of any view kept, pixels.
    """
    camera = view.camera
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pose = np.ascontiguousarray(camera.cam_from_world, np.float64)

    def chunk(begin: int, end: int) -> None:
        _sample(
            points.face, points.bary, begin, end, surface.vertices, surface.faces,
            surface.face_normals, surface.vertex_normals, surface.texel_size, pose, intrinsics,
            view.focal_px, view.depth, view.clearance, view.mask,
            view.image.pixels, view.image.levels, factors, weights, colors, best_clearance,
        )  # fmt: skip

    run_chunks(chunk, even_bounds(len(points), threads, 16), threads)


@inline
def _fade(distance: float, width: float, floor: float) -> float:
    return min(max(distance / width, floor), 1.0)


@kernel(fast=False)
def _sample(
    point_face: Any, point_bary: Any, begin: int, end: int, vertices: Any, faces: Any,
    face_normals: Any, corner_normals: Any, texel_size: float, pose: Any, intrinsics: Any,
    focal_px: float, depth: Any, clearance: Any, mask: Any, pixels: Any, levels: Any,
    factors: Any, weights: Any, colors: Any, best_clearance: Any,
) -> None:  # fmt: skip
    height, width = depth.shape
    has_mask = mask.shape[0] == height and mask.shape[1] == width
    kept = weights.shape[1]
    grid_height, grid_width = factors.shape[0], factors.shape[1]
    for i in range(begin, end):
        face = point_face[i]
        l0, l1 = np.float64(point_bary[i, 0]), np.float64(point_bary[i, 1])
        l2 = 1.0 - l0 - l1
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        wx = l0 * vertices[a, 0] + l1 * vertices[b, 0] + l2 * vertices[c, 0]
        wy = l0 * vertices[a, 1] + l1 * vertices[b, 1] + l2 * vertices[c, 1]
        wz = l0 * vertices[a, 2] + l1 * vertices[b, 2] + l2 * vertices[c, 2]
        z = pose[2, 0] * wx + pose[2, 1] * wy + pose[2, 2] * wz + pose[2, 3]
        if not z > 0.0:
            continue
        x = pose[0, 0] * wx + pose[0, 1] * wy + pose[0, 2] * wz + pose[0, 3]
        y = pose[1, 0] * wx + pose[1, 1] * wy + pose[1, 2] * wz + pose[1, 3]
        u = intrinsics[0] * x / z + intrinsics[2]
        v = intrinsics[1] * y / z + intrinsics[3]
        if not (u >= 0.0 and v >= 0.0 and u < width and v < height):
            continue
        # Facing: the face normal decides, the smooth normal reduces noise in the weight.
        fx, fy, fz = face_normals[face, 0], face_normals[face, 1], face_normals[face, 2]
        nx = pose[0, 0] * fx + pose[0, 1] * fy + pose[0, 2] * fz
        ny = pose[1, 0] * fx + pose[1, 1] * fy + pose[1, 2] * fz
        nz = pose[2, 0] * fx + pose[2, 1] * fy + pose[2, 2] * fz
        distance = np.sqrt(x * x + y * y + z * z)
        cosine = -(nx * x + ny * y + nz * z) / distance
        if cosine < LAST_COSINE:
            continue
        sx = l0 * corner_normals[a, 0] + l1 * corner_normals[b, 0] + l2 * corner_normals[c, 0]
        sy = l0 * corner_normals[a, 1] + l1 * corner_normals[b, 1] + l2 * corner_normals[c, 1]
        sz = l0 * corner_normals[a, 2] + l1 * corner_normals[b, 2] + l2 * corner_normals[c, 2]
        gx = pose[0, 0] * sx + pose[0, 1] * sy + pose[0, 2] * sz
        gy = pose[1, 0] * sx + pose[1, 1] * sy + pose[1, 2] * sz
        gz = pose[2, 0] * sx + pose[2, 1] * sy + pose[2, 2] * sz
        length = np.sqrt(gx * gx + gy * gy + gz * gz)
        smooth = -(gx * x + gy * y + gz * z) / (distance * length) if length > 1e-12 else cosine
        angle = 0.5 * (cosine + max(smooth, 0.0))
        useful = min(focal_px * texel_size / z, MAX_USEFUL_PX)
        weight = (angle * useful) ** 2
        ix, iy = int(u), int(v)
        weight *= _fade(np.float64(clearance[iy, ix]), CLEAR_PX, CLEAR_FLOOR)
        border = min(min(u, width - u) / width, min(v, height - v) / height)
        weight *= _fade(border, BORDER_SHARE, BORDER_FLOOR)
        # Within half a pixel of the border, interpolation may mix in colours without a known depth.
        outermost = min(min(u, width - u), min(v, height - v)) < 0.5
        if cosine < MIN_COSINE or outermost:
            weight *= LAST_RESORT
        # Replace the worst of the kept views; ties keep the earlier photo.
        slot = 0
        for k in range(1, kept):
            if weights[i, k] < weights[i, slot]:
                slot = k
        if np.float32(weight) <= weights[i, slot]:
            continue
        plane = nx * x + ny * y + nz * z
        hidden = hidden_pixels(depth, u, v, intrinsics, nx, ny, nz, plane, z)
        if hidden == 4:
            continue
        if hidden > 0 and weight > LAST_RESORT_BELOW:
            weight *= LAST_RESORT
            if np.float32(weight) <= weights[i, slot]:
                continue
        if has_mask:
            jx, jy = int(u - 0.5), int(v - 0.5)
            kx, ky = min(jx + 1, width - 1), min(jy + 1, height - 1)
            if not (mask[jy, jx] and mask[jy, kx] and mask[ky, jx] and mask[ky, kx]):
                continue
        level = np.log2(max(intrinsics[0] * texel_size / z, 1.0))
        red, green, blue = trilinear(pixels, levels, level, u, v)
        room = CLIPPED_FROM - max(red, max(green, blue))
        weight *= _fade(room, CLIPPED_RANGE, CLIPPED_FLOOR)
        if np.float32(weight) <= weights[i, slot]:
            continue
        weights[i, slot] = weight
        if weight > LAST_RESORT_BELOW:
            best_clearance[i] = max(best_clearance[i], clearance[iy, ix])
        grid_x, grid_y = u / width * (grid_width - 1), v / height * (grid_height - 1)
        gx0, gy0 = int(grid_x), int(grid_y)
        gx1, gy1 = min(gx0 + 1, grid_width - 1), min(gy0 + 1, grid_height - 1)
        tx, ty = grid_x - gx0, grid_y - gy0
        for channel in range(3):
            upper = (1.0 - tx) * factors[gy0, gx0, channel] + tx * factors[gy0, gx1, channel]
            lower = (1.0 - tx) * factors[gy1, gx0, channel] + tx * factors[gy1, gx1, channel]
            value = red if channel == 0 else green if channel == 1 else blue
            value *= (1.0 - ty) * upper + ty * lower
            colors[i, slot, channel] = int(min(value, 255.0) + 0.5)
