# SPDX-License-Identifier: GPL-3.0-or-later
"""Checkpoints: arrays in an npz, the rest in a JSON file, written last, that names its hash."""

from __future__ import annotations

import hashlib
import io
import logging
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from ..dataset.scene import Scene
from ..errors import ParseError, UsageError
from ..files import read_json, write_bytes, write_json
from ..settings import RESULT_INDEPENDENT, TrainingSettings, to_json
from .state import TrainingState

_logger = logging.getLogger(__name__)

VERSION = 2
KEPT = 2
"""So many checkpoints stay; the older ones are there for a broken newest."""

_NAME = re.compile(r"checkpoint-(\d{1,9})\.json")
_AGAIN = "Delete the folder and train again."


def fingerprint(
    scene: Scene, settings: TrainingSettings, seed: int, start: Path | None = None
) -> str:
    """Hash what a training's result depends on: settings, seed, cameras, photo names, points.

    Parameters
    ----------
    start : Path, optional
        File of Gaussians that the training starts from; its content counts.
    """
    described = {k: v for k, v in to_json(settings).items() if k not in RESULT_INDEPENDENT}
    described.pop("extra_iterations")  # a longer run starts as the shorter one does
    digest = hashlib.sha256()
    digest.update(repr((VERSION, sorted(described.items()), seed)).encode())
    for view in scene.views:
        camera = view.camera
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        digest.update(repr((camera.name, view.photo_path.name, numbers)).encode())
        digest.update(np.ascontiguousarray(camera.cam_from_world, np.float64).tobytes())
    digest.update(np.ascontiguousarray(scene.points, np.float64).tobytes())
    if start is not None:
        with open(start, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def save_checkpoint(folder: Path, state: TrainingState, key: str) -> Path:
    """Write the state atomically and remove checkpoints beyond the last two.

    Returns
    -------
    Path
        The JSON file. Without it, or with another hash in it, the npz counts for nothing.
    """
    stream = io.BytesIO()
    np.savez(stream, **state.to_arrays())
    data = stream.getvalue()
    path = folder / f"checkpoint-{state.iteration:09d}.json"
    write_bytes(path.with_suffix(".npz"), data)
    values = {
        "version": VERSION,
        "fingerprint": key,
        "sha256": hashlib.sha256(data).hexdigest(),
        "state": state.to_json(),
    }
    write_json(path, values)
    for old in _listed(folder)[KEPT:]:
        old.unlink(missing_ok=True)
        old.with_suffix(".npz").unlink(missing_ok=True)
    return path


def load_checkpoint(folder: Path, key: str) -> TrainingState | None:
    """Return the newest readable state of a folder, or ``None`` where there is no checkpoint.

    A broken checkpoint is named in the log and the one before it is tried.

    Raises
    ------
    UsageError
        The checkpoint belongs to other photos, settings or seed.
    ParseError
        There are checkpoints and none can be read.
    """
    failure: ParseError | None = None
    for path in _listed(folder):
        try:
            return _load(path, key)
        except ParseError as error:
            _logger.warning("%s", error)
            failure = failure or error
    if failure is not None:
        raise failure
    return None


def remove_checkpoints(folder: Path) -> None:
    """Delete all checkpoints of a finished run."""
    for path in _listed(folder):
        path.unlink(missing_ok=True)
        path.with_suffix(".npz").unlink(missing_ok=True)


def _listed(folder: Path) -> list[Path]:
    """Return the JSON files, newest first."""
    found = [p for p in folder.glob("checkpoint-*.json") if _NAME.fullmatch(p.name)]
    return sorted(found, key=lambda path: path.name, reverse=True)


def _load(path: Path, key: str) -> TrainingState:
    values = read_json(path)
    if not isinstance(values, dict) or values.get("version") != VERSION:
        raise ParseError(path, "version", f"version {VERSION} was expected.", _AGAIN)
    if values.get("fingerprint") != key:
        raise UsageError(
            f"{path.name} belongs to other photos, settings or another seed.",
            "Train in a new folder, or give what the first run was given.",
        )
    arrays = _read_arrays(path.with_suffix(".npz"), values.get("sha256"))
    try:
        state = TrainingState.restore(arrays, values["state"])
        if not state.adam.is_finite():
            raise ValueError("a parameter is not finite")
        return state
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise ParseError(path, "state", f"does not fit together ({error}).", _AGAIN) from None


def _read_arrays(path: Path, sha256: Any) -> dict[str, np.ndarray]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read ({error}).", _AGAIN) from None
    if hashlib.sha256(data).hexdigest() != sha256:
        raise ParseError(path, "whole file", "cut off or changed.", _AGAIN)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            # We store without compression, so nothing can unpack to more than the file holds.
            if any(e.compress_type != zipfile.ZIP_STORED for e in archive.infolist()):
                raise ParseError(path, "whole file", "compressed by someone else.", _AGAIN)
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ParseError(path, "whole file", f"no arrays ({error}).", _AGAIN) from None
