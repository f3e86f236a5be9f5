# SPDX-License-Identifier: GPL-3.0-or-later
"""Made masks and their folder."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from .. import limits
from ..errors import DatasetError, ParseError, ResourceError
from ..files import is_real_folder, read_bounded, read_json, resolve_inside, write_bytes, write_json
from ..limits import MAX_MODEL_BYTES

# -- The file of a segmentation model, looked at before a job starts. Standard library only -------


def check_model_file(path: Path) -> None:
    """Raise where a model's file is missing, no regular file, empty or too large; reads nothing.

    Raises DatasetError, ResourceError.
    """
    try:
        size = path.stat().st_size if path.is_file() else None
    except OSError:
        size = None
    if not size:
        state = "is empty" if size == 0 else "is not there, or no file"
        raise DatasetError(f"The mask model {path} {state}.", "Check the path.")
    if size > MAX_MODEL_BYTES:
        raise ResourceError(
            f"The mask model {path.name} has {size / 2**30:.1f} GiB; "
            f"{MAX_MODEL_BYTES / 2**30:.0f} GiB are the limit.",
            "Choose a smaller model.",
        )


# -- The folder of made masks: PNGs to look at and edit, and the list of those that were rejected
#
# Standard library only, so that Blender can load it.

FOLDER = "masks"
"""In the job folder."""
LIST_NAME = "masks.json"
VERSION = 1
MOST_MASK_BYTES = 4 * limits.MAX_IMAGE_PIXELS
"""Largest mask file that is read: one byte a pixel and channel, uncompressed."""
_KEY = re.compile("[0-9a-f]{1,64}")
_logger = logging.getLogger(__name__)
_HINT = "Delete the folder masks and resume the job: its masks are made again."


@dataclass(frozen=True)
class MadeMask:
    """One mask of the list."""

    photo: str
    """Name of the photo, as the cameras have it."""
    file: str
    """Of the mask, below the folder."""
    image: str
    """Path of the photo as it is trained on; relative to the job folder where it lies in it."""


@dataclass(frozen=True)
class MaskList:
    """Content of ``masks.json``."""

    made_by: str
    """Key of the stage that made the masks."""
    masks: tuple[MadeMask, ...]
    rejected: frozenset[str] = frozenset()
    """Names of photos that are left out."""

    def with_decision(self, photo: str, *, accepted: bool) -> MaskList:
        """Return the list with one photo accepted or rejected."""
        others = self.rejected - {photo}
        return replace(self, rejected=others if accepted else others | {photo})


def read_list(folder: Path) -> MaskList | None:
    """Return the list of a masks folder, or ``None`` where there is none.

    Raises ParseError: it is damaged, of another version, or names files outside of the folder.
    """
    path = folder / LIST_NAME
    if not path.is_file():
        return None
    values = read_json(path)
    if not isinstance(values, dict) or values.get("version") != VERSION:
        raise ParseError(path, "version", f"version {VERSION} was expected.", _HINT)
    entries, rejected, made_by = (values.get(n) for n in ("masks", "rejected", "made_by"))
    if not isinstance(entries, list) or len(entries) > limits.MAX_IMAGES:
        raise ParseError(path, "masks", "not a list of masks.", _HINT)
    if not isinstance(rejected, list) or not all(isinstance(name, str) for name in rejected):
        raise ParseError(path, "rejected", "not a list of names of photos.", _HINT)
    if not isinstance(made_by, str) or not _KEY.fullmatch(made_by):
        raise ParseError(path, "made_by", "not the key of a stage.", _HINT)
    masks = tuple(_entry(path, folder, number, entry) for number, entry in enumerate(entries))
    unknown = set(rejected) - {mask.photo for mask in masks}
    if unknown:
        raise ParseError(
            path, "rejected", f"there is no photo {min(unknown)!r}.", "Correct its name."
        )
    return MaskList(made_by, masks, frozenset(rejected))


def _entry(path: Path, folder: Path, number: int, values: Any) -> MadeMask:
    where = f"masks[{number}]"
    names = ("photo", "file", "image")
    if not isinstance(values, dict) or not all(isinstance(values.get(n), str) for n in names):
        raise ParseError(path, where, "not photo, file and image.", _HINT)
    if resolve_inside(folder, values["file"]) is None:
        raise ParseError(path, where, f"{values['file']!r} is no file of this folder.", _HINT)
    return MadeMask(values["photo"], values["file"], values["image"])


def write_list(folder: Path, masks: MaskList) -> None:
    """Write ``masks.json`` atomically."""
    entries = [{"photo": m.photo, "file": m.file, "image": m.image} for m in masks.masks]
    values = {"version": VERSION, "made_by": masks.made_by, "masks": entries}
    write_json(folder / LIST_NAME, {**values, "rejected": sorted(masks.rejected)})


def mask_names(photos: Sequence[str]) -> list[str]:
    """Return a file name for the mask of each photo: ``a/b.jpg.png``, or a number where unsafe."""
    names: list[str] = []
    used: set[str] = set()
    folders: set[str] = set()
    for index, photo in enumerate(photos):
        name = f"{photo}.png".replace("\\", "/")
        above = {parent.as_posix().casefold() for parent in PurePosixPath(name).parents}
        if (
            resolve_inside(Path(FOLDER), name) is None
            or name.casefold() in used | folders | {LIST_NAME}
            or above & used
        ):
            name, above = f"{index:06d}.png", set()
        used.add(name.casefold())
        folders |= above
        names.append(name)
    return names


def publish(root: Path, made: Path, masks: MaskList) -> Path:
    """Put masks that were made into the job's folder of masks, unless they are there.

    A folder that a person may have edited is kept: masks of another origin are moved aside, to
    ``masks-KEY``, and come back from there; files without a list, to ``masks-kept``.

    Parameters
    ----------
    root : Path
        The job folder.
    made : Path
        Where the files ``000000.png``, ... lie, in the order of ``masks``.

    Returns
    -------
    Path
        The folder of masks.
    """
    folder = root / FOLDER
    there = read_list(folder)
    if there is not None and there.made_by == masks.made_by:
        return folder
    # Complete before it takes the place of the other: an interrupted run leaves no half there.
    ready = root / f"{FOLDER}-{masks.made_by}"
    if not is_real_folder(ready) or read_list(ready) is None:
        if is_real_folder(ready):
            shutil.rmtree(ready)
        ready.mkdir()
        for index, mask in enumerate(masks.masks):
            target = ready / mask.file
            target.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(target, read_bounded(made / f"{index:06d}.png", MOST_MASK_BYTES))
        write_list(ready, masks)
    if there is not None:
        aside = root / f"{FOLDER}-{there.made_by}"
        if is_real_folder(aside):
            shutil.rmtree(aside)
        os.replace(folder, aside)
    elif folder.exists():
        aside = _unused(root)
        os.replace(folder, aside)
        _logger.warning(
            "%s held files that this job has not made: they are in %s now.", folder.name, aside.name
        )
    os.replace(ready, folder)
    return folder


def _unused(root: Path) -> Path:
    """Return a name for files that are not ours."""
    number = 1
    while (aside := root / f"{FOLDER}-kept{'' if number == 1 else f'-{number}'}").exists():
        number += 1
    return aside


def used_masks(folder: Path, masks: MaskList) -> Iterable[tuple[MadeMask, Path]]:
    """Yield the masks that count, with their files: neither rejected nor deleted."""
    for mask in masks.masks:
        path = folder / mask.file
        if mask.photo not in masks.rejected and path.is_file():
            yield mask, path


def digest(folder: Path, masks: MaskList) -> str:
    """Return a hash of the masks that count, whatever their dates, for the key of a training.

    Raises ParseError: a mask is a link or another thing that is not a file, or too large.
    """
    found = hashlib.sha256()
    for mask, path in used_masks(folder, masks):
        content = hashlib.sha256(read_bounded(path, MOST_MASK_BYTES)).hexdigest()
        found.update(f"{mask.photo}\0{content}\n".encode(errors="surrogateescape"))
    return found.hexdigest()
