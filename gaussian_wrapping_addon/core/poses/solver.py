# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera poses from photos alone, solved in a helper process."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError
from ..files import read_json, write_json
from ..limits import HELPER_DEADLINE_S, MAX_UNREADABLE_SHARE, MIN_IMAGES
from ..machine import helper_memory_limit_bytes
from ..parallel import default_threads
from ..photos.exif import GpsPosition, LensExif, read_gps_exif, read_lens_exif
from ..photos.finder import find_mask
from ..photos.photo_file import (
    AS_WRITTEN,
    MASK_THRESHOLD,
    DecodedPhoto,
    MaskReading,
    photo_header,
    read_mask,
    read_photo,
    write_mask,
    write_photo,
)
from ..progress import UNREADABLE_HINT, Progress, ReportWarning
from ..readers.colmap import ModelFiles, read_model
from ..readers.source_model import PHOTOS, PosedPhoto, SourceModel
from ..scene.scene import View
from ..worker.helper_process import run_helper
from .checks import MIN_GROUP, TURNING_FOLDER, TURNTABLE_NAME, photos_in_parts, with_findings
from .matching import EXHAUSTIVE_LIMIT, pairs_by_pose

# -- What the pose solver found of a turntable: facts, warnings and masks of the photos' full size

_NOT_FOUND = ReportWarning(
    "no-turntable",
    f"No turntable was found: fewer than {MIN_GROUP} photos are of one size.",
    "Take more photos from one place, or set Turntable to Auto.",
)
_NOT_MASKED_HINT = "Give masks, or put a background behind the object that looks different from it."


def with_turntable(
    model: SourceModel,
    folder: Path,
    sizes: Mapping[str, tuple[int, int]],
    target: Path,
    *,
    wanted: bool,
) -> SourceModel:
    """Add what the solver found to a model that still has the solver's names.

    Parameters
    ----------
    folder : Path
        The solver's.
    sizes : mapping of str to (int, int)
        Width and height of the photos.
    target : Path
        New folder for the masks.
    wanted : bool
        The user says that there is a turntable.

    Returns
    -------
    SourceModel
        With the facts ``turntable_photos`` and, where masks were made,
        ``photos_masked_as_turning``.
    """
    from PIL import Image

    found = read_json(folder / TURNTABLE_NAME)
    warnings = list(model.warnings)
    if not found["photos"]:
        warnings += [_NOT_FOUND] if wanted else []
        return dataclasses.replace(model, warnings=tuple(warnings))
    facts = {**model.facts, "turntable_photos": found["photos"]}
    photos = model.photos
    if any((folder / "masks").iterdir()):
        text = (
            f"{found['photos']} photos show a turntable. Their background is not masked, because "
            "photos have masks of their own."
        )
        hint = "Set Masks to Background if they leave out all but the object."
        warnings.append(ReportWarning("turntable-with-masks", text, hint))
    elif not found["is_masked"]:
        text = (
            f"The camera stands still in {found['photos']} photos, but what turns cannot be told "
            "from what stands still: its masks would be wrong, so none are used."
        )
        warnings.append(ReportWarning("turntable-not-masked", text, _NOT_MASKED_HINT))
    else:
        target.mkdir()
        masked = []
        for posed in photos:
            path = folder / TURNING_FOLDER / f"{posed.name}.png"
            if path.is_file():
                grey = Image.fromarray(read_mask(path))
                whole = np.asarray(grey.resize(sizes[posed.name], Image.Resampling.BILINEAR))
                write_mask(target / path.name, whole >= MASK_THRESHOLD)
                posed = dataclasses.replace(posed, mask_path=target / path.name)
            masked.append(posed)
        photos = tuple(masked)
        facts["photos_masked_as_turning"] = sum(p.mask_path is not None for p in photos)
    return dataclasses.replace(model, photos=photos, facts=facts, warnings=tuple(warnings))


# -- Solve camera poses, or triangulate points of posed photos, in a helper process ---------------
#
# The photos are decoded here, oriented, limited in size and written under plain names; the native
# solver reads only these files. Its result is a COLMAP model read by our own reader.

