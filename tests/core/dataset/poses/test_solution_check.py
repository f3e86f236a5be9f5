# SPDX-License-Identifier: GPL-3.0-or-later
"""Solutions held against their matches, joined and mended: halls by their matches alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.camera_places import Tracks, hall_tracks, write_database
from gaussian_wrapping_addon.core.evaluation.alignment import pose_errors
from gaussian_wrapping_addon.core.poses.checks import check_solution
from gaussian_wrapping_addon.core.poses.solver_helper import (
    joined,
    most_alike,
    near_in_tree,
    pair_likeness,
    place_at_once,
    place_one_by_one,
)
from gaussian_wrapping_addon.core.scene.camera import Camera

PHOTOS = 24
pytest.importorskip("pycolmap")


def _hall(folder: Path, repeats: int) -> tuple[Path, Tracks]:
    tracks = hall_tracks(PHOTOS, 150, repeats=repeats, seed=0)
    (folder / "images").mkdir()
    write_database(folder / "database.db", tracks, seed=0)
    return folder / "database.db", tracks


def _degrees(model: Any, tracks: Tracks) -> np.ndarray:
    cameras = [
        Camera(image.name, 2, 2, 1.0, 1.0, 1.0, 1.0, np.asarray(image.cam_from_world().matrix()))
        for image in (model.image(number) for number in sorted(model.reg_image_ids()))
    ]
    return pose_errors(cameras, tracks.cameras).rotation_degrees


def test_right_cameras_are_not_doubted_by_either_mapper(tmp_path: Path) -> None:
    database, tracks = _hall(tmp_path, repeats=1)
    for place in (place_one_by_one, place_at_once):
        model = place(database, tmp_path, 0, PHOTOS)[0]
        assert model.num_reg_images() == PHOTOS
        assert _degrees(model, tracks).max() < 0.5
        verdict = check_solution(database, model)
        assert not verdict.contradicting
        assert not verdict.is_doubtful
        assert len(verdict.parts([camera.name for camera in tracks.cameras])) == 1


def test_walls_that_repeat_are_noticed(tmp_path: Path) -> None:
    database, tracks = _hall(tmp_path, repeats=4)
    model = place_one_by_one(database, tmp_path, 0, PHOTOS)[0]
    assert np.median(_degrees(model, tracks)) > 10.0  # what the check must notice
    assert check_solution(database, model).is_doubtful


def test_parts_with_common_photos_are_joined(tmp_path: Path) -> None:
    database, tracks = _hall(tmp_path, repeats=1)
    parts = []
    for left_out in (range(16, PHOTOS), range(10)):
        model = place_one_by_one(database, tmp_path, 0, PHOTOS)[0]
        names = {tracks.cameras[k].name for k in left_out}
        for number in sorted(model.reg_image_ids()):
            if model.image(number).name in names:
                model.deregister_frame(model.image(number).frame_id)
        parts.append(model)
    whole, added = joined(database, tmp_path, 0, parts)
    assert added == PHOTOS - 16
    assert whole.num_reg_images() == PHOTOS
    assert _degrees(whole, tracks).max() < 0.5
    assert not check_solution(database, whole).is_doubtful
    assert joined(database, tmp_path, 0, parts[:1]) == (parts[0], 0)


def test_true_neighbours_are_more_alike_than_walls_that_repeat(tmp_path: Path) -> None:
    database, _ = _hall(tmp_path, repeats=4)
    alike = pair_likeness(database)
    assert all(0.0 < value <= 1.0 for value in alike.values())
    kept = near_in_tree(alike)
    assert len(kept) < len(alike) / 2
    numbers = sorted({number for pair in alike for number in pair})
    assert {number for pair in kept for number in pair} == set(numbers)
    closest = most_alike(alike)
    of_first = sorted((p for p in alike if numbers[0] in p), key=lambda p: -alike[p])[:3]
    assert set(of_first) <= closest
