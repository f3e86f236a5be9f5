# SPDX-License-Identifier: GPL-3.0-or-later
"""Trainings that the tables and pictures are made of, each kept in a folder of its own.

They run in this process through the program's own ``train``: plain 3DGS is the same trainer with
everything of the method off, so that both differ by nothing else.
"""

from __future__ import annotations

import dataclasses
import datetime
import logging
import os
import time
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene, save_scene
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.gaussians.foreign_splat import read_foreign_splat
from gaussian_wrapping_addon.core.gaussians.gaussian_file import load_gaussians, save_gaussians
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.gaussians.splat_ply import write_viewer_ply
from gaussian_wrapping_addon.core.jobs.stages.splat_scene import make_splat_scene
from gaussian_wrapping_addon.core.machine import processor_name
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.convex_region import Region
from gaussian_wrapping_addon.core.regions.region import read_region
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.settings.job import preset
from gaussian_wrapping_addon.core.training.checkpoint import remove_checkpoints
from gaussian_wrapping_addon.core.training.initialisation.splat_start import baked, fit_filter
from gaussian_wrapping_addon.core.training.initialisation.splat_transform import (
    transform_gaussians,
)
from gaussian_wrapping_addon.core.training.trainer import train

from ..scenes import ensure_scene
from ..speed_error.runs import ROOT, code_state
from ..tables import versions

_logger = logging.getLogger("benchmarks")

CACHE = ROOT / ".cache" / "paper"
PRESET = "draft"
ITERATIONS = 1000
PHOTOS, WIDTH, HEIGHT = 40, 640, 480
SPLAT = "plain.ply"

PLAIN, FULL, WRAPPED, UNTRAINED, ALONE, LONGER = (
    "plain", "full", "wrapped", "untrained", "alone", "longer",
)  # fmt: skip

_FIXED = {
    "harmonics": "on", "exposure": "off", "growth": "on", "full_size": "on", "holdout_every": 0,
    "preview_every_s": 0.0, "checkpoint_every_s": 1e9,
}  # fmt: skip
"""No decision is left to the photos, and all photos are trained on: test views lie apart."""

OFF = {
    "lambda_depth_normal": 0.0, "lambda_normal": 0.0, "multi_view": "off", "wrapping": "off",
    "overlap_price": 0.0, "prune_share": 0.0,
}  # fmt: skip
"""What makes the trainer a plain one: colour loss and density control alone."""

ON = {"multi_view": "on", "wrapping": "on"}


@dataclasses.dataclass(frozen=True)
class Training:
    """One training of a scene."""

    name: str
    settings: TrainingSettings
    start: bool = False
    """Starts from the PLY of the plain training."""
    photos: bool = True
    """False: views rendered from the PLY take their place."""

    @property
    def iterations(self) -> int:
        """Iterations that this run asks for; a start from a splat makes 0.3 of them."""
        return self.settings.iterations


def settings_of(iterations: int, changes: dict[str, Any]) -> TrainingSettings:
    """Return Draft's settings with fixed selection and some changes."""
    base = preset(PRESET).training
    return dataclasses.replace(base, iterations=iterations, **_FIXED, **changes)


def trainings(iterations: int = ITERATIONS) -> dict[str, Training]:
    """Return all trainings of a scene by name, in the order in which they can be made.

    The longer one has the iterations of the plain training and of the wrapping together.
    """
    more = iterations + round(0.3 * iterations)
    kinds = (
        Training(PLAIN, settings_of(iterations, OFF)),
        Training(FULL, settings_of(iterations, ON)),
        Training(WRAPPED, settings_of(iterations, ON), start=True),
        Training(UNTRAINED, settings_of(iterations, ON), start=True, photos=False),
        Training(ALONE, settings_of(iterations, ON), start=True, photos=False),
        Training(LONGER, settings_of(more, OFF)),
    )
    return {kind.name: kind for kind in kinds}


@dataclasses.dataclass(frozen=True)
class Trained:
    """A finished training; scene frame."""

    folder: Path
    scene: Scene
    gaussians: OrientedGaussians
    region: Region
    truth_folder: Path
    facts: dict[str, Any]


def finished(scene_name: str, name: str, *, threads: int, iterations: int = ITERATIONS) -> Trained:
    """Return a training of a scene; make it first where it does not exist yet."""
    kinds = trainings(iterations)
    kind = kinds[name]
    truth = ensure_scene(scene_name, photos=PHOTOS, width=WIDTH, height=HEIGHT)
    base = CACHE / f"{scene_name}-{iterations}"
    folder = base / name
    if not (folder / "training.json").is_file():
        splat = None
        if kind.start:
            finished(scene_name, PLAIN, threads=threads, iterations=iterations)
            splat = base / PLAIN / SPLAT
        _make(kind, truth, splat, folder, threads)
    scene = load_saved_scene(folder)
    region = read_region(truth / "region.json").transformed(scene.world_from_scene.inverse())
    gaussians = load_gaussians(folder / "gaussians.npz")
    facts = dict(read_json(folder / "training.json"))
    return Trained(folder, scene, gaussians, region, truth, facts)


def _make(kind: Training, truth: Path, splat: Path | None, folder: Path, threads: int) -> None:
    """Train, and write scene, Gaussians, the viewers' PLY and the figures; the figures last."""
    folder.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[0]
    progress = Progress()
    if kind.photos:
        scene = load_scene(truth, folder, progress, threads=threads)
    else:
        assert splat is not None, "only a splat can stand for photos"
        scene = make_splat_scene(splat, folder, progress, threads=threads)
    save_scene(scene, folder)
    facts: dict[str, Any] = {"name": kind.name, "iterations": 0}
    wall_s, cpu_s = time.monotonic(), time.process_time()
    if kind.name == UNTRAINED:
        assert splat is not None
        gaussians = _as_read(splat, scene, threads)
    else:
        photos = PhotoStore(scene, kind.settings.max_image_px)
        result = train(
            scene, photos, kind.settings, folder, progress, threads=threads, start_splat=splat
        )
        gaussians = result.gaussians
        facts["iterations"] = result.iterations
        remove_checkpoints(folder)
    facts |= {
        "gaussians": len(gaussians),
        "seconds": time.monotonic() - wall_s,
        "processor_s": time.process_time() - cpu_s,
        "settings": {name: getattr(kind.settings, name) for name in OFF},
        "load_before": load,
        "code": code_state(),
        "machine": f"{processor_name()}, {threads} thread{'s' * (threads > 1)}",
        "versions": versions(),
        "date": datetime.date.today().isoformat(),
    }
    save_gaussians(folder / "gaussians.npz", gaussians)
    write_viewer_ply(folder / SPLAT, transform_gaussians(gaussians, scene.world_from_scene))
    write_json(folder / "training.json", facts)
    _logger.info(
        "%s: %d Gaussians, %.0f s, %.0f processor seconds",
        folder.parent.name + "/" + kind.name, len(gaussians), facts["seconds"],
        facts["processor_s"],
    )  # fmt: skip


def _as_read(splat: Path, scene: Scene, threads: int) -> OrientedGaussians:
    """Return the Gaussians of a PLY in the scene's frame, not trained and not oriented."""
    moved = transform_gaussians(
        baked(read_foreign_splat(splat).gaussians), scene.world_from_scene.inverse()
    )
    return fit_filter(moved, [view.camera for view in scene.views], threads=threads)
