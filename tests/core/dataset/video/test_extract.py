# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames taken out of whole files: what is kept, counted, refused and left behind."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import Cancelled, DatasetError, ResourceError, WrapError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.photos import video_frames
from gaussian_wrapping_addon.core.photos.video_frames import VideoFrames, extract_frames
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from tests.core.dataset.video.small_videos import HEIGHT, WIDTH, mural, pan, shot, write

COUNT = 90


def taken(path: Path, work: Path, **options: float) -> VideoFrames:
    return extract_frames(path, work, Progress(), threads=1, **options)  # type: ignore[arg-type]


def numbers(found: VideoFrames) -> np.ndarray:
    return np.array([int(name[6:12]) for name in found.names])


def test_sharp_frames_of_the_motion_are_kept(tmp_path: Path) -> None:
    """A third is blurred, the middle is a pause."""
    places = np.concatenate([np.arange(30) * 8, np.full(30, 232), 232 + np.arange(30) * 8])
    blurred = np.random.default_rng(5).random(COUNT) < 1 / 3
    blurred[30:60] = False
    path = write(tmp_path / "clip.mp4", pan(places, blurred))
    found = taken(path, tmp_path / "work")
    kept = numbers(found)
    assert not blurred[kept].any()
    assert ((kept >= 30) & (kept < 60)).sum() <= 1
    assert len(kept) >= 15
    assert found.facts["video_frames_read"] == COUNT
    assert found.facts["video_frames_blurred"] == blurred.sum()
    assert found.facts["video_frames_still"] >= 28
    assert found.facts["video_frames_kept"] == len(kept)
    assert found.facts["video_frames_damaged"] == 0
    assert found.facts["photos_in_order"] == "frames of a video"
    assert found.warnings == ()


def test_names_sort_in_time_and_pictures_are_those_of_the_video(tmp_path: Path) -> None:
    places = range(0, 600, 10)
    path = write(tmp_path / "clip.mp4", pan(places))
    found = taken(path, tmp_path / "work", frames=12)
    assert list(found.names) == sorted(found.names)
    assert [p.name for p in sorted(found.folder.iterdir())] == list(found.names)
    assert list((tmp_path / "work").iterdir()) == [found.folder]
    assert len(found.names) == 12
    picture = mural()
    for name, number in zip(found.names, numbers(found), strict=True):
        with Image.open(found.folder / name) as photo:
            assert photo.size == (WIDTH, HEIGHT)
            error = np.asarray(photo, float) - shot(picture, places[number])
        assert np.abs(error).mean() < 8.0
        other = np.asarray(shot(picture, places[number] + 10), float) - shot(
            picture, places[number]
        )
        assert np.abs(error).mean() < np.abs(other).mean() / 2


def test_uneven_times_change_nothing_of_the_motion(tmp_path: Path) -> None:
    """Two parts of the same way, one filmed at a tenth of the frames' rate."""
    times = [*range(40), *range(40, 440, 10)]
    path = write(tmp_path / "clip.mkv", pan(range(0, 800, 10)), times=times)
    by_motion = numbers(taken(path, tmp_path / "a", frames=20))
    assert abs((by_motion < 40).sum() - 10) <= 1
    by_time = numbers(taken(path, tmp_path / "b", fps=2.0))
    assert (by_time < 40).sum() <= 4
    assert (by_time >= 40).sum() >= 22


def test_a_cut_file_gives_its_rest_and_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(0, 900, 10)), options={"movflags": "faststart"})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    found = taken(path, tmp_path / "work", frames=20)
    assert len(found.names) >= 3
    (warning,) = [w for w in found.warnings if w.code == "video-damaged"]
    lost = COUNT - found.facts["video_frames_read"]
    assert warning.text.startswith(f"{lost} frames of clip.mp4 cannot be decoded")
    assert found.facts["video_frames_damaged"] == lost


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "clip.mp4 is empty"), (b"just text, no video", "is no video that can be read")],
)
def test_what_is_no_video_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "clip.mp4").write_bytes(content)
    with pytest.raises(DatasetError, match=words) as told:
        taken(tmp_path / "clip.mp4", tmp_path / "work")
    assert told.value.hint
    assert not (tmp_path / "work" / "frames").exists()


def test_a_still_picture_is_refused_with_the_counts(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan([100] * 40))
    with pytest.raises(DatasetError, match=r"Only 1 frames of clip\.mp4 .* 40 frames were read: 0"):
        taken(path, tmp_path / "work")


def test_so_many_frames_a_second_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MAX_CHOSEN_FRAMES", 20)
    path = write(tmp_path / "clip.mp4", pan(range(0, 300, 10)))
    (tmp_path / "task").mkdir()
    task = {"video": str(path), "frames": 0, "fps": 25.0, "threads": 1}
    write_json(tmp_path / "task" / "task.json", task)
    with pytest.raises(DatasetError, match=r"25 frames of each of the 1 s of clip\.mp4 are more"):
        video_frames.main(tmp_path / "task")


def test_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(0, 300, 10)))
    (tmp_path / "task").mkdir()
    task = {"video": str(path), "frames": 5, "fps": 0.0, "threads": 1}
    write_json(tmp_path / "task" / "task.json", task)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(video_frames, "write_photo", full)
    with pytest.raises(ResourceError, match="No room is left on the disk"):
        video_frames.main(tmp_path / "task")


def test_hdr_is_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(0, 200, 10)), trc=16)
    (warning,) = taken(path, tmp_path / "work").warnings
    assert warning.code == "video-hdr"
    assert "clip.mp4" in warning.text


def test_a_cancel_ends_it_between_frames(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(0, 900, 10)))
    seen: list[ProgressEvent] = []
    progress = Progress("cameras", seen.append, lambda: bool(seen) and "frame" in seen[-1].message)
    with pytest.raises(Cancelled):
        extract_frames(path, tmp_path / "work", progress, threads=1)
    assert not (tmp_path / "work" / "frames").exists()
    found = taken(path, tmp_path / "work", frames=10)  # what was left is no obstacle
    assert len(found.names) == 10


def test_progress_goes_from_begin_to_end(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(0, 400, 5)))
    seen: list[ProgressEvent] = []
    extract_frames(path, tmp_path / "work", Progress("cameras", seen.append), threads=1)
    fractions = [event.fraction for event in seen]
    assert fractions == sorted(fractions)
    assert any("looking at frame" in event.message and "of 80" in event.message for event in seen)


def test_errors_of_the_helper_keep_their_type(tmp_path: Path) -> None:
    with pytest.raises(WrapError, match="cannot be read"):
        taken(tmp_path / "missing.mp4", tmp_path / "work")
