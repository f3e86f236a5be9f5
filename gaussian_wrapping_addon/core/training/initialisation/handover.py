# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training takes over from another one, instead of starting and deciding for itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ...gaussians.model import OrientedGaussians
from ...stereo.depth_priors import DepthPrior
from ..appearance.photo_exposure import Exposure
from ..selection.model_selection import ModelSelection


@dataclass(frozen=True)
class Handover:
    """Gaussians and decisions of a training that another one goes on with.

    Camera poses are those of the scene: give one with the poses that the first training refined.
    """

    gaussians: OrientedGaussians
    """float32, scene frame, of the settings' degree of harmonics."""
    degree: int
    """Degree of the harmonics in use."""
    iteration: int
    """Position in the schedule of the settings at which the training begins."""
    model_selection: ModelSelection
    exposure: Exposure | None
    """Exposures of all views, which stay as they are; ``None`` where they are not modelled."""
    digest: str
    """Names all of this: a checkpoint of another handover is refused."""
    frozen: int = 0
    """So many Gaussians, the first ones, are context: rendered, never changed, not in the result of
    a part."""
    rate_factor: float = 1.0
    """Factor on the learning rates."""
    priors: Mapping[int, DepthPrior] = field(default_factory=dict)
    """Confirmed depths, by view."""
    views: tuple[int, ...] | None = None
    """Views of a training of a part of the scene, which measures nothing and makes no backdrop;
    ``None``: the scene's, as the settings split them."""
    filter_views: tuple[int, ...] | None = None
    """Views whose pixels the 3D filter follows; ``None``: the training views."""
