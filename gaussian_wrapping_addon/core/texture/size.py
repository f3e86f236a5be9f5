# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture size and memory."""

from __future__ import annotations

import math

import numpy as np

from .. import limits
from ..errors import ResourceError
from ..mesh.components import FaceGraph
from ..progress import ReportWarning
from ..scene.scene import PhotoSource
from .bake import POINTS_PER_BLOCK
from .photo_samples import MIN_COSINE

# -- Estimate the memory needed to bake textures --------------------------------------------------


BASE_BYTES = 500 * 10**6
"""Photos, depth buffers and everything else that does not grow with the texture."""
FACE_BYTES = 900
"""Per face, with its share of vertices, graphs and helper files."""
TEXEL_BYTES = 30
"""Per texel of the atlas being baked, from the arrays held at once: image, rings, charts, points
and their colours, and indices of some of them. Counted, not measured."""
WAITING_TEXEL_BYTES = 14
"""The same for a baked atlas that waits for the others."""
BLOCK_POINT_BYTES = 105
"""Per point of the block that is held with its views."""
MIN_SIZE_PX = 256


def texture_memory_bytes(size_px: int, atlases: int, faces: int) -> int:
    """Return the approximate additional memory of a process that textures a mesh."""
    texels = size_px * size_px
    waiting = WAITING_TEXEL_BYTES * texels * (atlases - 1)
    block = BLOCK_POINT_BYTES * min(texels, POINTS_PER_BLOCK)
    return BASE_BYTES + block + FACE_BYTES * faces + TEXEL_BYTES * texels + waiting


def fit_into_memory(
    size_px: int, atlases: int, faces: int, free_bytes: int, *, may_lower: bool,
    may_join: bool = True,
) -> tuple[int, int, ReportWarning | None]:  # fmt: skip
    """Return side and number of textures that fit, and a warning if that is less than requested.

    Parameters
    ----------
    free_bytes : int
        Available memory; 0 if unknown, then nothing is checked.
    may_lower : bool
        Whether the size may be lowered because it was chosen automatically.
    may_join : bool
        Whether there may be fewer textures; otherwise only the size is lowered.

    Raises
    ------
    ResourceError
        Not even the smallest size fits, or not the requested one.
    """
    needed = texture_memory_bytes(size_px, atlases, faces)
    if free_bytes == 0 or needed <= free_bytes:
        return size_px, atlases, None
    side, number = size_px, atlases
    while may_join and number > 1 and texture_memory_bytes(side, number, faces) > free_bytes:
        number -= 1
    while side // 2 >= MIN_SIZE_PX and texture_memory_bytes(side, number, faces) > free_bytes:
        side //= 2
    fits = texture_memory_bytes(side, number, faces) <= free_bytes
    what = "A texture" if atlases == 1 else f"{atlases} textures"
    text = f"{what} of {size_px} pixels may need {needed / 2**30:.1f} GB of memory; "
    text += f"{free_bytes / 2**30:.1f} GB are free"
    if not (fits and may_lower):
        hint = "Close other programs or use a machine with more memory."
        if fits:
            hint = f"Choose {number} of {side} pixels, or close other programs."
        raise ResourceError(f"{text}.", hint)
    made = f"{text}. Made instead: {number} of {side} pixels."
    return side, number, ReportWarning("texture-made-smaller", made)


# -- Side and number of textures from the resolution of the photos on the surface -----------------


SAMPLED_FACES = 2_000
TEXELS_PER_FACE = 8
"""Minimum for many small charts, even if the photos show little of each face: by the photos alone,
most faces of a wheel with 28 spokes had no texel. With 8, 2 % of the faces and 0.2 % of the area
have none; 12 take 1.5 times as long for the same PSNR (two scenes, 50 thousand faces, photos of 480
pixels)."""
TEXELS_PER_DETAIL_POINT = 2
"""With one texel per vertex of the dense mesh, a normal map would lose half of its bends."""
FULL_GUTTER_SIDE_PX = 4096
MIN_GUTTER_PX = 2
MAX_AUTOMATIC_SIZE_PX = 4096
EXPECTED_UTILISATION = 0.5
"""Share of texels covered by charts; 0.4 to 0.65 were measured on ordinary meshes."""
ENOUGH = 0.8
"""This share of the photos' resolution suffices: the next size costs four times as much."""


