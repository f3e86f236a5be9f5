# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames of a video: sharpness, motion, which are chosen, and whole files."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, shift, uniform_filter1d

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import Cancelled, DatasetError, ResourceError, WrapError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.photos import video_frames
from gaussian_wrapping_addon.core.photos.video_frames import (
    FEWEST_FRAMES,
    MOST_FRAMES,
    FrameMeasures,
    MotionMeter,
    VideoFrames,
    are_blurred,
    automatic_count,
    choose_frames,
    details,
    displacement_px,
    extract_frames,
    relative_sharpness,
)
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from tests.core.photos.small_videos import HEIGHT, WIDTH, mural, pan, shot, write

SHAPE = (240, 320)


def greys(count: int, *, noise: float = 1.0) -> list[np.ndarray]:
    wide, random = mural().mean(2), np.random.default_rng(3)
    return [
        (wide[: SHAPE[0], 8 * i : 8 * i + SHAPE[1]] + random.normal(scale=noise, size=SHAPE))
        for i in range(count)
    ]


def judged(frames: list[np.ndarray], step: float = 0.02) -> np.ndarray:
    found = np.stack([details(np.asarray(frame, np.float32)) for frame in frames])
    times = np.arange(len(frames)) / 30.0
    return are_blurred(found, relative_sharpness(found, times, step * np.arange(len(frames))))


