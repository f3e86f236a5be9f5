# SPDX-License-Identifier: GPL-3.0-or-later
"""The decisions on the model that need no training, and those made by settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene
from ...settings import TrainingSettings
from ..appearance.photo_exposure import Exposure
from .exposure_selection import select_exposure
from .model_selection import Decision, ModelSelection, decide, select_multi_view


def first_decisions(
    scene: Scene,
    photos: PhotoSource,
    views: Sequence[int],
    neighbours: Mapping[int, np.ndarray],
    settings: TrainingSettings,
    image_size: Decision,
    *,
    from_splat: bool,
) -> tuple[ModelSelection, Exposure | None]:
    """Decide on exposure, multi-view terms, harmonics, wrapping and growth, as far as possible now.

    Parameters
    ----------
    views : sequence of int
        Training views.
    neighbours : mapping of int to (n,) int
        Views beside each of them.
    image_size : Decision
        Made before.
    from_splat : bool
        Whether the training starts from a splat, which has harmonics of its own.
    """
    found = select_exposure(scene, photos, views)
    selection = ModelSelection((image_size,)).with_decision(
        decide("exposure", settings.exposure, found.needed, found.evidence)
    )
    exposure = None
    if selection.chose("exposure"):
        exposure = Exposure(len(scene.views), views, found.log_gains)
    pairs = [neighbours[view] for view in views]
    selection = selection.with_decision(select_multi_view(pairs, settings.multi_view))
    if settings.harmonics != "auto" or settings.sh_degree == 0 or from_splat:
        degree = settings.sh_degree if settings.harmonics != "off" else 0
        why = "the splat has harmonics of its own." if from_splat else "decided by the settings."
        selection = selection.with_decision(
            Decision(
                "harmonics", settings.harmonics, f"degree {degree}", f"Not tried: {why}",
                measured=False,
            )
        )  # fmt: skip
    if settings.wrapping != "auto":
        selection = selection.with_decision(Decision.by_settings("wrapping", settings.wrapping))
    if settings.growth == "off":
        selection = selection.with_decision(Decision.by_settings("growth", "off"))
    return selection, exposure
