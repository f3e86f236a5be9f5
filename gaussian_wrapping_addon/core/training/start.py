# SPDX-License-Identifier: GPL-3.0-or-later
"""Start of a training: on surfaces found by stereo, on points, on what another training left."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from .. import limits
from ..gaussians.model import OrientedGaussians, gaussians_at, initial_gaussians, point_spacing
from ..progress import Progress
from ..scene.camera import Camera
from ..scene.scene import PhotoSource, Scene, usable_points
from ..settings import TrainingSettings
from ..stereo.depth_maps import (
    CELL_PX,
    DensePoints,
    DepthMap,
    DepthPrior,
    by_cell,
    cells_of,
    estimate_depth_maps,
    fill_gaps,
    fuse,
    load_priors,
    matching_divisor,
    open_cells,
    priors_of,
    save_priors,
)
from ..stereo.plane_filling import fill_plain_parts
from .background import inside_masks
from .exposure import Exposure
from .focus import Focus
from .model_selection import Decision, ModelSelection, decide

# -- What a training takes over from another one, instead of starting and deciding for itself -----


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


# -- Initial Gaussians far away, where the photos show what stereo cannot place -------------------
#
# Sky and the far distance have no parallax. Without Gaussians there, training explains them by
# fog before the things. See docs/method.md, section 11.9.

REACH_FACTOR = 4.0
"""Radius of the shell over the distance of the farthest points but one in a hundred."""

LEAST_REACH = limits.FAR_RADIUS
"""Smallest radius: the cameras lie within a tenth of it."""


def far_shell(
    depth_maps: Sequence[DepthMap], points: np.ndarray, wanted: int
) -> tuple[DensePoints, float]:
    """Return points on a sphere where photos show something and nothing is known of its depth.

    Parameters
    ----------
    points : (n, 3) float64
        Points known so far, scene frame; they cover the cells that they project into.
    wanted : int
        Largest number of points; cells are merged until it is kept.

    Returns
    -------
    shell : DensePoints
        Sizes are the distances of neighbours.
    radius : float
        Of the sphere around the origin of the scene frame.
    """
    reach = float(np.percentile(np.linalg.norm(points, axis=1), 99)) if len(points) else 0.0
    radius = max(LEAST_REACH, REACH_FACTOR * reach)
    directions, colors, angles = [], [], []
    for depth_map in depth_maps:
        camera, unexplained = depth_map.camera, open_cells(depth_map)
        _, row, column = cells_of(points, depth_map)
        unexplained[row, column] = False
        row, column = np.nonzero(unexplained)
        color = by_cell(depth_map.color.astype(np.float64))[row, column]
        at = (np.stack([column, row], 1) + 0.5) * CELL_PX  # (m, 2) pixels
        rays = camera.rays_at(at) @ camera.rotation
        directions.append(onto_sphere(camera.center, rays, radius))
        colors.append(color)
        angles.append(np.full(len(at), CELL_PX / camera.fx))
    found, color = np.concatenate(directions), np.concatenate(colors)
    if len(found) == 0 or wanted < 1:
        return _shell(np.zeros((0, 3)), np.zeros((0, 3)), 0.0, radius), radius
    step = float(np.median(np.concatenate(angles)))
    while True:
        key = np.floor(found / step + 0.5).astype(np.int64)
        cells, cell, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        if len(cells) <= wanted:
            break
        step *= 1.25
    cell = cell.reshape(-1)
    direction = np.stack([np.bincount(cell, found[:, k]) for k in range(3)], 1)
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    mean = np.stack([np.bincount(cell, color[:, k]) / count for k in range(3)], 1)
    return _shell(direction, mean, step, radius), radius


def _shell(direction: np.ndarray, color: np.ndarray, step: float, radius: float) -> DensePoints:
    count = len(direction)
    return DensePoints(
        radius * direction, -direction, np.clip(color + 0.5, 0, 255).astype(np.uint8),
        np.full(count, radius * step), np.zeros(count, np.float32),
    )  # fmt: skip


def onto_sphere(center: np.ndarray, rays: np.ndarray, radius: float) -> np.ndarray:
    """Return where rays (m, 3) from inside a sphere around the origin meet it, as unit vectors."""
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    along = unit @ center
    distance = -along + np.sqrt(along**2 + radius**2 - center @ center)
    return (center + unit * distance[:, None]) / radius


# -- Initial Gaussians on the surfaces that stereo finds (docs/method.md, section 11) -------------

_logger = logging.getLogger(__name__)

NAME = "dense_start"
"""Of the decision and of the setting."""

LEAST_CONFIRMED = 0.1
"""Share of the pixels that stereo must confirm for its points to be used."""

MOST_POINTS = 40_000
"""Points on confirmed depths; growth adds Gaussians where the photos show more."""

BUDGET_SHARE = 0.6
"""Of the largest number of Gaussians that the start may take."""

GUESS_SHARE = 0.5
"""Cells for unconfirmed depths, as a share of the points on confirmed ones; most are left out."""

SIZE_SHARE = 0.7
"""Standard deviation along the surface over the distance of neighbours."""

FLATNESS, GUESS_FLATNESS = 0.15, 0.5
OPACITY, GUESS_OPACITY = 0.5, 0.2
"""Of points on confirmed and unconfirmed depths. Guesses are displaced along the ray, so they are
thicker and fainter, and training may move them."""

SHELL_SHARE = 0.1
"""Most Gaussians far away, as a share of the points on confirmed depths."""

SPARSE_CLEARANCE = 5.0
"""Distance of a sparse point from the dense ones, in their median distance, from which it is kept:
nearer ones say nothing new and are less accurate."""


@dataclass(frozen=True)
class DenseStart:
    """Gaussians from stereo, and the decision to use them."""

    gaussians: OrientedGaussians | None
    """``None`` where stereo confirms too little."""
    priors: dict[int, DepthPrior]
    """Confirmed depths by view; empty without Gaussians."""
    decision: Decision


def dense_start(
    scene: Scene, photos: PhotoSource, views: Sequence[int], settings: TrainingSettings,
    progress: Progress, *, max_gaussians: int, seed: int, threads: int, focus: Focus | None = None,
) -> DenseStart:  # fmt: skip
    """Match the photos of the training views and return flat Gaussians on the surfaces found.

    The setting ``dense_start`` ``"auto"`` needs :data:`LEAST_CONFIRMED` of the pixels; ``"on"``
    takes what there is. The start leaves room below ``max_gaussians``, the limit of the growth.
    """
    sh_degree = settings.sh_degree
    points, colors = _usable(scene)
    maps = estimate_depth_maps(
        photos, views, points, progress, side_px=settings.match_px, seed=seed, threads=threads
    )  # none where there is too little to match
    confirmed = _confirmed_share(maps)
    decision = _decision(settings.dense_start, confirmed, len(maps))
    if decision.chosen != "on":
        return DenseStart(None, {}, decision)
    maps = fill_plain_parts(maps, points, progress, seed=seed)
    wanted = start_budget(max_gaussians)
    found = fuse(maps, wanted, None if focus is None else focus.apart)
    guesses = fill_gaps(maps, found, round(GUESS_SHARE * wanted))
    known = np.concatenate([found.positions, points])
    shell, _ = far_shell(maps, known, round(SHELL_SHARE * wanted))
    gaussians = _gaussians(
        found, guesses, points, colors, [photos.camera(view, 1) for view in views], sh_degree
    )
    _logger.info(
        "dense start: %d points, %d guesses, %d far away, %d Gaussians",
        len(found), len(guesses), len(shell), len(gaussians) + len(shell),
    )  # fmt: skip
    far = gaussians_at(
        shell.positions, shell.colors / 255.0, SIZE_SHARE * shell.sizes, sh_degree,
        normals=shell.normals, flatness=FLATNESS, opacities=OPACITY,
    )  # fmt: skip
    gaussians = gaussians.joined(far)
    if len(gaussians) > max_gaussians:
        random = np.random.default_rng([seed, 4])
        kept = np.sort(random.choice(len(gaussians), max_gaussians, replace=False))
        gaussians = gaussians.select(torch.from_numpy(kept))
    return DenseStart(gaussians, priors_of(views, maps), decision)


def start_budget(max_gaussians: int) -> int:
    """Return how many points on confirmed depths are wanted below a limit of Gaussians."""
    return max(1, min(MOST_POINTS, round(BUDGET_SHARE * max_gaussians)))


def _usable(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the sparse points within reach (n, 3) and their colours (n, 3) uint8."""
    points = np.asarray(scene.points, np.float64).reshape(-1, 3)
    usable = usable_points(points)
    return points[usable], np.asarray(scene.point_colors).reshape(-1, 3)[usable]


