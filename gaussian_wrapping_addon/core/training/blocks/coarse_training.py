# SPDX-License-Identifier: GPL-3.0-or-later
"""The coarse training of a whole scene: what all blocks start from and do not decide anew."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene
from ...errors import ParseError
from ...gaussians.model import OrientedGaussians
from ...progress import Progress
from ...report_warning import ReportWarning
from ...settings import TrainingSettings
from ...stereo.depth_maps import matching_divisor
from ...stereo.depth_priors import FILE_NAME, DepthPrior, load_priors
from ..appearance.photo_exposure import Exposure
from ..checkpoint import fingerprint, load_checkpoint
from ..devices.backend import Backend
from ..rounds import Inside
from ..selection.model_selection import ModelSelection
from ..trainer import train


@dataclass(frozen=True, eq=False)
class CoarseTraining:
    """Gaussians of the whole scene, and all that was decided about its model."""

    gaussians: OrientedGaussians
    """float32, scene frame, without harmonics that are not used, and without a backdrop."""
    model_selection: ModelSelection
    exposure: Exposure | None
    """Exposures of all views, or ``None`` where they are not modelled."""
    poses: np.ndarray | None
    """(views, 3, 4) float64 refined ``cam_from_world``, or ``None`` where those given hold."""
    key: str
    """Names its inputs: the confirmed depths in its folder carry it."""
    warnings: tuple[ReportWarning, ...] = ()
    """Of the training; none in a plan that was read from its file."""


def train_coarse(
    scene: Scene,
    photos: PhotoSource,
    settings: TrainingSettings,
    folder: Path,
    progress: Progress,
    *,
    seed: int = 0,
    threads: int = 0,
    inside: Inside | None = None,
    backend: Backend | None = None,
) -> CoarseTraining:
    """Train the whole scene coarsely, or read a finished such training of the same folder.

    Parameters
    ----------
    scene, photos, folder, progress, seed, threads, inside, backend
        As for :func:`~..trainer.train`; photos at the size of the settings.
    settings : TrainingSettings
        Those of :meth:`~.block_settings.BlockSettings.coarse`.

    Raises
    ------
    Cancelled, DatasetError, UsageError, ParseError, WrapError
        As by :func:`~..trainer.train`.
    """
    result = train(
        scene, photos, settings, folder, progress,
        seed=seed, threads=threads, inside=inside, backend=backend,
    )  # fmt: skip
    settings = dataclasses.replace(settings, mask_mode=scene.mask_mode(settings.mask_mode))
    key = fingerprint(scene, settings, seed)
    state = load_checkpoint(folder, key)
    if state is None:
        raise ParseError(
            folder, "checkpoint", "was removed while the training ended.", "Train again."
        )
    own = torch.arange(len(state.adam))  # what lies behind them is the backdrop
    return CoarseTraining(
        result.gaussians.select(own),
        state.model_selection,
        state.exposure,
        result.poses,
        key,
        result.warnings,
    )


def confirmed_depths(
    coarse: CoarseTraining,
    folder: Path,
    photos: PhotoSource,
    settings: TrainingSettings,
    all_views: Sequence[int],
    views: Sequence[int],
) -> dict[int, DepthPrior]:
    """Read the depths that a dense start of the coarse training confirmed for some views.

    Parameters
    ----------
    folder : Path
        Of the coarse training.
    photos : PhotoSource
        As it was trained on.
    settings : TrainingSettings
        Of the coarse training.
    all_views, views : sequence of int
        All training views, and those to read.

    Returns
    -------
    dict of int to DepthPrior
        Empty without a dense start, or where the settings have no use for depths.

    Raises
    ------
    ParseError
        The file is missing, damaged or of another training.
    """
    wanted = settings.lambda_depth_prior > 0.0 or settings.free_views > 0
    if not (wanted and coarse.model_selection.chose("dense_start")):
        return {}
    divisor = matching_divisor([photos.camera(view, 1) for view in all_views], settings.match_px)
    cameras = {view: photos.camera(view, divisor) for view in all_views}
    priors = load_priors(folder, cameras, coarse.key, views)
    if priors is None:
        raise ParseError(
            folder / FILE_NAME, "whole file", "missing, damaged, or of another training.",
            "Delete the folder of the coarse training and train again.",
        )  # fmt: skip
    return priors
