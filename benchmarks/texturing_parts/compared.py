# SPDX-License-Identifier: GPL-3.0-or-later
"""Renderings of a textured mesh beside photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.evaluation.views.mesh_rendering import render_views
from gaussian_wrapping_addon.core.evaluation.views.side_by_side import write_side_by_side
from gaussian_wrapping_addon.core.evaluation.views.textured_rendering import TexturedRenderer
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh

PICTURE_WIDTH_PX = 1400


def compared(
    textured: TexturedMesh,
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    picture: Path | None,
    threads: int,
) -> dict[str, float]:
    """Compare renderings with photos, over the pixels that the mesh covers wholly.

    Parameters
    ----------
    picture : Path or None
        Gets the photo of median PSNR, left, and the rendering, right.

    Returns
    -------
    dict
        Means over the photos: ``psnr``, ``ssim``, ``covered``, and ``fitted_psnr``, with one gain
        a channel fitted to each photo; ``views``: number of photos compared.
    """
    shown: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def keep(name: str, photo: np.ndarray, image: np.ndarray) -> None:
        shown[name] = photo, image

    score = render_views(textured, list(cameras), list(photos), threads=threads, on_view=keep)
    renderer = TexturedRenderer(textured, threads=threads)
    fitted = [
        _fitted_psnr(*shown[camera.name], renderer.render(camera).covered)
        for camera in cameras
        if camera.name in shown
    ]
    if picture is not None:
        ranked = sorted(score.views, key=lambda view: view.scores.psnr)
        middle = ranked[len(ranked) // 2].name
        write_side_by_side(picture, *shown[middle], max_width_px=PICTURE_WIDTH_PX)
    return {
        "psnr": score.psnr,
        "fitted_psnr": float(np.mean(fitted)),
        "ssim": score.ssim,
        "covered": score.covered,
        "views": len(score.views),
    }


def _fitted_psnr(photo: np.ndarray, image: np.ndarray, covered: np.ndarray) -> float:
    """Return the PSNR over covered pixels with the best gain of each channel, dB."""
    a, b = image[covered].astype(np.float64), photo[covered].astype(np.float64)
    gain = (a * b).sum(0) / np.maximum((a * a).sum(0), 1e-9)
    error = np.clip(gain * a, 0, 255) - b
    return float(10 * np.log10(255.0**2 / max(float((error**2).mean()), 1e-9)))
