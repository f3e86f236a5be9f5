# SPDX-License-Identifier: GPL-3.0-or-later
"""Tile lists, area lists and block masks: sorted, complete, tight."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.limits import ALPHA_MIN, TILE_PX
from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.render.area_lists import list_areas
from gaussian_wrapping_addon.core.render.depth_query import query_view
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    ScreenGaussians,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.reference import reference_projection
from gaussian_wrapping_addon.core.render.tile_kernels import mask_kernel
from gaussian_wrapping_addon.core.render.tiles import (
    TileBinning,
    TileLists,
    order_by_keys,
    radix_order,
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
    {"seed": 2, "scale": (0.001, 0.05)},
    {"seed": 3, "scale": (0.5, 2.0), "count": 60},
    {"seed": 4, "extreme": True, "count": 900},
]


@pytest.mark.parametrize("scene", SCENES)
def test_order_is_lexsort_and_slots_are_contiguous(scene: dict[str, object]) -> None:
    screen, _ = make(**scene)  # type: ignore[arg-type]
    lists = bin_gaussians(screen, CAMERA.width, CAMERA.height, 1)
    assert (lists.tiles_x, lists.tiles_y) == (5, 4)
    assert len(lists.start) == 21
    assert lists.start[0] == 0
    assert lists.start[-1] == len(lists.gaussian_ids) > 0
    ids, tiles = lists.gaussian_ids, tiles_of(lists)
    assert screen.visible[ids].all()
    order = np.lexsort((ids, screen.depths[ids], tiles))
    np.testing.assert_array_equal(order, np.arange(len(ids)))
    assert len(np.unique(tiles * len(screen) + ids)) == len(ids)
    np.testing.assert_array_equal(np.sort(lists.intersection_slots), np.arange(len(ids)))
    np.testing.assert_array_equal(
        np.searchsorted(lists.intersection_offsets, lists.intersection_slots, side="right") - 1, ids
    )


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


def test_any_number_of_threads_gives_the_same_lists() -> None:
    screen, _ = make(4, 700)
    one = bin_gaussians(screen, CAMERA.width, CAMERA.height, 1)
    for threads in (2, 5):
        many = bin_gaussians(screen, CAMERA.width, CAMERA.height, threads)
        for field in dataclasses.fields(TileLists):
            np.testing.assert_array_equal(getattr(many, field.name), getattr(one, field.name))


@pytest.mark.parametrize("max_intersections", [1, 150, 600])
def test_bands_hold_the_pairs_of_the_whole(max_intersections: int) -> None:
    screen, _ = make(1, 300, scale=(0.003, 0.6), filter_size=0.0)
    whole = bin_gaussians(screen, CAMERA.width, CAMERA.height, 1)
    binning = TileBinning(screen, CAMERA.width, CAMERA.height, 2, ArrayStore())
    bands = binning.bands(max_intersections)
    assert [band[0] for band in bands] + [20] == [0] + [band[1] for band in bands]
    np.testing.assert_array_equal(binning.ids, np.unique(whole.gaussian_ids))
    for first, end in bands[::-1]:  # in any order
        lists = binning.lists(first, end)
        begin, stop = whole.start[first], whole.start[end]
        pairs = stop - begin
        assert pairs <= max_intersections or end == first + 1
        np.testing.assert_array_equal(lists.gaussian_ids, whole.gaussian_ids[begin:stop])
        np.testing.assert_array_equal(lists.start, whole.start.clip(begin, stop) - begin)
        np.testing.assert_array_equal(
            lists.intersection_offsets,
            np.concatenate(
                [[0], np.cumsum(np.bincount(lists.gaussian_ids, minlength=len(screen)))]
            ),
        )
        np.testing.assert_array_equal(np.sort(lists.intersection_slots), np.arange(pairs))
        np.testing.assert_array_equal(
            np.searchsorted(lists.intersection_offsets, lists.intersection_slots, side="right") - 1,
            lists.gaussian_ids,
        )
    if len(bands) > 1:
        assert max(whole.start[end] - whole.start[first] for first, end in bands) < pairs_of(whole)


def pairs_of(lists: TileLists) -> int:
    """Return the number of pairs."""
    return len(lists.gaussian_ids)


def test_equal_distances_keep_the_order_of_storage() -> None:
    gaussians = random_gaussians(1, 3).select(torch.zeros(50, dtype=torch.long))
    screen = project_gaussians(RawArrays.from_gaussians(gaussians), CAMERA, OPTIONS)
    lists = bin_gaussians(screen, CAMERA.width, CAMERA.height, 2)
    for begin, end in zip(lists.start[:-1], lists.start[1:], strict=True):
        if end > begin:
            np.testing.assert_array_equal(lists.gaussian_ids[begin:end], np.arange(50))


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("kind", ["wide", "narrow", "one", "few"])
def test_order_by_keys_is_a_stable_argsort(kind: str, threads: int) -> None:
    random = np.random.default_rng(0)
    count = 40_000
    keys = {
        "wide": random.integers(0, 2**31, count),
        "narrow": 2**30 + random.integers(0, 5000, count),
        "one": np.full(count, 123_456_789),
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


@pytest.mark.parametrize("share", [0.0, 0.7])
def test_radix_order_is_a_stable_argsort(share: float) -> None:
    random = np.random.default_rng(0)
    depths = np.concatenate(
        [random.uniform(0.2, 1e4, 3000), random.choice([0.5, 1.0, 2.0], 500), [0.0, 1e-30, 3e38]]
    ).astype(np.float32)
    random.shuffle(depths)
    visible = random.uniform(size=len(depths)) < share
    order = radix_order(depths, visible)
    rows = np.nonzero(visible)[0]
    assert order.dtype == np.int32
    np.testing.assert_array_equal(order, rows[np.argsort(depths[rows], kind="stable")])


@pytest.mark.parametrize("count", [0, 40])
def test_nothing_visible(count: int) -> None:
    screen = ScreenGaussians.allocate(count)
    lists = bin_gaussians(screen, 33, 16, 2)
    np.testing.assert_array_equal(lists.start, np.zeros(4))
    assert len(lists.gaussian_ids) == len(lists.intersection_slots) == 0
    np.testing.assert_array_equal(lists.intersection_offsets, np.zeros(count + 1))
    assert (lists.pixel_ranges[:, 0] > lists.pixel_ranges[:, 1]).all()


def test_one_pixel_image() -> None:
    camera = look_at((2.2, 0.5, 0.8), width=1, height=1, focal=1.0)
    gaussians = random_gaussians(30, 1)
    screen = project_gaussians(RawArrays.from_gaussians(gaussians), camera, OPTIONS)
    lists = bin_gaussians(screen, 1, 1, 1)
    assert lists.start.tolist() == [0, int(screen.visible.sum())]
    np.testing.assert_array_equal(
        lists.pixel_ranges[screen.visible], np.zeros((int(screen.visible.sum()), 4))
    )


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
    other = list_areas(view.screen, camera.width, camera.height, 3)
    for field in dataclasses.fields(lists):
        assert np.array_equal(getattr(lists, field.name), getattr(other, field.name)), field.name


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