def required_side(
    graph: FaceGraph, photos: PhotoSource, count: int, detail_points: int = 0
) -> float:
    """Return the side in pixels of one texture at about the photos' resolution, without limits.

    That of :func:`side_in_photos`, but it also allows for :data:`TEXELS_PER_FACE`, and for
    :data:`TEXELS_PER_DETAIL_POINT` of the ``detail_points`` of a normal map. 0 if no photo shows
    the mesh.
    """
    wanted = side_in_photos(graph, photos, count)
    if wanted == 0.0:
        return 0.0
    room = max(TEXELS_PER_FACE * len(graph.areas), TEXELS_PER_DETAIL_POINT * detail_points)
    return max(wanted, math.sqrt(room / EXPECTED_UTILISATION))


def side_in_photos(graph: FaceGraph, photos: PhotoSource, count: int) -> float:
    """Return the side in pixels of one texture that holds what photos show of a mesh.

    The footprint of a photo's pixel on the surface is ``z / focal``; each sampled face uses its
    best photo, and the surface the median of the faces (by area). Occlusion is not tested: only the
    order of magnitude matters.
    """
    area = float(graph.areas.sum())
    faces = np.random.default_rng(0).choice(len(graph.areas), SAMPLED_FACES, p=graph.areas / area)
    centroids, normals = graph.centroids[faces], graph.normals[faces]
    best = np.full(SAMPLED_FACES, np.inf)
    for index in range(count):
        camera = photos.camera(index, 1)
        pixels, depth = camera.project(centroids)
        inside = (pixels > 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
        ray = centroids - camera.center
        cosine = -(ray * normals).sum(axis=1) / np.maximum(np.linalg.norm(ray, axis=1), 1e-12)
        sees = inside & (depth > 0) & (cosine > MIN_COSINE)
        best = np.where(sees, np.minimum(best, depth / camera.fx), best)
    best = best[np.isfinite(best)]
    if len(best) == 0:
        return 0.0
    return ENOUGH * math.sqrt(area / EXPECTED_UTILISATION) / float(np.median(best))


def plan_textures(wanted: float, size_px: int, max_atlases: int) -> tuple[int, int]:
    """Return the side of each texture in pixels and how many there are.

    Parameters
    ----------
    wanted : float
        Required side of a single texture (:func:`required_side`).
    size_px : int
        Requested side; 0 chooses a power of two from 256 to 4096.
    max_atlases : int
        Maximum number of textures, of which as many are used as hold the texels of one of side
        ``wanted``. 0 means one, but :data:`~.limits.MAX_AUTOMATIC_ATLASES` if one of 8192 is not
        enough and no smaller size was requested.
    """
    nearest = 2 ** math.ceil(math.log2(max(wanted, 1.0)))
    side = size_px or min(max(nearest, MIN_SIZE_PX), MAX_AUTOMATIC_SIZE_PX)
    most = max_atlases
    if most == 0:
        is_free = size_px in (0, limits.MAX_TEXTURE_SIDE_PX)
        beyond = wanted > limits.MAX_TEXTURE_SIDE_PX
        most = limits.MAX_AUTOMATIC_ATLASES if is_free and beyond else 1
    # Rounding errors must not add another texture.
    return side, min(max(math.ceil((wanted / side) ** 2 - 1e-6), 1), most)


def gutter_for(size_px: int, gutter_px: int) -> int:
    """Return the gutter of a texture: ``gutter_px`` at 4096 texels, in proportion below.

    Smaller textures have fewer mip levels to separate, and with full gutters around small charts
    there would be no room for texels.
    """
    share = min(1.0, size_px / FULL_GUTTER_SIDE_PX)
    return max(min(MIN_GUTTER_PX, gutter_px), round(gutter_px * share))
