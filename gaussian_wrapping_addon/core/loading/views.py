# SPDX-License-Identifier: GPL-3.0-or-later
"""Views of a scene: photos undistorted, with their masks."""

from __future__ import annotations

import itertools
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import DatasetError
from ..files import real_path
from ..limits import MIN_PHOTO_SIDE_PX
from ..parallel import default_threads
from ..photos.finder import PhotoIndex, find_mask, resolve_photo
from ..photos.formats import PhotoHeader, require_extras
from ..photos.photo_file import (
    AS_WRITTEN,
    MASK_THRESHOLD,
    MaskReading,
    apply_orientation,
    photo_header,
    read_mask,
    read_photo,
    write_mask,
    write_photo,
)
from ..poses.solver import check_unreadable_share
from ..progress import UNREADABLE_HINT, Progress, ReportWarning
from ..readers.lenses import fit_lens, pinhole_of, same_proportions, sampling_map
from ..readers.source_model import LensCamera, PosedPhoto, SourceModel, counts_stored_pixels
from ..resampling import sample_bicubic
from .source_kind import SourceKind

_MAX_ONE_COLOUR_RANGE = 2
"""Levels of 255 between darkest and brightest pixel up to which a photo counts as of one colour: a
JPEG of one colour may differ by one, the noise of a camera by more."""
_QUICK_STEP = 16
"""Every so many pixels are compared before all are."""
_MAX_MAPS = 2
_SMALLEST_MASKED_SHARE = 1e-4
"""Smallest share of unmasked pixels; photos with less are not used."""


@dataclass(frozen=True)
class PreparedView:
    """A photo that matches its pinhole camera; the pose is in the world frame."""

    name: str
    pinhole: LensCamera
    cam_from_world: np.ndarray
    photo_path: Path
    mask_path: Path | None
    source_path: Path
    """The photo of the input."""
    lens: LensCamera
    """Of that photo, as stored or upright."""
    stored_orientation: int
    """EXIF orientation of the photo where ``lens`` is of its stored pixels, else 1."""


