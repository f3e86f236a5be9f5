# SPDX-License-Identifier: GPL-3.0-or-later
"""The Gaussians a training starts from: at dense points from stereo, or at the sparse points."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path

from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene
from ...gaussians.initialisation import initial_gaussians
from ...gaussians.model import OrientedGaussians
from ...progress import Progress
from ...settings import TrainingSettings
from ...stereo.depth_maps import matching_divisor
from ...stereo.depth_priors import DepthPrior, load_priors, priors_of, save_priors
from ..appearance.background import inside_masks
from ..selection.model_selection import Decision
from .dense_start import dense_start, matched_photos, on_planes

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class PointStart:
    """The start of one training at points of its scene.

    Parameters
    ----------
    views : list of int
        Training views.
    folder : Path
        Receives the confirmed depths of a dense start.
    divisor : int
        Of the photos in the first iterations.
    max_gaussians : int
        Largest number of Gaussians that density control leads to.
    """

    scene: Scene
    photos: PhotoSource
    views: list[int]
    settings: TrainingSettings
    folder: Path
    divisor: int
    max_gaussians: int
    seed: int
    threads: int

    def gaussians(
        self, key: str, progress: Progress
    ) -> tuple[OrientedGaussians, Decision, dict[int, DepthPrior]]:
        """Return the Gaussians, whether they are at dense points and why, and confirmed depths.

        Parameters
        ----------
        key : str
            Names the training: the file of confirmed depths carries it.
        """
        scene, settings = self._start_scene(), self.settings
        decision = Decision.by_settings("dense_start", "off")
        if settings.dense_start != "off":
            start = dense_start(
                scene, self.photos, self.views, settings.dense_start, progress.span(0.0, 0.0),
                side_px=settings.match_px, max_gaussians=self.max_gaussians,
                sh_degree=settings.sh_degree, seed=self.seed, threads=self.threads,
            )  # fmt: skip
            if start.gaussians is not None:
                priors = start.priors if self.uses_priors else {}
                if priors:
                    save_priors(self.folder, priors, key)
                return start.gaussians, start.decision, dict(priors)
            decision = start.decision
        sparse = initial_gaussians(
            scene,
            self.views,
            lambda i: (
                self.photos.camera(i, self.divisor),
                self.photos.photo(i, self.divisor),
                self.photos.mask(i, self.divisor),
            ),
            max_gaussians=self.max_gaussians,
            sh_degree=settings.sh_degree,
            seed=self.seed,
        )
        return sparse, decision, {}

    @property
    def uses_priors(self) -> bool:
        """Whether the settings have a use for confirmed depths."""
        return self.settings.lambda_depth_prior > 0.0 or self.settings.free_views > 0

    def saved_priors(self, key: str, progress: Progress) -> dict[int, DepthPrior]:
        """Return the confirmed depths of an earlier dense start; lost ones are made again."""
        full = [self.photos.camera(view, 1) for view in self.views]
        divisor = matching_divisor(full, self.settings.match_px)
        cameras = {view: self.photos.camera(view, divisor) for view in self.views}
        priors = load_priors(self.folder, cameras, key)
        if priors is None:
            _logger.info("the confirmed depths are not there: matching the photos again")
            scene, quiet = self._start_scene(), progress.span(0.0, 0.0)
            maps = matched_photos(
                scene, self.photos, self.views, quiet, side_px=self.settings.match_px,
                seed=self.seed, threads=self.threads,
            )  # fmt: skip
            priors = priors_of(self.views, on_planes(scene, maps, quiet, seed=self.seed))
            save_priors(self.folder, priors, key)
        return priors

    def _start_scene(self) -> Scene:
        """Return the scene with the sparse points that masks do not show to be background."""
        scene = self.scene
        if self.settings.mask_mode != "background" or not len(scene.points):
            return scene
        kept = inside_masks(
            scene.points,
            [self.photos.camera(i, self.divisor) for i in self.views],
            (self.photos.mask(i, self.divisor) for i in self.views),
        )
        return dataclasses.replace(
            scene, points=scene.points[kept], point_colors=scene.point_colors[kept]
        )
