# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the vacancy field of a region with the job's cameras, masks and unseen space."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...devices import DeviceChoice, stage_device
from ...devices.failures import is_device_failure
from ...errors import DatasetError, WrapError
from ...names import AUTOMATIC_REGIONS

if TYPE_CHECKING:
    from ...dataset.photo_source import PhotoSource
    from ...dataset.scene import Scene
    from ...field.vacancy.vacancy import VacancyField
    from ...gaussians.model import GaussianArrays, OrientedGaussians
    from ...meshing.tiles.plan import Field
    from ...regions.convex_region import Region
    from ...settings import MeshingSettings, TrainingSettings
    from ..store.job_file import JobFile
    from ..store.stage_folder import Stage

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RegionInputs:
    """What the mesh of a region is made from."""

    scene: Scene
    gaussians: OrientedGaussians
    arrays: GaussianArrays
    region: Region
    """Scene frame."""
    world_region: Region
    field: Field


def load_region(
    job: JobFile, request: str, cameras: Stage, trained: Stage, device: DeviceChoice, threads: int
) -> RegionInputs:
    """Load a finished training and build the field of a region from it.

    Parameters
    ----------
    request : str
        The region's entry in the job's settings.
    device : DeviceChoice
        Where vacancy is evaluated, if it fits there.

    Raises
    ------
    ParseError, DatasetError
        A file of the stages is damaged or missing.
    DeviceError
        As :func:`field_device`.
    """
    from ...dataset.refined_scene import load_refined_scene
    from ...field.vector_field import VectorField
    from ...gaussians.gaussian_file import load_gaussians
    from ...meshing.tiles.plan import Field

    scene = load_refined_scene(cameras.folder, trained.folder)
    gaussians = load_gaussians(trained.folder / "gaussians.npz")
    arrays = gaussians.arrays()
    body = job.region_bodies.get(request)
    region, world_region = requested_region(request, body, scene, arrays)
    vacancy = region_field(
        scene, arrays, region, job.settings.training, job.meshing_of(request), threads=threads,
        device=field_device(device, job.settings.device, arrays).device,
    )  # fmt: skip
    field = Field(vacancy, VectorField(arrays, threads=threads), threads)
    return RegionInputs(scene, gaussians, arrays, region, world_region, field)


def requested_region(
    request: str, body: Any, scene: Scene, arrays: GaussianArrays | None
) -> tuple[Region, Region]:
    """Return the requested region in the scene frame, on its grid, and in the world frame.

    The world-frame region of a file is returned as read: transforming it to the scene frame and
    back would change its last digits each time.

    Parameters
    ----------
    request : str
        ``"auto"``, ``"all"`` or the path of a region file.
    body : object
        Content of that file.
    arrays : GaussianArrays, optional
        Of the training; only the region ``"all"`` needs them.
    """
    from ...regions.automatic_region import automatic_region, whole_region
    from ...regions.region import parse_region
    from ...regions.scene_region import on_scene_grid, region_in_scene

    if request in AUTOMATIC_REGIONS:
        if request == "auto":
            region = automatic_region(scene)
        else:
            assert arrays is not None
            region = whole_region(scene, arrays)
        region = on_scene_grid(region)
        return region, region.transformed(scene.world_from_scene)
    world_region = parse_region(body, Path(request))
    return region_in_scene(world_region, scene.world_from_scene), world_region


def reject_short_edges(job: JobFile, cameras: Path) -> None:
    """Refuse edges far too short for their region, which would else fail after the training.

    The region of all Gaussians is known only then, and is left out.

    Parameters
    ----------
    cameras : Path
        Folder of the finished cameras stage.

    Raises
    ------
    ResourceError
        Names the region.
    """
    from ...dataset.scene_file import load_saved_scene
    from ...meshing.points.resolution import checked_request

    lengths = {
        request: meshing.edge_length
        for request in job.settings.regions
        if (meshing := job.meshing_of(request)).method == "pam" and request != "all"
    }
    if not any(lengths.values()):
        return
    scene = load_saved_scene(cameras)
    for request, length in lengths.items():
        region, _ = requested_region(request, job.region_bodies.get(request), scene, None)
        checked_request(length / scene.world_from_scene.scale, 0, region)


