# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake a mesh's texture again without some photos, for an unbiased comparison with them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from pathlib import Path

import numpy as np

from ...dataset.camera import Camera
from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene
from ...mesh.face_graph import face_graph, uv_charts
from ...mesh.textured_mesh import TexturedMesh
from ...progress import Progress
from ...settings import TextureSettings
from ...texture.texture_mesh import texture_mesh
from ...texture.unwrap.unwrap import Unwrap

MIN_SIZE_PX = 256


class _PhotoSubset:
    """A renumbered subset of the photos of a store."""

    def __init__(self, photos: PhotoSource, indices: list[int]) -> None:
        self._photos = photos
        self._indices = indices

    def camera(self, index: int, divisor: int = 1) -> Camera:
        return self._photos.camera(self._indices[index], divisor)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        return self._photos.photo(self._indices[index], divisor)

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        return self._photos.mask(self._indices[index], divisor)


def bake_held_out_texture(
    textured: TexturedMesh,
    scene: Scene,
    photos: PhotoSource,
    names: Collection[str],
    reduction: int,
    work_folder: Path,
    progress: Progress,
    *,
    threads: int,
) -> TexturedMesh:
    """Bake the colours again on the same UVs from all photos except the named ones.

    Parameters
    ----------
    textured : TexturedMesh
        Scene frame.
    names : collection of str
        Photos to leave out; at least one must remain.
    reduction : int
        Factor by which the compared pictures are coarser than the photos: the texture is reduced
        by the largest power of two up to it.
    work_folder : Path
        For temporary files, all removed before returning.

    Returns
    -------
    TexturedMesh
        Without normal map and occlusion, which unlit pictures do not show.
    """
    kept = [i for i, view in enumerate(scene.views) if view.camera.name not in names]
    full_px = len(textured.albedo)
    size_px = full_px
    while size_px >= 2 * MIN_SIZE_PX and full_px // size_px * 2 <= reduction:
        size_px //= 2
    mesh, uvs = textured.mesh, textured.corner_uvs
    graph = face_graph(mesh.vertices, mesh.faces)
    gutter_px = float(textured.statistics.get("gutter_px", 1.0)) * size_px / full_px
    charts = uv_charts(graph, mesh.faces, uvs)
    unwrapped = Unwrap(uvs, charts, "kept", gutter_px, face_atlas=textured.face_atlas)
    settings = TextureSettings(
        size_px=size_px,
        gutter_px=max(1, math.floor(gutter_px)),
        normal_map="off",
        ambient_occlusion="off",
    )
    part = dataclasses.replace(scene, views=tuple(scene.views[i] for i in kept))
    return texture_mesh(
        mesh, part, _PhotoSubset(photos, kept), settings, work_folder, progress,
        threads=threads, unwrapped=unwrapped,
    )  # fmt: skip
