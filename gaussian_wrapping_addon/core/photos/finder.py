# SPDX-License-Identifier: GPL-3.0-or-later
"""Find photos on disk and match the names of an input to them."""

from __future__ import annotations

import functools
import os
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from .. import limits
from ..errors import DatasetError
from ..files import resolve_inside
from ..names import JOB_MARKER
from .formats import HEIF_SUFFIXES, PHOTO_SUFFIXES, RAW_SUFFIXES

PHOTO_FOLDERS = ("images", "photos", "input", "rgb")
MASK_FOLDERS = ("masks", "mask")
MASK_ENDINGS = ("_mask", "-mask", ".mask")
"""Of the stem of a mask's name, as other programs write it beside the photo or in a folder."""
_MAX_DEPTH = 8


def list_photos(root: Path) -> list[Path]:
    """List photo files under ``root``, sorted by name, without masks and hidden folders.

    ``x_mask.png`` is a mask where ``x.jpg`` lies beside it, else a photo. Of ``x.jpg``, ``x.heic``
    and ``x.dng`` beside each other, the first that is there is taken (:func:`second_copies`).

    Links to files are followed, links to folders are not (they could form a loop).

    Raises DatasetError: more files than the limit.
    """
    photos, _ = _walk(root)
    return photos


def list_second_copies(root: Path) -> list[Path]:
    """List the files under ``root`` that :func:`second_copies` leaves out, sorted by name."""
    _, left_out = _walk(root)
    return left_out


def _walk(root: Path) -> tuple[list[Path], list[Path]]:
    """Return the photos under ``root``, and those left out for another copy; both sorted."""
    found: list[Path] = []
    left_out: list[Path] = []
    base_depth = len(root.parts)
    for folder, subfolders, names in os.walk(root):
        if JOB_MARKER in names:
            subfolders.clear()  # a job beside its video or transforms.json is no input
            continue
        here = Path(folder)
        inner = [s for s in subfolders if s[0] != "." and s.lower() not in MASK_FOLDERS]
        is_deep = len(here.parts) - base_depth >= _MAX_DEPTH
        subfolders[:] = [] if is_deep else sorted(inner)
        shown = [name for name in names if _is_photo_name(name)]
        masks = set(masks_among(shown).values())
        photos = [name for name in shown if name not in masks]
        second = second_copies(photos)
        found += [here / name for name in photos if name not in second]
        left_out += [here / name for name in second]
        if len(found) > limits.MAX_IMAGES:
            text = f"{root.name} holds more than {limits.MAX_IMAGES} photos."
            raise DatasetError(text, "Choose a subfolder.")

    def name_of(path: Path) -> str:
        return path.relative_to(root).as_posix()

    return sorted(found, key=name_of), sorted(left_out, key=name_of)


def _is_photo_name(name: str) -> bool:
    return not name.startswith(".") and PurePosixPath(name).suffix.lower() in PHOTO_SUFFIXES


def second_copies(names: Iterable[str]) -> set[str]:
    """Return the names of files that hold the same photo as another one.

    ``names``: of the photos of one folder. Cameras write ``x.jpg`` and ``x.nef`` of the same photo:
        the HEIC and RAW files are left out where an image of the same stem is there, the RAW files
        where a HEIC is. An image is what the camera made of it, needs no package and no time.
    """
    rank_of: dict[str, list[tuple[int, str]]] = {}
    for name in names:
        pure = PurePosixPath(name)
        suffix = pure.suffix.lower()
        rank = 2 if suffix in RAW_SUFFIXES else 1 if suffix in HEIF_SUFFIXES else 0
        rank_of.setdefault(pure.stem.casefold(), []).append((rank, name))
    return {
        name
        for copies in rank_of.values()
        for rank, name in copies
        if rank > min(other for other, _ in copies)
    }


def masks_among(names: Iterable[str]) -> dict[str, str]:
    """Return the masks that lie beside their photos: the mask's name of each photo's.

    ``names``: of the files of one folder. ``x_mask.png``, ``x.jpg.mask.png`` and the like
    (``MASK_ENDINGS``), in upper or lower case, belong to ``x.jpg`` if that is there.
    """
    photos: dict[str, list[str]] = {}
    marked: list[tuple[str, str]] = []
    for name in sorted(names):
        if not _is_photo_name(name):
            continue
        key = name.casefold()
        stem = PurePosixPath(key).stem
        for base in {key, stem}:
            photos.setdefault(base, []).append(name)
        marked += [(name, stem.removesuffix(e)) for e in MASK_ENDINGS if stem.endswith(e)]
    return {photo: mask for mask, base in marked for photo in photos.get(base, ())}


def photo_root(source: Path) -> Path:
    """Return the subfolder that holds the photos of a data set, or ``source`` itself."""
    for name in PHOTO_FOLDERS:
        if (source / name).is_dir() and list_photos(source / name):
            return source / name
    return source


def resolve_photo(root: Path, name: str) -> Path | None:
    """Return the path of a photo or mask of a data set, or ``None`` if the name is unsafe.

    As :func:`~.files.resolve_inside`, but the folders of photos and masks themselves may be
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

    ``roots``: names are looked up exactly under each of them, then by looser rules under the first.
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
        keys = _keys(str(PurePosixPath(name.replace("\\", "/"))))
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
    in_folder = [("folder", PurePosixPath(key).name) for key in (folded, stem)]
    return [("case", folded), ("extension", stem), *in_folder]


def mask_candidates(name: str) -> list[str]:
    """Return the names a photo's mask may have in a mask folder, most specific first."""
    pure = PurePosixPath(name.replace("\\", "/"))
    bases = (str(pure), str(pure.with_suffix("")))
    marked = [f"{base}{ending}.png" for base in bases for ending in MASK_ENDINGS]
    return [f"{pure}.png", str(pure.with_suffix(".png")), str(pure), *marked]


def find_mask(mask_roots: list[Path], name: str, beside: Sequence[Path] = ()) -> Path | None:
    """Return the mask of photo ``name``, or ``None``.

    Parameters
    ----------
    mask_roots : list of Path
        Folders of masks: ``x.jpg.png``, ``x.png``, the same name, or a name that says so
        (``MASK_ENDINGS``).
    beside : sequence of Path
        Folders of photos: the mask lies beside the photo (:func:`masks_among`).
    """
    for root in mask_roots:
        for candidate in mask_candidates(name):
            path = resolve_photo(root, candidate)
            if path is not None and os.path.isfile(path):
                return path
    for root in beside:
        photo = resolve_photo(root, name)
        if photo is None or not os.path.isfile(photo):
            continue
        mask = _masks_beside(str(photo.parent), os.stat(photo.parent).st_mtime_ns).get(photo.name)
        if mask is not None:
            path = resolve_photo(root, str(PurePosixPath(name.replace("\\", "/")).parent / mask))
            if path is not None and os.path.isfile(path):
                return path
    return None


@functools.lru_cache(maxsize=16)
def _masks_beside(folder: str, changed_ns: int) -> dict[str, str]:
    """List a folder once while its photos are looked up; ``changed_ns`` makes a new entry."""
    return masks_among(os.listdir(folder))


def mask_roots_of(source: Path) -> list[Path]:
    """Return the folders beside the photos that may hold masks."""
    parents = [source, source.parent] if source.name in PHOTO_FOLDERS else [source]
    return [p / name for p in parents for name in MASK_FOLDERS if (p / name).is_dir()]
