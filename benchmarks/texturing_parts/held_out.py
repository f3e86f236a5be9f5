# SPDX-License-Identifier: GPL-3.0-or-later
"""Textured meshes of real photos beside photos that neither training nor texture has seen."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.evaluation.views.held_out_texture import bake_held_out_texture
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.limits import MAX_IMAGE_SIDE_PX
from gaussian_wrapping_addon.core.mesh.mesh_file import load_mesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh

from .compared import compared

LONG_SIDE_PX = 800


def held_out_figures(job: Path, picture: Path | None, threads: int) -> dict[str, Any]:
    """Texture a finished job's mesh anew without its held-out photos, and compare with these.

    Parameters
    ----------
    job : Path
        A job folder; the region that was meshed last counts.
    picture : Path or None
        Gets the photo of median PSNR, left, and the rendering, right.

    Returns
    -------
    dict
        What :func:`.compared.compared` returns; ``fitted_psnr`` counts, since nobody knows the
        exposure of a photo that was held out. ``itself_psnr``: of a texture baked from the held-out
        photos alone, about as much as one unlit texture can have.
    """
    scene = load_saved_scene(_newest(job, "cameras"))
    trained = read_json(_newest(job, "train") / "done.json")
    names = {figure["name"] for figure in trained["held_out"]}
    mesh = load_mesh(_newest(job, "mesh") / "mesh.npz")
    seen = tuple(view for view in scene.views if view.camera.name not in names)
    kept = dataclasses.replace(scene, views=seen)
    with tempfile.TemporaryDirectory() as folder:
        textured = texture_mesh(
            mesh, kept, PhotoStore(kept, MAX_IMAGE_SIDE_PX), TextureSettings(), Path(folder),
            Progress(), threads=threads,
        )  # fmt: skip
    photos = PhotoStore(scene, MAX_IMAGE_SIDE_PX)
    cameras, images = [], []
    for index, view in enumerate(scene.views):
        if view.camera.name in names:
            full = photos.camera(index, 1)
            divisor = -(-max(full.width, full.height) // LONG_SIDE_PX)
            cameras.append(photos.camera(index, divisor))
            images.append(photos.photo(index, divisor))
    figures = compared(textured, cameras, images, picture, threads)
    with tempfile.TemporaryDirectory() as folder:
        # On the same UVs, from the photos that it is compared with.
        itself = bake_held_out_texture(
            textured, scene, photos, [view.camera.name for view in seen], 1, Path(folder),
            Progress(), threads=threads,
        )  # fmt: skip
    return {
        "photos": len(seen),
        "faces": len(mesh.faces),
        "texture": textured.statistics,
        "itself_psnr": compared(itself, cameras, images, None, threads)["psnr"],
        **figures,
    }


def _newest(job: Path, name: str) -> Path:
    """Return the folder of the stage that finished last: a job may have been meshed again."""
    done = list((job / "stages").glob(f"{name}-*/done.json"))
    return max(done, key=lambda path: path.stat().st_mtime).parent
