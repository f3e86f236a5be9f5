# SPDX-License-Identifier: GPL-3.0-or-later
"""A training in blocks: cells, their photos, files of the plan."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussian_wrapping_addon.core.errors import Cancelled, ParseError, UsageError
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.training import block_plan
from gaussian_wrapping_addon.core.training.block_plan import (
    ARRAYS_NAME,
    PLAN_NAME,
    BlockPlan,
    chosen_photos,
    load_plan,
    plan_blocks,
    save_plan,
)
from gaussian_wrapping_addon.core.training.exposure import Exposure
from tests.core.training.row_scene import SETTINGS, divided, known_coarse, row_scene, two_blocks
from tests.core.training.small_scene import sphere_gaussians

# -- Plans of blocks: cells, photos, what is trained and what stands still ------------------------


@given(seed=st.integers(0, 10**6), cells=st.integers(1, 6), coverage=st.floats(0.5, 1.0))
@settings(max_examples=60, deadline=None)
def test_photos_of_a_cell_show_most_of_it_and_each_is_needed(
    seed: int, cells: int, coverage: float
) -> None:
    random = np.random.default_rng(seed)
    shown = random.exponential(size=(12, cells)) * (random.random((12, cells)) < 0.6)
    chosen = chosen_photos(shown, coverage)
    assert chosen.any(1).all(), "every photo belongs to a block"
    lonely = (chosen.sum(1) == 1) & (chosen.argmax(1) == shown.argmax(1))
    for cell in range(cells):
        weights, total = shown[:, cell], shown[:, cell].sum()
        mine = chosen[:, cell]
        held = weights[mine].sum()
        assert held >= coverage * total * (1 - 1e-12)
        for photo in np.flatnonzero(mine & ~lonely):  # the others may have nowhere else to go
            assert held - weights[photo] < coverage * total or weights[photo] > weights[mine].min()


@pytest.mark.parametrize("blocks", [2, 4])
def test_cells_and_their_photos_lie_along_the_row(blocks: int) -> None:
    plan, (scene, _) = two_blocks(blocks), row_scene()
    means = plan.coarse.gaussians.means.double().numpy()
    owner = plan.tiling.owner(means)
    assert set(owner) == set(range(blocks))
    assert {axis for _, axis, _ in plan.tiling.splits} == {0}
    assert set(plan.views) == {view for block in plan.blocks for view in block.views}
    assert not set(range(0, 24, 8)) & set(plan.views), "held-out photos are in no block"
    lasting = [block.pixels for block in plan.blocks]
    assert max(lasting) <= 1.35 * np.mean(lasting)
    for index, block in enumerate(plan.blocks):
        low, high = plan.tiling.box(index)
        reach = plan.margins[index]
        assert reach[0] > 0.0
        rows = np.concatenate([block.trained, block.still])
        assert len(np.unique(rows)) == len(rows)
        inside = ((means >= low - reach) & (means <= high + reach)).all(1)
        assert inside[block.trained].all()
        # All of the cell is trained here, or stays: nothing is lost.
        mine = np.flatnonzero(owner == index)
        assert set(mine) == (set(block.trained) & set(mine)) | set(plan.kept(index))
        # A camera looks straight at the row: what it is far away from, it does not show.
        for view in block.views:
            x = scene.views[view].camera.center[0]
            assert low[0] - 2.6 < x < high[0] + 2.6
    assert 0 < len(plan.blocks[0].views) < len(plan.views)


def test_a_plan_is_the_same_each_time_and_on_any_number_of_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, photos = row_scene()
    again = plan_blocks(known_coarse(), scene, photos, divided(), Progress(), threads=2)
    assert again.digest == two_blocks().digest
    monkeypatch.setattr(block_plan, "MARGIN", 0.3)
    other = plan_blocks(known_coarse(), scene, photos, divided(), Progress(), threads=1)
    assert other.digest != again.digest
    assert all(
        set(narrow.trained) < set(wide.trained)
        for narrow, wide in zip(again.blocks, other.blocks, strict=True)
    )


def test_sky_around_the_scene_makes_no_margin_wider() -> None:
    known, (scene, photos) = known_coarse(), row_scene()
    ball = sphere_gaussians(300)
    sky = ball.replaced(means=100.0 * ball.means, log_scales=ball.log_scales + np.log(100.0))
    coarse = dataclasses.replace(known, gaussians=known.gaussians.joined(sky))
    plan = plan_blocks(coarse, scene, photos, divided(), Progress(), threads=1)
    without = two_blocks(2)
    # It fills most of what the photos show.
    renderer, options = ViewRenderer(), RenderOptions(depth=False, statistics=True)
    raw, filled = RawArrays.from_gaussians(coarse.gaussians), np.zeros(len(coarse.gaussians))
    for view in plan.views:
        statistics = renderer.render(raw, photos.camera(view, 1), options).statistics
        assert statistics is not None
        filled += statistics.weight_sum
    assert filled[len(known.gaussians) :].sum() > 0.3 * filled.sum()
    np.testing.assert_allclose(plan.margins, without.margins, rtol=0.1)
    assert {axis for _, axis, _ in plan.tiling.splits} == {0}
    for block in plan.blocks:
        assert len(block.views) < len(plan.views)


def test_what_the_photos_of_a_block_hardly_show_stands_still(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Pruning and growth look at the block's photos alone: it would be lost."""
    monkeypatch.setattr(block_plan, "COVERAGE", 0.5)
    scene, photos = row_scene()
    plan = plan_blocks(known_coarse(), scene, photos, divided(), Progress(), threads=1)
    raw, renderer = RawArrays.from_gaussians(plan.coarse.gaussians), ViewRenderer()
    options = RenderOptions(depth=False, sh_degree=0, threads=1, statistics=True)
    weights = {}
    for view in plan.views:
        statistics = renderer.render(raw, scene.views[view].camera, options).statistics
        assert statistics is not None
        weights[view] = statistics.weight_sum.astype(float)
    total = np.sum(list(weights.values()), 0)
    kept = 0
    for index, block in enumerate(plan.blocks):
        held = np.sum([weights[view] for view in block.views], 0)
        assert (held[block.trained] >= 0.5 * total[block.trained]).all()
        assert (held[plan.kept(index)] < 0.5 * total[plan.kept(index)]).all()
        kept += len(plan.kept(index))
        # What stands still is seen; nearly all that is seen is there.
        assert (held[block.still] > 0.0).all()
        there = np.concatenate([block.trained, block.still])
        for view in block.views:
            assert weights[view][there].sum() >= 0.995 * weights[view].sum()
    assert kept > 0


