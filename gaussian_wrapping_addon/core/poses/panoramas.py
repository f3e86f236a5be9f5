# SPDX-License-Identifier: GPL-3.0-or-later
"""360 degree photos cut into pinhole views, and solved as rigs."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from ..errors import DatasetError
from ..limits import MIN_IMAGES
from ..parallel import default_threads
from ..photos.formats import PhotoHeader, read_photo_header
from ..photos.photo_file import (
    MASK_THRESHOLD,
    MaskReading,
    photo_header,
    read_mask,
    read_photo,
    write_mask,
    write_photo,
)
from ..progress import Progress, ReportWarning
from ..readers.source_model import PHOTOS, LensCamera, PosedPhoto, SourceModel
from ..resampling import sample_bicubic
from .matching import all_pairs, pairs_at_steps
from .solver import fresh_folder, run_solver, save_model, write_reduced

# -- The pinhole views of an equirectangular photo: directions, lens, and where their pixels lie
#
# A panorama's frame has x right, y down and z forward, where forward is the middle of the photo;
# its long side is a full turn about y. Needs numpy only.

FIELD_OF_VIEW_DEG = 84.0
"""Of each view: neighbours on the horizon, 45 degrees apart, share nearly half of their width; with
80 degrees there are gaps between the horizon and the tilted views."""
_TILT_DEG = 55.0
_HORIZON, _TILTED = 8, 3


_EQUIRECTANGULAR = "equirectangular"
STATED, BY_SHAPE = "stated", "shape"
"""How it is known that photos are panoramas."""


@dataclass(frozen=True)
class PanoramaView:
    """Direction of a view: to the right of the photo's middle, and above its horizon."""

    yaw_deg: float
    pitch_deg: float

    @property
    def cam_from_panorama(self) -> np.ndarray:
        """(3, 3) rotation; rows are the view's right, down and forward."""
        yaw, pitch = math.radians(self.yaw_deg), math.radians(self.pitch_deg)
        right = np.array([math.cos(yaw), 0.0, -math.sin(yaw)])
        forward = np.array([
            math.sin(yaw) * math.cos(pitch), -math.sin(pitch), math.cos(yaw) * math.cos(pitch),
        ])  # fmt: skip
        return np.stack([right, np.cross(forward, right), forward])


VIEWS = (
    *(PanoramaView(360.0 * i / _HORIZON, 0.0) for i in range(_HORIZON)),
    *(PanoramaView(360.0 * i / _TILTED, _TILT_DEG) for i in range(_TILTED)),
    *(PanoramaView(360.0 * (i + 0.5) / _TILTED, -_TILT_DEG) for i in range(_TILTED)),
)
"""Eight around the horizon, three upwards, three downwards: they cover all but the two poles."""


def view_name(name: str, view: int) -> str:
    """Return the name of a view of a panorama: ``hall-view-00.jpg`` of ``hall.jpg``."""
    pure = PurePosixPath(name.replace("\\", "/"))
    return f"{pure.with_suffix('')}-view-{view:02d}.jpg"


def view_lens(width: int) -> LensCamera:
    """Return the lens of the views of a panorama ``width`` pixels wide, at its own scale."""
    focal = width / (2.0 * math.pi)
    side = max(1, round(2.0 * focal * math.tan(math.radians(0.5 * FIELD_OF_VIEW_DEG))))
    return LensCamera("PINHOLE", side, side, (focal, focal, 0.5 * side, 0.5 * side))


def panorama_evidence(photos: Sequence[Path]) -> str:
    """Return what tells that photos are panoramas, by the headers of those that can be read.

    Returns :data:`BY_SHAPE` where all are exactly twice as wide as high, :data:`STATED` where one
    of them also says that it is equirectangular. Empty where they are none: another shape, or one
    says another projection.
    """
    stated: set[str] = set()
    for path in photos:
        try:
            header = read_photo_header(path)
        except DatasetError:
            continue
        if header is None or not _is_twice_as_wide(header.upright_size):
            return ""
        stated.add(header.projection)
    if stated - {"", _EQUIRECTANGULAR}:
        return ""
    return STATED if _EQUIRECTANGULAR in stated else BY_SHAPE if stated else ""


def check_panorama(header: PhotoHeader, file_name: str) -> None:
    """Raise :class:`DatasetError` where a photo has not the shape of a whole panorama."""
    width, height = header.upright_size
    if not _is_twice_as_wide((width, height)):
        text = f"{file_name} is {width} x {height} pixels; a panorama is twice as wide as high."
        raise DatasetError(text, "Export the photos as whole equirectangular panoramas.")


def _is_twice_as_wide(size: tuple[int, int]) -> bool:
    return size[0] == 2 * size[1]


def panorama_pixels(view: PanoramaView, width: int, height: int) -> np.ndarray:
    """Return where the pixels of a view lie in a panorama of ``width`` x ``height``.

    Returns (side, side, 2) float64, first pixel's centre at (0.5, 0.5); x in [0, width].
    """
    lens = view_lens(width)
    fx, fy, cx, cy = lens.params
    rays = np.ones((lens.height, lens.width, 3))
    rays[..., 0] = (np.arange(lens.width) + 0.5 - cx) / fx
    rays[..., 1] = ((np.arange(lens.height) + 0.5 - cy) / fy)[:, None]
    x, y, z = np.moveaxis(rays @ view.cam_from_panorama, -1, 0)
    longitude, latitude = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
    return np.stack(
        [(longitude / (2 * np.pi) + 0.5) * width, (0.5 - latitude / np.pi) * height], -1
    )


