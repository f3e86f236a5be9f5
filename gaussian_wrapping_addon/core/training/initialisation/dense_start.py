# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial Gaussians on the surfaces that stereo finds (docs/method.md, section 11)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from ...dataset.camera import Camera
from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene, usable_points
from ...gaussians.initialisation import gaussians_at, point_spacing
from ...gaussians.model import OrientedGaussians
from ...progress import Progress
from ...stereo.depth_maps import DepthMap, estimate_depth_maps
from ...stereo.depth_priors import DepthPrior, priors_of
from ...stereo.fusion import DensePoints, fuse
from ...stereo.gap_filling import fill_gaps
from ...stereo.plain.filling import fill_plain_parts
from ..selection.model_selection import Decision, decide
from .far_shell import far_shell

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
    scene: Scene,
    photos: PhotoSource,
    views: Sequence[int],
    setting: str,
    progress: Progress,
    *,
    side_px: int,
    max_gaussians: int,
    sh_degree: int,
    seed: int,
    threads: int,
) -> DenseStart:
    """Match the photos and return flat Gaussians on the surfaces found.

    Parameters
    ----------
    scene : Scene
    photos : PhotoSource
    views : sequence of int
        Training views.
    setting : str
        ``"auto"`` needs :data:`LEAST_CONFIRMED` of the pixels; ``"on"`` takes what there is.
    progress : Progress
    side_px : int
        Longest side at which photos are matched.
    max_gaussians : int
        Limit of the growth; the start leaves room below it.
    """
    points, colors = _usable(scene)
    maps = matched_photos(
        scene, photos, views, progress, side_px=side_px, seed=seed, threads=threads
    )
    confirmed = _confirmed_share(maps)
    decision = _decision(setting, confirmed, len(maps))
    if decision.chosen != "on":
        return DenseStart(None, {}, decision)
    maps = on_planes(scene, maps, progress, seed=seed)
    wanted = start_budget(max_gaussians)
    found = fuse(maps, wanted)
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
    gaussians = gaussians.joined(_shell_gaussians(shell, sh_degree))
    if len(gaussians) > max_gaussians:
        random = np.random.default_rng([seed, 4])
        kept = np.sort(random.choice(len(gaussians), max_gaussians, replace=False))
        gaussians = gaussians.select(torch.from_numpy(kept))
    return DenseStart(gaussians, priors_of(views, maps), decision)


def start_budget(max_gaussians: int) -> int:
    """Return how many points on confirmed depths are wanted below a limit of Gaussians."""
    return max(1, min(MOST_POINTS, round(BUDGET_SHARE * max_gaussians)))


def matched_photos(
    scene: Scene,
    photos: PhotoSource,
    views: Sequence[int],
    progress: Progress,
    *,
    side_px: int,
    seed: int,
    threads: int,
) -> list[DepthMap]:
    """Return the depth maps of the training views; empty where there is too little to match."""
    points, _ = _usable(scene)
    return estimate_depth_maps(
        photos, views, points, progress, side_px=side_px, seed=seed, threads=threads
    )


def on_planes(
    scene: Scene, maps: Sequence[DepthMap], progress: Progress, *, seed: int
) -> list[DepthMap]:
    """Return the depth maps with planes through their plain parts."""
    return fill_plain_parts(maps, _usable(scene)[0], progress, seed=seed)


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
    found: DensePoints,
    guesses: DensePoints,
    points: np.ndarray,
    colors: np.ndarray,
    cameras: Sequence[Camera],
    sh_degree: int,
) -> OrientedGaussians:
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


def _shell_gaussians(shell: DensePoints, sh_degree: int) -> OrientedGaussians:
    return gaussians_at(
        shell.positions, shell.colors / 255.0, SIZE_SHARE * shell.sizes, sh_degree,
        normals=shell.normals, flatness=FLATNESS, opacities=OPACITY,
    )  # fmt: skip
