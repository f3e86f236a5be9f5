# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages: folders named by the hash of their inputs, finished once ``done.json`` exists."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ... import limits
from ...errors import DatasetError, ParseError, WrapError
from ...files import read_json, write_json
from ...names import JOB_MARKER
from ...photos.finder import second_copies
from ...photos.formats import PHOTO_SUFFIXES
from ...progress import Progress
from ...readers.program_files import find_program_cameras

_logger = logging.getLogger(__name__)

# Increase a number when a stage's code changes its result: old stage folders are not re-used then.
# Keys of later stages hold those of earlier ones. Finished trainings can be meshed and trained on
# whatever the number of their cameras; with another number of their own they cannot: a training
# that comes out better now keeps its number.
STAGE_VERSIONS = {
    "frames": 1, "cameras": 3, "masks": 1, "masked": 1, "train": 6, "mesh": 13, "texture": 13,
    "bake": 3,
}  # fmt: skip

DONE_NAME = "done.json"
HASH_CHARACTERS = 12
INPUT_SUFFIXES = (*PHOTO_SUFFIXES, ".bin", ".txt", ".json", ".ply")
CAMERA_SUFFIXES = (".sfm", ".xml", ".csv", ".geojson", ".xmp")
"""Of files with cameras that other programs write."""


@dataclass(frozen=True)
class Stage:
    """One finished stage."""

    name: str
    key: str
    """Hash of everything that the stage's result depends on."""
    folder: Path
    done: dict[str, Any]
    """Content of ``done.json``: the stage's measurements."""
    reused: bool
    before: tuple[Stage, ...] = ()
    """Stages that it was made of, for the report: of a masked scene its cameras and masks, of a
    training in blocks each of them."""


def stage_key(*parts: Any) -> str:
    """Hash JSON values (and keys of earlier stages) into the key of a stage."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:HASH_CHARACTERS]


def source_fingerprint(source: Path) -> list[tuple[str, int, int]]:
    """List the files of an input with size and modification time, for :func:`stage_key`.

    An input that is gone has none. Photos are not read: size and time detect a change, as in build
    systems. Raises DatasetError: there are too many files for photos, as on a whole disk.
    """
    if source.is_file() and source.suffix.lower() == ".ply":
        state = source.stat()
        return [(source.name, state.st_size, state.st_mtime_ns)]
    if not source.exists():
        return []
    root = source if source.is_dir() else source.parent
    # Other programs write such files beside photos, too, and change them: notes of photo managers.
    suffixes = (*INPUT_SUFFIXES, *(CAMERA_SUFFIXES if _has_camera_files(source) else ()))
    found, seen = [], 0
    for folder, subfolders, names in os.walk(root):
        seen += len(names)
        if seen > limits.MAX_SOURCE_FILES:
            raise DatasetError(
                f"{root} holds more than {limits.MAX_SOURCE_FILES} files.",
                "Give the folder of the photos alone.",
            )
        if JOB_MARKER in names:
            subfolders.clear()  # a job folder beside a transforms.json is not input
            continue
        subfolders[:] = sorted(s for s in subfolders if not s.startswith("."))
        photos = [n for n in names if PurePosixPath(n).suffix.lower() in PHOTO_SUFFIXES]
        second = second_copies(photos)
        for name in sorted(names):
            path = Path(folder) / name
            if path.suffix.lower() in suffixes and name not in second and path.is_file():
                state = path.stat()
                found.append((path.relative_to(root).as_posix(), state.st_size, state.st_mtime_ns))
    return [(source.name if source.is_file() else "", 0, 0), *found]


def _has_camera_files(source: Path) -> bool:
    """Return whether an input's cameras are in files of another program."""
    try:
        return find_program_cameras(source) is not None
    except (OSError, WrapError):
        return True  # loading says what is wrong


def read_done(folder: Path) -> dict[str, Any] | None:
    """Return the content of ``done.json``, or ``None`` where the stage is not finished."""
    path = folder / DONE_NAME
    if not path.is_file():
        return None
    try:
        values = read_json(path)
    except (OSError, ParseError):
        return None
    return values if isinstance(values, dict) else None


def run_stage(
    stages: Path, name: str, key: str, progress: Progress,
    work: Callable[[Path, Progress], dict[str, Any]], *,
    whole: Callable[[Path], bool] = Path.is_dir,
) -> Stage:  # fmt: skip
    """Run a stage, or re-use its finished folder.

    Parameters
    ----------
    stages : Path
        Folder of all stages.
    name, key : str
        Together they form the folder's name.
    progress : Progress
        Progress of the stage.
    work : callable
        Works in the folder; returns the content of ``done.json``. The folder of an interrupted
        run is passed as it is, so that training finds its checkpoints.
    whole : callable
        Tells whether a finished folder still holds what later stages read; without, or damaged,
        the stage is done again.
    """
    folder = stages / f"{name}-{key}"
    done = read_done(folder)
    if done is not None and not whole(folder):
        _logger.warning("%s is damaged or incomplete: the stage is done again", folder.name)
        (folder / DONE_NAME).unlink()
        done = None
    if done is not None:
        _logger.info("stage %s is finished already (%s)", name, folder.name)
        progress.update(1.0, f"{name}: finished before")
        return Stage(name, key, folder, done, True)
    folder.mkdir(parents=True, exist_ok=True)
    begun_s, begun_processor_s = time.monotonic(), time.process_time()
    progress.update(0.0, f"{name}: starting")
    done = work(folder, progress)
    done = {
        **done,
        "seconds": round(_seconds_so_far(folder) + time.monotonic() - begun_s, 3),
        # Of this process in this run only, without helpers.
        "processor_seconds": round(time.process_time() - begun_processor_s, 3),
        "finished_unix_s": round(time.time(), 1),
    }
    write_json(folder / DONE_NAME, done)
    progress.update(1.0, f"{name}: finished")
    return Stage(name, key, folder, done, False)


def record_interrupted_time(folder: Path, seconds: float) -> None:
    """Record the time of an interrupted run of a stage, so that reports include it."""
    if folder.is_dir() and read_done(folder) is None:
        write_json(folder / "spent.json", {"seconds": _seconds_so_far(folder) + seconds})


def _seconds_so_far(folder: Path) -> float:
    try:
        return float(read_json(folder / "spent.json")["seconds"])
    except (OSError, ParseError, KeyError, TypeError, ValueError):
        return 0.0
