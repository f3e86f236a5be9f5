# SPDX-License-Identifier: GPL-3.0-or-later
"""The video benchmark: what is filmed, and the page."""

from __future__ import annotations

from itertools import islice

import numpy as np

from benchmarks.video.__main__ import _page, frame_figures
from benchmarks.video.filmed import Studio, blurred, frames, photo_cameras, walk

WIDTH, HEIGHT = 96, 54


def test_a_third_is_blurred_and_the_pause_is_still() -> None:
    way = walk(WIDTH, HEIGHT)
    assert way.blurred.sum() == len(way.cameras) // 3 == 100
    assert way.paused.sum() == 29
    assert not (way.blurred & way.paused).any()
    centers = np.array([camera.center for camera in way.cameras])
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert np.all(steps[way.paused[1:]] < 1e-12)
    assert np.all(steps[~way.paused[1:]] > 1e-3)


def test_the_walk_goes_once_around_as_the_photos_do() -> None:
    for cameras in (walk(WIDTH, HEIGHT).cameras, photo_cameras(40, WIDTH, HEIGHT)):
        centers = np.array([camera.center for camera in cameras])
        turns = np.unwrap(np.arctan2(centers[:, 1], centers[:, 0]))
        assert abs(abs(turns[-1] - turns[0]) - 2 * np.pi) < 0.2
        assert np.ptp(np.degrees(np.arcsin(centers[:, 2] / 3.1))) > 25


def test_frames_show_the_cow_and_differ_in_the_pause_by_noise_alone() -> None:
    studio, way = Studio(), walk(WIDTH, HEIGHT, seconds=10, fps=2)
    pictures = np.array(list(islice(frames(studio, way), 10)), float)
    still = np.flatnonzero(way.paused[:10])
    assert len(still) == 1
    change = np.abs(np.diff(pictures, axis=0)).mean((1, 2, 3))
    assert change[still[0] - 1] < 4.0 or way.blurred[still[0] - 1]
    seen = studio.truth(way.cameras).seen
    assert seen is not None
    assert (seen >= 2).mean() > 0.7


def test_blur_goes_along_its_line() -> None:
    picture = np.zeros((21, 21, 3), np.float32)
    picture[10, 10] = 210.0
    across = blurred(picture, 6.0, 0.0)
    assert np.allclose(across.sum((0, 1)), 210.0, rtol=1e-5)
    assert (across[10, :, 0] > 0).sum() >= 5
    assert (across[:, :, 0].sum(1) > 0).sum() == 1


def test_the_page_says_what_has_run() -> None:
    assert "It has not been run yet." in _page([])
    way = walk(WIDTH, HEIGHT)
    sharp = np.flatnonzero(~way.blurred)[:5]
    names = [f"frame-{i:06d}.jpg" for i in [*sharp, int(np.flatnonzero(way.blurred)[0])]]
    facts = {"video_frames_read": 300, "video_frames_blurred": 99, "video_frames_still": 28}
    figures = frame_figures(names, facts, way)
    assert (figures["kept"], figures["kept_blurred"], figures["blurred"]) == (6, 1, 100)
    common = {"code": "c", "date": "d", "machine": "m", "threads": 1, "preset": "draft"}
    page = _page([{**common, "case": "frames", **figures}])
    assert "no mesh was made yet" in page
    failed = {**common, "case": "photos", "failed": "error: none placed"}
    good = {
        **common, "case": "video", "placed": 6, "photos": 6, "rotation_degrees_median": 0.1,
        "f1": [0.1, 0.2, 0.3], "precision": [0.4] * 3, "recall": [0.5] * 3, "processor_s": 9.0,
        **figures,
    }  # fmt: skip
    page = _page([failed, good])
    assert "error: none placed" in page
    assert "| 6 of 6 " in page
    assert "0.100 / 0.200 / 0.300" in page
