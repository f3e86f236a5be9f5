# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether camera poses are refined: what starts it, what ends it."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.training.camera_poses import LEAST_VIEWS
from gaussian_wrapping_addon.core.training.model_selection import (
    LEAST_SHIFT_PX,
    Decision,
    ModelSelection,
    select_poses,
    start_poses,
)
from tests.core.training.small_scene import sphere_scene

POINTS = np.random.default_rng(1).normal(size=(200, 3))
DENSE = ModelSelection((Decision("dense_start", "auto", "on", "found"),))
SPARSE = ModelSelection((Decision("dense_start", "auto", "off", "not found"),))


@pytest.mark.parametrize(
    ("setting", "known", "views", "chosen"),
    [
        ("auto", DENSE, 12, None),
        ("auto", SPARSE, 12, "off"),
        ("auto", DENSE, LEAST_VIEWS - 1, "off"),
        ("on", SPARSE, 12, "on"),
        ("on", DENSE, LEAST_VIEWS - 1, "off"),
        ("off", DENSE, 12, "off"),
    ],
)
def test_settings_and_start_decide_whether_poses_may_move(
    setting: str, known: ModelSelection, views: int, chosen: str | None
) -> None:
    scene, _ = sphere_scene()
    poses, selection = start_poses(setting, scene, range(views), known)
    decision = selection.get("refine_poses")
    assert (None if decision is None else decision.chosen) == chosen
    assert (poses is None) == (chosen == "off")


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_poses_that_hardly_moved_go_back(share: float) -> None:
    scene, photos = sphere_scene(size_px=32)
    poses, _ = start_poses("auto", scene, range(12), DENSE)
    assert poses is not None
    cameras = {view: photos.camera(view) for view in range(12)}
    for view, camera in cameras.items():
        gradient = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        poses.step(view, camera, gradient, share * LEAST_SHIFT_PX)
    measured = float(np.median(poses.shifts_px(cameras, POINTS)))
    assert measured == pytest.approx(share * LEAST_SHIFT_PX, rel=0.08)
    decision = select_poses(poses, cameras, POINTS)
    assert decision.chosen == ("on" if share > 1.0 else "off")
    assert decision.figures["shift_px"] == pytest.approx(measured)
    assert (poses.moved() is None) == (share < 1.0)
