# SPDX-License-Identifier: GPL-3.0-or-later
"""Windows of a photo: coverage, pixel budget, renders equal to crops of the whole image."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.backend import OVERLAP_PX, Window, windows
from tests.core.render.scenes import random_gaussians


@pytest.mark.parametrize(
    ("width", "height", "most"),
    [(640, 480, 80_000), (100, 40, 10_000), (101, 67, 900), (37, 1000, 5000), (20, 20, 1)],
)
def test_windows_cover_the_image_and_are_of_one_size(width: int, height: int, most: int) -> None:
    parts = windows(width, height, most)
    seen = np.zeros((height, width), int)
    for part in parts:
        assert part.left >= 0
        assert part.top >= 0
        shown = part.of(seen)
        assert shown.shape == (part.height, part.width)
        seen[part.top : part.top + part.height, part.left : part.left + part.width] += 1
    assert seen.min() >= 1
    assert len({(part.width, part.height) for part in parts}) == 1
    if width * height <= most:
        assert parts == [Window(0, 0, width, height)]
    elif min(width, height) > 8 * OVERLAP_PX:
        grown = parts[0].width * parts[0].height / most
        assert grown < (1 + OVERLAP_PX / parts[0].width) * (1 + OVERLAP_PX / parts[0].height)


def test_a_window_renders_that_part_of_the_whole() -> None:
    gaussians = random_gaussians(200, dtype=torch.float32)
    pose = np.concatenate([np.eye(3), [[0.0], [0.0], [5.0]]], 1)
    whole = Camera("view", 96, 80, 90.0, 91.0, 47.0, 41.0, pose)
    options = RenderOptions(depth=True, threads=1)
    expected = render(gaussians, whole, options)
    for part in windows(96, 80, 2500):
        image = render(gaussians, part.camera(whole), options)
        np.testing.assert_allclose(image.color.numpy(), part.of(expected.color.numpy()), atol=2e-5)
        both = (image.depth.numpy() > 0) & (part.of(expected.depth.numpy()) > 0)
        assert both.mean() > 0.05
        np.testing.assert_allclose(
            image.depth.numpy()[both], part.of(expected.depth.numpy())[both], rtol=1e-3
        )


def test_the_whole_image_keeps_its_camera() -> None:
    camera = Camera("view", 30, 20, 30.0, 30.0, 15.0, 10.0, np.eye(3, 4))
    (part,) = windows(30, 20, 600)
    assert part.camera(camera) is camera