def _confirmed_share(maps: Sequence[DepthMap]) -> float:
    """Return the share of the pixels that masks leave and sources confirm."""
    confirmed = sum(int((m.confidence > 0).sum()) for m in maps)
    counted = sum(m.confidence.size if m.mask is None else int(m.mask.sum()) for m in maps)
    return confirmed / max(1, counted)


def _decision(setting: str, confirmed: float, count: int) -> Decision:
    if count == 0:
        evidence = "Too few photos or sparse points to match photos with each other."
        return Decision(NAME, setting, "off", evidence)
    evidence = (
        f"Neighbouring photos confirm the depth of {100.0 * confirmed:.0f} % of the pixels of "
        f"{count} photos (limit {100.0 * LEAST_CONFIRMED:.0f} %)."
    )
    figures = {"photos": float(count), "confirmed": confirmed, "limit": LEAST_CONFIRMED}
    chosen = decide(NAME, setting, confirmed >= LEAST_CONFIRMED, evidence, figures)
    if chosen.chosen == "on" and confirmed == 0.0:
        return Decision(NAME, setting, "off", evidence, figures)
    return chosen


def _gaussians(
    found: DensePoints, guesses: DensePoints, points: np.ndarray, colors: np.ndarray,
    cameras: Sequence[Camera], sh_degree: int,
) -> OrientedGaussians:  # fmt: skip
    """Return flat Gaussians of both kinds, and round ones at sparse points away from them."""
    dense = np.concatenate([found.positions, guesses.positions])
    tree = cKDTree(dense)
    step = float(np.median(tree.query(dense, k=2)[0][:, -1])) if len(dense) > 1 else 0.0
    away = tree.query(points)[0] > SPARSE_CLEARANCE * step
    counts = (len(found), len(guesses), int(away.sum()))
    upright = np.broadcast_to([0.0, 0.0, 1.0], (counts[2], 3))
    positions = np.concatenate([dense, points[away]])
    return gaussians_at(
        positions,
        np.concatenate([found.colors, guesses.colors, colors[away]]) / 255.0,
        SIZE_SHARE * point_spacing(positions, list(cameras)),
        sh_degree,
        normals=np.concatenate([found.normals, guesses.normals, upright]),
        flatness=np.repeat([FLATNESS, GUESS_FLATNESS, 1.0], counts),
        opacities=np.repeat([OPACITY, GUESS_OPACITY, 0.1], counts),
    )


# -- The Gaussians a training starts from: at dense points from stereo, or at the sparse points


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
    focus: Focus | None = None

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
                scene, self.photos, self.views, settings, progress.span(0.0, 0.0),
                max_gaussians=self.max_gaussians, seed=self.seed, threads=self.threads,
                focus=self.focus,
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
            (points, _), quiet = _usable(self._start_scene()), progress.span(0.0, 0.0)
            maps = estimate_depth_maps(
                self.photos, self.views, points, quiet, side_px=self.settings.match_px,
                seed=self.seed, threads=self.threads,
            )  # fmt: skip
            priors = priors_of(self.views, fill_plain_parts(maps, points, quiet, seed=self.seed))
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
