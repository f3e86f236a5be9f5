# SPDX-License-Identifier: GPL-3.0-or-later
"""Sharp frames of a video as photos, in a helper process."""

from __future__ import annotations

import itertools
import logging
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from .. import limits
from ..errors import DatasetError, known_error
from ..files import read_json, write_json
from ..limits import MIN_IMAGES
from ..machine import helper_memory_limit_bytes
from ..parallel import default_threads
from ..progress import Progress, ReportWarning
from ..worker.helper_process import emit, run_helper
from .photo_file import write_photo
from .video import (
    frames_of,
    grey_of,
    kind_warnings,
    open_video,
    upright_color,
)

# -- How far the picture has moved between two frames (docs/method.md, section 14.1) --------------

MOTION_SIDE_PX = 160
"""Long side of the pictures that motion is measured in."""
_BLOCKS = 12
"""Blocks along the long side of a picture; each is followed on its own."""
_ROUNDS = 3
_MIN_TEXTURE = 4.0
"""Mean squared gradient, levels per pixel squared, of a block that can be followed."""
_STEEPEST_SHARE = 1e-2
"""Added to a block's matrix, as a share of its trace: nothing moves along an edge alone."""
_PERCENTILE = 90.0
"""Of the blocks' motion: where the object turns, most of a picture may stand still."""
_STILL_PX = 0.12
"""Motion of noise; steps shorter than this are none."""
_ANCHOR_PX = 3.0
"""Distance at which the frame compared with is replaced; until then errors do not add up."""
_MOST_SHARE = 0.25
"""Longest step that counts, in sides of the picture: cuts and lost tracks measure anything."""


class MotionMeter:
    """Follow a video: :meth:`add` returns how far the picture has moved since its beginning.

    Shaking counts where it is wider than three small pixels, noise never does.
    """

    def __init__(self) -> None:
        self._anchor: np.ndarray | None = None
        self._anchor_at = 0.0
        self._at = 0.0

    def add(self, grey: np.ndarray) -> float:
        """Return the way so far, in long sides of the picture.

        ``grey``: (h, w) float32, the next frame, of the size of those before; ``MOTION_SIDE_PX``
            long.
        """
        if self._anchor is None:
            self._anchor = grey
            return 0.0
        side = float(max(grey.shape))
        moved_px = displacement_px(self._anchor, grey)
        step = min(max(moved_px - _STILL_PX, 0.0) / side, _MOST_SHARE)
        self._at = max(self._at, self._anchor_at + step)
        if moved_px > _ANCHOR_PX:
            self._anchor, self._anchor_at = grey, self._at
        return self._at


