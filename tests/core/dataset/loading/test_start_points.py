# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a training starts if the photos give no points, and where it must not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MemoryShortageError, WorkerError, WrapError
from gaussian_wrapping_addon.core.loading import load
from gaussian_wrapping_addon.core.progress import Progress, ReportWarning
from gaussian_wrapping_addon.core.scene.camera import Camera


def points_where(
    error: WrapError, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[str, list[ReportWarning]]:
    """Return the origin of the points where the triangulation fails, and the warnings."""

    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(load, "triangulate_points", fail)
    pose = np.hstack([np.eye(3), [[0.0], [0.0], [4.0]]])
    cameras = [Camera(f"{k}.png", 80, 60, 80.0, 80.0, 40.0, 30.0, pose) for k in range(3)]
    warnings: list[ReportWarning] = []
    points, colors, origin = load.make_start_points(
        cameras, [], [], tmp_path, Progress(), warnings, seed=0, threads=1
    )
    assert len(points) == len(colors) > 1000
    return origin, warnings


def test_a_failed_triangulation_is_replaced_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    origin, warnings = points_where(WorkerError("crashed"), tmp_path, monkeypatch)
    assert origin == "random"
    assert [w.code for w in warnings] == ["points-not-triangulated", "random-start-points"]


def test_a_shortage_of_memory_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The training would depend on what else runs."""
    with pytest.raises(MemoryShortageError):
        points_where(MemoryShortageError("short", "Wait."), tmp_path, monkeypatch)