def test_limits_of_blocks_add_up_to_that_of_the_whole() -> None:
    plan = two_blocks(4)
    owner = plan.tiling.owner(plan.coarse.gaussians.means.double().numpy())
    kept = sum(len(plan.kept(index)) for index in range(4))
    expected = kept
    for index, block in enumerate(plan.blocks):
        share = (owner[block.trained] == index).mean()
        expected += block.max_gaussians * share
    assert 0.98 * SETTINGS.max_gaussians <= expected <= SETTINGS.max_gaussians


def test_what_cannot_be_divided_is_refused_and_planning_can_be_cancelled() -> None:
    scene, photos = row_scene()
    with pytest.raises(UsageError, match="22 blocks: 21 photos"):
        plan_blocks(known_coarse(), scene, photos, divided(22), Progress())
    with pytest.raises(Cancelled):
        plan_blocks(known_coarse(), scene, photos, divided(), Progress("plan", None, lambda: True))


# -- Files of a plan: read again as written, refused when damaged or mixed up ---------------------


def full_plan() -> BlockPlan:
    """Return a plan that has everything a plan may have."""
    plan = two_blocks(4)
    gains = np.random.default_rng(0).normal(size=(24, 3), scale=0.1)
    poses = np.random.default_rng(1).normal(size=(24, 3, 4))
    coarse = dataclasses.replace(plan.coarse, exposure=Exposure(24, plan.views, gains), poses=poses)
    return dataclasses.replace(plan, coarse=coarse)


