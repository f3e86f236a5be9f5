# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos: by name and first bytes, decoded, looked at in a child process."""

from __future__ import annotations

import json
import os
import struct
import sys
from pathlib import Path

import av
import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import DatasetError, ParseError, WorkerError
from gaussian_wrapping_addon.core.jobs.commands.estimate_command import input_facts
from gaussian_wrapping_addon.core.loading import check
from gaussian_wrapping_addon.core.loading.check import Finding, check_input
from gaussian_wrapping_addon.core.loading.source_kind import source_kind
from gaussian_wrapping_addon.core.photos import video as video_module
from gaussian_wrapping_addon.core.photos.video import (
    container_of,
    frames_of,
    grey_of,
    open_video,
    probe_video,
    probed,
    upright_color,
    upright_size,
)
from gaussian_wrapping_addon.core.settings import JobSettings
from tests.core.photos.small_videos import FPS, HEIGHT, WIDTH, pan, write


@pytest.mark.parametrize(
    ("name", "codec", "container"),
    [
        ("a.mp4", "libx264", "mov"), ("a.MOV", "mpeg4", "mov"), ("a.mkv", "libx264", "matroska"),
        ("a.webm", "libvpx", "matroska"), ("a.avi", "mpeg4", "avi"),
    ],
)  # fmt: skip
def test_all_containers_are_read_and_known_by_their_first_bytes(
    tmp_path: Path, name: str, codec: str, container: str
) -> None:
    path = write(tmp_path / name, pan(range(0, 20, 2)), codec=codec)
    assert container_of(path) == container
    path = path.rename(tmp_path / "other.mp4")
    assert container_of(path) == container
    with open_video(path, 1) as video:
        assert [frame.index for frame in frames_of(video)] == list(range(10))
        assert (video.bad_packets, video.is_cut) == (0, False)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"#EXTM3U\n#EXT-X-VERSION:3\nfile:///etc/passwd\n", "no video that can be read"),
        (b"ffconcat version 1.0\nfile /etc/passwd\n", "no video that can be read"),
        (b"\xff\xd8\xff\xe0 jpeg", "no video that can be read"),
    ],
)
def test_what_is_no_video_is_refused_by_name(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "clip.mp4"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=rf"^clip\.mp4 .*{words}|^clip\.mp4 is {words}") as told:
        container_of(path)
    assert told.value.hint
    if hasattr(os, "mkfifo"):  # a named pipe is not waited for
        os.mkfifo(tmp_path / "pipe.mp4")
        with pytest.raises(ParseError):
            container_of(tmp_path / "pipe.mp4")


def test_a_folder_with_one_video_and_no_photos_is_that_video(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("by hand")
    (tmp_path / ".hidden.mp4").write_bytes(b"resource fork")
    (tmp_path / "clip.MP4").write_bytes(b"not looked into")
    kind = source_kind(tmp_path)
    assert (kind.kind, kind.video) == ("video", tmp_path / "clip.MP4")
    assert source_kind(tmp_path / "clip.MP4").video == tmp_path / "clip.MP4"
    (tmp_path / "second.mov").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"no photos, but 2 videos: clip\.MP4, second\.mov"):
        source_kind(tmp_path)
    (tmp_path / "photo.jpg").write_bytes(b"")
    assert source_kind(tmp_path).kind == "photos"


