# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the vacancy field of a region with the job's masks and handling of unseen space."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import DeviceError
from ...names import AUTOMATIC_REGIONS

if TYPE_CHECKING:
    from ...dataset.scene import Scene
    from ...field.vacancy.vacancy import VacancyField
    from ...gaussians.model import GaussianArrays
    from ...regions.convex_region import Region
    from ...settings import MeshingSettings, TrainingSettings

_logger = logging.getLogger(__name__)


def requested_region(
    request: str, body: Any, scene: Scene, arrays: GaussianArrays
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
    """
    from ...regions.automatic_region import automatic_region, whole_region
    from ...regions.region import parse_region
    from ...regions.scene_region import on_scene_grid, region_in_scene

    if request in AUTOMATIC_REGIONS:
        region = automatic_region(scene) if request == "auto" else whole_region(scene, arrays)
        region = on_scene_grid(region)
        return region, region.transformed(scene.world_from_scene)
    world_region = parse_region(body, Path(request))
    return region_in_scene(world_region, scene.world_from_scene), world_region


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
        ``mask_mode`` and the size of the photos that masks are read at.
    meshing : MeshingSettings
        ``unseen`` is read.
    device : str
        Torch device that the Gaussians were trained on. On a GPU the field is evaluated there too;
        if its kernels cannot run, it is evaluated on the CPU and the log says why.

    Raises
    ------
    DatasetError
        A mask does not fit its photo.
    """
    from ...dataset.photos.photo_store import PhotoStore
    from ...field.vacancy.vacancy import VacancyField
    from ...meshing.points.candidate_surface import halo_bounds

    photos = PhotoStore(scene, training.max_image_px)
    options: dict[str, Any] = {
        "threads": threads,
        "unseen": meshing.unseen,
        "region_bounds": halo_bounds(region),
        "masks": [photos.mask(index) for index in range(len(photos))],
        "mask_mode": training.mask_mode,
    }
    if device.startswith("cuda"):
        from ...field.vacancy.cuda_vacancy import CudaVacancyField

        try:
            return CudaVacancyField(arrays, scene.cameras, device=device, **options)
        except DeviceError as error:
            _logger.warning(
                "Vacancy is evaluated on the processor, not on the GPU: %s", error.message
            )
    return VacancyField(arrays, scene.cameras, **options)


def field_figures(field: VacancyField) -> dict[str, Any]:
    """Return the report's figures of a field: device, evaluations, and share that is unseen."""
    return {
        "field_device": field.device,
        "unseen": field.unseen,
        "field_evaluations": field.evaluations,
        "unseen_evaluations": field.unseen_evaluations,
    }
