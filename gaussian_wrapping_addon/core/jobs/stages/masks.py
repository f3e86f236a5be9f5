# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages that make masks."""

from __future__ import annotations

import dataclasses
import logging
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...devices import DeviceChoice
from ...errors import DatasetError, UsageError, WrapError
from ...files import read_bounded, write_bytes, write_json
from ...limits import MIN_IMAGES
from ...machine import helper_memory_limit_bytes
from ...masks import mask_folder
from ...progress import Progress, ReportWarning
from ...regions.shapes import Region
from ..store.job_file import JobFile, training_keys
from ..store.job_folder import JobFolder
from ..store.stage_folder import STAGE_VERSIONS, Stage, read_done, run_stage, stage_key
from .cameras import (
    MASKED,
    is_whole_scene,
    regions_listed,
    saved_scene,
    scene_of_finished_training,
)
from .training import compile_if_needed

if TYPE_CHECKING:
    from ...gaussians.model import OrientedGaussians
    from ...render.types import Renderer
    from ...scene.camera import Camera
    from ...scene.scene import Scene


# -- Masks of what stands in regions: a short training, and its silhouettes in the photos ---------

_logger = logging.getLogger(__name__)

COARSE: dict[str, Any] = {
    "iterations": 500, "extra_iterations": 0, "max_gaussians": 20_000, "max_image_px": 320,
    "sh_degree": 0, "holdout_every": 0, "harmonics": "off", "multi_view": "off", "wrapping": "off",
    "growth": "on", "full_size": "on", "dense_start": "off", "refine_poses": "off",
    "region_weight": 1.0, "focus": "", "preview_every_s": 0.0,
}  # fmt: skip
"""Settings of the short training: silhouettes need neither detail nor directions. Exposure and the
constants of the method are the job's, but nothing is pruned. All are in the key of the masks."""
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
    scene: Scene, job: JobFile, folder: Path, progress: Progress, *, threads: int,
    device: DeviceChoice,
) -> None:  # fmt: skip
    """Write ``000000.png``, ... of the scene's views; the training in ``folder`` is resumed.

    Raises DatasetError: the short training has nothing in the regions.
    """
    import torch

    from ...devices.checks import with_renderer
    from ...masks.making import silhouettes
    from ...masks.segmentation import GROWN_SHARE, cleaned, encoded

    gaussians = _coarse_training(
        scene, job, folder / "coarse", progress.span(0.0, _TRAINED), threads, device
    )
    regions = regions_listed(job.settings.mask_regions, scene)
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
            mask = cleaned(next(shares), (view.camera.width, view.camera.height), GROWN_SHARE)
            write_bytes(folder / f"{index:06d}.png", encoded(mask))

    with_renderer(device.device, "Silhouettes", write)


def _limited(camera: Camera) -> Camera:
    factor = SILHOUETTE_PX / max(camera.width, camera.height)
    if factor >= 1.0:
        return camera
    width, height = round(camera.width * factor), round(camera.height * factor)
    return camera.resized(max(1, width), max(1, height))


def _inside(regions: list[Region], gaussians: OrientedGaussians) -> np.ndarray:
    """Tell which Gaussians are in regions, (n,) int8: 1, 0, or -1 for fog in there."""
    means = gaussians.means.detach().cpu().double().numpy()
    sizes = gaussians.scales().detach().cpu().numpy().max(1)
    found = np.zeros(len(means), np.int8)
    for region in regions:
        small = sizes < MOST_SIZE_SHARE * region.diagonal
        found = np.where(region.contains(means, 0.0) & (found != 1), np.where(small, 1, -1), found)
    return found


def _coarse_training(
    scene: Scene, job: JobFile, folder: Path, progress: Progress, threads: int, device: DeviceChoice
) -> OrientedGaussians:
    from ...gaussians.files import load_gaussians, save_gaussians
    from ...masks.making import with_background
    from ...photos.store import PhotoStore
    from ...training.device_backend import chosen_backend
    from ...training.trainer import train

    done = folder / "gaussians.npz"
    if done.is_file():
        return load_gaussians(done)
    settings = dataclasses.replace(
        job.settings.training, **COARSE, prune_share=0.0, overlap_price=0.0
    )
    folder.mkdir(exist_ok=True)
    compile_if_needed(settings, folder, progress, threads, device)
    photos = PhotoStore(scene, settings.max_image_px)
    result = train(
        with_background(scene, photos, seed=job.settings.seed), photos, settings, folder, progress,
        seed=job.settings.seed, threads=threads,
        backend=chosen_backend(device.device, threads, or_processor=job.settings.device == "auto"),
    )  # fmt: skip
    save_gaussians(done, result.gaussians)
    return result.gaussians


