# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of what stands in regions: a short training, and its silhouettes in the photos."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...devices import DeviceChoice
from ...errors import DatasetError
from ...files import write_bytes
from ...progress import COMPILING, Progress
from ...regions.region import Region, parse_region
from ...regions.scene_region import region_in_scene
from ...settings import TrainingSettings
from ..store.job_file import JobFile

if TYPE_CHECKING:
    from ...dataset.camera import Camera
    from ...dataset.scene import Scene
    from ...gaussians.model import OrientedGaussians
    from ...render.types.renderer import Renderer

_logger = logging.getLogger(__name__)

COARSE: dict[str, Any] = {
    "iterations": 500, "extra_iterations": 0, "max_gaussians": 20_000, "max_image_px": 320,
    "sh_degree": 0, "holdout_every": 0, "harmonics": "off", "multi_view": "off", "wrapping": "off",
    "growth": "on", "full_size": "on", "dense_start": "off", "refine_poses": "off",
    "region_weight": 1.0, "focus": "", "preview_every_s": 0.0,
}  # fmt: skip
"""Settings of the short training: silhouettes need neither detail nor directions. Exposure and the
constants of the method are the job's."""
SILHOUETTE_PX = 800
"""Longest side of the rendered silhouettes."""
MOST_SIZE_SHARE = 0.1
"""Largest standard deviation of a Gaussian of the object, over the region's diagonal. Larger ones
are fog in front of a plain background, whose centres may lie anywhere; they hide nothing."""
_TRAINED = 0.85
"""Share of the progress that training takes."""
_HINT = (
    "Check that the region's box stands around the object: it is in the world coordinates of the "
    "input."
)


def make_region_masks(
    scene: Scene,
    job: JobFile,
    folder: Path,
    progress: Progress,
    *,
    threads: int,
    device: DeviceChoice,
) -> None:
    """Write ``000000.png``, ... of the scene's views; the training in ``folder`` is resumed.

    Raises
    ------
    DatasetError
        The short training has nothing in the regions.
    """
    import torch

    from ...devices.whole_views import with_renderer
    from ...masks.cleaning import GROWN_SHARE, cleaned, encoded
    from ...masks.silhouettes import silhouettes

    gaussians = _coarse_training(
        scene, job, folder / "coarse", progress.span(0.0, _TRAINED), threads, device
    )
    regions = _regions(job, scene)
    side = _inside(regions, gaussians)
    gaussians = gaussians.select(torch.from_numpy(side >= 0))
    inside = side[side >= 0] == 1
    if not inside.any():
        raise DatasetError(
            "No mask can be made: the short training found nothing in the regions.", _HINT
        )
    _logger.info("masks: %d of %d Gaussians are in the regions", inside.sum(), len(inside))
    cameras = [_limited(view.camera) for view in scene.views]
    bounds = np.concatenate([region.vertices for region in regions])
    rendering = progress.span(_TRAINED, 1.0)

    def write(renderer: Renderer) -> None:
        shares = silhouettes(gaussians, inside, cameras, renderer, bounds=bounds, threads=threads)
        for index, view in enumerate(scene.views):
            rendering.update(index / len(cameras), f"masking photo {index + 1} of {len(cameras)}")
            size = (view.camera.width, view.camera.height)
            mask = cleaned(next(shares), size, GROWN_SHARE)
            write_bytes(folder / f"{index:06d}.png", encoded(mask))

    with_renderer(device.device, "Silhouettes", write)


def _limited(camera: Camera) -> Camera:
    factor = SILHOUETTE_PX / max(camera.width, camera.height)
    if factor >= 1.0:
        return camera
    width, height = round(camera.width * factor), round(camera.height * factor)
    return camera.resized(max(1, width), max(1, height))


def _regions(job: JobFile, scene: Scene) -> list[Region]:
    """Return the job's mask regions, scene frame."""
    return [
        region_in_scene(parse_region(body, Path("job.json")), scene.world_from_scene)
        for body in json.loads(job.settings.mask_regions)
    ]


def _inside(regions: list[Region], gaussians: OrientedGaussians) -> np.ndarray:
    """Tell which Gaussians are in regions, (n,) int8: 1, 0, or -1 for fog in there."""
    means = gaussians.means.detach().cpu().double().numpy()
    sizes = gaussians.scales().detach().cpu().numpy().max(1)
    found = np.zeros(len(means), np.int8)
    for region in regions:
        small = sizes < MOST_SIZE_SHARE * region.diagonal
        found = np.where(region.contains(means, 0.0) & (found != 1), np.where(small, 1, -1), found)
    return found


def coarse_settings(settings: TrainingSettings) -> TrainingSettings:
    """Return the settings of the short training of a job."""
    return dataclasses.replace(settings, **COARSE)


def _coarse_training(
    scene: Scene,
    job: JobFile,
    folder: Path,
    progress: Progress,
    threads: int,
    device: DeviceChoice,
) -> OrientedGaussians:
    from ...dataset.photos.photo_store import PhotoStore
    from ...gaussians.gaussian_file import load_gaussians, save_gaussians
    from ...masks.background_points import with_background
    from ...training.cost.machine_speed import renderer_is_compiled
    from ...training.devices.chosen import chosen_backend
    from ...training.trainer import train
    from ...training.warm_up import compile_kernels

    done = folder / "gaussians.npz"
    if done.is_file():
        return load_gaussians(done)
    settings = coarse_settings(job.settings.training)
    folder.mkdir(exist_ok=True)
    if not device.is_cuda and not renderer_is_compiled():
        progress.enter(COMPILING, "compiling the renderer, about a minute, only this once")
        compile_kernels(settings, folder, progress, threads=threads)
    photos = PhotoStore(scene, settings.max_image_px)
    result = train(
        with_background(scene, photos, seed=job.settings.seed), photos, settings, folder, progress,
        seed=job.settings.seed, threads=threads,
        backend=chosen_backend(device.device, threads, or_processor=job.settings.device == "auto"),
    )  # fmt: skip
    save_gaussians(done, result.gaussians)
    return result.gaussians