MAX_SIFT_PX = 1600
"""Long side of the photos that features are extracted from."""
TURNTABLE_FOLDER = "turntable"
"""Masks of what turns, of the photos' full size."""
_HELPER = "poses.solver_helper"
"""Module of the process that solves."""
_UNKNOWN_LENS = LensExif((), None)
_SECONDS_A_PHOTO = 60.0
"""Longest time that solving may take: more than ten times what 400 photos took on two cores."""


@dataclass(frozen=True)
class _SolverPhoto:
    """One photo as passed to the solver."""

    name: str
    """Name under ``images/`` of the task folder."""
    source_name: str
    """Name in the input."""
    width: int
    height: int
    full_width: int
    full_height: int
    lens_key: tuple[str, ...]
    focal_px: float | None
    """Focal length from EXIF, in pixels of this size."""


def solve_poses(
    root: Path,
    photos: Sequence[Path],
    mask_roots: list[Path],
    work_folder: Path,
    progress: Progress,
    *,
    seed: int = 0,
    threads: int = 0,
    turntable: str = "auto",
    reading: MaskReading = AS_WRITTEN,
    in_order: bool = False,
) -> SourceModel:
    """Solve cameras and sparse points of photos without poses (structure from motion).

    Parameters
    ----------
    root : Path
        Folder that the photo names are relative to.
    photos : sequence of Path
    mask_roots : list of Path
        Folders of masks; features on black pixels are not used.
    work_folder : Path
        Temporary files, ``cameras/`` (the COLMAP model) and ``turntable/`` (masks) are written
        here.
    turntable : {"auto", "on", "off"}
        Whether the camera stood still while the object turned; ``"auto"`` sees it by matches that
        stay in their place. Matches of the background are then left out, and the background is
        masked, unless a photo has a mask.
    reading : MaskReading
        How mask files are understood.
    in_order : bool
        Photos sorted by name were taken one after the other, as of a video. Matters where there are
        too many to match all pairs.

    Returns
    -------
    SourceModel
        Photos that could not be registered are left out, with a warning. World is the solver's own
        frame. Reproducible for the same seed with one thread; with more, the native matcher
        differed once in about 60 runs.

    Raises
    ------
    DatasetError
        Too few photos can be decoded, or fewer than ``MIN_IMAGES`` can be registered.
    """
    folder = fresh_folder(work_folder)
    prepared: list[_SolverPhoto] = []
    bad: list[str] = []
    positions: list[GpsPosition | None] = []
    for i, path in enumerate(photos):
        name = path.relative_to(root).as_posix()
        try:
            decoded = read_photo(path, enough_px=MAX_SIFT_PX)
            full_size = photo_header(path).upright_size
        except DatasetError as error:
            bad.append(error.message)
            check_unreadable_share(bad, len(photos))
            continue
        mask = find_mask(mask_roots, name, [root])
        visible = _visible(decoded, mask, reading)
        lens = read_lens_exif(path, *full_size)
        prepared.append(
            _write_solver_photo(folder, i, decoded.color, visible, full_size, lens, name)
        )
        positions.append(read_gps_exif(path) if len(photos) > EXHAUSTIVE_LIMIT else None)
        progress.update(0.08 * (i + 1) / len(photos), f"reading photo {i + 1} of {len(photos)}")
    if len(prepared) < MIN_IMAGES:
        text = f"Only {len(prepared)} photos can be read; {MIN_IMAGES} are needed."
        raise DatasetError(text, "Add photos.")
    groups: dict[tuple[Any, ...], list[_SolverPhoto]] = {}
    for photo in prepared:
        groups.setdefault((photo.full_width, photo.full_height, *photo.lens_key), []).append(photo)
    told = []
    for group in groups.values():
        size = {"width": group[0].width, "height": group[0].height}
        told.append({**size, "focal_px": group[0].focal_px, "names": [p.name for p in group]})
    task = {
        "mode": "solve", "seed": seed, "threads": threads or default_threads(),
        "turntable": turntable, "groups": told, "in_order": in_order,
        "positions": [p and [p.latitude_deg, p.longitude_deg] for p in positions],
    }  # fmt: skip
    model = run_solver(folder, task, progress, expected_s=_SECONDS_A_PHOTO * len(prepared))
    sizes = {p.name: (p.full_width, p.full_height) for p in prepared}
    target = work_folder / TURNTABLE_FOLDER
    model = with_turntable(model, folder, sizes, target, wanted=turntable == "on")
    model = with_findings(model, folder, {p.name: p.source_name for p in prepared})
    in_parts = photos_in_parts(folder)
    save_model(folder, work_folder)
    return _with_source_names(model, prepared, bad, in_parts)


