# SPDX-License-Identifier: GPL-3.0-or-later
"""Compile the training kernels ahead by a tiny training, so that a job can report the wait."""

from __future__ import annotations

import dataclasses
import logging
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import Cancelled
from ..progress import Progress
from ..scene.camera import Camera, Similarity
from ..scene.scene import Scene, View
from ..settings import TrainingSettings

_logger = logging.getLogger(__name__)

VIEWS = 4
SIDE_PX = 64
POINTS = 200
ITERATIONS = 24
_DISTANCE = 4.0
_DECIDED = ("exposure", "multi_view")


class _NoisePhotos:
    """Grey noise in memory, with the interface of ``PhotoStore``."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        random = np.random.Generator(np.random.PCG64(1))
        self._photos = random.integers(60, 200, (VIEWS, SIDE_PX, SIDE_PX, 3)).astype(np.uint8)

    def camera(self, index: int, divisor: int = 1) -> Camera:
        base = self._scene.views[index].camera
        width, height = base.width // divisor, base.height // divisor
        return base.resized(width, height)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        return np.ascontiguousarray(self._photos[index, ::divisor, ::divisor])

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        return None


def tiny_scene() -> Scene:
    """Return four cameras around a ball of random points."""
    random = np.random.Generator(np.random.PCG64(2))
    points = random.normal(size=(POINTS, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    views = []
    for index in range(VIEWS):
        angle = 0.05 * index  # narrow enough for semi-global matching, which is compiled, too
        forward = np.array([-math.cos(angle), -math.sin(angle), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        rotation = np.stack([np.cross(down, forward), down, forward])
        pose = np.concatenate([rotation, (rotation @ (_DISTANCE * forward))[:, None]], axis=1)
        half = 0.5 * SIDE_PX
        name = f"{index}.png"
        camera = Camera(name, SIDE_PX, SIDE_PX, 2.0 * SIDE_PX, 2.0 * SIDE_PX, half, half, pose)
        views.append(View(camera, Path(name)))
    return Scene(tuple(views), points, np.full((POINTS, 3), 128, np.uint8), Similarity())


def compile_kernels(
    settings: TrainingSettings, folder: Path, progress: Progress, *, threads: int
) -> None:
    """Run a training of a few seconds that calls every kernel that ``settings`` may use.

    Settings of "auto" count as "on". Failures are only logged: the training itself compiles what is
    missing and reports errors. ``folder`` holds a temporary folder meanwhile.

    Raises
    ------
    Cancelled
    """
    from .trainer import train

    decided: dict[str, Any] = {name: "on" for name in _DECIDED if getattr(settings, name) == "auto"}
    tiny = dataclasses.replace(
        settings, **decided, iterations=ITERATIONS, extra_iterations=0, max_gaussians=400,
        max_image_px=SIDE_PX, densify_every=4, wrap_rounds=min(1, settings.wrap_rounds),
        holdout_every=0, preview_every_s=0.0, checkpoint_every_s=math.inf, multi_view_pixels=64,
    )  # fmt: skip
    scene = tiny_scene()
    quiet = Progress(is_cancelled=progress.cancelled)
    with tempfile.TemporaryDirectory(dir=folder, prefix="warm-up-") as temporary:
        try:
            train(scene, _NoisePhotos(scene), tiny, Path(temporary), quiet, threads=threads)
        except Cancelled:
            raise
        except Exception as error:
            _logger.warning("warm-up of the kernels failed: %s: %s", type(error).__name__, error)