@dataclass
class _Preparation:
    """Prepares photos, on several threads; collects problems of single ones for warnings."""

    kind: SourceKind
    reading: MaskReading
    work_folder: Path
    prefers_stored: bool
    """Whether the cameras are of the photos as stored."""
    photos: frozenset[Path] = frozenset()
    """Real paths of all photos: none of them is the mask of another."""
    missing: list[str] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)
    wrong_masks: list[str] = field(default_factory=list)
    fully_masked: list[str] = field(default_factory=list)
    one_colour: list[str] = field(default_factory=list)
    renamed: int = 0
    rescaled: int = 0
    masked: int = 0
    undistorted: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _map_lock: threading.Lock = field(default_factory=threading.Lock)
    _maps: dict[LensCamera, np.ndarray] = field(default_factory=dict)
    """Sampling maps, shared by photos of the same lens."""

    def view(self, index: int, posed: PosedPhoto, path: Path) -> PreparedView | None:
        """Prepare one photo; ``None`` if it cannot be used, which is recorded."""
        try:
            header = photo_header(path)
            if min(header.width, header.height) < MIN_PHOTO_SIDE_PX:
                raise DatasetError(f"{path.name} is {header.width} x {header.height} pixels.")
            photo = read_photo(path, upright=False)
        except DatasetError as error:
            self._add(self.bad, error.message)
            return None
        if photo.color.shape[:2] != (header.height, header.width):
            self._add(self.bad, f"{path.name} decodes to another size than its header says.")
            return None
        lens, upright, rescaled = fit_lens(
            posed, header, path.name, prefers_stored=self.prefers_stored
        )
        color, alpha = photo.color, photo.alpha
        if upright:
            color = apply_orientation(color, header.orientation)
            alpha = None if alpha is None else apply_orientation(alpha, header.orientation)
        mask = self._mask(posed, path, color.shape[:2], alpha, header if upright else None)
        if mask is None and _is_one_colour(color):  # a mask's outline tells about shape
            self._add(self.one_colour, posed.name)
            return None
        pinhole = pinhole_of(lens)
        photo_path = path
        if not lens.is_pinhole:
            pixels = self._map(lens, pinhole)
            color = sample_bicubic(color, pixels)
            if mask is not None:
                mask = sample_bicubic(np.where(mask, 255, 0).astype(np.uint8)[..., None], pixels)
                mask = mask[..., 0] >= MASK_THRESHOLD
        # Every program reads the same pixels from a plain file without orientation.
        if not (lens.is_pinhole and photo.plain and header.orientation == 1):
            photo_path = self.work_folder / "images" / f"{index:06d}.jpg"
            write_photo(photo_path, color)
        mask_path = None
        with self._lock:
            self.rescaled += rescaled
            self.undistorted += not lens.is_pinhole
            if mask is not None and mask.mean() < _SMALLEST_MASKED_SHARE:
                self.fully_masked.append(posed.name)
                return None
            self.masked += mask is not None
        if mask is not None:
            mask_path = self.work_folder / "masks" / f"{index:06d}.png"
            write_mask(mask_path, mask)
        return PreparedView(
            posed.name, pinhole, posed.cam_from_world, photo_path, mask_path, path, lens,
            1 if upright else header.orientation,
        )  # fmt: skip

    def _mask(
        self,
        posed: PosedPhoto,
        path: Path,
        shape: tuple[int, ...],
        alpha: np.ndarray | None,
        turned: PhotoHeader | None,
    ) -> np.ndarray | None:
        """Return the (h, w) bool mask of a photo, of exactly its size, or ``None``.

        ``turned``: header of a photo whose EXIF orientation was applied.
        """
        mask_path = posed.mask_path or self._mask_file(posed, path)
        mask = None if alpha is None else alpha >= MASK_THRESHOLD
        if mask_path is None:
            return mask
        try:
            stored = read_mask(mask_path)
            if turned and stored.shape != shape and stored.shape == (turned.height, turned.width):
                stored = apply_orientation(stored, turned.orientation)
            if stored.shape != shape:
                stored = _resized_mask(stored, shape, mask_path)
        except DatasetError as error:
            self._add(self.wrong_masks, f"Mask {error.message}")
            return mask
        made = posed.mask_path is not None
        from_file = (AS_WRITTEN if made else self.reading).kept(stored)
        combined = from_file if mask is None else from_file & mask
        return None if combined.all() else combined

    def _mask_file(self, posed: PosedPhoto, path: Path) -> Path | None:
        """Return the mask that the input names for a photo, or that is found for it."""
        if posed.mask_name is None:
            for name in (posed.name, path.name):
                mask = find_mask(self.kind.mask_roots, name, self.kind.photo_roots)
                # An input may name a.jpg and a_mask.jpg both as photos.
                if mask is not None and real_path(mask) not in self.photos:
                    return mask
            return None
        found = resolve_photo(self.kind.folder, posed.mask_name)
        if found is not None and os.path.isfile(found):
            return found
        self._add(self.wrong_masks, f"{posed.mask_name} is missing")
        return None

    def _map(self, lens: LensCamera, pinhole: LensCamera) -> np.ndarray:
        # Hold the lock while computing: two threads would compute the same map otherwise.
        with self._map_lock:
            if lens not in self._maps:
                while len(self._maps) >= _MAX_MAPS:
                    del self._maps[next(iter(self._maps))]
                self._maps[lens] = sampling_map(lens, pinhole)
            return self._maps[lens]

    def _add(self, items: list[str], text: str) -> None:
        with self._lock:
            items.append(text)

    def warnings(self, total: int, kind: str) -> list[ReportWarning]:
        """Return the warnings of a set of ``total`` photos."""
        out = []

        def add(code: str, items: list[str], text: str, hint: str = "") -> None:
            if items:
                listed = ", ".join(sorted(items)[:3]) + (" ..." if len(items) > 3 else "")
                out.append(ReportWarning(code, f"{len(items)} {text}: {listed}.", hint))

        text = f"of the {total} photos that the {kind} names were not found"
        add("photos-not-found", self.missing, text)
        bad, text = [m.rstrip(".") for m in self.bad], "photos cannot be read and are not used"
        add("photos-unreadable", bad, text, UNREADABLE_HINT)
        add("masks-not-used", [m.rstrip(".") for m in self.wrong_masks], "masks were not used")
        text = "photos are masked altogether and are not used"
        hint = "White or opaque is kept, black or transparent is masked: check the masks."
        add("photos-masked-altogether", self.fully_masked, text, hint)
        text = "photos show one colour only and are not used"
        hint = "Remove them, or take photos that show something with texture."
        add("photos-of-one-colour", self.one_colour, text, hint)
        if self.renamed:
            differs = "a name that differs in case, extension or folder"
            text = f"{self.renamed} photos were found under {differs}."
            out.append(ReportWarning("photos-renamed", text))
        return out