def displacement_px(first: np.ndarray, second: np.ndarray) -> float:
    """Return the shift of the faster blocks between two (h, w) float32 pictures, pixels."""
    shift_y, shift_x = _whole_shift(first, second)
    height, width = first.shape
    block = max(4, max(height, width) // _BLOCKS)
    rows, columns = height // block, width // block
    if not rows or not columns:
        return float(np.hypot(shift_y, shift_x))
    flow = np.zeros((2, rows, columns))
    flow[0], flow[1] = shift_y, shift_x
    down, across = np.gradient(first)
    cut = (slice(rows * block), slice(columns * block))
    yy = _block_sums(down * down, cut, block)
    xx = _block_sums(across * across, cut, block)
    xy = _block_sums(down * across, cut, block)
    trace = yy + xx
    followed = trace > _MIN_TEXTURE * block * block
    if not followed.any():
        return float(np.hypot(shift_y, shift_x))
    ridge = _STEEPEST_SHARE * trace + 1e-6
    determinant = (yy + ridge) * (xx + ridge) - xy * xy
    y, x = np.mgrid[: rows * block, : columns * block].astype(np.float32)
    for _ in range(_ROUNDS):
        each = flow.repeat(block, 1).repeat(block, 2)  # (2, h, w)
        moved = map_coordinates(second, [y + each[0], x + each[1]], order=1, mode="nearest")
        change = moved - first[cut]
        b_y = _block_sums(down[cut] * change, cut, block)
        b_x = _block_sums(across[cut] * change, cut, block)
        flow[0] -= ((xx + ridge) * b_y - xy * b_x) / determinant
        flow[1] -= ((yy + ridge) * b_x - xy * b_y) / determinant
        # A block that lost its track goes no further than a block from the whole.
        flow[0] = flow[0].clip(shift_y - block, shift_y + block)
        flow[1] = flow[1].clip(shift_x - block, shift_x + block)
    row_at, column_at = np.mgrid[:rows, :columns] * block + flow
    leaves = (row_at < 0) | (row_at > height - block)
    leaves |= (column_at < 0) | (column_at > width - block)
    followed &= ~leaves if (followed & ~leaves).any() else True
    return float(np.percentile(np.hypot(flow[0], flow[1])[followed], _PERCENTILE))


def _whole_shift(first: np.ndarray, second: np.ndarray) -> tuple[int, int]:
    """Return the shift of whole pixels that fits best, by phase correlation; else none."""
    window = np.outer(np.hanning(first.shape[0]), np.hanning(first.shape[1]))
    a = np.fft.rfft2((first - first.mean()) * window)
    b = np.fft.rfft2((second - second.mean()) * window)
    cross = b * a.conj()
    cross /= np.abs(cross) + 1e-3 * (np.abs(cross).max() + 1e-12)
    peak = np.fft.irfft2(cross, s=first.shape)
    at = np.unravel_index(int(np.argmax(peak)), peak.shape)
    y, x = (int(k) - n if k > n // 2 else int(k) for k, n in zip(at, first.shape, strict=True))
    shift = y, x
    # A peak of chance would send all blocks astray.
    return shift if _misfit(first, second, shift) < _misfit(first, second, (0, 0)) else (0, 0)


def _misfit(first: np.ndarray, second: np.ndarray, shift: tuple[int, int]) -> float:
    """Return the mean difference where the shifted pictures overlap."""
    height, width = first.shape
    y, x = shift
    moved = second[max(y, 0) : height + min(y, 0), max(x, 0) : width + min(x, 0)]
    base = first[max(-y, 0) : height - max(y, 0), max(-x, 0) : width - max(x, 0)]
    return float(np.abs(moved - base).mean())


def _block_sums(values: np.ndarray, cut: Sequence[slice], block: int) -> np.ndarray:
    inside = values[tuple(cut)]
    height, width = inside.shape
    return inside.reshape(height // block, block, width // block, block).sum((1, 3))


# -- Sharpness of frames: fine detail in each direction (docs/method.md, section 14.2) ------------

SHARPNESS_SIDE_PX = 960
"""Long side of the pictures that sharpness is measured in."""
_COARSE = 4
"""Pixels of the coarse picture are this many wide: usual blur leaves its detail."""
_NOISE_STEP = 3
"""Noise is looked for at every third pixel of every third row."""
_LEAST = 1e-2
"""Detail below this, levels squared, is none: noise and rounding."""
_LOCAL_S = 2.0
_LOCAL_MOTION = 0.25
"""Frames whose content is alike: so near in time, seconds, and so little moved, sides."""
_REFERENCE_PERCENTILE = 90.0
_BLURRED_LOCALLY = np.log(0.5)
"""Less than half of the detail, in some direction, of the sharp frames around it."""
_BLURRED_OVERALL = np.log(0.2)
"""Fine detail against coarse, as a share of that of the video's sharp frames: finds blur that
lasts so long that no frame around it is sharp."""


def details(grey: np.ndarray) -> np.ndarray:
    """Return (2, 4) float64: log energy of second differences in each direction, fine and coarse.

    Across, down and the two diagonals, since camera shake takes the detail of one direction.

    ``grey``: (h, w) float32, brightness, 0 to 255.
    """
    coarse = _energies(_block_means(grey, _COARSE))
    fine = _energies(grey) - 6.0 * _noise_variance(grey)  # 1 + 4 + 1: of (1, -2, 1) on noise
    return np.log(np.maximum(np.stack([fine, coarse]), _LEAST))


def relative_sharpness(details: np.ndarray, times_s: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return the detail of each frame over that of the sharp frames around it, (n,) log.

    The worst direction counts. Only frames with the same content are compared.

    Parameters
    ----------
    details : (n, 2, 4) float64
        Of :func:`details`.
    times_s, ways : (n,) float64
        Time, and way of the picture so far in its sides.
    """
    fine = details[:, 0]
    relative = np.zeros(len(fine))
    first = np.searchsorted(times_s, times_s - _LOCAL_S)
    last = np.searchsorted(times_s, times_s + _LOCAL_S, side="right")
    first = np.maximum(first, np.searchsorted(ways, ways - _LOCAL_MOTION))
    last = np.minimum(last, np.searchsorted(ways, ways + _LOCAL_MOTION, side="right"))
    for i in range(len(fine)):
        reference = np.percentile(fine[first[i] : last[i]], _REFERENCE_PERCENTILE, axis=0)
        relative[i] = (fine[i] - reference).min()
    return relative


def are_blurred(details: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Tell which frames are blurred, (n,) bool; parameters as of :func:`relative_sharpness`."""
    ratio = details[:, 0] - details[:, 1]  # (n, 4)
    overall = (ratio - np.percentile(ratio, _REFERENCE_PERCENTILE, axis=0)).min(1)
    return (relative < _BLURRED_LOCALLY) | (overall < _BLURRED_OVERALL)


def _energies(grey: np.ndarray) -> np.ndarray:
    """Return the mean squared second differences across, down and along the diagonals, (4,)."""
    middle = 2.0 * grey[1:-1, 1:-1]
    pairs = (
        (grey[1:-1, :-2], grey[1:-1, 2:]), (grey[:-2, 1:-1], grey[2:, 1:-1]),
        (grey[:-2, :-2], grey[2:, 2:]), (grey[:-2, 2:], grey[2:, :-2]),
    )  # fmt: skip
    return np.array([float(np.mean((a + b - middle) ** 2)) for a, b in pairs])


def _noise_variance(grey: np.ndarray) -> float:
    """Estimate the variance of noise by a mask that edges and slopes leave 0, mostly."""
    rows = grey[:-2] - 2.0 * grey[1:-1] + grey[2:]
    both = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    median = float(np.median(np.abs(both[::_NOISE_STEP, ::_NOISE_STEP])))
    return (1.4826 * median / 6.0) ** 2  # of a normal distribution; the mask has the norm 6


# -- Choose frames: the sharpest of each stretch of motion (docs/method.md, section 14.3) ---------

MOTION_STEP = 0.08
"""Way of the picture from one chosen frame to the next, in its long sides."""
FEWEST_FRAMES, MOST_FRAMES = 40, 200
"""Bounds of the automatic number of frames."""
STILL_WAY = 0.001
"""A frame that has moved less, in sides, since the one before it that counts shows the same."""
_FAR = 0.3
"""Way between two chosen frames, in sides, that leaves little overlap where things are near."""
_MIDDLE = 0.6
"""Part of a stretch, around its middle, in which the sharpest frame is looked for first: frames
from the ends of two stretches would be almost the same."""


@dataclass(frozen=True)
class FrameMeasures:
    """What is known of each frame that was read."""

    indices: np.ndarray
    """(n,) int64, number in the video."""
    times_s: np.ndarray
    """(n,) float64, ascending."""
    ways: np.ndarray
    """(n,) float64: way of the picture so far, in its long sides; never decreases."""
    details: np.ndarray
    """(n, 2, 4) float64, of :func:`~.video_frames.details`."""


@dataclass(frozen=True)
class Choice:
    """The chosen frames, and why others are not used."""

    positions: np.ndarray
    """(k,) int64: positions in the measures, ascending."""
    blurred: int
    still: int
    """Sharp frames that show the same as another one before them."""
    gaps_s: tuple[tuple[float, float], ...]
    """Times between which all frames are blurred, while the picture goes far."""


def choose_frames(measures: FrameMeasures, *, frames: int = 0, fps: float = 0.0) -> Choice:
    """Choose frames.

    Parameters
    ----------
    measures : FrameMeasures
    frames : int
        Number of stretches of equal motion, so the most frames; 0: by the motion.
    fps : float
        If not 0 and ``frames`` is: stretches of equal time instead, so many a second.
    """
    ways, times_s = measures.ways, measures.times_s
    if not len(ways):
        return Choice(np.zeros(0, np.int64), 0, 0, ())
    relative = relative_sharpness(measures.details, times_s, ways)
    blurred = are_blurred(measures.details, relative)
    still = ~blurred & _show_the_same(ways, blurred)
    if fps and not frames:
        place = (times_s - times_s[0]) * fps
    else:
        total = float(ways[-1])
        count = frames or automatic_count(total)
        place = ways / total * count if total > 0.0 else np.zeros(len(ways))
        place = np.minimum(place, np.nextafter(count, 0.0))
    stretch = np.floor(place).astype(np.int64)
    chosen: list[int] = []
    empty: list[int] = []
    for number in np.unique(stretch):
        inside = np.flatnonzero(stretch == number)
        usable = inside[~blurred[inside]]
        if not len(usable):
            empty.append(int(inside[0]))
            continue
        middle = usable[np.abs(place[usable] - number - 0.5) <= _MIDDLE / 2]
        best = middle if len(middle) else usable
        pick = int(best[np.argmax(relative[best])])
        if chosen and ways[pick] - ways[chosen[-1]] < STILL_WAY:
            if relative[pick] > relative[chosen[-1]]:
                chosen[-1] = pick
            continue
        chosen.append(pick)
    gaps = tuple(
        (float(times_s[before]), float(times_s[after]))
        for before, after in itertools.pairwise(chosen)
        if ways[after] - ways[before] > _FAR and any(before < i < after for i in empty)
    )
    return Choice(np.array(chosen, np.int64), int(blurred.sum()), int(still.sum()), gaps)


def automatic_count(way: float) -> int:
    """Return the number of frames for a way of the picture, in its long sides."""
    return int(np.clip(round(way / MOTION_STEP), FEWEST_FRAMES, MOST_FRAMES))


def _show_the_same(ways: np.ndarray, blurred: np.ndarray) -> np.ndarray:
    """Tell which frames have not moved since the last frame that counts, (n,) bool."""
    same = np.zeros(len(ways), bool)
    last = -np.inf
    for i in np.flatnonzero(~blurred):
        if ways[i] - last < STILL_WAY:
            same[i] = True
        else:
            last = ways[i]
    return same


# -- Helper process: decodes a video twice, measures frames and writes the chosen -----------------
#
# Reads ``task.json`` of its folder; writes ``frames/`` and, last, ``chosen.json``.

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
        text = f"All {choice.blurred} frames of {path.name} are blurred."
        raise DatasetError(text, "Film again, more slowly and in more light.")
    written = _write(path, folder / FRAMES_FOLDER, measures, choice, task["threads"])
    first["damaged"] += len(choice.positions) - len(written)
    chosen = {
        **first, "frames": written, "read": len(measures.indices), "blurred": choice.blurred,
        "still": choice.still, "gaps_s": choice.gaps_s,
    }  # fmt: skip
    write_json(folder / CHOSEN_NAME, chosen)


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
        for decoded in frames_of(video):
            grey = grey_of(decoded.frame, SHARPNESS_SIDE_PX)
            indices.append(decoded.index)
            times_s.append(decoded.time_s)
            ways.append(meter.add(_small(grey)))
            found.append(details(grey))
            ticker.tick(len(indices), video.facts.expected_frames)
        if not indices:
            text = f"No frame of {path.name} can be decoded: the file is cut or damaged."
            raise DatasetError(text, "Copy it from the camera again, or export it as MP4.")
        stated = video.facts.frames
        missing = max(video.bad_packets, stated - len(indices) if stated else 0)
        facts = {
            "is_hdr": video.facts.is_hdr, "is_interlaced": video.facts.is_interlaced,
            "is_cut": video.is_cut, "damaged": missing,
        }  # fmt: skip
    measures = FrameMeasures(np.array(indices), np.array(times_s), np.array(ways), np.stack(found))
    return measures, facts


def _write(
    path: Path, folder: Path, measures: FrameMeasures, choice: Choice, threads: int
) -> list[str]:
    """Decode again and write the chosen frames; return their names."""
    folder.mkdir()
    wanted = set(measures.indices[choice.positions].tolist())
    written: list[str] = []
    ticker = _Ticker(_MEASURED, 1.0, "writing frames, at frame")
    last = max(wanted)
    with open_video(path, threads) as video:
        for decoded in frames_of(video):
            if decoded.index in wanted:
                name = f"frame-{decoded.index:06d}.jpg"
                write_photo(folder / name, upright_color(decoded.frame, video.facts.pixel_ratio))
                written.append(name)
            ticker.tick(decoded.index + 1, last + 1)
            if decoded.index >= last:
                break
    if not written:
        text = f"{path.name} has changed while it was read."
        raise DatasetError(text, "Start again once it is complete.")
    return written


def _small(grey: np.ndarray) -> np.ndarray:
    """Return the mean of blocks, about ``MOTION_SIDE_PX`` long."""
    factor = max(1, round(max(grey.shape) / MOTION_SIDE_PX))
    while factor > 1 and min(grey.shape) // factor < _MIN_SIDE_PX:
        factor -= 1
    return _block_means(grey, factor)


def _block_means(grey: np.ndarray, factor: int) -> np.ndarray:
    """Return the means of whole blocks, ``factor`` pixels wide and high."""
    height, width = (side // factor for side in grey.shape)
    cut = grey[: height * factor, : width * factor]
    return cut.reshape(height, factor, width, factor).mean((1, 3))


class _Ticker:
    """Report progress a few times a second."""

    def __init__(self, begin: float, end: float, message: str) -> None:
        self._begin, self._end, self._message = begin, end, message
        self._last_s = 0.0

    def tick(self, done: int, expected: int) -> None:
        if time.monotonic() - self._last_s < _EMIT_EVERY_S:
            return
        self._last_s = time.monotonic()
        share = min(done / expected, 1.0) if expected else 0.5
        message = f"{self._message} {done}" + (f" of {expected}" if expected else "")
        emit(fraction=self._begin + (self._end - self._begin) * share, message=message)


# -- Take photos out of a video, in a helper process: FFmpeg may crash or hang on damaged files

_HELPER = "photos.video_frames"
_DEADLINE_S = 4 * 3600.0
"""For an hour of 4K on a slow machine."""
_LISTED_GAPS = 3
_MOST_DAMAGED_SHARE = 0.02
"""Share of frames that may be missing without a warning: players skip them, too."""


@dataclass(frozen=True)
class VideoFrames:
    """Photos taken out of a video."""

    folder: Path
    names: tuple[str, ...]
    """In order of time, which is the order of the names."""
    facts: dict[str, Any]
    """For the report."""
    warnings: tuple[ReportWarning, ...]


def extract_frames(
    video: Path,
    work_folder: Path,
    progress: Progress,
    *,
    frames: int = 0,
    fps: float = 0.0,
    threads: int = 0,
) -> VideoFrames:
    """Choose sharp frames of a video and write them as JPEG into ``work_folder/frames``.

    Parameters
    ----------
    video : Path
        Nothing is written beside it.
    work_folder : Path
        What an interrupted run has left there is removed.
    frames, fps : int, float
        As of :func:`~.video_frames.choose_frames`; 0 chooses by the motion.
    threads : int
        Of the decoder; 0 uses every core.

    Raises
    ------
    DatasetError, ParseError
        It is no video that can be read, or fewer than ``MIN_IMAGES`` frames can be used.
    Cancelled
    """
    target = work_folder / FRAMES_FOLDER
    task_folder = work_folder / "video"
    for earlier in (target, task_folder):
        if earlier.exists():
            shutil.rmtree(earlier)
    task_folder.mkdir(parents=True)
    task = {
        "video": str(video), "frames": frames, "fps": fps,
        "threads": threads or default_threads(),
    }  # fmt: skip
    write_json(task_folder / "task.json", task)
    run_helper(
        _HELPER, task_folder, progress, deadline_s=_DEADLINE_S,
        memory_bytes=helper_memory_limit_bytes(),
    )  # fmt: skip
    chosen = read_json(task_folder / CHOSEN_NAME)
    os.replace(task_folder / FRAMES_FOLDER, target)
    shutil.rmtree(task_folder)
    names = tuple(chosen["frames"])
    left_out = (
        f"{chosen['read']} frames were read: {chosen['blurred']} are blurred, {chosen['still']} "
        "show the same as the one before."
    )
    if len(names) < MIN_IMAGES:
        raise DatasetError(
            f"Only {len(names)} frames of {video.name} can be used; {MIN_IMAGES} are needed. "
            f"{left_out}",
            "Film again: walk around the object, slowly and in enough light.",
        )
    facts = {
        "kind": "video", "photos_in_order": "frames of a video",
        **{f"video_frames_{k}": chosen[k] for k in ("read", "blurred", "still", "damaged")},
        "video_frames_kept": len(names),
    }  # fmt: skip
    return VideoFrames(target, names, facts, tuple(_warnings(video, chosen)))


def _warnings(video: Path, chosen: dict[str, Any]) -> list[ReportWarning]:
    found = []
    if chosen["is_cut"] or chosen["damaged"] > _MOST_DAMAGED_SHARE * chosen["read"]:
        text = (
            f"{chosen['damaged']} frames of {video.name} cannot be decoded and are not used; "
            f"{chosen['read']} can."
        )
        found.append(ReportWarning("video-damaged", text, "Copy it from the camera again."))
    if chosen["gaps_s"]:
        gaps = [f"{begin:.1f} to {end:.1f} s" for begin, end in chosen["gaps_s"]]
        listed = ", ".join(gaps[:_LISTED_GAPS]) + (", ..." if len(gaps) > _LISTED_GAPS else "")
        text = f"All frames of {video.name} are blurred at {listed}; nothing is used of it."
        hint = "Where cameras or surface are missing, film that part again, more slowly."
        found.append(ReportWarning("video-blurred", text, hint))
    return found + kind_warnings(video, chosen["is_hdr"], chosen["is_interlaced"])