def _with_source_names(
    model: SourceModel, prepared: list[_SolverPhoto], bad: list[str], in_parts: Collection[str]
) -> SourceModel:
    """Restore original names and full-size intrinsics of the solved photos.

    Of photos that are not placed, those ``in_parts`` have a warning already.
    """
    offered = len(prepared) + len(bad)
    of_name = {p.name: p for p in prepared}
    photos: list[PosedPhoto] = []
    for posed in model.photos:
        photo = of_name[posed.name]
        assert posed.lens is not None
        lens = posed.lens.resized(photo.full_width, photo.full_height)
        photos.append(dataclasses.replace(posed, name=photo.source_name, lens=lens))
    photos.sort(key=lambda p: p.name)
    if len(photos) < MIN_IMAGES:
        text = f"Only {len(photos)} of {offered} photos could be placed; {MIN_IMAGES} are needed."
        hint = "Take more photos with more overlap, from a textured object that does not move."
        raise DatasetError(text, hint)
    warnings = list(model.warnings)
    explained = {p.name for p in model.photos}.union(in_parts)
    unregistered = [p.source_name for p in prepared if p.name not in explained]
    if unregistered:
        listed = ", ".join(unregistered[:5]) + (" ..." if len(unregistered) > 5 else "")
        count = f"{len(unregistered)} of {len(prepared)}"
        text = f"{count} photos could not be placed and are not used: {listed}."
        hint = "Take more photos with more overlap there, or remove blurred ones."
        warnings.append(ReportWarning("photos-not-placed", text, hint))
    if bad:
        text = f"{len(bad)} photos cannot be read and are not used: {bad[0]}"
        warnings.append(ReportWarning("photos-unreadable", text, UNREADABLE_HINT))
    facts = {
        "photos": offered,
        "photos_placed": len(photos),
        "photos_with_focal_length": sum(p.focal_px is not None for p in prepared),
        **{k: v for k, v in model.facts.items() if k != "images_in_model"},
    }
    return dataclasses.replace(
        model, kind=PHOTOS, photos=tuple(photos), warnings=tuple(warnings), facts=facts
    )


