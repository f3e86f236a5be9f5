# SPDX-License-Identifier: GPL-3.0-or-later
"""A set too large for all pairs is matched in chosen pairs, and its cameras are right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.camera_places import Tracks, hall_tracks, write_database
from gaussian_wrapping_addon.core.poses import matching
from gaussian_wrapping_addon.core.poses.checks import check_solution
from gaussian_wrapping_addon.core.poses.matching import match_chosen
from gaussian_wrapping_addon.core.poses.solver_helper import place_one_by_one

pycolmap = pytest.importorskip("pycolmap")
PHOTOS = 36


def _features(folder: Path) -> tuple[Path, Tracks]:
    """Write features without matches; what looks the same has nearly the same descriptor."""
    tracks = hall_tracks(PHOTOS, 200, repeats=1, seed=0)
    database = folder / "database.db"
    write_database(database, tracks, seed=0)
    chance = np.random.default_rng(0)
    of_look = chance.gamma(0.4, 60.0, (5000, 128))
    with pycolmap.Database.open(database) as db:
        db.clear_two_view_geometries()
        db.clear_matches()
        for image in db.read_all_images():
            look = tracks.looks[[camera.name for camera in tracks.cameras].index(image.name)]
            noisy = of_look[look] + chance.normal(0.0, 8.0, (len(look), 128))
            found = pycolmap.FeatureDescriptors()
            found.type = pycolmap.FeatureExtractorType.SIFT
            found.data = noisy.clip(0, 255).astype(np.uint8)
            db.write_descriptors(image.image_id, found)
    (folder / "images").mkdir()
    return database, tracks


def test_chosen_pairs_give_right_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (matching, matching):
        monkeypatch.setattr(module, "EXHAUSTIVE_LIMIT", 10)
    monkeypatch.setattr(matching, "ALIKE_NEIGHBOURS", 6)
    monkeypatch.setattr(matching, "WELL_CONNECTED", 4)
    said: list[float] = []
    monkeypatch.setattr(matching, "emit", lambda **values: said.append(values["fraction"]))
    database, tracks = _features(tmp_path)
    names = sorted(camera.name for camera in tracks.cameras)
    task: dict[str, Any] = {
        "seed": 0, "threads": 1, "in_order": False, "positions": [None] * PHOTOS,
    }  # fmt: skip
    match_chosen(tmp_path, database, task, names)
    pairs = [(names.index(a), names.index(b)) for a, b in task["pairs"]]
    assert len(set(pairs)) == len(pairs) < PHOTOS * (PHOTOS - 1) / 4
    around = {(i, (i + 1) % PHOTOS) for i in range(PHOTOS)}
    assert {(min(p), max(p)) for p in around} <= set(pairs)  # the first and the last, too
    assert said == sorted(said)
    model = place_one_by_one(database, tmp_path, 0, PHOTOS)[0]
    assert model.num_reg_images() == PHOTOS
    verdict = check_solution(database, model)
    assert not verdict.contradicting
    assert len(verdict.parts(names)) == 1
