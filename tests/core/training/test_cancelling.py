# SPDX-License-Identifier: GPL-3.0-or-later
"""A request to cancel is noticed in every loop over views before the next view is rendered."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.training import wrapping
from gaussian_wrapping_addon.core.training.cancelling import checked
from gaussian_wrapping_addon.core.training.optimizer import Adam
from gaussian_wrapping_addon.core.training.wrapping import (
    WrapView,
    normal_errors,
    start_orientation,
)
from tests.core.training.small_scene import sphere_gaussians, sphere_scene

VIEWS = 5


def vote(adam: Adam, views: object) -> None:
    start_orientation(adam, views, threads=1)


def look_at_normals(adam: Adam, views: object) -> None:
    normal_errors(adam.gaussians(), views, threads=1)


@pytest.mark.parametrize("loop", [vote, look_at_normals])
@pytest.mark.parametrize("after", [0, 1, 3])
def test_no_view_is_rendered_after_the_request(
    monkeypatch: pytest.MonkeyPatch, loop: Callable[[Adam, object], None], after: int
) -> None:
    _, photos = sphere_scene()
    adam = Adam(sphere_gaussians(40))
    before = {name: adam.array(name).copy() for name in adam.values}
    rendered, real = [], wrapping.render

    def counted(*arguments: object, **options: object) -> object:
        rendered.append(1)
        return real(*arguments, **options)

    monkeypatch.setattr(wrapping, "render", counted)
    progress = Progress(is_cancelled=lambda: len(rendered) >= after)
    views = (WrapView(photos.camera(i), None) for i in range(VIEWS))
    with pytest.raises(Cancelled):
        loop(adam, checked(views, progress))
    assert len(rendered) == after
    assert all((before[name] == adam.array(name)).all() for name in before)


def test_without_a_request_every_item_comes_once() -> None:
    assert list(checked(range(VIEWS), Progress())) == list(range(VIEWS))
    assert list(checked(np.arange(0), Progress())) == []