def triangulate_points(
    views: Sequence[View], work_folder: Path, progress: Progress, *, seed: int, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate features of photos with known, fixed pinhole cameras.

    Returns ``points``: (n, 3) float64, in the frame of ``cameras``; may be empty; ``colors``:
    (n, 3) uint8.
    """
    folder = fresh_folder(work_folder)
    entries = []
    cameras = [view.camera for view in views]
    for i, (view, camera) in enumerate(zip(views, cameras, strict=True)):
        decoded, size = read_photo(view.photo_path), (camera.width, camera.height)
        visible = _visible(decoded, view.mask_path, AS_WRITTEN)
        prepared = _write_solver_photo(folder, i, decoded.color, visible, size)
        small = camera.resized(prepared.width, prepared.height)
        entries.append({
            "name": prepared.name, "width": small.width, "height": small.height,
            "params": [small.fx, small.fy, small.cx, small.cy],
            "cam_from_world": np.asarray(small.cam_from_world).tolist(),
        })  # fmt: skip
        progress.update(0.08 * (i + 1) / len(views), f"reading photo {i + 1} of {len(views)}")
    pairs = pairs_by_pose(
        np.array([c.center for c in cameras]), np.array([c.forward for c in cameras])
    )
    task = {
        "mode": "triangulate", "seed": seed, "threads": threads or default_threads(),
        "photos": entries, "pairs": [[entries[i]["name"], entries[j]["name"]] for i, j in pairs],
    }  # fmt: skip
    model = run_solver(folder, task, progress)
    shutil.rmtree(folder)
    return model.points, model.point_colors


def run_solver(
    folder: Path, task: dict[str, Any], progress: Progress, *, expected_s: float = 0.0
) -> SourceModel:
    """Run a task of the helper in ``folder``, with the last 92 % of ``progress``; read its model.

    ``expected_s`` is the longest time that it may take, where that is more than usual.
    """
    write_json(folder / "task.json", task)
    run_helper(
        _HELPER, folder, progress.span(0.08, 1.0), memory_bytes=helper_memory_limit_bytes(),
        deadline_s=max(HELPER_DEADLINE_S, expected_s),
    )  # fmt: skip
    return read_model(ModelFiles(folder / "model", ".bin"))


def check_unreadable_share(bad: Sequence[str], offered: int) -> None:
    """Raise :class:`DatasetError` once more than a fifth of the photos cannot be read."""
    if len(bad) > MAX_UNREADABLE_SHARE * offered:
        text = f"{len(bad)} of {offered} photos cannot be read. First: {bad[0]}"
        raise DatasetError(text, "Restore the photos, or remove the bad ones.")


def _visible(decoded: DecodedPhoto, mask: Path | None, reading: MaskReading) -> np.ndarray | None:
    """Return what the mask of a photo, or else its transparency, shows of it, uint8."""
    if mask is None:
        return decoded.alpha
    return np.where(reading.kept(read_mask(mask)), 255, 0).astype(np.uint8)


def _write_solver_photo(
    folder: Path,
    index: int,
    color: np.ndarray,
    visible: np.ndarray | None,
    full_size: tuple[int, int],
    lens: LensExif = _UNKNOWN_LENS,
    source_name: str = "",
) -> _SolverPhoto:
    """Write one upright photo, and what is ``visible`` of it (uint8), in limited size.

    ``full_size`` is (width, height) of the whole photo, which may be decoded at less.
    """
    full_width, full_height = full_size
    factor = min(1.0, MAX_SIFT_PX / max(full_width, full_height))
    size = (max(1, round(full_width * factor)), max(1, round(full_height * factor)))
    name = f"{index:06d}.jpg"
    write_reduced(folder, name, color, visible, size)
    focal_px = None if lens.focal_px is None else lens.focal_px * factor
    return _SolverPhoto(name, source_name, *size, full_width, full_height, lens.key, focal_px)


def write_reduced(
    folder: Path, name: str, color: np.ndarray, visible: np.ndarray | None, size: tuple[int, int]
) -> None:
    """Write a photo of a task, and what is ``visible`` of it (uint8), at width and height."""
    from PIL import Image

    if size != (color.shape[1], color.shape[0]):
        color = np.asarray(Image.fromarray(color).resize(size, Image.Resampling.LANCZOS))
    target, mask = folder / "images" / name, folder / "masks" / f"{name}.png"
    target.parent.mkdir(exist_ok=True)
    write_photo(target, color)
    if visible is not None:
        mask.parent.mkdir(exist_ok=True)
        Image.fromarray(visible).resize(size, Image.Resampling.NEAREST).save(mask)


def fresh_folder(work_folder: Path) -> Path:
    """Return a new folder for a task of the helper; what an earlier run has left is removed."""
    folder = work_folder / "pose_solver"
    for earlier in (folder, work_folder / TURNTABLE_FOLDER):
        if earlier.exists():
            shutil.rmtree(earlier)
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    return folder


def save_model(folder: Path, work_folder: Path) -> None:
    """Keep the solved model as ``cameras/``, drop features and temporary photos."""
    target = work_folder / "cameras"
    if target.exists():
        shutil.rmtree(target)
    os.replace(folder / "model", target)
    shutil.rmtree(folder)
