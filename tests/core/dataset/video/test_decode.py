# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames of a file: turned, timed, within limits, and past damage."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.photos import video as decode
from gaussian_wrapping_addon.core.photos.video import (
    frames_of,
    grey_of,
    open_video,
    upright_color,
    upright_size,
)
from tests.core.dataset.video.small_videos import FPS, HEIGHT, WIDTH, pan, write


def quarters() -> np.ndarray:
    """Return a picture whose quarters have four colours."""
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[: HEIGHT // 2, : WIDTH // 2] = (220, 40, 40)
    picture[: HEIGHT // 2, WIDTH // 2 :] = (40, 220, 40)
    picture[HEIGHT // 2 :, : WIDTH // 2] = (40, 40, 220)
    picture[HEIGHT // 2 :, WIDTH // 2 :] = (220, 220, 40)
    return picture


# Turned counterclockwise by so much, as numpy's rot90 counts, and mirrored after it.
@pytest.mark.parametrize("suffix", [".mp4", ".mov"])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_rotation_flags_are_respected(
    tmp_path: Path, turns: int, mirrored: bool, suffix: str
) -> None:
    degrees = (0, 90, 180, -90)[turns]
    stored = quarters()
    path = write(tmp_path / f"clip{suffix}", [stored] * 3, rotation=degrees, mirrored=mirrored)
    wanted = np.rot90(stored, turns)
    if mirrored:
        wanted = wanted[:, ::-1]
    with open_video(path, 1) as video:
        frame = next(frames_of(video)).frame
        color = upright_color(frame)
        assert upright_size(frame, 1.0) == (wanted.shape[1], wanted.shape[0])
    assert color.shape == wanted.shape
    assert np.abs(color.astype(int) - wanted).mean() < 6.0


def test_pixels_that_are_not_square_become_square(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan([0, 4, 8]))
    with open_video(path, 1) as video:
        frame = next(frames_of(video)).frame
        assert upright_color(frame, 1.5).shape == (HEIGHT, 480, 3)
        assert upright_size(frame, 1.5) == (480, HEIGHT)


def test_uneven_times_are_those_of_the_file(tmp_path: Path) -> None:
    times = [0, 1, 5, 6, 40, 41, 42]
    path = write(tmp_path / "clip.mkv", pan(range(7)), times=times)
    with open_video(path, 1) as video:
        found = [frame.time_s for frame in frames_of(video)]
    assert np.allclose(found, np.array(times) / FPS, atol=1.1e-3)  # Matroska counts milliseconds


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("a.mp4", "libx264"), ("a.MOV", "mpeg4"), ("a.m4v", "mpeg4"), ("a.mkv", "libx264"),
        ("a.webm", "libvpx"), ("a.avi", "mpeg4"),
    ],
)  # fmt: skip
def test_all_containers_are_read(tmp_path: Path, name: str, codec: str) -> None:
    path = write(tmp_path / name, pan(range(0, 20, 2)), codec=codec)
    with open_video(path, 1) as video:
        frames = list(frames_of(video))
        assert (video.bad_packets, video.is_cut) == (0, False)
    assert [frame.index for frame in frames] == list(range(10))


def test_grey_pictures_are_small_and_of_the_right_brightness(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", [np.full((HEIGHT, WIDTH, 3), 100, np.uint8)] * 3)
    with open_video(path, 1) as video:
        grey = grey_of(next(frames_of(video)).frame, 160)
    assert grey.shape == (120, 160)
    assert np.abs(grey - 100).max() < 3


def test_a_file_that_is_cut_gives_what_is_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(0, 120, 2)), options={"movflags": "faststart"})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with open_video(path, 1) as video:
        count = len(list(frames_of(video)))
        assert video.facts.frames == 60
    assert 10 < count < 50


def test_a_file_without_its_index_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(10)))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with (
        pytest.raises(DatasetError, match=r"clip\.mp4 cannot be opened as a video.*cut") as told,
        open_video(path),
    ):
        pass
    assert told.value.hint


def test_damage_in_the_middle_leaves_the_rest(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.avi", pan(range(0, 80, 2)), codec="mpeg4")
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 3000] = bytes(3000)
    path.write_bytes(data)
    with open_video(path, 1) as video:
        frames = list(frames_of(video))
    assert 20 < len(frames) <= 40
    assert np.all(np.diff([frame.time_s for frame in frames]) > 0)


SIZE_IN_JPEG = b"\xff\xc0\x00\x11\x08" + struct.pack(">HH", HEIGHT, WIDTH)
SIZE_IN_AVI = struct.pack("<ii", WIDTH, HEIGHT)


def patched(path: Path, codec: str, old: bytes, new: bytes, *, skipped: int = 0) -> Path:
    """Write a video and replace a size in it, but for the first few places."""
    write(path, pan(range(10)), codec=codec)
    parts = path.read_bytes().split(old)
    assert len(parts) > skipped + 1
    head = old.join(parts[: skipped + 1])
    path.write_bytes(new.join([head, *parts[skipped + 1 :]]))
    return path


@pytest.mark.parametrize("side", [12_000, 65_000])
def test_absurd_sizes_of_a_header_are_refused(tmp_path: Path, side: int) -> None:
    path = patched(tmp_path / "clip.avi", "rawvideo", SIZE_IN_AVI, struct.pack("<ii", side, side))
    with (
        pytest.raises(DatasetError, match=r"clip\.avi (claims to have|cannot be opened|has 0)"),
        open_video(path, 1) as video,
    ):
        list(frames_of(video))


def test_frames_that_claim_absurd_sizes_take_no_memory(tmp_path: Path) -> None:
    huge = SIZE_IN_JPEG[:5] + struct.pack(">HH", 12_000, 12_000)
    path = patched(tmp_path / "clip.avi", "mjpeg", SIZE_IN_JPEG, huge)
    with open_video(path, 1) as video:
        assert not list(frames_of(video))
        assert video.bad_packets == 10


def test_frames_of_another_size_are_left_out(tmp_path: Path) -> None:
    larger = SIZE_IN_JPEG[:5] + struct.pack(">HH", 2 * HEIGHT, 2 * WIDTH)
    path = patched(tmp_path / "clip.avi", "mjpeg", SIZE_IN_JPEG, larger, skipped=6)
    with open_video(path, 1) as video:
        assert [frame.index for frame in frames_of(video)] == list(range(6))
        assert video.bad_packets == 4


def test_long_videos_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(10)))
    monkeypatch.setattr(limits, "MAX_VIDEO_FRAMES", 9)
    with (
        pytest.raises(DatasetError, match=r"clip\.mp4 is 0 minutes long \(10 frames\)"),
        open_video(path),
    ):
        pass
    monkeypatch.setattr(decode, "_check_limits", lambda name, facts: None)
    with open_video(path, 1) as video, pytest.raises(DatasetError, match="more than 9 frames"):
        list(frames_of(video))


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    import av

    path = tmp_path / "clip.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(DatasetError, match="holds no pictures"), open_video(path):
        pass


def test_hdr_is_noticed(tmp_path: Path) -> None:
    for trc, wanted in ((16, True), (18, True), (1, False)):
        path = write(tmp_path / f"clip-{trc}.mp4", pan([0, 2, 4]), trc=trc)
        with open_video(path) as video:
            assert video.facts.is_hdr is wanted
