# SPDX-License-Identifier: GPL-3.0-or-later
"""Cases of the zoo, their making through the studies' machinery, and what is judged besides."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion, binary_fill_holes

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.evaluation.surface.truth import read_truth
from gaussian_wrapping_addon.core.files import finite_json, read_json

from ..speed_error.alpha_shape import make_alpha
from ..speed_error.plan import Photos
from ..speed_error.score import read_textured, stage_folder, true_mask
from ..study.case import Case
from ..study.making import KEPT_RUNS, make, rounded, run_folder
from ..study.record import Record, read_record, record_path, write_record
from .cache import ensure_zoo_scene, scene_folder
from .catalogue import draw_photography, zoo_scene
from .taken_photos import ensure_taken_scene, taken_folder

STUDY = "zoo"
BASELINES = "baselines"
ALPHA = "alpha"
"""The alpha shape of the sparse points, with the best alpha by the truth."""

TAKEN = "-taken"
"""Ends the labels of runs on photos as a camera takes them (:mod:`.taken_photos`)."""

FIGURES = "zoo"
"""Key of a record's scores for what :func:`judged` returns, and the scene's folder (``scene``)."""
_FEWEST_PX = 200
"""Openings of fewer pixels in all test views together are not judged."""


def scene_photos(name: str) -> Photos:
    """Return number and size of a scene's photos."""
    shot = draw_photography(zoo_scene(name))
    return Photos(shot.photos, shot.width, shot.height)


def alpha_case(name: str) -> Case:
    """Return the alpha shape of a scene's sparse points."""
    return Case(f"{STUDY}/{BASELINES}", name, ALPHA, 0, "", (), photos=scene_photos(name))


def run_case(name: str, label: str, preset: str, arguments: Sequence[str]) -> Case:
    """Return a job on a scene; further arguments make it a variant, which has its own label."""
    photos = scene_photos(name)
    return Case(f"{STUDY}/{label}", name, label, 0, preset, tuple(arguments), photos=photos)


def find_scene(case: Case) -> Path:
    """Return the folder of a case's scene; render it where missing."""
    return (ensure_taken_scene if _is_taken(case) else ensure_zoo_scene)(case.scene)


def is_present(record: Record) -> bool:
    """Tell whether a run was made on the scene as today's sources draw it."""
    made_on = record.scores.get(FIGURES, {}).get("scene")
    folder = (taken_folder if _is_taken(record.case) else scene_folder)(record.case.scene)
    return bool(made_on == folder.name)


def _is_taken(case: Case) -> bool:
    return case.study.endswith(TAKEN)


def is_made(case: Case) -> bool:
    """Tell whether a case has a record of the scene as today's sources draw it."""
    path = record_path(case)
    return path.is_file() and is_present(read_record(path))


def make_one(case: Case, *, threads: int, kept: Path = KEPT_RUNS) -> Record:
    """Make a job or an alpha shape, judge it, and write its record.

    Raises
    ------
    WorkerError
        With the last lines of the job's output.
    """
    scene = find_scene(case)
    # The folder found here stays the run's, even if the sources of the scenes change meanwhile.
    figures: dict[str, Any] = {"scene": scene.name}
    if case.name == ALPHA:
        made = make_alpha(case, threads=threads, kept=kept, find_scene=lambda _: scene)
    else:
        made = make(case, threads=threads, kept=kept, find_scene=lambda _: scene)
        figures |= judged(scene, run_folder(case, kept), threads)
    record = dataclasses.replace(made, scores={**made.scores, FIGURES: rounded(figures)})
    write_record(record)
    return record


def judged(scene: Path, folder: Path, threads: int) -> dict[str, Any]:
    """Return figures of a kept run besides its scores.

    Returns
    -------
    dict
        ``training_psnr``, dB, of the photos that were trained on last; ``held_out_psnr`` of those
        that were not, ``None`` without any; ``open_share``: see :func:`open_share`.
    """
    report = read_json(folder / "out" / "result" / "report.json")["training"]
    saved = load_saved_scene(stage_folder(folder / "out", "cameras"))
    mesh = read_textured(folder / "mesh").mesh
    truth = read_truth(scene)
    assert truth.mesh is not None
    values = read_json(scene / "test" / "cameras.json")["cameras"]
    surface = (saved.world_from_scene.points(mesh.vertices), mesh.faces)
    found = {
        "training_psnr": report["history"][-1]["psnr"] if report.get("history") else None,
        "held_out_psnr": report.get("held_out_psnr"),
        "open_share": open_share(
            surface, truth.mesh, [Camera.from_json(v) for v in values], threads
        ),
    }
    return dict(finite_json(found))


def open_share(
    mesh: tuple[np.ndarray, np.ndarray],
    truth: tuple[np.ndarray, np.ndarray],
    cameras: Sequence[Camera],
    threads: int,
) -> float | None:
    """Return which share of the true surface's openings a mesh leaves open.

    Openings are the pixels that its outline encloses and that it does not cover, without those at
    their edges; ``None`` where there are practically none.
    """
    seen = opened = 0
    for camera in cameras:
        solid = true_mask(*truth, camera, threads)
        through = binary_erosion(binary_fill_holes(solid) & ~solid)
        seen += int(through.sum())
        opened += int((through & ~true_mask(*mesh, camera, threads)).sum())
    return opened / seen if seen >= _FEWEST_PX else None