def quarters() -> np.ndarray:
    """Return a picture whose quarters have four colours."""
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[: HEIGHT // 2, : WIDTH // 2] = (220, 40, 40)
    picture[: HEIGHT // 2, WIDTH // 2 :] = (40, 220, 40)
    picture[HEIGHT // 2 :, : WIDTH // 2] = (40, 40, 220)
    picture[HEIGHT // 2 :, WIDTH // 2 :] = (220, 220, 40)
    return picture


# Turned counterclockwise by so much, as numpy's rot90 counts, and mirrored after it.
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_rotation_flags_are_respected(tmp_path: Path, turns: int, mirrored: bool) -> None:
    degrees = (0, 90, 180, -90)[turns]
    stored = quarters()
    path = write(tmp_path / "clip.mp4", [stored] * 3, rotation=degrees, mirrored=mirrored)
    wanted = np.rot90(stored, turns)
    if mirrored:
        wanted = wanted[:, ::-1]
    with open_video(path, 1) as video:
        frame = next(frames_of(video)).frame
        color = upright_color(frame)
        assert upright_size(frame, 1.0) == (wanted.shape[1], wanted.shape[0])
    assert color.shape == wanted.shape
    assert np.abs(color.astype(int) - wanted).mean() < 6.0


def test_pixels_become_square_and_grey_pictures_keep_their_brightness(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", [np.full((HEIGHT, WIDTH, 3), 100, np.uint8)] * 3)
    with open_video(path, 1) as video:
        frame = next(frames_of(video)).frame
        assert upright_color(frame, 1.5).shape == (HEIGHT, 480, 3)
        assert upright_size(frame, 1.5) == (480, HEIGHT)
        grey = grey_of(frame, 160)
    assert grey.shape == (120, 160)
    assert np.abs(grey - 100).max() < 3


def test_uneven_times_are_those_of_the_file(tmp_path: Path) -> None:
    times = [0, 1, 5, 6, 40, 41, 42]
    path = write(tmp_path / "clip.mkv", pan(range(7)), times=times)
    with open_video(path, 1) as video:
        found = [frame.time_s for frame in frames_of(video)]
    assert np.allclose(found, np.array(times) / FPS, atol=1.1e-3)  # Matroska counts milliseconds


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


def test_frames_of_absurd_or_other_sizes_are_left_out(tmp_path: Path) -> None:
    huge = SIZE_IN_JPEG[:5] + struct.pack(">HH", 12_000, 12_000)
    larger = SIZE_IN_JPEG[:5] + struct.pack(">HH", 2 * HEIGHT, 2 * WIDTH)
    for size, skipped, kept in ((huge, 0, 0), (larger, 6, 6)):
        path = patched(tmp_path / "clip.avi", "mjpeg", SIZE_IN_JPEG, size, skipped=skipped)
        with open_video(path, 1) as video:
            assert [frame.index for frame in frames_of(video)] == list(range(kept))
            assert video.bad_packets == 10 - kept


def test_long_videos_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(10)))
    monkeypatch.setattr(limits, "MAX_VIDEO_FRAMES", 9)
    with (
        pytest.raises(DatasetError, match=r"clip\.mp4 is 0 minutes long \(10 frames\)"),
        open_video(path),
    ):
        pass
    monkeypatch.setattr(video_module, "_check_limits", lambda name, facts: None)
    with open_video(path, 1) as video, pytest.raises(DatasetError, match="more than 9 frames"):
        list(frames_of(video))


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(DatasetError, match="holds no pictures"), open_video(path):
        pass


def kinds(findings: list[Finding]) -> list[str]:
    return [finding.severity for finding in findings]


def test_facts_are_those_that_players_show(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(45)), rotation=-90, trc=18)
    found = probe_video(path, sys.executable)
    assert (found.width, found.height, found.frames) == (HEIGHT, WIDTH, 45)
    assert found.duration_s == pytest.approx(1.5)
    assert (found.codec, found.is_hdr, found.is_interlaced) == ("h264", True, False)
    assert probed(path) == found


@pytest.mark.parametrize("worker", ["", sys.executable])
def test_the_check_refuses_what_is_no_video(tmp_path: Path, worker: str) -> None:
    (tmp_path / "clip.mkv").write_bytes(b"some text, not a video")
    (error,) = [f for f in check_input(tmp_path, worker=worker) if f.severity == "error"]
    assert "no video" in error.message
    assert error.hint


def test_the_check_describes_a_video(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(45)), trc=16)
    without = check_input(path)
    assert kinds(without) == ["fact", "fact"]
    findings = check_input(path, worker=sys.executable)
    assert kinds(findings) == ["fact", "fact", "warning"]
    assert "45 frames, 320 x 240, h264" in findings[0].message
    assert "HDR" in findings[2].message
    shown = ", ".join(finding.short for finding in findings if finding.short)
    assert shown == "2 s of video, cameras to be solved"
    assert [finding.kind for finding in findings if finding.kind] == ["video"]


def test_the_check_refuses_cut_short_and_tiny_videos(tmp_path: Path) -> None:
    whole = write(tmp_path / "clip.mp4", pan(range(30)))
    whole.write_bytes(whole.read_bytes()[:5000])
    short = write(tmp_path / "short.mp4", pan([0, 5]))
    for path, words in ((whole, "cannot be opened as a video"), (short, "has 2 frames")):
        (error,) = [f for f in check_input(path, worker=sys.executable) if f.severity == "error"]
        assert words in error.message
        assert error.hint


def test_a_worker_without_the_decoder_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(_path: Path) -> None:
        raise ModuleNotFoundError("No module named 'av'", name="av")

    monkeypatch.setattr(video_module, "probed", missing)
    assert video_module.main(["clip.mp4"]) == WorkerError.exit_code
    (line,) = capsys.readouterr().out.splitlines()
    said = json.loads(line)
    assert "lacks a package" in said["error"]
    assert "Set Up Worker" in said["hint"]
    assert "kind" not in said


def test_a_worker_that_does_not_answer_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(10)))
    with pytest.raises(WorkerError):
        probe_video(path, str(tmp_path / "no" / "python"))

    def broken(*_: object) -> None:
        raise WorkerError("The worker's Python lacks a package.", "Press Set Up Worker.")

    monkeypatch.setattr(check, "probe_video", broken)
    assert kinds(check_input(path, worker="python")) == ["fact", "warning"]


def test_the_estimate_knows_how_many_frames_are_used(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(90)))
    wanted = {
        90: JobSettings(), 12: JobSettings(video_frames=12), 6: JobSettings(video_fps=2.0),
    }  # fmt: skip
    for count, settings in wanted.items():
        facts = input_facts(path, settings)
        assert (facts.photos, facts.long_side_px) == (count, WIDTH)
    (tmp_path / "bad.mp4").write_bytes(b"")
    with pytest.raises(DatasetError, match="is empty"):
        input_facts(tmp_path / "bad.mp4")
