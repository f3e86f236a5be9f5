# SPDX-License-Identifier: GPL-3.0-or-later
"""Look at a video's headers and first frame, in a child process of the worker's Python.

:func:`probe_video` needs the standard library alone, as Blender has no PyAV. The child writes one
JSON line: the facts, or ``{"error", "hint"}``.
"""

from __future__ import annotations

import json
import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ...errors import DatasetError, WorkerError, WrapError
from ...processes.helper_process import child_command, emit
from ...processes.spawn import run_to_end
from ...processes.worker_requirements import not_started, package_error

PROBE_DEADLINE_S = 60.0
_AGAIN = "Copy it from the camera again, or export it as MP4."


@dataclass(frozen=True)
class ProbedVideo:
    """What is known of a video before it is read."""

    width: int
    height: int
    """As players show it."""
    frames: int
    """0 where it is not known."""
    duration_s: float
    codec: str
    is_hdr: bool
    is_interlaced: bool


def probe_video(path: Path, python: str) -> ProbedVideo:
    """Look at a video.

    Parameters
    ----------
    path : Path
    python : str
        The worker's interpreter, or the folder of its environment.

    Raises
    ------
    DatasetError
        It is no video that can be read.
    WorkerError
        The worker's Python does not answer.
    """
    try:
        command = child_command("dataset.video.probe", str(path), python=python)
        _, output, errors = run_to_end(command, PROBE_DEADLINE_S)
    except OSError as error:
        raise not_started(python, error) from None
    except subprocess.TimeoutExpired:
        raise DatasetError(
            f"{path.name} was not opened within {PROBE_DEADLINE_S:.0f} s.", _AGAIN
        ) from None
    for line in output.splitlines():
        try:
            values: Any = json.loads(line)
        except ValueError:
            continue
        if isinstance(values, dict) and "error" in values:
            kind = DatasetError if values.get("kind") == "video" else WorkerError
            raise kind(str(values["error"]), str(values.get("hint", "")))
        try:
            return ProbedVideo(**values)
        except TypeError:
            continue
    said = errors.strip().splitlines()
    raise DatasetError(
        f"{path.name} cannot be opened: the decoder ended ({said[-1] if said else 'no output'}).",
        _AGAIN,
    )


def main(arguments: list[str]) -> int:
    """Write the facts of the video ``arguments[0]``; return the exit code."""
    try:
        emit(**asdict(probed(Path(arguments[0]))))
    except WrapError as error:
        emit(error=error.message, hint=error.hint, kind="video")
        return error.exit_code
    except ImportError as error:
        missing = package_error(error)
        if missing is None:
            raise
        emit(error=missing.message, hint=missing.hint)
        return missing.exit_code
    return 0


def probed(path: Path) -> ProbedVideo:
    """Return the facts of a video, with one frame decoded; needs PyAV.

    Raises
    ------
    DatasetError, ParseError
        It is no video that can be read.
    """
    from .decode import frames_of, open_video, upright_size

    with open_video(path) as video:
        first = next(frames_of(video), None)
        if first is None:
            raise DatasetError(
                f"No frame of {path.name} can be decoded: the file is cut or damaged.", _AGAIN
            )
        facts = video.facts
        width, height = upright_size(first.frame, facts.pixel_ratio)
        frames = facts.frames or round(facts.duration_s * facts.fps)
        return ProbedVideo(
            width, height, frames, facts.duration_s, facts.codec, facts.is_hdr, facts.is_interlaced
        )
