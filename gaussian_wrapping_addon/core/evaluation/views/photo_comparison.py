# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare a job's textured mesh with some of the job's photos: figures and pictures."""

from __future__ import annotations

import math
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene
from ...dataset.view_split import evenly_spaced
from ...imaging.lpips import lpips_if_ready
from ...kernels.parallel import default_threads
from ...mesh.textured_mesh import TexturedMesh
from ...progress import Progress
from .held_out_texture import bake_held_out_texture
from .mesh_rendering import render_views
from .side_by_side import write_side_by_side

MAX_PHOTOS = 8
LONG_SIDE_PX = 800
MAX_PICTURES = 3
PICTURE_WIDTH_PX = 1200
NOTE_ALL_PHOTOS = "the texture was baked from all photos, including those compared"
NOTE_HELD_OUT = (
    "the texture compared was baked without the held-out photos; the files use all photos"
)
NOTE_GAUSSIANS = (
    "the texture is rendered from the Gaussians, which were not trained on the held-out photos"
)


def compare_with_photos(
    textured: TexturedMesh,
    scene: Scene,
    photos: PhotoSource,
    held_out: Collection[str],
    folder: Path,
    progress: Progress,
    *,
    from_gaussians: bool = False,
    threads: int = 0,
) -> dict[str, Any]:
    """Evaluate mesh-based rendering over covered pixels, and write some of the comparisons.

    Comparison with a photo from which the texture was baked is biased. If photos were held out, a
    texture baked without them is compared, at the coarsest size that the pictures allow.

    Parameters
    ----------
    textured : TexturedMesh
        Scene frame.
    scene : Scene
        Views of the photos.
    photos : PhotoStore
    held_out : collection of str
        Names of photos held out of training. Up to :data:`MAX_PHOTOS` evenly spaced ones of these
        are compared, or of all photos if none were held out.
    folder : Path
        Where ``comparison-1.jpg`` and so on are written: photo left, rendering right.
    from_gaussians : bool
        The texture has no colours of photos, so no photo has to be left out.
    threads : int
        0 uses every core.

    Returns
    -------
    dict
        What :meth:`~.mesh_rendering.MeshRenderingScore.to_json` returns, with ``pictures`` (file
        names), ``held_out`` (whether the photos were held out of training), ``note``, and, if a
        texture was baked for it, ``texture_size_px`` and ``bake_s``. Views with a picture have the
        key ``picture``.

    Raises
    ------
    ResourceError
        A picture cannot be written.
    """
    names = [view.camera.name for view in scene.views]
    wanted = [index for index, name in enumerate(names) if name in held_out]
    chosen = evenly_spaced(wanted or range(len(names)), MAX_PHOTOS)
    cameras, images, counted = [], [], []
    reduction = 0
    for index in chosen:
        full = photos.camera(index, 1)
        # Whole blocks of pixels are averaged, as the renderer averages whole blocks of rays.
        divisor = math.ceil(max(full.width, full.height) / LONG_SIDE_PX)
        divisor = min(divisor, full.width, full.height)
        reduction = min(reduction or divisor, divisor)
        cameras.append(photos.camera(index, divisor))
        images.append(photos.photo(index, divisor))
        counted.append(photos.mask(index, divisor))
    description: dict[str, Any] = {
        "note": NOTE_GAUSSIANS if from_gaussians and wanted else NOTE_ALL_PHOTOS
    }
    if wanted and len(wanted) < len(names) and not from_gaussians:
        begun_s = time.monotonic()
        textured = bake_held_out_texture(
            textured, scene, photos, held_out, reduction, folder, progress,
            threads=threads or default_threads(),
        )  # fmt: skip
        description = {
            "note": NOTE_HELD_OUT,
            "texture_size_px": len(textured.albedo),
            "bake_s": round(time.monotonic() - begun_s, 1),
        }
    shown: list[tuple[np.ndarray, np.ndarray]] = []
    lpips, reason = lpips_if_ready()
    score = render_views(
        textured, cameras, images, counted=counted, lpips=lpips, threads=threads,
        on_view=lambda name, photo, image: shown.append((photo, image)),
    )  # fmt: skip
    values = score.to_json()
    if reason:
        values["lpips_note"] = reason
    values["pictures"] = []
    for number, index in enumerate(evenly_spaced(range(len(shown)), MAX_PICTURES), start=1):
        name = f"comparison-{number}.jpg"
        write_side_by_side(folder / name, *shown[index], max_width_px=PICTURE_WIDTH_PX)
        values["views"][index]["picture"] = name
        values["pictures"].append(name)
    return {**values, "held_out": bool(wanted), **description}