def prepare_views(
    model: SourceModel,
    kind: SourceKind,
    work_folder: Path,
    progress: Progress,
    *,
    threads: int = 0,
    reading: MaskReading = AS_WRITTEN,
) -> tuple[list[PreparedView], list[ReportWarning], dict[str, int]]:
    """Convert every posed photo to a pinhole view; photos that fit already are used in place.

    Written files: ``work_folder/images/*.jpg`` (undistorted, or oriented and converted to 8 bits)
    and ``work_folder/masks/*.png``.

    Returns views in the order of the names, warnings and facts.
    Raises DatasetError: no photo was found, more than a fifth cannot be decoded, or sizes do not
    match the cameras; MissingExtraError: photos need a package that the worker lacks.
    """
    threads = threads or default_threads()
    work = _Preparation(kind, reading, work_folder, counts_stored_pixels(model.kind))
    index = PhotoIndex(kind.photo_roots)
    found: list[tuple[PosedPhoto, Path]] = []
    used: set[Path] = set()
    for posed in sorted(model.photos, key=lambda p: p.name):
        match = index.find(posed.name)
        if match is None or match.path in used:
            work.missing.append(posed.name)
            continue
        used.add(match.path)
        work.renamed += match.how != "exact"
        found.append((posed, match.path))
    if not found:
        searched = ", ".join(str(root) for root in kind.photo_roots)
        text = f"None of the {len(model.photos)} photos that the {model.kind} names was found."
        raise DatasetError(text, f"Looked for {work.missing[0]} in {searched}.")
    require_extras([path for _, path in found])
    work.photos = frozenset(real_path(path) for path in used)
    (work_folder / "images").mkdir(parents=True, exist_ok=True)
    (work_folder / "masks").mkdir(exist_ok=True)
    views: list[PreparedView] = []
    with ThreadPoolExecutor(threads) as pool:
        try:
            done = pool.map(work.view, itertools.count(), *zip(*found, strict=True))
            for i, view in enumerate(done):
                if view is not None:
                    views.append(view)
                check_unreadable_share(work.bad, len(found))
                progress.update((i + 1) / len(found), f"preparing photo {i + 1} of {len(found)}")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    counts = {
        "photos_undistorted": work.undistorted, "photos_rescaled": work.rescaled,
        "photos_masked": work.masked,
    }  # fmt: skip
    facts = {name: count for name, count in counts.items() if count}
    return views, work.warnings(len(model.photos), model.kind), facts


def _is_one_colour(color: np.ndarray) -> bool:
    """Tell whether all pixels of (h, w, 3) agree, such as under a lens cap.

    Such a photo says nothing about shape, and contradicts the others wherever they see something.
    """
    quick = color[::_QUICK_STEP, ::_QUICK_STEP]  # most photos differ among a few pixels
    return all(
        int(np.ptp(pixels, axis=(0, 1)).max()) <= _MAX_ONE_COLOUR_RANGE for pixels in (quick, color)
    )


def _resized_mask(mask: np.ndarray, shape: tuple[int, ...], path: Path) -> np.ndarray:
    from PIL import Image

    same = LensCamera("SIMPLE_PINHOLE", mask.shape[1], mask.shape[0], (1.0, 0.0, 0.0))
    if not same_proportions((shape[1], shape[0]), same):
        raise DatasetError(
            f"{path.name} is {mask.shape[1]} x {mask.shape[0]} pixels, its photo "
            f"{shape[1]} x {shape[0]}."
        )
    return np.asarray(Image.fromarray(mask).resize((shape[1], shape[0]), Image.Resampling.NEAREST))
