# SPDX-License-Identifier: GPL-3.0-or-later
"""Textured meshes of real photos beside photos that neither training nor texture has seen."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.evaluation.views.mesh_rendering import render_views
from gaussian_wrapping_addon.core.evaluation.views.side_by_side import write_side_by_side
from gaussian_wrapping_addon.core.evaluation.views.textured_rendering import TexturedRenderer
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.limits import MAX_IMAGE_SIDE_PX
from gaussian_wrapping_addon.core.mesh.mesh_file import load_mesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh

LONG_SIDE_PX = 800
PICTURE_WIDTH_PX = 1400


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
        ``psnr``, ``ssim`` and ``covered``: means over the held-out photos, of the pixels that the
        mesh covers wholly; ``fitted_psnr``: with one gain a channel fitted to each photo, since
        nobody knows the exposure of a photo that was held out.
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
    shown: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    fitted: list[float] = []

    def keep(name: str, photo: np.ndarray, image: np.ndarray) -> None:
        shown[name] = photo, image

    score = render_views(textured, cameras, images, threads=threads, on_view=keep)
    renderer = TexturedRenderer(textured, threads=threads)
    for camera in cameras:
        if camera.name in shown:
            photo, image = shown[camera.name]
            covered = renderer.render(camera).covered
            fitted.append(_fitted_psnr(photo, image, covered))
    ranked = sorted(score.views, key=lambda view: view.scores.psnr)
    if picture is not None:
        middle = ranked[len(ranked) // 2].name
        write_side_by_side(picture, *shown[middle], max_width_px=PICTURE_WIDTH_PX)
    return {
        "photos": len(seen),
        "held_out": len(score.views),
        "faces": len(mesh.faces),
        "psnr": score.psnr,
        "fitted_psnr": float(np.mean(fitted)),
        "ssim": score.ssim,
        "covered": score.covered,
        "texture": textured.statistics,
    }


def _newest(job: Path, name: str) -> Path:
    """Return the folder of the stage that finished last: a job may have been meshed again."""
    done = list((job / "stages").glob(f"{name}-*/done.json"))
    return max(done, key=lambda path: path.stat().st_mtime).parent


def _fitted_psnr(photo: np.ndarray, image: np.ndarray, covered: np.ndarray) -> float:
    """Return the PSNR over covered pixels with the best gain of each channel, dB."""
    a, b = image[covered].astype(np.float64), photo[covered].astype(np.float64)
    gain = (a * b).sum(0) / np.maximum((a * a).sum(0), 1e-9)
    error = np.clip(gain * a, 0, 255) - b
    return float(10 * np.log10(255.0**2 / max(float((error**2).mean()), 1e-9)))