# -- Cut equirectangular photos and their masks into pinhole views --------------------------------

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

    Returns the views of each panorama that could be read, in order, and what is wrong with the
    others.
    Raises DatasetError: a photo is not twice as wide as high.
    """
    threads = threads or default_threads()
    cut: list[CutView] = []
    bad: list[str] = []
    mapped: tuple[int, int] | None = None
    maps: list[np.ndarray] = []
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
        if (width, height) != mapped:  # one size at a time: 8 bytes a pixel of each view
            mapped, maps = (width, height), []
            for view in VIEWS:
                grid = panorama_pixels(view, width, height) + np.array([_WRAP_PX, 0.0])
                maps.append(grid.astype(np.float32))
        color, grey = _wrapped(decoded.color), None
        if kept is not None:
            grey = _wrapped(np.where(kept, 255, 0).astype(np.uint8)[..., None])
        for index, pixels in enumerate(maps):
            name = view_name(panorama.name, index)
            path = work_folder / CUT_FOLDER / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_photo(path, sample_bicubic(color, pixels, threads))
            mask = None
            if grey is not None:
                mask = (work_folder / CUT_MASKS / name).with_suffix(".png")
                mask.parent.mkdir(parents=True, exist_ok=True)
                write_mask(mask, sample_bicubic(grey, pixels, threads)[..., 0] >= MASK_THRESHOLD)
            cut.append(CutView(name, number, index, mask, width))
        progress.update(
            (number + 1) / len(panoramas), f"cutting panorama {number + 1} of {len(panoramas)}"
        )
    return cut, bad


def _wrapped(pixels: np.ndarray) -> np.ndarray:
    """Return (h, w, c) pixels with columns of the other side at both sides."""
    return np.concatenate([pixels[:, -_WRAP_PX:], pixels, pixels[:, :_WRAP_PX]], 1)


# -- Solve the poses of panoramas from their views, which keep their known directions (a rig) -----

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
        return all_pairs(count)
    return pairs_at_steps(
        count, [*range(1, _NEIGHBOURS + 1), *(2**k for k in range(3, count.bit_length()))]
    )


def solve_panoramas(
    cut: Sequence[CutView], work_folder: Path, progress: Progress, *, seed: int, threads: int
) -> SourceModel:
    """Solve cameras and sparse points of the views of panoramas without poses.

    Views of a panorama share its place and keep the directions that they were cut in; their lens
    is known. Nothing of either is adjusted.

    ``cut``: all of panoramas of one size, as :func:`cut_panoramas` has written them.
    Raises DatasetError: the panoramas differ in size, or fewer than ``MIN_IMAGES`` of them can be
    placed.
    """
    widths = sorted({view.width for view in cut})
    if len(widths) != 1:
        text = f"The panoramas are {', '.join(f'{w} x {w // 2}' for w in widths[:3])} pixels large."
        raise DatasetError(text, "Give panoramas of one size.")
    folder = fresh_folder(work_folder)
    full = view_lens(widths[0])
    side = min(full.width, _MAX_SIFT_PX)
    numbers = sorted({view.panorama for view in cut})
    names: dict[str, CutView] = {}
    for i, view in enumerate(cut):
        name = f"{view.view:02d}/{numbers.index(view.panorama):06d}.jpg"
        visible = None if view.mask is None else read_mask(view.mask)
        color = read_photo(work_folder / CUT_FOLDER / view.name).color
        write_reduced(folder, name, color, visible, (side, side))
        names[name] = view
        progress.update(0.08 * (i + 1) / len(cut), f"reading view {i + 1} of {len(cut)}")
    pitches = [view.pitch_deg for view in VIEWS]
    rings = [[v for v, own in enumerate(pitches) if own == p] for p in (0.0, _TILT_DEG, -_TILT_DEG)]
    pairs = [
        [f"{v:02d}/{a:06d}.jpg", f"{w:02d}/{b:06d}.jpg"]
        for a, b in panorama_pairs(len(numbers))
        for ring in rings
        for v, w in itertools.product(ring, ring)
    ]
    task = {
        "mode": "panoramas", "seed": seed, "threads": threads or default_threads(), "side": side,
        "focal_px": full.resized(side, side).focal[0],
        "cam_from_panorama": [view.cam_from_panorama.tolist() for view in VIEWS],
        "panoramas": len(numbers), "pairs": pairs,
    }  # fmt: skip
    model = run_solver(folder, task, progress, expected_s=_SECONDS_A_PANORAMA * len(numbers))
    save_model(folder, work_folder)
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
            "--set equirectangular=off.",
        )
    warnings = list(model.warnings)
    if len(placed) < len(numbers):
        count = f"{len(numbers) - len(placed)} of {len(numbers)}"
        text = f"{count} panoramas could not be placed and are not used."
        warnings.append(ReportWarning("photos-not-placed", text, "Take more panoramas in between."))
    facts = {**model.facts, "panoramas": len(numbers), "panoramas_placed": len(placed)}
    photos.sort(key=lambda photo: photo.name)
    return dataclasses.replace(
        model, kind=PHOTOS, photos=tuple(photos), warnings=tuple(warnings), facts=facts
    )
