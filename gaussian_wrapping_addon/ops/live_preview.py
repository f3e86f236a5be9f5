# SPDX-License-Identifier: GPL-3.0-or-later
"""The picture of a running training, loaded by the job timer, drawn from memory.

Panels draw often and must neither read the disk nor make anything: they ask :func:`icons_of`. The
pictures lie in a preview collection, not in ``bpy.data``, so that no file is saved with them and
undo does not know them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy.utils.previews
import numpy as np

_logger = logging.getLogger(__name__)

PICTURE = "preview-training.png"
EVERY_S = 3.0
"""Between two looks at the folder."""
MAX_BYTES = 8 * 2**20
"""Larger files are not a preview; reading them would be felt."""

_NEVER_S = float("-inf")


@dataclass
class _Shown:
    looked_s: float = _NEVER_S
    stamp: tuple[str, int, int] | None = None
    names: tuple[str, ...] = ()
    icons: tuple[int, ...] = ()


_shown: dict[str, _Shown] = {}
_pictures: Any = None  # ImagePreviewCollection, made when the first picture is there
_count = 0


def icons_of(folder: str) -> tuple[int, ...]:
    """Return the icons of a job folder's picture, none where there is none; reads nothing.

    A photo beside its rendering gives two: an icon is drawn in a square.
    """
    shown = _shown.get(folder)
    return shown.icons if shown else ()


def path_of(folder: str) -> str:
    """Return the file that the picture of a job folder was read from, or ``""``."""
    shown = _shown.get(folder)
    return shown.stamp[0] if shown and shown.stamp else ""


def newest_picture(folder: Path) -> tuple[str, int, int] | None:
    """Return path, time and size of the picture of the training that is under way, or None."""
    found = []
    for path in (folder / "stages").glob(f"train-*/{PICTURE}"):
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
    """Look for a new picture, at most every few seconds; tell whether there is one.

    The old picture stays until the new one has been read whole: one that is being written, or is
    broken, changes nothing.
    """
    shown = _shown.setdefault(folder, _Shown())
    if now_s - shown.looked_s < EVERY_S:
        return False
    shown.looked_s = now_s
    try:
        stamp = newest_picture(Path(folder))
    except OSError:
        return False
    if stamp is None or stamp == shown.stamp or stamp[2] > MAX_BYTES:
        return False
    loaded = _load(stamp[0])
    if loaded is None:
        return False
    _drop(shown.names)
    shown.names, shown.icons = loaded
    shown.stamp = stamp
    return True


def forget(folder: str) -> None:
    """Let go of the picture of a job that has ended."""
    shown = _shown.pop(folder, None)
    if shown is not None:
        _drop(shown.names)


def stop() -> None:
    """Let go of everything; Blender complains about collections left behind."""
    global _pictures
    _shown.clear()
    if _pictures is not None:
        bpy.utils.previews.remove(_pictures)
        _pictures = None


def _load(path: str) -> tuple[tuple[str, ...], tuple[int, ...]] | None:
    """Read a picture; return names and icons, or None where it is not sound."""
    global _pictures, _count
    if _pictures is None:
        _pictures = bpy.utils.previews.new()
    _count += 1
    name = str(_count)  # a new name each time: Blender keeps what it has drawn of an old one
    try:
        picture = _pictures.load(name, path, "IMAGE", force_reload=True)
        width, height = picture.image_size[:]  # reads the file now, so that drawing does not
        if not width or not height:
            _drop((name,))
            return None
        if width < 2 * height:
            return (name,), (picture.icon_id,)
        pixels = np.empty((height, width, 4), np.float32)
        picture.image_pixels_float.foreach_get(pixels.ravel())
    except (KeyError, OSError, RuntimeError):
        _logger.exception("cannot show %s", path)
        return None
    _drop((name,))
    halves = {
        f"{name} photo": pixels[:, : width // 2],
        f"{name} rendering": pixels[:, -width // 2 :],
    }
    return tuple(halves), tuple(_new(part, values) for part, values in halves.items())


def _new(name: str, pixels: np.ndarray) -> int:
    """Make a picture of (h, w, 4) float32 values; return its icon."""
    picture = _pictures.new(name)
    picture.image_size = pixels.shape[1::-1]
    picture.image_pixels_float.foreach_set(np.ascontiguousarray(pixels).ravel())
    return int(picture.icon_id)


def _drop(names: tuple[str, ...]) -> None:
    for name in names:
        if _pictures is not None and name in _pictures:
            del _pictures[name]
