# SPDX-License-Identifier: GPL-3.0-or-later
"""Panoramas of an input replaced by their pinhole views, posed or to be solved."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from ...errors import DatasetError
from ...progress import Progress
from ...report_warning import UNREADABLE_HINT, ReportWarning
from ..panoramas.panorama_cutting import CUT_FOLDER, CutView, Panorama, cut_panoramas
from ..panoramas.panorama_solver import solve_panoramas
from ..panoramas.panorama_views import BY_SHAPE, VIEWS, panorama_evidence, view_lens
from ..photos.mask_reading import MaskReading
from ..photos.photo_finder import PhotoIndex, find_mask, photo_root, resolve_photo
from ..poses.pose_solver import check_unreadable_share
from ..readers.source_model import PosedPhoto, SourceModel
from .source_kind import SourceKind

_CUTTING = 0.3
"""Share of the progress that cutting takes where cameras are solved afterwards."""


def takes_for_panoramas(photos: Sequence[Path], mode: str) -> bool:
    """Whether photos without cameras are cut: ``"on"``, or ``"auto"`` where they look so."""
    return mode == "on" or (mode == "auto" and bool(panorama_evidence(photos)))


def shape_warning(photos: Sequence[Path], mode: str) -> list[ReportWarning]:
    """Return the warning about photos that are cut for their shape alone, or none."""
    if mode != "auto" or panorama_evidence(photos) != BY_SHAPE:
        return []
    text = (
        "The photos are taken for 360 degree panoramas, as all are exactly twice as wide as high; "
        f"each is cut into {len(VIEWS)} views. Nothing else in them says so."
    )
    hint = "Set 360° Photos to Off (--equirectangular off) if they are ordinary photos."
    return [ReportWarning("panoramas-by-shape", text, hint)]


def with_views_of_panoramas(
    model: SourceModel,
    kind: SourceKind,
    work_folder: Path,
    progress: Progress,
    reading: MaskReading,
    *,
    threads: int,
) -> tuple[SourceModel, SourceKind]:
    """Cut the panoramas of a model with poses; other photos stay.

    Returns
    -------
    model : SourceModel
        Every panorama replaced by its views.
    kind : SourceKind
        That finds them.

    Raises
    ------
    DatasetError
        No panorama was found, or one is not twice as wide as high.
    """
    index = PhotoIndex(kind.photo_roots)
    posed = [photo for photo in model.photos if photo.is_panorama]
    found: list[Panorama] = []
    owners: list[PosedPhoto] = []
    missing: list[str] = []
    masks_missing: list[str] = []
    used: set[Path] = set()
    for photo in sorted(posed, key=lambda one: one.name):
        match = index.find(photo.name)
        if match is None or match.path in used:
            missing.append(photo.name)
            continue
        used.add(match.path)
        if photo.mask_name is None:
            mask = find_mask(kind.mask_roots, photo.name, kind.photo_roots)
        else:
            mask = resolve_photo(kind.folder, photo.mask_name)
            if mask is not None and not mask.is_file():
                mask = None
            if mask is None:
                masks_missing.append(photo.mask_name)
        found.append(Panorama(photo.name, match.path, mask))
        owners.append(photo)
    if not found:
        raise DatasetError(
            f"None of the {len(posed)} panoramas that the {model.kind} names was found.",
            f"Looked for {missing[0]} in {', '.join(str(root) for root in kind.photo_roots)}.",
        )
    cut, bad = cut_panoramas(found, work_folder, progress, reading, threads=threads)
    check_unreadable_share(bad, len(found))
    photos = [photo for photo in model.photos if not photo.is_panorama]
    for view in cut:
        pose = owners[view.panorama].cam_from_world
        turned = VIEWS[view.view].cam_from_panorama @ pose
        photos.append(PosedPhoto(view.name, view_lens(view.width), turned, mask_path=view.mask))
    warnings = [*model.warnings, *_warnings(bad, missing)]
    if masks_missing:
        text = f"{len(masks_missing)} masks were not used: {masks_missing[0]} is missing."
        warnings.append(ReportWarning("masks-not-used", text))
    facts = {**model.facts, "panoramas": len(found), "views_of_panoramas": len(cut)}
    model = dataclasses.replace(model, photos=tuple(photos), warnings=tuple(warnings), facts=facts)
    return model, dataclasses.replace(kind, cut_folder=work_folder / CUT_FOLDER)


def solve_views_of_panoramas(
    photos: Sequence[Path],
    kind: SourceKind,
    work_folder: Path,
    progress: Progress,
    reading: MaskReading,
    *,
    seed: int,
    threads: int,
) -> tuple[SourceModel, SourceKind]:
    """Cut photos without cameras, and solve the poses of the panoramas.

    Raises
    ------
    DatasetError
        A photo is not twice as wide as high, or too few panoramas can be placed.
    """
    root = photo_root(kind.folder)
    names = [path.relative_to(root).as_posix() for path in photos]
    panoramas = [
        Panorama(name, path, find_mask(kind.mask_roots, name, [root]))
        for name, path in zip(names, photos, strict=True)
    ]
    cut: list[CutView]
    cut, bad = cut_panoramas(
        panoramas, work_folder, progress.span(0.0, _CUTTING), reading, threads=threads
    )
    check_unreadable_share(bad, len(panoramas))
    folder = work_folder / CUT_FOLDER
    model = solve_panoramas(
        cut, folder, work_folder, progress.span(_CUTTING, 1.0), seed=seed, threads=threads
    )
    model = dataclasses.replace(model, warnings=(*model.warnings, *_warnings(bad, [])))
    return model, dataclasses.replace(kind, cut_folder=folder)


def _warnings(bad: Sequence[str], missing: Sequence[str]) -> list[ReportWarning]:
    found = []
    if bad:
        text = f"{len(bad)} panoramas cannot be read and are not used: {bad[0]}"
        found.append(ReportWarning("photos-unreadable", text, UNREADABLE_HINT))
    if missing:
        text = f"{len(missing)} panoramas were not found: {', '.join(missing[:3])}."
        found.append(ReportWarning("photos-not-found", text))
    return found
