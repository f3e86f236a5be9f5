# SPDX-License-Identifier: GPL-3.0-or-later
"""Training checkpoints: arrays in an npz; the rest, and its hash, in a JSON file written last."""

from __future__ import annotations

import hashlib
import io
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np

from ..array_file import read_arrays
from ..dataset.scene import Scene
from ..errors import ParseError, UsageError
from ..files import read_json, write_bytes, write_json
from ..regular_files import open_regular
from ..settings import TrainingSettings, key_values
from .state import TrainingState

_logger = logging.getLogger(__name__)

VERSION = 2
KEPT = 2
"""Number of checkpoints kept; the older one is the fallback for a broken newest one."""

_NAME = re.compile(r"checkpoint-(\d{1,9})\.json")
_AGAIN = "Delete the folder and train again."
_BLOCK_BYTES = 1024 * 1024


def fingerprint(
    scene: Scene,
    settings: TrainingSettings,
    seed: int,
    start: Path | None = None,
    taken_over: str = "",
) -> str:
    """Hash the inputs that a training's result depends on.

    These are settings, seed, cameras, photo names and points.

    Parameters
    ----------
    start : Path, optional
        File of Gaussians that the training starts from; its content is hashed.
    taken_over : str
        Digest of what it takes over from another training.
    """
    described = key_values(settings)
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
    digest.update(taken_over.encode())
    return digest.hexdigest()


def save_checkpoint(folder: Path, state: TrainingState, key: str) -> Path:
    """Write the state atomically and remove all but the last two checkpoints.

    Returns
    -------
    Path
        The JSON file. The npz is ignored without it, or if its hash differs.
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
    """Return the newest readable state of a folder, or ``None`` without a checkpoint.

    A broken checkpoint is logged and the one before it is tried.

    Raises
    ------
    UsageError
        The checkpoint belongs to other photos, settings or seed.
    ParseError
        There are checkpoints, but none can be read.
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
            f"{path.name} was written with other photos, settings or another seed.",
            "Train in a new folder, or use the inputs of the first run.",
        )
    arrays = _read_arrays(path.with_suffix(".npz"), values.get("sha256"))
    try:
        state = TrainingState.restore(arrays, values["state"])
        if not state.adam.is_finite():
            raise ValueError("a parameter is not finite")
        return state
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise ParseError(path, "state", f"is inconsistent ({error}).", _AGAIN) from None


def _read_arrays(path: Path, sha256: Any) -> dict[str, np.ndarray]:
    digest = hashlib.sha256()
    try:
        with open_regular(path) as stream:
            while block := stream.read(_BLOCK_BYTES):
                digest.update(block)
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read ({error}).", _AGAIN) from None
    if digest.hexdigest() != sha256:
        raise ParseError(path, "whole file", "truncated or changed.", _AGAIN)
    return read_arrays(path, hint=_AGAIN)
