# SPDX-License-Identifier: GPL-3.0-or-later
"""Solve the poses of panoramas from their views, which keep their known directions (a rig)."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import DatasetError
from ...files import write_json
from ...kernels.parallel import default_threads
from ...limits import HELPER_DEADLINE_S, MIN_IMAGES
from ...machine import helper_memory_limit_bytes
from ...processes.helper_process import run_helper
from ...progress import Progress
from ...report_warning import ReportWarning
from ..photos.photo_file import read_mask, read_photo, write_photo
from ..poses.pose_solver import HELPER
from ..readers.colmap_reader import ModelFiles, read_model
from ..readers.source_model import PosedPhoto, SourceModel
from .panorama_cutting import CutView
from .panorama_views import VIEWS, view_lens

_MAX_SIFT_PX = 1000
"""Side of the views that features are extracted from."""
_SECONDS_A_PANORAMA = 600.0
"""Longest time that solving may take: ten times what five panoramas took on one busy core."""
_ALL_PAIRS = 12
"""Up to this many panoramas each is matched with each other."""
_NEIGHBOURS = 4


def panorama_pairs(count: int) -> list[tuple[int, int]]:
    """Return pairs (i < j) of ``count`` panoramas in the order in which they were taken.

    Few: all. Many: the next ones, and those at powers of two for ways that come back.
    """
    if count <= _ALL_PAIRS:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    steps = {*range(1, _NEIGHBOURS + 1), *(2**k for k in range(3, count.bit_length()))}
    return sorted((i, i + step) for i in range(count) for step in steps if i + step < count)


def solve_panoramas(
    cut: Sequence[CutView],
    cut_folder: Path,
    work_folder: Path,
    progress: Progress,
    *,
    seed: int = 0,
    threads: int = 0,
) -> SourceModel:
    """Solve cameras and sparse points of the views of panoramas without poses.

    Views of a panorama share its place and keep the directions that they were cut in; their lens
    is known. Nothing of either is adjusted.

    Parameters
    ----------
    cut : sequence of CutView
        All of panoramas of one size.
    cut_folder : Path
        Holds the views.

    Raises
    ------
    DatasetError
        The panoramas differ in size, or fewer than ``MIN_IMAGES`` of them can be placed.
    """
    widths = sorted({view.width for view in cut})
    if len(widths) != 1:
        raise DatasetError(
            f"The panoramas are {', '.join(f'{w} x {w // 2}' for w in widths[:3])} pixels large.",
            "Give panoramas of one size.",
        )
    folder = work_folder / "pose_solver"
    if folder.exists():
        shutil.rmtree(folder)
    full = view_lens(widths[0])
    side = min(full.width, _MAX_SIFT_PX)
    numbers = sorted({view.panorama for view in cut})
    names: dict[str, CutView] = {}
    for i, view in enumerate(cut):
        name = f"{view.view:02d}/{numbers.index(view.panorama):06d}.jpg"
        _write_small(folder, name, cut_folder / view.name, view.mask, side)
        names[name] = view
        progress.update(0.08 * (i + 1) / len(cut), f"reading view {i + 1} of {len(cut)}")
    horizon = [v for v, view in enumerate(VIEWS) if view.pitch_deg == 0]
    upper = [v for v, view in enumerate(VIEWS) if view.pitch_deg > 0]
    lower = [v for v, view in enumerate(VIEWS) if view.pitch_deg < 0]
    pairs = [
        [f"{v:02d}/{a:06d}.jpg", f"{w:02d}/{b:06d}.jpg"]
        for a, b in panorama_pairs(len(numbers))
        for ring in (horizon, upper, lower)
        for v in ring
        for w in ring
    ]
    lens = full.resized(side, side)
    task = {
        "mode": "panoramas",
        "seed": seed,
        "threads": threads or default_threads(),
        "side": side,
        "focal_px": lens.focal[0],
        "cam_from_panorama": [view.cam_from_panorama.tolist() for view in VIEWS],
        "panoramas": len(numbers),
        "pairs": pairs,
    }
    write_json(folder / "task.json", task)
    run_helper(
        HELPER, folder, progress.span(0.08, 1.0), memory_bytes=helper_memory_limit_bytes(),
        deadline_s=max(HELPER_DEADLINE_S, _SECONDS_A_PANORAMA * len(numbers)),
    )  # fmt: skip
    model = read_model(ModelFiles(folder / "model", ".bin"))
    target = work_folder / "cameras"
    if target.exists():
        shutil.rmtree(target)
    os.replace(folder / "model", target)
    shutil.rmtree(folder)
    photos: list[PosedPhoto] = []
    placed = set()
    for posed in model.photos:
        view = names[posed.name]
        placed.add(view.panorama)
        photos.append(dataclasses.replace(posed, name=view.name, lens=full, mask_path=view.mask))
    if len(placed) < MIN_IMAGES:
        raise DatasetError(
            f"Only {len(placed)} of {len(numbers)} panoramas could be placed; {MIN_IMAGES} are "
            "needed.",
            "Take more panoramas, a few steps apart. If these are ordinary photos, say "
            "--equirectangular off.",
        )
    warnings = list(model.warnings)
    if len(placed) < len(numbers):
        warnings.append(
            ReportWarning(
                "photos-not-placed",
                f"{len(numbers) - len(placed)} of {len(numbers)} panoramas could not be placed and "
                "are not used.",
                "Take more panoramas in between.",
            )
        )
    facts = {**model.facts, "panoramas": len(numbers), "panoramas_placed": len(placed)}
    return dataclasses.replace(
        model,
        kind="photos",
        photos=tuple(sorted(photos, key=lambda photo: photo.name)),
        warnings=tuple(warnings),
        facts=facts,
    )


def _write_small(folder: Path, name: str, path: Path, mask: Path | None, side: int) -> None:
    """Write a view, and its mask, in the size that features are extracted from."""
    from PIL import Image

    color = read_photo(path).color
    if color.shape[0] != side:
        color = np.asarray(Image.fromarray(color).resize((side, side), Image.Resampling.LANCZOS))
    (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / "masks").mkdir(exist_ok=True)
    write_photo(folder / "images" / name, color)
    if mask is not None:
        small = Image.fromarray(read_mask(mask)).resize((side, side), Image.Resampling.NEAREST)
        target = folder / "masks" / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        small.save(target)
