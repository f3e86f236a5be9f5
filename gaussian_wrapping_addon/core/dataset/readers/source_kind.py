# SPDX-License-Identifier: GPL-3.0-or-later
"""Detect the kind of an input, locate its photos, and read its poses if it has any."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...errors import DatasetError
from ..photos.photo_finder import (
    PHOTO_FOLDERS,
    count_raw_photos,
    list_photos,
    mask_roots_of,
    photo_root,
)
from .colmap_reader import find_models, read_colmap
from .source_model import SourceModel
from .splat_header import is_splat_path
from .transforms_reader import find_transforms, read_transforms

_WANTED = (
    "Give a folder of photos, a folder with images/ and sparse/0 (COLMAP), a transforms.json, or "
    "the PLY of a 3D Gaussian splat."
)


SPLAT = "splat"
"""Kind of an input that is a 3D Gaussian splat without photos."""


@dataclass(frozen=True)
class SourceKind:
    """Kind and location of an input."""

    kind: str
    """``"COLMAP model"``, ``"transforms.json"``, ``"photos"`` or ``"splat"``."""
    folder: Path
    """Folder that names in the input are relative to."""
    transforms: Path | None
    """The transforms file, also if a COLMAP model is preferred to it."""

    @property
    def photo_roots(self) -> list[Path]:
        """Folders that photo names may be relative to, in order of preference."""
        roots = [photo_root(self.folder), self.folder]
        # The input is the model folder itself: photos are beside "sparse".
        if self.folder.name == "sparse":
            roots.append(photo_root(self.folder.parent))
        elif self.folder.parent.name == "sparse":
            roots.append(photo_root(self.folder.parent.parent))
        return list(dict.fromkeys(roots))

    @property
    def mask_roots(self) -> list[Path]:
        """Folders that may hold masks."""
        return [m for root in self.photo_roots for m in mask_roots_of(root)]


def source_kind(source: Path) -> SourceKind:
    """Detect the kind of input; prefers a COLMAP model to transforms.json, both to photos.

    Raises
    ------
    DatasetError
        The path does not exist or holds nothing usable.
    """
    if not source.exists():
        raise DatasetError(f"{source} does not exist.", _WANTED)
    if source.is_file():
        if is_splat_path(source):
            return SourceKind(SPLAT, source.parent, None)
        transforms = find_transforms(source)
        if transforms is None:
            raise DatasetError(f"{source.name} is a file, but not a transforms.json.", _WANTED)
        return SourceKind("transforms.json", source.parent, transforms)
    if not source.is_dir():
        raise DatasetError(f"{source.name} is neither a file nor a folder.", _WANTED)
    transforms = find_transforms(source)
    if find_models(source):
        return SourceKind("COLMAP model", source, transforms)
    if transforms is not None:
        return SourceKind("transforms.json", source, transforms)
    if source.name in PHOTO_FOLDERS and find_models(source.parent):
        return SourceKind("COLMAP model", source.parent, find_transforms(source.parent))
    if list_photos(photo_root(source)):
        return SourceKind("photos", source, None)
    name, raw_photos = source.name or source, count_raw_photos(source)
    if raw_photos:
        raise DatasetError(
            f"{name} holds no photo that can be read, but {raw_photos} HEIC or RAW files.",
            "Export them as JPEG or PNG first.",
        )
    raise DatasetError(f"{name} holds no photos.", _WANTED)


def read_poses(kind: SourceKind) -> SourceModel:
    """Read the poses of an input that has them.

    Raises
    ------
    ParseError, DatasetError
    """
    if kind.kind == SPLAT:
        raise DatasetError("A splat contains no cameras.", "Give the input that it was trained on.")
    if kind.kind == "COLMAP model":
        return read_colmap(kind.folder)
    assert kind.transforms is not None
    return read_transforms(kind.transforms)
