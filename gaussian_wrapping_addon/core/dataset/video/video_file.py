# SPDX-License-Identifier: GPL-3.0-or-later
"""Recognise video files by name and first bytes, and find the one of an input; decodes nothing."""

from __future__ import annotations

import os
from pathlib import Path

from ...errors import DatasetError
from ...regular_files import open_regular

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
_HEAD_BYTES = 16
_QUICKTIME_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")
"""Boxes that MP4 and QuickTime files begin with."""
_COPY_AGAIN = "Copy it from the camera again."


def is_video_path(path: Path) -> bool:
    """Tell whether a name is that of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")


def videos_in(folder: Path) -> list[Path]:
    """Return the video files directly in a folder, by name."""
    with os.scandir(folder) as entries:
        found = [Path(entry.path) for entry in entries if entry.is_file()]
    return sorted(path for path in found if is_video_path(path))


def the_video_in(folder: Path) -> Path | None:
    """Return the only video of a folder, or ``None`` where it has none.

    Raises
    ------
    DatasetError
        There are several: cameras, lenses and zoom may differ between them.
    """
    found = videos_in(folder)
    if len(found) > 1:
        raise DatasetError(
            f"{folder.name} holds no photos, but {len(found)} videos: "
            f"{', '.join(path.name for path in found[:3])}{', ...' * (len(found) > 3)}.",
            "Give one of the videos.",
        )
    return found[0] if found else None


def container_of(path: Path) -> str:
    """Return FFmpeg's name of a video's container: ``"mov"``, ``"matroska"`` or ``"avi"``.

    Going by the content keeps playlists and scripts, which name other files, from being opened.

    Raises
    ------
    DatasetError
        The file is empty, cannot be read, or begins like none of these.
    ParseError
        It is no regular file.
    """
    try:
        with open_regular(path, follow_links=True) as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError as error:
        raise DatasetError(
            f"{path.name} cannot be read: {error.strerror}.", "Check the path and its permissions."
        ) from None
    if not head:
        raise DatasetError(f"{path.name} is empty.", _COPY_AGAIN)
    if head[4:8] in _QUICKTIME_BOXES:
        return "mov"
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        return "matroska"
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        return "avi"
    raise DatasetError(
        f"{path.name} is no video that can be read: its first bytes are not those of MP4, MOV, "
        "MKV, WebM or AVI.",
        "Export it again as MP4.",
    )
