# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper process of :mod:`.extract`: decodes a video twice, measures frames and writes the chosen.

Reads ``task.json`` of its folder; writes ``frames/`` and, last, ``chosen.json``.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np

from ... import limits
from ...errors import DatasetError, known_error
from ...files import read_json, write_json
from ...processes.helper_process import emit
from ..photos.photo_file import write_photo
from .choose_frames import Choice, FrameMeasures, choose_frames
from .decode import OpenVideo, frames_of, grey_of, open_video, upright_color
from .motion import MOTION_SIDE_PX, MotionMeter
from .sharpness import SHARPNESS_SIDE_PX, details

FRAMES_FOLDER = "frames"
CHOSEN_NAME = "chosen.json"
_EMIT_EVERY_S = 0.2
_MEASURED = 0.6
"""Share of the time until all frames are measured."""
_MIN_SIDE_PX = 8


def main(folder: Path) -> None:
    """Run the task of ``folder``."""
    try:
        _run(folder)
    except OSError as error:
        told = known_error(error, folder)
        if told is None:
            raise
        raise told from error


def _run(folder: Path) -> None:
    logging.getLogger("libav").setLevel(logging.CRITICAL)
    task = read_json(folder / "task.json")
    path = Path(task["video"])
    measures, first = _measure(path, task["threads"])
    _check_rate(path, measures, task)
    choice = choose_frames(measures, frames=task["frames"], fps=task["fps"])
    if not len(choice.positions):
        raise DatasetError(
            f"All {choice.blurred} frames of {path.name} are blurred.",
            "Film again, more slowly and in more light.",
        )
    written, facts = _write(path, folder / FRAMES_FOLDER, measures, choice, task["threads"])
    first["damaged"] += len(choice.positions) - len(written)
    write_json(
        folder / CHOSEN_NAME,
        {
            **first, **facts, "frames": written,
            "read": len(measures.indices), "blurred": choice.blurred, "still": choice.still,
            "gaps_s": [list(gap) for gap in choice.gaps_s],
        },
    )  # fmt: skip


def _check_rate(path: Path, measures: FrameMeasures, task: dict[str, Any]) -> None:
    """Raise where so many frames a second are asked for that they would fill a disk."""
    if task["frames"] or not task["fps"]:
        return
    length_s = float(measures.times_s[-1] - measures.times_s[0])
    if min(length_s * task["fps"], len(measures.indices)) > limits.MAX_CHOSEN_FRAMES:
        raise DatasetError(
            f"{task['fps']:g} frames of each of the {length_s:.0f} s of {path.name} are more than "
            f"{limits.MAX_CHOSEN_FRAMES}.",
            f"Give fewer a second (--fps {limits.MAX_CHOSEN_FRAMES / length_s:.2g}), or --frames.",
        )


def _measure(path: Path, threads: int) -> tuple[FrameMeasures, dict[str, Any]]:
    """Return the measures of all frames, and what the file says and lacks."""
    indices: list[int] = []
    times_s: list[float] = []
    ways: list[float] = []
    found: list[np.ndarray] = []
    meter, ticker = MotionMeter(), _Ticker(0.0, _MEASURED, "looking at frame")
    with open_video(path, threads) as video:
        expected = _expected(video)
        for decoded in frames_of(video):
            grey = grey_of(decoded.frame, SHARPNESS_SIDE_PX)
            indices.append(decoded.index)
            times_s.append(decoded.time_s)
            ways.append(meter.add(_small(grey)))
            found.append(details(grey))
            ticker.tick(len(indices), expected)
        if not indices:
            raise DatasetError(
                f"No frame of {path.name} can be decoded: the file is cut or damaged.",
                "Copy it from the camera again, or export it as MP4.",
            )
        stated = video.facts.frames
        missing = max(video.bad_packets, stated - len(indices) if stated else 0)
        facts = {
            "codec": video.facts.codec, "is_hdr": video.facts.is_hdr, "is_cut": video.is_cut,
            "is_interlaced": video.facts.is_interlaced, "damaged": missing,
            "fps": video.facts.fps,
        }  # fmt: skip
    measures = FrameMeasures(np.array(indices), np.array(times_s), np.array(ways), np.stack(found))
    return measures, facts


def _write(
    path: Path, folder: Path, measures: FrameMeasures, choice: Choice, threads: int
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Decode again and write the chosen frames; return their entries, and facts."""
    folder.mkdir()
    wanted = {int(measures.indices[p]): float(measures.times_s[p]) for p in choice.positions}
    written: list[dict[str, Any]] = []
    ticker = _Ticker(_MEASURED, 1.0, "writing frames, at frame")
    last = max(wanted)
    size: list[int] = []
    with open_video(path, threads) as video:
        for decoded in frames_of(video):
            if decoded.index in wanted:
                color = upright_color(decoded.frame, video.facts.pixel_ratio)
                name = f"frame-{decoded.index:06d}.jpg"
                write_photo(folder / name, color)
                size = [color.shape[1], color.shape[0]]
                written.append({"name": name, "time_s": round(decoded.time_s, 6)})
            ticker.tick(decoded.index + 1, last + 1)
            if decoded.index >= last:
                break
    if not written:
        raise DatasetError(
            f"{path.name} has changed while it was read.", "Start again once it is complete."
        )
    return written, {"size_px": size}


def _small(grey: np.ndarray) -> np.ndarray:
    """Return the mean of blocks, about ``MOTION_SIDE_PX`` long."""
    factor = max(1, round(max(grey.shape) / MOTION_SIDE_PX))
    while factor > 1 and min(grey.shape) // factor < _MIN_SIDE_PX:
        factor -= 1
    height, width = (side // factor for side in grey.shape)
    cut = grey[: height * factor, : width * factor]
    return cut.reshape(height, factor, width, factor).mean((1, 3))


def _expected(video: OpenVideo) -> int:
    facts = video.facts
    return facts.frames or round(facts.duration_s * facts.fps)


class _Ticker:
    """Report progress a few times a second."""

    def __init__(self, begin: float, end: float, message: str) -> None:
        self._begin, self._end, self._message = begin, end, message
        self._last_s = 0.0

    def tick(self, done: int, expected: int) -> None:
        now_s = time.monotonic()
        if now_s - self._last_s < _EMIT_EVERY_S:
            return
        self._last_s = now_s
        share = min(done / expected, 1.0) if expected else 0.5
        of = f" of {expected}" if expected else ""
        emit(
            fraction=self._begin + (self._end - self._begin) * share,
            message=f"{self._message} {done}{of}",
        )
