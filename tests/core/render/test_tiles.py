# SPDX-License-Identifier: GPL-3.0-or-later
"""Tile lists, area lists and block masks: sorted, complete, tight."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.limits import ALPHA_MIN, TILE_PX
from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.render.depth_query import query_view
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    ScreenGaussians,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.reference import reference_projection
from gaussian_wrapping_addon.core.render.tile_kernels import mask_kernel
from gaussian_wrapping_addon.core.render.tiles import (
    TileLists,
    order_by_keys,
)
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.query_scenes import scene
from tests.core.render.scenes import bin_gaussians, look_at, random_gaussians

OPTIONS = RenderOptions(threads=1)


CAMERA = look_at((2.2, 0.5, 0.8), width=75, height=52, focal=80.0)


def tiles_of(lists: TileLists) -> np.ndarray:
    """(pairs,) tile number of each pair."""
    return np.repeat(np.arange(len(lists.start) - 1), np.diff(lists.start))


def wild(gaussians: OrientedGaussians, seed: int) -> OrientedGaussians:
    """Spread distances over 7 decades, sizes over 10 and opacity logits over +-20."""
    random = np.random.default_rng(seed)
    count = len(gaussians)
    return gaussians.replaced(
        means=gaussians.means * torch.from_numpy(10.0 ** random.uniform(-3, 4, (count, 1))),
        log_scales=torch.from_numpy(random.uniform(-16, 8, (count, 3))),
        opacity_logits=torch.from_numpy(random.normal(size=count) * 10),
        filter_3d=torch.from_numpy(10.0 ** random.uniform(-9, 1, count)),
    )


def make(
    seed: int = 0, count: int = 300, *, extreme: bool = False, **scene: object
) -> tuple[ScreenGaussians, np.ndarray]:
    """Return screen Gaussians and their float64 alpha at every pixel centre, (n, h, w)."""
    gaussians = random_gaussians(count, seed, **scene)  # type: ignore[arg-type]
    if extreme:
        gaussians = wild(gaussians, seed)
    screen = project_gaussians(RawArrays.from_gaussians(gaussians), CAMERA, OPTIONS)
    with torch.no_grad():
        params = reference_projection(gaussians, CAMERA, OPTIONS).params.numpy()
    u, v, qa, qb, qc, px, py, r, s, t, _, opacity = params[:, :12].T[:, :, None, None]
    dx = np.arange(CAMERA.width) + 0.5 - u
    dy = (np.arange(CAMERA.height) + 0.5)[:, None] - v
    den = 1.0 + 2.0 * (px * dx + py * dy) + r * dx * dx + s * dx * dy + t * dy * dy
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # rows of zeros
        alpha = opacity * np.exp(-0.5 * (qa * dx * dx + qb * dx * dy + qc * dy * dy) / den)
    return screen, alpha


SCENES = [
    {"seed": 0},
    {"seed": 1, "scale": (0.003, 0.6), "filter_size": 0.0},
    {"seed": 3, "scale": (0.5, 2.0), "count": 60},
    {"seed": 4, "extreme": True, "count": 900},
]


@pytest.mark.parametrize("scene", SCENES)
def test_every_pixel_that_sees_a_gaussian_is_covered(scene: dict[str, object]) -> None:
    screen, alpha = make(**scene)  # type: ignore[arg-type]
    lists = bin_gaussians(screen, CAMERA.width, CAMERA.height, 1)
    covered = np.zeros(alpha.shape, bool)
    y0, y1, x0, x1 = lists.pixel_ranges.T
    for i, tile in zip(lists.gaussian_ids, tiles_of(lists), strict=True):
        row, column = divmod(int(tile), lists.tiles_x)
        rows = slice(max(row * TILE_PX, y0[i]), min(row * TILE_PX + TILE_PX - 1, y1[i]) + 1)
        columns = slice(
            max(column * TILE_PX, x0[i]), min(column * TILE_PX + TILE_PX - 1, x1[i]) + 1
        )
        assert rows.start < rows.stop
        assert columns.start < columns.stop
        covered[i, rows, columns] = True
    needed = alpha >= ALPHA_MIN
    assert needed.any()
    assert not (needed & ~covered).any()


def test_corner_tiles_are_left_out_and_almost_nothing_else_is_kept() -> None:
    screen, alpha = make(1, 200, scale=(0.003, 0.6), filter_size=0.0)
    lists = bin_gaussians(screen, CAMERA.width, CAMERA.height, 1)
    y0, y1, x0, x1 = (lists.pixel_ranges // TILE_PX).T
    in_box = ((y1 - y0 + 1) * (x1 - x0 + 1))[screen.visible].sum()
    assert len(lists.gaussian_ids) < 0.8 * in_box
    # What is kept but reaches no pixel centre passes between the centres: few.
    reached = 0
    for i, tile in zip(lists.gaussian_ids, tiles_of(lists), strict=True):
        row, column = divmod(int(tile), lists.tiles_x)
        part = alpha[i, row * TILE_PX :, column * TILE_PX :][:TILE_PX, :TILE_PX]
        reached += bool((part >= ALPHA_MIN).any())
    assert reached > 0.9 * len(lists.gaussian_ids)


@pytest.mark.parametrize("threads", [1, 5])
@pytest.mark.parametrize("kind", ["wide", "narrow", "few"])
def test_order_by_keys_is_a_stable_argsort(kind: str, threads: int) -> None:
    random = np.random.default_rng(0)
    count = 40_000
    keys = {
        "wide": random.integers(0, 2**31, count),
        "narrow": 2**30 + random.integers(0, 5000, count),
        "few": random.choice([1, 2**31 - 1, 2**23], count),
    }[kind].astype(np.uint32)
    bounds = np.array([[0, 9000], [9000, 9000], [9100, 30_000], [31_000, count]])
    counts = np.zeros(count, bool)
    for begin, end in bounds:
        counts[begin:end] = True
    rows = np.nonzero(counts)[0]
    extent = int(keys[rows].min()), int(keys[rows].max())
    order = order_by_keys(keys, bounds, extent, threads, ArrayStore())
    np.testing.assert_array_equal(order, rows[np.argsort(keys[rows], kind="stable")])


def test_area_lists_hold_every_gaussian_that_reaches_a_tile() -> None:
    gaussians, camera = scene("thin", seed=1)
    view = query_view(RawArrays.from_gaussians(gaussians), camera, RenderOptions(threads=1))
    lists = view.lists
    random = np.random.default_rng(5)
    q = view.screen.params.astype(np.float64)
    missing = reached = 0
    for tile in range(lists.tiles_x * lists.tiles_y):
        listed = set(lists.gaussian_ids[lists.start[tile] : lists.start[tile + 1]].tolist())
        corner = np.array([tile % lists.tiles_x, tile // lists.tiles_x]) * 16
        places = corner + random.uniform(0.0, 16.0, (1500, 2))
        dx, dy = (places[:, i, None] - q[:, i] for i in range(2))  # (p, n)
        num = q[:, 2] * dx * dx + q[:, 3] * dx * dy + q[:, 4] * dy * dy
        den = 1.0 + 2.0 * (q[:, 5] * dx + q[:, 6] * dy)
        den = den + q[:, 7] * dx * dx + q[:, 8] * dx * dy + q[:, 9] * dy * dy
        alpha = q[:, 11] * np.exp(-0.5 * num / den)
        hit = set(np.flatnonzero((alpha >= 1.0 / 255.0).any(0)).tolist())
        missing += len(hit - listed)
        reached += len(listed & hit)
    assert missing == 0
    # Nor does it list much that reaches nothing.
    assert reached > 0.85 * len(lists.gaussian_ids)


WIDTH = 4


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
    strips = TILE_PX // height
    bits = (masks[:, None] >> np.arange(strips * TILE_PX // WIDTH, dtype=np.uint32)) & 1

    tile = np.repeat(np.arange(tiles), np.diff(lists.start))
    q = screen.params[lists.gaussian_ids].astype(np.float64).T[:, :, None, None]  # (24, p, 1, 1)
    left, top = tile % lists.tiles_x * TILE_PX + 0.5, tile // lists.tiles_x * TILE_PX + 0.5
    dx = left[:, None, None] + np.arange(TILE_PX) - q[0]  # (p, 1, 16)
    dy = top[:, None, None] + np.arange(TILE_PX)[:, None] - q[1]  # (p, 16, 1)
    num = q[2] * dx * dx + q[3] * dx * dy + q[4] * dy * dy
    den = 1 + 2 * (q[5] * dx + q[6] * dy) + q[7] * dx * dx + q[8] * dx * dy + q[9] * dy * dy
    seen = q[11] * np.exp(-0.5 * num / den) >= limits.ALPHA_MIN
    blocks = seen.reshape(len(seen), strips, height, TILE_PX // WIDTH, WIDTH).any((2, 4))
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