# -- Masks stages: make masks once, put them where people can edit them, and use what is left -----

SECONDS_A_PHOTO = 120.0
"""Of a mask model, at most: a large one needs some 20 s on one slow core."""
_KEPT_SHARE = 1e-4
"""Of a photo, at least: those whose mask keeps less do not show the object."""
_MAKE_HINT = "Check the region, or the masks in the folder masks of the job."
_OWN_HINT = (
    "Leave one of the two out, or give --set mask_mode=background if your masks leave out all but "
    "the object."
)


def run_masks(
    folder: JobFolder, job: JobFile, cameras: Stage, progress: Progress, *, threads: int,
    device: DeviceChoice,
) -> Stage:  # fmt: skip
    """Return the stage whose scene has the job's made masks; ``cameras`` where none are made.

    Masks are made once and put into the job's folder ``masks``. What is there when a training
    begins counts: edited files, deleted ones, and those that ``masks.json`` rejects. ``mesh``,
    ``bake`` and ``more`` use the masks of the finished training even if they have changed since.
    Raises DatasetError, UsageError, ResourceError: masks cannot be made, or too few photos are
    left.
    """
    if not job.settings.masks_are_made or cameras.name == MASKED:
        return cameras
    of_finished = job.command in ("mesh", "more", "bake")
    if of_finished and not _are_made(folder, job, cameras):  # the model may be gone by now
        earlier = scene_of_finished_training(folder, job)
        if earlier is not None:
            return earlier
    made = _run_making(folder, job, cameras, progress.span(0.0, 0.95), threads, device)
    masks = _list_of(folder, cameras, made)
    where = mask_folder.publish(folder.root, made.folder, masks)
    masks = mask_folder.read_list(where) or masks
    key = stage_key(STAGE_VERSIONS[MASKED], cameras.key, mask_folder.digest(where, masks))
    if of_finished:
        train_key, _ = training_keys(key, job)
        if read_done(folder.stages / f"train-{train_key}") is None:
            earlier = scene_of_finished_training(folder, job)
            if earlier is not None:
                _logger.warning(
                    "the masks have changed since the training: the mesh is of the training as it "
                    "is. To train anew, run wrap."
                )
                return earlier

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        return _write_masked_scene(stage_folder, cameras, where, masks)

    stage = run_stage(
        folder.stages, MASKED, key, progress.span(0.95, 1.0), work, whole=is_whole_scene
    )
    return dataclasses.replace(stage, before=(cameras, made))


def _making_key(job: JobFile, cameras: Stage) -> str:
    """Return the key of the masks. Constants of the method are left out: edited masks stay."""
    settings = job.settings
    if settings.mask_model:
        mask_folder.check_model_file(Path(settings.mask_model))
        state = Path(settings.mask_model).stat()
        how = [settings.mask_model, state.st_size, state.st_mtime_ns, settings.mask_model_range]
    else:
        how = [settings.mask_regions, settings.seed, COARSE]
    return stage_key(STAGE_VERSIONS["masks"], cameras.key, how)


def _are_made(folder: JobFolder, job: JobFile, cameras: Stage) -> bool:
    try:
        key = _making_key(job, cameras)
    except WrapError:
        return False
    return read_done(folder.stages / f"masks-{key}") is not None


def _run_making(
    folder: JobFolder, job: JobFile, cameras: Stage, progress: Progress, threads: int,
    device: DeviceChoice,
) -> Stage:  # fmt: skip
    settings = job.settings
    key = _making_key(job, cameras)

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        from ...scene.scene import load_saved_scene

        scene = load_saved_scene(cameras.folder)
        own = sum(view.mask_path is not None for view in scene.views)
        if own and scene.mask_mode(settings.training.mask_mode) != "background":
            raise UsageError(
                f"{own} of {len(scene.views)} photos have masks of their own, which may hide the "
                "object: no masks are made for them.",
                _OWN_HINT,
            )
        if settings.mask_model:
            photos = [os.path.abspath(view.photo_path) for view in scene.views]
            _run_model(job, photos, stage_folder, progress, threads)
        else:
            make_region_masks(scene, job, stage_folder, progress, threads=threads, device=device)
        return {"masks": len(scene.views)}

    def whole(stage_folder: Path) -> bool:
        count = (read_done(stage_folder) or {}).get("masks", 0)
        return all((stage_folder / f"{index:06d}.png").is_file() for index in range(count))

    return run_stage(folder.stages, "masks", key, progress, work, whole=whole)