def field_views(scene: Scene, photos: PhotoSource, holdout_every: int, cameras: str) -> list[int]:
    """Return the views whose cameras a mesh is made from (docs/method.md, section 5.3).

    Parameters
    ----------
    holdout_every : int
        Setting of the training.
    cameras : str
        Setting of the meshing: ``"training"`` leaves out held-out photos and photos that their
        masks cover; ``"all"`` uses every camera.

    Raises
    ------
    DatasetError
        No camera is left.
    """
    from ...dataset.view_split import training_views

    if cameras == "all":
        return list(range(len(scene.views)))
    views = training_views(scene, photos, holdout_every)
    if not views:
        raise DatasetError(
            "The masks cover every photo that was trained on.",
            "Check the masks, or mesh with the cameras of all photos.",
        )
    return views


def field_device(chosen: DeviceChoice, setting: str, arrays: GaussianArrays) -> DeviceChoice:
    """Return where the field of these Gaussians is evaluated: the job's device if it fits there.

    Raises
    ------
    DeviceError
        As :func:`~...devices.choice.stage_device`.
    """
    if not chosen.is_cuda:
        return chosen
    from ...field.vacancy.cuda_vacancy import needed_bytes

    return stage_device(chosen, setting, needed_bytes(len(arrays)), "Vacancy")


def region_field(
    scene: Scene,
    arrays: GaussianArrays,
    region: Region,
    training: TrainingSettings,
    meshing: MeshingSettings,
    *,
    threads: int,
    device: str = "cpu",
) -> VacancyField:
    """Return the field in and around a region, limited to the mesher's halo.

    Parameters
    ----------
    region : Region
        Scene frame.
    training : TrainingSettings
        ``mask_mode``, ``holdout_every`` and the size of the photos that masks are read at.
    meshing : MeshingSettings
        ``unseen`` and ``cameras`` are read.
    device : str
        Torch device of the field, from :func:`field_device`. If the kernels of a GPU cannot run,
        the field is evaluated on the processor and the log says why.

    Raises
    ------
    DatasetError
        A mask does not fit its photo, or masks cover every photo that was trained on.
    """
    from ...dataset.photos.photo_store import PhotoStore
    from ...field.vacancy.photo_masks import PackedMask
    from ...field.vacancy.vacancy import VacancyField
    from ...meshing.points.candidate_surface import halo_bounds

    photos = PhotoStore(scene, training.max_image_px)
    views = field_views(scene, photos, training.holdout_every, meshing.cameras)
    cameras = [scene.views[index].camera for index in views]
    options: dict[str, Any] = {
        "threads": threads,
        "unseen": meshing.unseen,
        "region_bounds": halo_bounds(region),
        "masks": [PackedMask.of(photos.mask(index)) for index in views],
        "mask_mode": scene.mask_mode(training.mask_mode),
    }
    if device.startswith("cuda"):
        from ...field.vacancy.cuda_vacancy import CudaVacancyField

        try:
            return CudaVacancyField(arrays, cameras, device=device, **options)
        except (WrapError, RuntimeError) as error:
            if not is_device_failure(error):
                raise
            reason = getattr(error, "message", error)
            _logger.warning("Vacancy is evaluated on the processor, not on the GPU: %s", reason)
    return VacancyField(arrays, cameras, **options)


def field_figures(field: VacancyField) -> dict[str, Any]:
    """Return the report's figures of a field: device, cameras, evaluations, what is unseen."""
    return {
        "field_device": field.device,
        "field_cameras": len(field.cameras),
        "unseen": field.unseen,
        "field_evaluations": field.evaluations,
        "unseen_evaluations": field.unseen_evaluations,
    }