@pytest.mark.parametrize("noise", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_blur_of_one_direction_is_found(axis: int, noise: float) -> None:
    frames, random = greys(60, noise=0.0), np.random.default_rng(4)
    truth = np.arange(60) % 3 == 1
    for i in np.flatnonzero(truth):
        frames[i] = uniform_filter1d(frames[i], 7, axis=axis)
    frames = [frame + random.normal(scale=noise, size=SHAPE) for frame in frames]
    assert np.array_equal(judged(frames), truth)


def test_frames_without_blur_are_all_sharp_whatever_they_show() -> None:
    frames = greys(40)
    for i in range(15, 25):  # a plain wall comes into the picture, and goes
        frames[i][:, : 25 * (10 - abs(i - 20))] = 128.0
    assert not judged(frames, step=0.1)[:15].any()
    assert not judged(frames, step=0.1)[25:].any()
    assert judged(frames, step=0.1).sum() <= 2


def test_long_blur_is_found_although_no_frame_near_it_is_sharp() -> None:
    frames = greys(60)
    truth = (np.arange(60) >= 20) & (np.arange(60) < 40)
    for i in np.flatnonzero(truth):
        frames[i] = gaussian_filter(frames[i], 3.0)
    # So much motion from frame to frame that none is compared with its neighbours.
    assert np.array_equal(judged(frames, step=1.0), truth)


MOTION_SHAPE = (90, 160)


def textured(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=MOTION_SHAPE)
    smooth = gaussian_filter(noise, 1.5)
    return np.asarray(128 + 40 * smooth / smooth.std(), np.float32)


@pytest.mark.parametrize("way", [(0.0, 0.6), (0.7, -1.3), (-6.0, 11.0), (0.0, 21.0)])
def test_shifts_are_measured(way: tuple[float, float]) -> None:
    first = textured()
    second = shift(first, way, order=3, mode="wrap").astype(np.float32)
    assert displacement_px(first, second) == pytest.approx(np.hypot(*way), abs=0.12)


def test_noise_is_no_motion() -> None:
    random, still = np.random.default_rng(1), textured()
    meter = MotionMeter()
    ways = [meter.add(still + random.normal(scale=0.5, size=MOTION_SHAPE)) for _ in range(60)]
    assert ways == [0.0] * 60


def test_slow_motion_adds_up() -> None:
    first, meter = textured(), MotionMeter()
    ways = [meter.add(shift(first, (0, 0.2 * i), order=3, mode="wrap")) for i in range(101)]
    assert np.all(np.diff(ways) >= 0.0)
    # Twenty pixels; each new anchor costs what noise may be.
    assert ways[-1] * MOTION_SHAPE[1] == pytest.approx(20.0, abs=1.5)


def test_what_turns_before_a_still_background_counts() -> None:
    first = textured()
    second = first.copy()
    second[30:70, 50:110] = shift(first, (0, 2.0), order=3, mode="wrap")[30:70, 50:110]
    assert displacement_px(first, second) == pytest.approx(2.0, abs=0.4)


def test_a_picture_of_one_colour_does_not_move_and_a_cut_is_a_bounded_step() -> None:
    plain, tiny = np.full(MOTION_SHAPE, 50.0, np.float32), np.zeros((8, 9), np.float32)
    assert displacement_px(plain, plain) == displacement_px(tiny, tiny) == 0.0
    found = details(np.zeros(SHAPE, np.float32))
    assert np.isfinite(found).all()
    assert found.shape == (2, 4)
    meter = MotionMeter()
    meter.add(textured(0))
    assert 0.0 < meter.add(textured(5)) <= 0.25


FPS = 30.0


def measures(ways: np.ndarray, blurred: np.ndarray | None = None) -> FrameMeasures:
    """Return measures of frames that are alike, with little fine detail where blurred."""
    count = len(ways)
    details = np.zeros((count, 2, 4))
    details += 0.02 * np.random.default_rng(0).normal(size=(count, 1, 1))
    if blurred is not None:
        details[blurred, 0, 1] -= 2.0
    return FrameMeasures(np.arange(count), np.arange(count) / FPS, np.asarray(ways), details)


def test_no_blurred_frame_is_chosen_and_they_are_counted() -> None:
    blurred = np.random.default_rng(1).random(600) < 1 / 3
    choice = choose_frames(measures(np.linspace(0.0, 5.0, 600), blurred))
    assert len(choice.positions) >= 55
    assert not blurred[choice.positions].any()
    assert choice.blurred == blurred.sum()
    assert choice.gaps_s == ()


def test_a_pause_gives_one_frame_at_most() -> None:
    ways = np.concatenate([np.linspace(0, 2, 100), np.full(300, 2.0), np.linspace(2, 4, 100)])
    choice = choose_frames(measures(ways))
    paused = (choice.positions >= 99) & (choice.positions <= 400)
    assert paused.sum() <= 1
    assert len(choice.positions) == pytest.approx(50, abs=2)
    assert choice.still >= 298


def test_fast_motion_gives_more_frames() -> None:
    ways = np.concatenate([np.linspace(0, 1, 300), np.linspace(1, 4, 300)[1:]])
    chosen = choose_frames(measures(ways)).positions
    assert (chosen >= 300).sum() == pytest.approx(3 * (chosen < 300).sum(), rel=0.15)


@pytest.mark.parametrize("wanted", [3, 20, 77])
def test_a_wanted_number_is_given(wanted: int) -> None:
    choice = choose_frames(measures(np.linspace(0.0, 4.0, 600)), frames=wanted)
    assert len(choice.positions) == wanted
    assert np.all(np.diff(choice.positions) > 0)
    steps = np.diff(choice.positions)
    assert steps.max() < 2.0 * 600 / wanted


def test_frames_a_second_count_by_time() -> None:
    ways = np.concatenate([np.linspace(0, 1, 300), np.linspace(1, 4, 301)[1:]])
    chosen = choose_frames(measures(ways), fps=3.0).positions
    assert len(chosen) == 60
    assert (chosen < 300).sum() == 30
    assert len(choose_frames(measures(ways), frames=10, fps=3.0).positions) == 10


def test_nothing_moves_gives_one_frame() -> None:
    choice = choose_frames(measures(np.zeros(90)))
    assert len(choice.positions) == 1
    assert choice.still == 89
    assert len(choose_frames(measures(np.zeros(90)), fps=10.0).positions) == 1
    nothing = FrameMeasures(np.zeros(0, int), np.zeros(0), np.zeros(0), np.zeros((0, 2, 4)))
    assert len(choose_frames(nothing).positions) == 0


def test_blur_over_a_long_way_is_reported() -> None:
    blurred = (np.arange(600) >= 200) & (np.arange(600) < 300)
    choice = choose_frames(measures(np.linspace(0.0, 5.0, 600), blurred))
    ((begin, end),) = choice.gaps_s
    assert begin == pytest.approx(200 / FPS, abs=0.3)
    assert end == pytest.approx(300 / FPS, abs=0.3)


def test_the_automatic_number_follows_the_motion() -> None:
    assert automatic_count(0.0) == FEWEST_FRAMES
    assert automatic_count(8.0) == 100
    assert automatic_count(1e6) == MOST_FRAMES


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
    seen: list[ProgressEvent] = []
    found = extract_frames(path, tmp_path / "work", Progress("cameras", seen.append), threads=1)
    kept = numbers(found)
    assert not blurred[kept].any()
    assert ((kept >= 30) & (kept < 60)).sum() <= 1
    assert len(kept) >= 15
    facts = {name.removeprefix("video_frames_"): value for name, value in found.facts.items()}
    assert (facts["read"], facts["blurred"], facts["damaged"]) == (COUNT, blurred.sum(), 0)
    assert (facts["still"] >= 28, facts["kept"]) == (True, len(kept))
    assert facts["photos_in_order"] == "frames of a video"
    assert found.warnings == ()
    fractions = [event.fraction for event in seen]
    assert fractions == sorted(fractions)
    assert any("looking at frame" in event.message and "of 90" in event.message for event in seen)


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
        other = shot(picture, places[number] + 10) - shot(picture, places[number]).astype(float)
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
    path = write(
        tmp_path / "clip.mp4", pan(range(0, 900, 10)), options={"movflags": "faststart"}, trc=16
    )
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    found = taken(path, tmp_path / "work", frames=20)
    assert len(found.names) >= 3
    (warning,) = [w for w in found.warnings if w.code == "video-damaged"]
    (hdr,) = [w for w in found.warnings if w.code == "video-hdr"]
    assert "clip.mp4" in hdr.text
    lost = COUNT - found.facts["video_frames_read"]
    assert warning.text.startswith(f"{lost} frames of clip.mp4 cannot be decoded")
    assert found.facts["video_frames_damaged"] == lost


def test_a_still_picture_is_refused_with_the_counts(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan([100] * 40))
    with pytest.raises(DatasetError, match=r"Only 1 frames of clip\.mp4 .* 40 frames were read: 0"):
        taken(path, tmp_path / "work")


def test_too_many_frames_and_a_full_disk_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(limits, "MAX_CHOSEN_FRAMES", 20)
    monkeypatch.setattr(video_frames, "write_photo", full)
    path = write(tmp_path / "clip.mp4", pan(range(0, 300, 10)))
    task = {"video": str(path), "frames": 0, "fps": 25.0, "threads": 1}
    write_json(tmp_path / "task.json", task)
    with pytest.raises(DatasetError, match=r"25 frames of each of the 1 s of clip\.mp4 are more"):
        video_frames.main(tmp_path)
    write_json(tmp_path / "task.json", {**task, "frames": 5, "fps": 0.0})
    with pytest.raises(ResourceError, match="No room is left on the disk"):
        video_frames.main(tmp_path)


def test_a_cancel_ends_it_between_frames(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.mp4", pan(range(0, 900, 10)))
    seen: list[ProgressEvent] = []
    progress = Progress("cameras", seen.append, lambda: bool(seen) and "frame" in seen[-1].message)
    with pytest.raises(Cancelled):
        extract_frames(path, tmp_path / "work", progress, threads=1)
    assert not (tmp_path / "work" / "frames").exists()
    found = taken(path, tmp_path / "work", frames=10)  # what was left is no obstacle
    assert len(found.names) == 10


def test_errors_of_the_helper_keep_their_type(tmp_path: Path) -> None:
    with pytest.raises(WrapError, match="cannot be read"):
        taken(tmp_path / "missing.mp4", tmp_path / "work")
    (tmp_path / "clip.mp4").write_bytes(b"just text, no video")
    with pytest.raises(DatasetError, match="is no video that can be read") as told:
        taken(tmp_path / "clip.mp4", tmp_path / "work")
    assert told.value.hint
    assert not (tmp_path / "work" / "frames").exists()
