# SPDX-License-Identifier: GPL-3.0-or-later
"""Find photos on disk and match the names of an input to them."""

from __future__ import annotations

import functools
import os
import unicodedata
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ... import limits
from ...errors import DatasetError
from ...files import resolve_inside
from .photo_header import PHOTO_SUFFIXES

PHOTO_FOLDERS = ("images", "photos", "input", "rgb")
MASK_FOLDERS = ("masks", "mask")
RAW_SUFFIXES = (
    ".heic", ".heif", ".avif",
    ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2",
)  # fmt: skip
_MAX_DEPTH = 8


def list_photos(root: Path) -> list[Path]:
    """List photo files under ``root``, sorted by name, without masks and hidden folders.

    Links to files are followed, links to folders are not (they could form a loop).

    Raises
    ------
    DatasetError
        More files than the limit.
    """
    found: list[Path] = []
    base_depth = len(root.parts)
    for folder, subfolders, names in os.walk(root):
        here = Path(folder)
        deep = len(here.parts) - base_depth >= _MAX_DEPTH
        subfolders[:] = (
            []
            if deep
            else sorted(
                s for s in subfolders if not s.startswith(".") and s.lower() not in MASK_FOLDERS
            )
        )
        found += [
            here / name
            for name in names
            if not name.startswith(".") and PurePosixPath(name).suffix.lower() in PHOTO_SUFFIXES
        ]
        if len(found) > limits.MAX_IMAGES:
            raise DatasetError(
                f"{root.name} holds more than {limits.MAX_IMAGES} photos.", "Choose a subfolder."
            )
    return sorted(found, key=lambda p: p.relative_to(root).as_posix())


def count_raw_photos(root: Path) -> int:
    """Count the camera RAW and HEIC files under ``root``, which must be converted first."""
    return sum(
        PurePosixPath(name).suffix.lower() in RAW_SUFFIXES
        for _, _, names in os.walk(root)
        for name in names
    )


def photo_root(source: Path) -> Path:
    """Return the subfolder that holds the photos of a data set, or ``source`` itself."""
    for name in PHOTO_FOLDERS:
        if (source / name).is_dir() and list_photos(source / name):
            return source / name
    return source


def resolve_photo(root: Path, name: str) -> Path | None:
    """Return the path of a photo or mask of a data set, or ``None`` if the name is unsafe.

    As :func:`~...files.resolve_inside`, but the folders of photos and masks themselves may be
    links: people keep photos on another disk.
    """
    path = resolve_inside(root, name)
    folder, _, rest = name.replace("\\", "/").partition("/")
    if path is None and rest and folder.lower() in (*PHOTO_FOLDERS, *MASK_FOLDERS):
        path = resolve_inside(root / folder, rest)
    return path


@dataclass(frozen=True)
class Match:
    """A found photo, and how: ``"exact"``, ``"case"``, ``"extension"`` or ``"folder"``."""

    path: Path
    how: str


class PhotoIndex:
    """Photos looked up by the names that a model uses.

    Parameters
    ----------
    roots : list of Path
        Names are looked up exactly under each of them, then by looser rules under the first.
    """

    def __init__(self, roots: list[Path]) -> None:
        self.roots = roots

    @functools.cached_property
    def _by_key(self) -> dict[tuple[str, str], list[Path]]:
        table: dict[tuple[str, str], list[Path]] = {}
        root = self.roots[0]
        for path in list_photos(root):
            for how, key in _keys(path.relative_to(root).as_posix()):
                paths = table.setdefault((how, key), [])
                if path not in paths:
                    paths.append(path)
        return table

    def find(self, name: str) -> Match | None:
        """Return the photo of ``name``; looser rules apply only if they give one candidate."""
        for root in self.roots:
            path = resolve_photo(root, name)
            if path is not None and os.path.isfile(path):
                return Match(path, "exact")
        clean = str(PurePosixPath(name.replace("\\", "/")))
        keys = _keys(clean)
        # A name without extension may still hold a dot: "img.0001".
        keys.insert(1, ("extension", keys[0][1]))
        for how, key in keys:
            paths = self._by_key.get((how, key), [])
            if len(paths) > 1 and how == "extension":
                paths = [p for p in paths if p.suffix.lower() == ".png"]
            if len(paths) == 1:
                return Match(paths[0], how)
        return None


def _keys(name: str) -> list[tuple[str, str]]:
    """Return the keys by which a name is matched, strictest first."""
    folded = unicodedata.normalize("NFC", name).casefold()
    stem = str(PurePosixPath(folded).with_suffix("")) if PurePosixPath(folded).name else folded
    return [
        ("case", folded),
        ("extension", stem),
        ("folder", PurePosixPath(folded).name),
        ("folder", PurePosixPath(stem).name),
    ]


def mask_candidates(name: str) -> list[str]:
    """Return the names a photo's mask may have in a mask folder, most specific first."""
    pure = PurePosixPath(name.replace("\\", "/"))
    return [f"{pure}.png", str(pure.with_suffix(".png")), str(pure)]


def find_mask(mask_roots: list[Path], name: str) -> Path | None:
    """Return the mask of photo ``name``: ``x.jpg.png``, ``x.png`` or the same name."""
    for root in mask_roots:
        for candidate in mask_candidates(name):
            path = resolve_photo(root, candidate)
            if path is not None and os.path.isfile(path):
                return path
    return None


def mask_roots_of(source: Path) -> list[Path]:
    """Return the folders beside the photos that may hold masks."""
    parents = [source, source.parent] if source.name in PHOTO_FOLDERS else [source]
    return [p / name for p in parents for name in MASK_FOLDERS if (p / name).is_dir()]
