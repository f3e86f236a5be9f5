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
MASK_ENDINGS = ("_mask", "-mask", ".mask")
"""Of the stem of a mask's name, as other programs write it beside the photo or in a folder."""
MASK_SUFFIXES = (".png", ".jpg", ".tif")
RAW_SUFFIXES = (
    ".heic", ".heif", ".avif",
    ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2",
)  # fmt: skip
_MAX_DEPTH = 8


def list_photos(root: Path) -> list[Path]:
    """List photo files under ``root``, sorted by name, without masks and hidden folders.

    ``x_mask.png`` is a mask where ``x.jpg`` lies beside it, else a photo.

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
        shown = [
            name
            for name in names
            if not name.startswith(".") and PurePosixPath(name).suffix.lower() in PHOTO_SUFFIXES
        ]
        masked = _masked_by(shown)
        found += [here / name for name in shown if name not in masked]
        if len(found) > limits.MAX_IMAGES:
            raise DatasetError(
                f"{root.name} holds more than {limits.MAX_IMAGES} photos.", "Choose a subfolder."
            )
    return sorted(found, key=lambda p: p.relative_to(root).as_posix())


def _masked_by(names: list[str]) -> set[str]:
    """Return which of the names of one folder are masks of others."""
    known = {name.casefold() for name in names}
    known |= {PurePosixPath(name).stem for name in known}
    masks = set()
    for name in names:
        stem = PurePosixPath(name).stem.casefold()
        for ending in MASK_ENDINGS:
            if stem.endswith(ending) and stem.removesuffix(ending) in known:
                masks.add(name)
    return masks


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
    return [f"{pure}.png", str(pure.with_suffix(".png")), str(pure), *_marked_masks(name)]


def _marked_masks(name: str) -> list[str]:
    """Return the names of a photo's mask that say so, for any folder."""
    pure = PurePosixPath(name.replace("\\", "/"))
    bases = (str(pure), str(pure.with_suffix("")))
    return [f"{b}{ending}{s}" for b in bases for ending in MASK_ENDINGS for s in MASK_SUFFIXES]


def find_mask(mask_roots: list[Path], name: str) -> Path | None:
    """Return the mask of photo ``name``, or ``None``.

    In a folder of masks ``x.jpg.png``, ``x.png`` or the same name; there and beside the photo
    ``x_mask.png`` and the like (``MASK_ENDINGS``, ``MASK_SUFFIXES``).
    """
    for root in mask_roots:
        of_masks = root.name.lower() in MASK_FOLDERS
        for candidate in mask_candidates(name) if of_masks else _marked_masks(name):
            if "\0" in candidate or not os.path.lexists(os.path.join(root, candidate)):
                continue  # most are not there, and looking is faster than resolving
            path = resolve_photo(root, candidate)
            if path is not None and os.path.isfile(path):
                return path
    return None


def mask_roots_of(source: Path) -> list[Path]:
    """Return the folders beside the photos that may hold masks."""
    parents = [source, source.parent] if source.name in PHOTO_FOLDERS else [source]
    return [p / name for p in parents for name in MASK_FOLDERS if (p / name).is_dir()]
