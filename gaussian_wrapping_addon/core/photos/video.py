# SPDX-License-Identifier: GPL-3.0-or-later
"""A video file: what it holds, what is wrong with it, its pictures."""

from __future__ import annotations

import contextlib
import json
import os
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import limits
from ..errors import DatasetError, WorkerError, WrapError
from ..files import open_regular
from ..progress import ReportWarning
from ..worker.environment import not_started, package_error
from ..worker.helper_process import child_command, emit
from ..worker.spawn import run_to_end

if TYPE_CHECKING:
    from av import VideoFrame


# -- Recognise video files by name and first bytes, and find the one of an input; decodes nothing

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
_HEAD_BYTES = 16
_QUICKTIME_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")
"""Boxes that MP4 and QuickTime files begin with."""
_COPY_AGAIN = "Copy it from the camera again."


def is_video_path(path: Path) -> bool:
    """Tell whether a name is that of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")


def the_video_in(folder: Path) -> Path | None:
    """Return the only video of a folder, or ``None`` where it has none.

    Raises DatasetError: there are several: cameras, lenses and zoom may differ between them.
    """
    with os.scandir(folder) as entries:
        files = [Path(entry.path) for entry in entries if entry.is_file()]
    found = sorted(path for path in files if is_video_path(path))
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

    Raises DatasetError: the file is empty, cannot be read, or begins like none of these;
    ParseError: it is no regular file.
    """
    try:
        with open_regular(path, follow_links=True) as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError as error:
        text = f"{path.name} cannot be read: {error.strerror}."
        raise DatasetError(text, "Check the path and its permissions.") from None
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


# -- Look at a video's headers and first frame, in a child process of the worker's Python ---------
#
# :func:`probe_video` needs the standard library alone, as Blender has no PyAV. The child writes
# one JSON line: the facts, or ``{"error", "hint"}``.

PROBE_DEADLINE_S = 60.0
_AGAIN = "Copy it from the camera again, or export it as MP4."


@dataclass(frozen=True)
class ProbedVideo:
    """What is known of a video before it is read."""

    width: int
    height: int
    """As players show it."""
    frames: int
    duration_s: float
    """Both 0 where they are not known."""
    codec: str
    is_hdr: bool
    is_interlaced: bool


def probe_video(path: Path, python: str) -> ProbedVideo:
    """Look at a video.

    ``python``: the worker's interpreter, or the folder of its environment.
    Raises DatasetError: it is no video that can be read; WorkerError: the worker's Python does not
    answer.
    """
    try:
        command = child_command("photos.video", str(path), python=python)
        _, output, errors = run_to_end(command, PROBE_DEADLINE_S)
    except OSError as error:
        raise not_started(python, error) from None
    except subprocess.TimeoutExpired:
        text = f"{path.name} was not opened within {PROBE_DEADLINE_S:.0f} s."
        raise DatasetError(text, _AGAIN) from None
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
    text = f"{path.name} cannot be opened: the decoder ended ({said[-1] if said else 'no output'})."
    raise DatasetError(text, _AGAIN)


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

    Raises DatasetError, ParseError: it is no video that can be read.
    """
    with open_video(path) as video:
        first = next(frames_of(video), None)
        if first is None:
            text = f"No frame of {path.name} can be decoded: the file is cut or damaged."
            raise DatasetError(text, _AGAIN)
        facts = video.facts
        width, height = upright_size(first.frame, facts.pixel_ratio)
        return ProbedVideo(
            width, height, facts.expected_frames, facts.duration_s, facts.codec, facts.is_hdr,
            facts.is_interlaced,
        )  # fmt: skip


# -- Warnings about kinds of videos, the same when one is checked and when it is read -------------


def kind_warnings(video: Path, is_hdr: bool, is_interlaced: bool) -> list[ReportWarning]:
    """Return the warnings of a video with a transfer function of HDR, and of an interlaced one."""
    hdr = ReportWarning(
        "video-hdr",
        f"{video.name} is an HDR video (PQ or HLG): its colours are taken as they are stored, and "
        "look pale.",
        "Film without HDR, or export it as SDR.",
    )
    interlaced = ReportWarning(
        "video-interlaced",
        f"{video.name} is interlaced: what moves has combs at its edges.",
        "Film or export it progressive.",
    )
    return [hdr] * is_hdr + [interlaced] * is_interlaced


# -- Open a video with PyAV and decode its frames one by one, within limits and past damage -------
#
# Frames are read as the file has them; :func:`upright_color` turns them as players show them.

MAX_DECODE_ERRORS = 1000
"""Packets that cannot be decoded until the rest of the file is given up."""
HD_HEIGHT_PX = 720
"""From this height on, colours without a label are those of HD television (BT.709)."""
PQ, HLG = 16, 18
"""Transfer functions of HDR in ITU-T H.273."""
_BT601, _BT709, _UNLABELLED = 5, 1, 2
_INTERLACED = (2, 3, 4, 5)
"""FFmpeg's orders of fields (AVFieldOrder) that are not progressive."""