def _run_model(
    job: JobFile, photos: list[str], folder: Path, progress: Progress, threads: int
) -> None:
    """Load the job's model, and mask photos with it."""
    from ...worker.helper_process import run_helper

    settings = job.settings
    task = {
        "model": settings.mask_model, "range": settings.mask_model_range, "threads": threads,
        "photos": photos,
    }  # fmt: skip
    write_json(folder / "task.json", task)
    run_helper(
        "masks.model_helper", folder, progress, memory_bytes=helper_memory_limit_bytes(),
        deadline_s=SECONDS_A_PHOTO * (5 + len(photos) if photos else 1),
    )  # fmt: skip


def check_mask_model(job: JobFile, folder: JobFolder, progress: Progress) -> None:
    """Load the job's mask model and raise if it is none, before photos are read.

    Raises UsageError, DatasetError, ResourceError: the model cannot be used.
    """
    if not job.settings.mask_model or job.command != "wrap":
        return
    if any(read_done(path) is not None for path in folder.stages.glob("masks-*")):
        return  # it may be resumed where the model is no longer; else it is checked when it runs
    progress.update(0.0, "loading the mask model")
    with tempfile.TemporaryDirectory() as temporary:
        _run_model(job, [], Path(temporary), progress, 1)


def _list_of(folder: JobFolder, cameras: Stage, made: Stage) -> mask_folder.MaskList:
    from ...scene.scene import load_saved_scene

    views = load_saved_scene(cameras.folder).views
    names = [view.camera.name for view in views]
    entries = []
    for view, name, file in zip(views, names, mask_folder.mask_names(names), strict=True):
        path, root = view.photo_path, folder.root
        inside = path.is_relative_to(root)
        image = path.relative_to(root).as_posix() if inside else str(path)
        entries.append(mask_folder.MadeMask(name, file, image))
    return mask_folder.MaskList(made.key, tuple(entries))


def _write_masked_scene(
    stage_folder: Path, cameras: Stage, where: Path, masks: mask_folder.MaskList
) -> dict[str, Any]:
    """Copy masks and scene, without the photos that are left out."""

    from ...masks.segmentation import encoded
    from ...photos.photo_file import MASK_THRESHOLD, read_mask
    from ...scene.scene import MASKS_MADE, load_saved_scene

    scene = load_saved_scene(cameras.folder)
    files = {mask.photo: path for mask, path in mask_folder.used_masks(where, masks)}
    views, empty = [], []
    for index, view in enumerate(scene.views):
        path = files.get(view.camera.name)
        if path is None:
            continue
        copy = stage_folder / f"{index:06d}.png"
        write_bytes(copy, read_bounded(path, mask_folder.MOST_MASK_BYTES))
        kept = read_mask(copy, upright=False) >= MASK_THRESHOLD
        if kept.shape != (view.camera.height, view.camera.width):
            raise DatasetError(
                f"The mask {path} is {kept.shape[1]} x {kept.shape[0]} pixels, its photo "
                f"{view.camera.width} x {view.camera.height}.",
                "Save it in the photo's size, or delete it: its photo is left out then.",
            )
        if view.mask_path is not None:
            kept &= read_mask(view.mask_path, upright=False) >= MASK_THRESHOLD
        if kept.mean() < _KEPT_SHARE:
            empty.append(view.camera.name)
            continue
        write_bytes(copy, encoded(kept))
        # Relative to this stage, so that the job folder can be moved.
        photo = view.photo_path
        if photo.is_relative_to(cameras.folder):
            photo = Path(os.path.relpath(photo, stage_folder))
        views.append(dataclasses.replace(view, photo_path=photo, mask_path=copy))
    if len(views) < MIN_IMAGES:
        raise DatasetError(
            f"Masks leave {len(views)} of {len(scene.views)} photos; at least {MIN_IMAGES} are "
            "needed.",
            _MAKE_HINT,
        )
    rejected = len(scene.views) - len(views) - len(empty)
    facts = {**scene.facts, "views": len(views), MASKS_MADE: len(views)}
    facts |= {"photos_rejected": rejected} if rejected else {}
    warnings = list(scene.warnings)
    if empty:
        listed = ", ".join(empty[:3]) + (" ..." if len(empty) > 3 else "")
        text = f"{len(empty)} photos do not show the object and are not used: {listed}."
        warnings.append(ReportWarning("photos-without-object", text, _MAKE_HINT))
    masked = dataclasses.replace(scene, views=tuple(views), facts=facts, warnings=tuple(warnings))
    return saved_scene(masked, stage_folder)
