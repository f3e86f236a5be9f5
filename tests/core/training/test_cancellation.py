# SPDX-License-Identifier: GPL-3.0-or-later
"""Cancellation is checked in every loop over views before the next view is rendered."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training import trainer
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.density import needed_by_a_view
from gaussian_wrapping_addon.core.training.state import CancellablePhotos, cancellable
from gaussian_wrapping_addon.core.training.wrapping import (
    WrapView,
    normal_errors,
    start_orientation,
)
from tests.core.training.small_scene import sphere_gaussians, sphere_scene

VIEWS = 5
SMALL = TrainingSettings(iterations=10, max_gaussians=200, wrap_rounds=1)


def vote(adam: Adam, views: object) -> None:
    start_orientation(adam, views, threads=1)


def look_at_normals(adam: Adam, views: object) -> None:
    normal_errors(adam.gaussians(), views, threads=1)


def look_at_contributions(adam: Adam, views: object) -> None:
    needed_by_a_view(adam.gaussians().detached(), views, ViewRenderer(), 0.1, threads=1)


@pytest.mark.parametrize("loop", [vote, look_at_normals, look_at_contributions])
@pytest.mark.parametrize("after", [0, 1, 3])
def test_no_view_is_rendered_after_the_request(
    monkeypatch: pytest.MonkeyPatch, loop: Callable[[Adam, object], None], after: int
) -> None:
    _, photos = sphere_scene()
    adam = Adam(sphere_gaussians(40).replaced(orientation=torch.zeros(40, 4)))
    before = {name: adam.array(name).copy() for name in adam.values}
    rendered: list[int] = []
    honest = ViewRenderer.render
    monkeypatch.setattr(
        ViewRenderer, "render", lambda *a, **o: rendered.append(1) or honest(*a, **o)
    )
    progress = Progress(is_cancelled=lambda: len(rendered) >= after)
    views = (WrapView(photos.camera(i), None) for i in range(VIEWS))
    with pytest.raises(Cancelled):
        loop(adam, cancellable(views, progress))
    assert len(rendered) == after
    assert all((before[name] == adam.array(name)).all() for name in before)


def test_without_a_request_every_item_comes_once() -> None:
    assert list(cancellable(range(VIEWS), Progress())) == list(range(VIEWS))
    assert list(cancellable(np.arange(0), Progress())) == []


@pytest.mark.parametrize("fetched", [1, 7, 20])
def test_looking_at_photos_before_the_first_iteration_can_be_cancelled(
    tmp_path: Path, fetched: int
) -> None:
    scene, photos = sphere_scene()
    seen = [0]

    class Counted(CancellablePhotos):
        def photo(self, index: int, divisor: int = 1) -> np.ndarray:
            seen[0] += 1
            return super().photo(index, divisor)

    progress = Progress(is_cancelled=lambda: seen[0] >= fetched)
    with pytest.raises(Cancelled):
        trainer.train(scene, Counted(photos, Progress()), SMALL, tmp_path, progress, threads=1)
    assert seen[0] <= fetched + 1
