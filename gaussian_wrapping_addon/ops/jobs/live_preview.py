# SPDX-License-Identifier: GPL-3.0-or-later
"""Preview image of a running training, loaded by the job timer, drawn from memory.

Panels draw often and must neither read the disk nor create data: they call :func:`icons_of`. The
images are in a preview collection, not in ``bpy.data``, so that they are neither saved nor part of
undo. Files are searched and read in a thread, as plain pixels: Blender takes longer to decode its
first image than its window may wait.
"""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy.utils.previews
import numpy as np

from ...core.regular_files import read_bounded
from ..common.background import Lane, Task

_logger = logging.getLogger(__name__)

PICTURE = "preview-training.npy"
WHOLE_TRAININGS = ("train-*", "blocks-*/coarse-*")
"""Folders of trainings of the whole scene, in that of the stages."""
ALL_TRAININGS = (*WHOLE_TRAININGS, "blocks-*/block-*")
EVERY_S = 3.0
"""Interval between two searches of the folder."""
MAX_BYTES = 8 * 2**20
"""Larger files are not a preview; drawing them would be noticeable."""

_NEVER_S = float("-inf")

Stamp = tuple[str, int, int]
"""Path, time in ns and size in bytes of a file."""


@dataclass
class _Shown:
    searched_s: float = _NEVER_S
    stamp: Stamp | None = None
    names: tuple[str, ...] = ()
    icons: tuple[int, ...] = ()
    reading: Task[_Read | None] | None = None


@dataclass(frozen=True)
class _Read:
    stamp: Stamp
    parts: tuple[np.ndarray, ...]
    """Each (h, w, 4) float32, as Blender wants them: from the bottom up."""


_readings = Lane()
_shown: dict[str, _Shown] = {}
_pictures: Any = None  # ImagePreviewCollection, created with the first image
_count = 0


def icons_of(folder: str) -> tuple[int, ...]:
    """Return the icons of a job folder's image, or none; reads no file.

    A photo beside its rendering gives two: an icon is drawn in a square.
    """
    shown = _shown.get(folder)
    return shown.icons if shown else ()


def newest_picture(
    folder: Path, name: str = PICTURE, places: tuple[str, ...] = ALL_TRAININGS
) -> Stamp | None:
    """Return the image of the running training, or another of its files, or None."""
    found = []
    for path in (p for place in places for p in (folder / "stages").glob(f"{place}/{name}")):
        try:
            state = path.stat()
            if path.is_symlink() or (path.parent / "done.json").exists():
                continue
        except OSError:
            continue
        found.append((state.st_mtime_ns, state.st_size, str(path)))
    if not found:
        return None
    time_ns, size_bytes, text = max(found)
    return text, time_ns, size_bytes


def refresh(folder: str, now_s: float) -> bool:
    """Search for a new image, at most every few seconds; return whether a new one is shown.

    It is read in a thread and shown by a later call. The old image stays until then: an incomplete
    or broken file changes nothing.
    """
    shown = _shown.setdefault(folder, _Shown())
    if shown.reading is None:
        if now_s - shown.searched_s >= EVERY_S:
            shown.searched_s = now_s
            known = shown.stamp
            shown.reading = _readings.submit(lambda: _read(Path(folder), known))
        return False
    if not shown.reading.finished():
        return False
    reading, shown.reading = shown.reading, None
    try:
        read = reading.result()
        loaded = _load(read.parts) if read else None
    except Exception:  # whatever the file contains: the job continues without its image
        _logger.info("no picture of %s", folder, exc_info=True)
        return False
    if read is None or loaded is None:
        return False
    _drop(shown.names)
    shown.names, shown.icons = loaded
    shown.stamp = read.stamp
    return True


def forget(folder: str) -> None:
    """Remove the image of a job that has ended."""
    shown = _shown.pop(folder, None)
    if shown is not None:
        _drop(shown.names)


def start() -> None:
    """Start the thread that reads images, ahead of the first one."""
    _readings.start()


def stop() -> None:
    """Remove everything; Blender warns about collections left behind."""
    global _pictures
    _shown.clear()
    _readings.stop()
    if _pictures is not None:
        bpy.utils.previews.remove(_pictures)
        _pictures = None


def _read(folder: Path, known: Stamp | None) -> _Read | None:
    """Return the newest image, cut in two if it is wide; None if there is no new one.

    Raises
    ------
    Exception
        The file cannot be read or contains no image; NumPy raises many types.
    """
    stamp = newest_picture(folder)
    if stamp is None or stamp == known or stamp[2] > MAX_BYTES:
        return None
    data = read_bounded(Path(stamp[0]), MAX_BYTES)  # not mapped: the file may be replaced meanwhile
    pixels = np.load(io.BytesIO(data), allow_pickle=False)
    if not isinstance(pixels, np.ndarray):
        raise ValueError(f"{stamp[0]} holds several arrays")
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8 or not pixels.size:
        raise ValueError(f"{stamp[0]} holds {pixels.dtype} of shape {pixels.shape}")
    height, width, _ = pixels.shape
    values = np.ones((height, width, 4), np.float32)
    values[..., :3] = pixels[::-1] / np.float32(255.0)
    if width < 2 * height:
        return _Read(stamp, (values,))
    return _Read(stamp, (values[:, : width // 2], values[:, -(width // 2) :]))


def _load(parts: tuple[np.ndarray, ...]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Create previews from (h, w, 4) values; return names and icons."""
    global _pictures, _count
    if _pictures is None:
        _pictures = bpy.utils.previews.new()
    _count += 1  # new names each time: Blender caches what it has drawn under a name
    names = tuple(f"{_count} {part}" for part in ("photo", "rendering")[: len(parts)])
    return names, tuple(map(_new, names, parts))


def _new(name: str, pixels: np.ndarray) -> int:
    """Create a preview from (h, w, 4) float32 values; return its icon."""
    picture = _pictures.new(name)
    picture.image_size = pixels.shape[1::-1]
    picture.image_pixels_float.foreach_set(np.ascontiguousarray(pixels).ravel())
    return int(picture.icon_id)


def _drop(names: tuple[str, ...]) -> None:
    for name in names:
        if _pictures is not None and name in _pictures:
            del _pictures[name]