@dataclass(frozen=True)
class VideoFacts(ProbedVideo):
    """What the headers of a video say; its size is as stored, before any rotation."""

    fps: float
    pixel_ratio: float
    """Width over height of a pixel."""

    @property
    def expected_frames(self) -> int:
        """Number of frames as stated, else by the length; 0 where neither is known."""
        return self.frames or round(self.duration_s * self.fps)


@dataclass
class OpenVideo:
    """An open file; ``bad_packets`` counts what could not be decoded so far."""

    name: str
    container: Any
    stream: Any
    facts: VideoFacts
    bad_packets: int = 0
    is_cut: bool = False
    """Whether reading ended before the end of the file."""


@contextlib.contextmanager
def open_video(path: Path, threads: int = 0) -> Iterator[OpenVideo]:
    """Open the first video stream of a file.

    FFmpeg gets an open file, not a name: nothing in it can make FFmpeg open something else.

    Raises DatasetError, ParseError: it is no video, is cut before its index, or exceeds a limit.
    """
    import av

    format_name = container_of(path)
    with open_regular(path, follow_links=True) as file:
        try:
            container = av.open(file, format=format_name)
        except (av.FFmpegError, ValueError) as error:
            raise DatasetError(
                f"{path.name} cannot be opened as a video ({_reason(error)}): the file is cut or "
                "damaged.",
                _AGAIN,
            ) from None
        with container:
            if not container.streams.video:
                raise DatasetError(f"{path.name} holds no pictures.", _AGAIN)
            stream = container.streams.video[0]
            if stream.codec_context is None:
                text = f"{path.name}: its codec is not known here."
                raise DatasetError(text, "Export it as MP4 with H.264.")
            if threads:
                stream.codec_context.thread_count = threads
            stream.thread_type = "AUTO"
            facts = _facts(container, stream)
            _check_limits(path.name, facts)
            yield OpenVideo(path.name, container, stream, facts)


def _facts(container: Any, stream: Any) -> VideoFacts:
    context = stream.codec_context
    duration_s = 0.0
    if stream.duration and stream.time_base:
        duration_s = float(stream.duration * stream.time_base)
    elif container.duration:
        duration_s = container.duration / 1e6  # FFmpeg's AV_TIME_BASE
    ratio = float(stream.sample_aspect_ratio or 1.0)
    return VideoFacts(
        int(context.width), int(context.height), int(stream.frames or 0), max(duration_s, 0.0),
        str(context.name), int(context.color_trc or 0) in (PQ, HLG),
        int(context.field_order) in _INTERLACED,
        float(stream.average_rate or stream.guessed_rate or 0.0),
        ratio if 0.25 <= ratio <= 4.0 else 1.0,  # what is stated may be absurd
    )  # fmt: skip


def _check_limits(name: str, facts: VideoFacts) -> None:
    width, height = facts.width, facts.height
    if max(width, height) > limits.MAX_IMAGE_SIDE_PX or width * height > limits.MAX_IMAGE_PIXELS:
        raise DatasetError(
            f"{name} claims to have {width} x {height} pixels; at most "
            f"{limits.MAX_IMAGE_PIXELS // 10**6} million are read.",
            "Export it smaller.",
        )
    if min(width, height) < limits.MIN_PHOTO_SIDE_PX:
        raise DatasetError(f"{name} has {width} x {height} pixels.", "Use a larger video.")
    if facts.duration_s > limits.MAX_VIDEO_S or facts.frames > limits.MAX_VIDEO_FRAMES:
        raise DatasetError(
            f"{name} is {facts.duration_s / 60:.0f} minutes long ({facts.frames} frames); at most "
            f"{limits.MAX_VIDEO_S / 60:.0f} minutes and {limits.MAX_VIDEO_FRAMES} frames are read.",
            "Cut the part that shows the object.",
        )


@dataclass(frozen=True)
class DecodedFrame:
    """One frame, its number in the order of display, and its time."""

    index: int
    time_s: float
    frame: VideoFrame