@pytest.mark.parametrize("plan_of", [two_blocks, full_plan])
def test_a_plan_is_read_as_it_was_written(plan_of: Callable[[], BlockPlan], tmp_path: Path) -> None:
    plan = plan_of()
    save_plan(tmp_path, plan)
    assert sorted(p.name for p in tmp_path.iterdir()) == [PLAN_NAME, ARRAYS_NAME]
    found = load_plan(tmp_path)
    assert found.digest == plan.digest
    assert found.to_json() == plan.to_json()
    arrays = plan.to_arrays()
    assert found.to_arrays().keys() == arrays.keys()
    for name, array in found.to_arrays().items():
        assert np.array_equal(array, arrays[name]), name
        assert array.dtype == arrays[name].dtype
    for name, tensor in plan.coarse.gaussians.tensors():
        assert torch.equal(getattr(found.coarse.gaussians, name), tensor)
    for index in range(len(plan.blocks)):
        assert np.array_equal(found.kept(index), plan.kept(index))


@pytest.mark.parametrize("text", ["{", "[" * 100_000, '{"version": NaN}'])
def test_what_is_no_json_says_that_the_plan_is_made_again(tmp_path: Path, text: str) -> None:
    (tmp_path / PLAN_NAME).write_text(text)
    with pytest.raises(ParseError) as caught:
        load_plan(tmp_path)
    assert caught.value.hint == "Delete both files of the plan: it is made again."


def _json(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / PLAN_NAME
        values = json.loads(path.read_text())
        change(values)
        path.write_text(json.dumps(values))

    return apply


def _arrays(**changes: np.ndarray) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / ARRAYS_NAME
        with np.load(path) as held:
            arrays = {**held, **{k.replace("__", "."): v for k, v in changes.items()}}
        stream = io.BytesIO()
        np.savez(stream, **arrays)
        path.write_bytes(stream.getvalue())

    return apply


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / PLAN_NAME).unlink(),
        lambda folder: (folder / ARRAYS_NAME).unlink(),
        lambda folder: (folder / PLAN_NAME).write_text("{"),
        lambda folder: (folder / ARRAYS_NAME).write_bytes(b"PK"),
        _json(lambda v: v.update(version=2)),
        _json(lambda v: v.update(digest="0")),
        _json(lambda v: v.pop("plan")),
        _json(lambda v: v["plan"]["blocks"].pop()),
        _json(lambda v: v["plan"].update(splits=[[0, 0, 0.5], [7, 0, 0.5], [0, 0, 0.1]])),
        _json(lambda v: v["plan"].update(splits=[[0, 3, 0.5], [0, 0, 0.5], [0, 0, 0.1]])),
        _json(lambda v: v["plan"].update(begin=1.5)),
        _json(lambda v: v["plan"].update(views=[1])),
        _json(lambda v: v["plan"].update(views="all")),
        _json(lambda v: v["plan"].update(decisions=3)),
        _json(lambda v: v["plan"]["blocks"][0].update(views=[])),
        _json(lambda v: v["plan"]["blocks"][0].update(max_gaussians=1)),
        _json(lambda v: v["plan"]["blocks"][0].update(pixels=7)),
        _arrays(trained__0=np.array([3, 2], np.int32)),
        _arrays(trained__0=np.array([10**6], np.int32)),
        _arrays(trained__0=np.array([-1, 4], np.int32)),
        _arrays(trained__0=np.zeros(0, np.int32)),
        _arrays(trained__0=np.arange(5.0)),
        _arrays(still__1=np.array([[1]], np.int32)),
        _arrays(margins=np.full((4, 3), -1.0)),
        _arrays(margins=np.full((4, 3), np.nan)),
        _arrays(margins=np.zeros((2, 3))),
        _arrays(gaussians__means=np.full((500, 3), np.inf, np.float32)),
        _arrays(gaussians__means=np.zeros((500, 3))),
        _arrays(gaussians__sh=np.zeros((500, 2, 3), np.float32)),
        _arrays(gaussians__quats=np.zeros((499, 4), np.float32)),
        _arrays(poses=np.zeros((24, 4, 4))),
        _arrays(poses=np.array(1.0)),
        _arrays(exposure__values=np.zeros((3, 6), np.float32)),
    ],
)  # fmt: skip
def test_a_damaged_plan_is_refused_by_name(damage: Callable[[Path], None], tmp_path: Path) -> None:
    save_plan(tmp_path, full_plan())
    damage(tmp_path)
    with pytest.raises(ParseError) as caught:
        load_plan(tmp_path)
    assert caught.value.path.name in (PLAN_NAME, ARRAYS_NAME)
