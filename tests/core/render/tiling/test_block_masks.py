# SPDX-License-Identifier: GPL-3.0-or-later
"""Block masks include every block that a Gaussian reaches, and almost no other."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import RawArrays, project_gaussians
from gaussian_wrapping_addon.core.render.tile_kernels import mask_kernel
from gaussian_wrapping_addon.core.render.tiles import bin_gaussians
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.scenes import look_at, random_gaussians

TILE, WIDTH = limits.TILE_PX, 4


def masks_and_truth(gaussians: OrientedGaussians, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (pairs, blocks) bool: the kernel's masks, and blocks with a pixel alpha >= 1/255."""
    camera = look_at((2.2, 1.0, 0.8), width=150, height=90, focal=160.0)
    screen = project_gaussians(RawArrays.from_gaussians(gaussians), camera, RenderOptions())
    lists = bin_gaussians(screen, camera.width, camera.height, 1)
    masks = np.zeros(len(lists.gaussian_ids), np.uint32)
    tiles = len(lists.start) - 1
    mask_kernel(lanes)(
        0, tiles, lists.start, lists.gaussian_ids, screen.boxes, screen.skews, lists.tiles_x, masks
    )
    height = lanes // WIDTH
    strips = TILE // height
    bits = (masks[:, None] >> np.arange(strips * TILE // WIDTH, dtype=np.uint32)) & 1

    tile = np.repeat(np.arange(tiles), np.diff(lists.start))
    q = screen.params[lists.gaussian_ids].astype(np.float64).T[:, :, None, None]  # (24, p, 1, 1)
    left, top = tile % lists.tiles_x * TILE + 0.5, tile // lists.tiles_x * TILE + 0.5
    dx = left[:, None, None] + np.arange(TILE) - q[0]  # (p, 1, 16)
    dy = top[:, None, None] + np.arange(TILE)[:, None] - q[1]  # (p, 16, 1)
    num = q[2] * dx * dx + q[3] * dx * dy + q[4] * dy * dy
    den = 1 + 2 * (q[5] * dx + q[6] * dy) + q[7] * dx * dx + q[8] * dx * dy + q[9] * dy * dy
    seen = q[11] * np.exp(-0.5 * num / den) >= limits.ALPHA_MIN
    blocks = seen.reshape(len(seen), strips, height, TILE // WIDTH, WIDTH).any((2, 4))
    return bits.astype(bool), blocks.reshape(len(seen), -1)


@pytest.mark.parametrize("lanes", [8, 16])
@pytest.mark.parametrize(
    "scale", [(0.004, 0.02), (0.02, 0.2), (0.0005, 0.5)], ids=["small", "large", "needles"]
)
def test_every_block_that_sees_a_gaussian_is_named(lanes: int, scale: tuple[float, float]) -> None:
    gaussians = random_gaussians(400, seed=3, dtype=torch.float32, scale=scale, filter_size=0.002)
    found, truth = masks_and_truth(gaussians, lanes)
    assert truth.sum() > 300
    assert not (truth & ~found).any()
    # Of blocks that the ellipse reaches between pixel centres only, a few are named too.
    assert found.sum() <= 1.35 * truth.sum()


@pytest.mark.parametrize("lanes", [8, 16])
def test_unbounded_ellipse_is_everywhere(lanes: int) -> None:
    gaussians = random_gaussians(1, seed=0, dtype=torch.float32, spread=0.0, opacity=(0.9, 0.95))
    gaussians = gaussians.replaced(log_scales=torch.full((1, 3), 1.5))
    found, truth = masks_and_truth(gaussians, lanes)
    assert len(found) > 10
    assert found.all()
    assert truth.any()


@pytest.mark.parametrize("lanes", [8, 16])
def test_tiles_are_marked_alone(lanes: int) -> None:
    gaussians = random_gaussians(300, seed=4, dtype=torch.float32, scale=(0.004, 0.1))
    camera = look_at((2.2, 1.0, 0.8), width=150, height=90, focal=160.0)
    screen = project_gaussians(RawArrays.from_gaussians(gaussians), camera, RenderOptions())
    lists = bin_gaussians(screen, camera.width, camera.height, 1)
    counts = np.diff(lists.start)
    assert (counts < 16).any()
    assert counts.max() > 32

    def marked(first: int, end: int) -> np.ndarray:
        masks = np.full(len(lists.gaussian_ids), 0xABCDEF, np.uint32)
        mask_kernel(lanes)(
            first, end, lists.start, lists.gaussian_ids, screen.boxes, screen.skews,
            lists.tiles_x, masks,
        )  # fmt: skip
        return masks

    whole = marked(0, len(counts))
    for tile in range(len(counts)):
        begin, end = lists.start[tile : tile + 2]
        alone = marked(tile, tile + 1)
        np.testing.assert_array_equal(alone[begin:end], whole[begin:end])
        alone[begin:end] = 0xABCDEF
        assert (alone == 0xABCDEF).all()