def frames_of(video: OpenVideo) -> Iterator[DecodedFrame]:
    """Decode frame after frame; what is damaged or of another size is left out.

    ``video.bad_packets`` and ``video.is_cut`` tell of damage afterwards. Two passes over a file
    give the same frames with the same numbers.

    Raises DatasetError: more frames than the limit.
    """
    import av

    index = 0
    last_s = -1.0
    step_s = 1.0 / video.facts.fps if video.facts.fps else 1.0 / 30.0
    packets = video.container.demux(video.stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except (av.FFmpegError, OSError):
            video.is_cut = True
            return
        try:
            decoded = packet.decode()
        except (av.FFmpegError, ValueError):
            video.bad_packets += 1
            if video.bad_packets > MAX_DECODE_ERRORS:
                video.is_cut = True
                return
            continue
        for frame in decoded:
            if index >= limits.MAX_VIDEO_FRAMES:
                text = f"{video.name} holds more than {limits.MAX_VIDEO_FRAMES} frames."
                raise DatasetError(text, "Cut the part that shows the object.")
            same_size = (frame.width, frame.height) == (video.facts.width, video.facts.height)
            if frame.is_corrupt or not same_size:
                video.bad_packets += 1
                index += 1
                continue
            stated = frame.time
            # A time that is missing or goes back would break the order of the frames.
            time_s = last_s + step_s if stated is None or stated <= last_s else float(stated)
            last_s = max(time_s, 0.0) if index == 0 else time_s
            yield DecodedFrame(index, last_s, frame)
            index += 1


def grey_of(frame: VideoFrame, long_side_px: int) -> np.ndarray:
    """Return the brightness of a frame, not turned, at most ``long_side_px``, (h, w) float32."""
    factor = min(1.0, long_side_px / max(frame.width, frame.height))
    width, height = (
        max(limits.MIN_PHOTO_SIDE_PX, round(side * factor)) for side in (frame.width, frame.height)
    )
    small = frame.reformat(width, height, "gray", interpolation="AREA")
    return _plane(small, 1)[..., 0].astype(np.float32)


def upright_color(frame: VideoFrame, pixel_ratio: float = 1.0) -> np.ndarray:
    """Return a frame as players show it: turned, with square pixels, (h, w, 3) uint8."""
    width = max(limits.MIN_PHOTO_SIDE_PX, round(frame.width * pixel_ratio))
    colorspace = int(frame.colorspace)
    if colorspace == _UNLABELLED:
        colorspace = _BT709 if frame.height >= HD_HEIGHT_PX else _BT601
    rgb = frame.reformat(
        width, frame.height, "rgb24", src_colorspace=colorspace, interpolation="BICUBIC"
    )
    return _turned(_plane(rgb, 3), _display_matrix(frame))


def upright_size(frame: VideoFrame, pixel_ratio: float) -> tuple[int, int]:
    """Return width and height of :func:`upright_color`."""
    width = max(limits.MIN_PHOTO_SIDE_PX, round(frame.width * pixel_ratio))
    return (frame.height, width) if _display_matrix(frame)[1] else (width, frame.height)


def _plane(frame: VideoFrame, channels: int) -> np.ndarray:
    plane: Any = frame.planes[0]
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)  # (h, padded)
    used = rows[: frame.height, : frame.width * channels]
    return used.reshape(frame.height, frame.width, channels)


def _display_matrix(frame: VideoFrame) -> tuple[int, int, int, int]:
    """Return a, b, c, d of the matrix to display coordinates, rounded to quarter turns."""
    sides: Any = frame.side_data  # typed as a mapping of names, which it is not
    for data in sides.keys():  # noqa: SIM118 - iterating gives something else in PyAV
        if data.type.name == "DISPLAYMATRIX" and len(bytes(data)) == 36:
            a, b, _, c, d = struct.unpack("=5i", bytes(data)[:20])
            if abs(a) + abs(d) >= abs(b) + abs(c):
                return _sign(a), 0, 0, _sign(d)
            return 0, _sign(b), _sign(c), 0
    return 1, 0, 0, 1


def _sign(value: int) -> int:
    return -1 if value < 0 else 1


def _turned(pixels: np.ndarray, matrix: tuple[int, int, int, int]) -> np.ndarray:
    """Apply a matrix of quarter turns and mirrors: (x, y) goes to (a x + c y, b x + d y)."""
    a, b, c, d = matrix
    across, down = (c, b) if b else (a, d)
    if b:  # x becomes y, and y becomes x
        pixels = pixels.swapaxes(0, 1)
    if across < 0:
        pixels = pixels[:, ::-1]
    if down < 0:
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def _reason(error: Exception) -> str:
    text = str(getattr(error, "strerror", "") or error)
    return text.strip().splitlines()[0][:80] if text.strip() else type(error).__name__
