# SPDX-License-Identifier: GPL-3.0-or-later
"""Make a scene of a splat without photos: place virtual cameras around it and render them."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ...dataset.loading.source_kind import SPLAT
from ...dataset.loading.splat_cameras import (
    NO_PHOTOS_HINT,
    NO_PHOTOS_WARNING,
    cameras_on_spheres,
    scene_frame,
    splat_extent,
)
from ...dataset.readers.splat_header import is_splat_path
from ...dataset.scene import Scene, View
from ...files import write_bytes
from ...progress import Progress
from ...report_warning import ReportWarning
from ..store.job_file import JobFile

MAX_START_POINTS = 30_000
"""Centres of at most this many opaque Gaussians serve as sparse points."""

MIN_START_OPACITY = 0.5
"""Minimum opacity of Gaussians that serve as sparse points."""


def start_splat_of(job: JobFile) -> Path | None:
    """Return the splat that a job's training starts from: the setting, or the input itself."""
    if job.settings.start_splat:
        return Path(job.settings.start_splat)
    source = Path(job.source)
    return source if is_splat(source) else None


def is_splat(source: Path) -> bool:
    """Tell whether an input is a splat file."""
    return source.is_file() and is_splat_path(source)


def make_splat_scene(source: Path, folder: Path, progress: Progress, *, threads: int = 0) -> Scene:
    """Render a splat from virtual cameras into ``folder/images`` and return the scene.

    The scene frame keeps the axes of the file. The background is black, as in training.

    Raises
    ------
    ParseError, DatasetError
        The file is not a splat, or has no visible Gaussian.
    """
    import torch

    from ...gaussians.foreign_splat import read_foreign_splat
    from ...gaussians.initialisation import SH_C0
    from ...render.render import render
    from ...render.types.options import RenderOptions
    from ...training.initialisation.splat_start import baked, fit_filter
    from ...training.initialisation.splat_transform import transform_gaussians, within_reach

    progress.update(0.0, "reading the splat")
    splat = read_foreign_splat(source)
    world = baked(splat.gaussians)
    means, opacities = world.means.numpy(), torch.sigmoid(world.opacity_logits).numpy()
    extent = splat_extent(means, opacities)
    file_cameras = cameras_on_spheres(extent)
    scene_from_world = scene_frame(file_cameras)
    cameras = [camera.moved(scene_from_world) for camera in file_cameras]
    moved, _ = within_reach(transform_gaussians(world, scene_from_world))  # training warns of it
    gaussians = fit_filter(moved, cameras, threads=threads)
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    options = RenderOptions(depth=False, threads=threads)
    views = []
    for index, camera in enumerate(cameras):
        progress.update(index / len(cameras), f"rendering view {index + 1} of {len(cameras)}")
        with torch.no_grad():
            color = render(gaussians, camera, options).color.numpy()
        path = images / camera.name
        write_bytes(path, _png(color))
        views.append(View(camera, path))
    with np.errstate(over="ignore"):
        near = np.linalg.norm(means - extent.center, axis=1) <= extent.radius
    chosen = np.nonzero((opacities >= MIN_START_OPACITY) & near)[0]
    chosen = chosen[:: max(1, -(-len(chosen) // MAX_START_POINTS))]
    colors = np.clip(0.5 + SH_C0 * world.sh[chosen, 0].numpy(), 0.0, 1.0)  # (m, 3)
    warnings = [*splat.warnings, ReportWarning("without-photos", NO_PHOTOS_WARNING, NO_PHOTOS_HINT)]
    if extent.has_surroundings:
        text = "The splat reaches far beyond its middle; only the middle is covered by the views."
        warnings.append(ReportWarning("surroundings-not-covered", text))
    facts = {"kind": SPLAT, "views": len(views), "points": len(chosen), **splat.facts}
    progress.update(1.0, f"{len(views)} views are rendered")
    return Scene(
        tuple(views),
        scene_from_world.points(means[chosen]),
        np.round(255.0 * colors).astype(np.uint8),
        scene_from_world.inverse(),
        tuple(warnings),
        facts,
    )


def _png(color: np.ndarray) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    pixels = np.round(255.0 * np.clip(color, 0.0, 1.0)).astype(np.uint8)
    Image.fromarray(pixels).save(stream, "PNG", compress_level=1)
    return stream.getvalue()
