# SPDX-License-Identifier: GPL-3.0-or-later
"""The vacancy that a region is meshed from: masks and unseen space as the job says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from ..dataset.scene import Scene
    from ..field.vacancy import VacancyField
    from ..gaussians.model import GaussianArrays
    from ..meshing.convex_region import Region
    from ..settings import MeshingSettings, TrainingSettings


def region_field(
    scene: Scene,
    arrays: GaussianArrays,
    region: Region,
    training: TrainingSettings,
    meshing: MeshingSettings,
    *,
    threads: int,
) -> VacancyField:
    """Return the field in and around a region; it knows nothing beyond the mesher's halo.

    Parameters
    ----------
    region : Region
        Scene frame.
    training : TrainingSettings
        ``mask_mode`` and the size of the photos that masks are read at.
    meshing : MeshingSettings
        ``unseen`` is read.

    Raises
    ------
    DatasetError
        A mask does not fit its photo.
    """
    from ..dataset.photos import PhotoStore
    from ..field.photo_masks import MaskMode
    from ..field.vacancy import Unseen, VacancyField
    from ..meshing.candidate_surface import halo_bounds

    photos = PhotoStore(scene, training.max_image_px)
    return VacancyField(
        arrays,
        scene.cameras,
        threads=threads,
        unseen=cast(Unseen, meshing.unseen),
        region_bounds=halo_bounds(region),
        masks=[photos.mask(index) for index in range(len(photos))],
        mask_mode=cast(MaskMode, training.mask_mode),
    )


def field_figures(field: VacancyField) -> dict[str, Any]:
    """Return what the report tells of a field that was used: how much no camera saw."""
    return {
        "unseen": field.unseen,
        "field_evaluations": field.evaluations,
        "unseen_evaluations": field.unseen_evaluations,
    }
