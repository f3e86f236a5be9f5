# SPDX-License-Identifier: GPL-3.0-or-later
"""Cut equirectangular photos and their masks into pinhole views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import DatasetError
from ...imaging.bicubic import sample_bicubic
from ...kernels.parallel import default_threads
from ...progress import Progress
from ..photos.mask_reading import MaskReading
from ..photos.photo_file import (
    MASK_THRESHOLD,
    photo_header,
    read_mask,
    read_photo,
    write_mask,
    write_photo,
)
from .panorama_views import VIEWS, check_panorama, panorama_pixels, view_name

CUT_FOLDER, CUT_MASKS = "panoramas", "panorama-masks"
"""Folders of the views and of their masks, in the work folder."""

_WRAP_PX = 4
"""Columns repeated across the seam of a panorama: more than the cubic kernel reaches."""


@dataclass(frozen=True)
class Panorama:
    """A photo to cut: its name in the input, its file, its mask's."""

    name: str
    path: Path
    mask: Path | None


@dataclass(frozen=True)
class CutView:
    """A view that was cut: its name, the panorama and the number of the view, the mask's file."""

    name: str
    panorama: int
    view: int
    mask: Path | None
    width: int
    """Of the panorama, pixels."""


def cut_panoramas(
    panoramas: Sequence[Panorama],
    work_folder: Path,
    progress: Progress,
    reading: MaskReading,
    *,
    threads: int = 0,
) -> tuple[list[CutView], list[str]]:
    """Write the views below ``work_folder / CUT_FOLDER``, all of the same lens for a size.

    Returns
    -------
    views : list of CutView
        Of each panorama that could be read, in order.
    bad : list of str
        What is wrong with the others.

    Raises
    ------
    DatasetError
        A photo is not twice as wide as high.
    """
    threads = threads or default_threads()
    cut: list[CutView] = []
    bad: list[str] = []
    maps: dict[tuple[int, int], list[np.ndarray]] = {}
    names: set[str] = set()
    for number, panorama in enumerate(panoramas):
        if view_name(panorama.name, 0) in names:
            bad.append(f"{panorama.name} has the name of another panorama but for its ending.")
            continue
        names.add(view_name(panorama.name, 0))
        try:
            header = photo_header(panorama.path)
        except DatasetError as error:
            bad.append(error.message)
            continue
        check_panorama(header, panorama.path.name)
        try:
            decoded = read_photo(panorama.path)
            kept = None if decoded.alpha is None else decoded.alpha >= MASK_THRESHOLD
            if panorama.mask is not None:
                from_file = reading.kept(read_mask(panorama.mask))
                if from_file.shape != decoded.color.shape[:2]:
                    raise DatasetError(f"{panorama.mask.name} is not of the size of its photo.")
                kept = from_file if kept is None else kept & from_file
        except DatasetError as error:
            bad.append(error.message)
            continue
        height, width = decoded.color.shape[:2]
        if (width, height) not in maps:
            maps.clear()  # one size at a time: a map takes 8 bytes a pixel of each view
            grids = [panorama_pixels(view, width, height) for view in VIEWS]
            maps[width, height] = [
                (g + np.array([_WRAP_PX, 0.0])).astype(np.float32) for g in grids
            ]
        color = _wrapped(decoded.color)
        grey = (
            None if kept is None else _wrapped(np.where(kept, 255, 0).astype(np.uint8)[..., None])
        )
        for view, pixels in enumerate(maps[width, height]):
            name = view_name(panorama.name, view)
            path = work_folder / CUT_FOLDER / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_photo(path, sample_bicubic(color, pixels, threads))
            mask = None
            if grey is not None:
                mask = (work_folder / CUT_MASKS / name).with_suffix(".png")
                mask.parent.mkdir(parents=True, exist_ok=True)
                write_mask(mask, sample_bicubic(grey, pixels, threads)[..., 0] >= MASK_THRESHOLD)
            cut.append(CutView(name, number, view, mask, width))
        progress.update(
            (number + 1) / len(panoramas), f"cutting panorama {number + 1} of {len(panoramas)}"
        )
    return cut, bad


def _wrapped(pixels: np.ndarray) -> np.ndarray:
    """Return (h, w, c) pixels with columns of the other side at both sides."""
    return np.concatenate([pixels[:, -_WRAP_PX:], pixels, pixels[:, :_WRAP_PX]], 1)
