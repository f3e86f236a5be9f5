# SPDX-License-Identifier: GPL-3.0-or-later
"""Joined blocks: one owner for each Gaussian, and a result as good as that of one training."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import Cancelled, UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.training.block_plan import (
    BlockPlan,
    BlockSettings,
    plan_blocks,
    train_coarse,
)
from gaussian_wrapping_addon.core.training.blocks import join_blocks, joined_blocks, train_block
from gaussian_wrapping_addon.core.training.state import TrainingResult
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.training.blocks.row_scene import SETTINGS, row_scene, two_blocks
from tests.core.training.test_trainer import StopAt, assert_same


def untrained(plan: BlockPlan) -> list[OrientedGaussians]:
    """Return what blocks of no iterations would hand back."""
    return [plan.coarse.gaussians.select(torch.from_numpy(b.trained)) for b in plan.blocks]


def sorted_rows(gaussians: OrientedGaussians) -> np.ndarray:
    flat = [t.reshape(len(gaussians), -1).numpy() for _, t in gaussians.tensors()]
    rows = np.concatenate(flat, 1)
    return rows[np.lexsort(rows.T)]


@pytest.mark.parametrize("blocks", [2, 4])
def test_every_gaussian_is_there_once(blocks: int) -> None:
    plan = two_blocks(blocks)
    parts = untrained(plan)
    assert sum(map(len, parts)) > len(plan.coarse.gaussians), "margins overlap"
    joined = joined_blocks(plan, parts)
    assert np.array_equal(sorted_rows(joined), sorted_rows(plan.coarse.gaussians))
    owner = plan.tiling.owner(joined.means.double().numpy())
    assert (np.diff(owner) >= 0).all(), "in the order of the blocks"


def test_a_gaussian_on_the_border_belongs_to_the_cell_that_begins_there() -> None:
    plan = two_blocks()
    (_, axis, at), = plan.tiling.splits  # fmt: skip
    parts = []
    for part in untrained(plan):
        means = part.means.clone()
        means[:30, axis] = at
        parts.append(part.replaced(means=means))
    joined = joined_blocks(
        dataclasses.replace(plan, tiling=type(plan.tiling)(((0, axis, float(np.float32(at))),))),
        parts,
    )
    assert int((joined.means[:, axis] == np.float32(at)).sum()) == 30


def test_parts_that_do_not_fit_are_refused() -> None:
    plan = two_blocks()
    parts = untrained(plan)
    for wrong in (parts[:1], [*parts, parts[0]], []):
        with pytest.raises(UsageError):
            joined_blocks(plan, wrong)
    other = parts[0].replaced(sh=torch.zeros(len(parts[0]), 4, 3))
    with pytest.raises(UsageError, match="degree 1"):
        joined_blocks(plan, [other, parts[1]])


def test_more_gaussians_than_allowed_leave_those_that_show_most(tmp_path: Path) -> None:
    plan, (scene, photos) = two_blocks(), row_scene()
    settings = dataclasses.replace(SETTINGS, max_gaussians=300)
    result = join_blocks(
        plan, untrained(plan), scene, photos, settings, BlockSettings(2, polish_iterations=0.0),
        tmp_path, Progress(), threads=1,
    )  # fmt: skip
    assert len(result.gaussians) == 300
    # The photos look from the sides, so what faces along the row or inwards is what goes.
    dropped = ~np.isin(plan.coarse.gaussians.means[:, 0], result.gaussians.means[:, 0])
    facing = np.abs(plan.coarse.gaussians.means[:, 1].numpy())
    assert facing[dropped].mean() < 0.75 * facing[~dropped].mean()


def test_joined_gaussians_are_trained_together_and_can_be_interrupted(tmp_path: Path) -> None:
    plan, (scene, photos) = two_blocks(), row_scene()
    blocks = BlockSettings(2, polish_iterations=0.5)

    def joined(folder: str, progress: Progress | None = None, **changes: int) -> TrainingResult:
        (tmp_path / folder).mkdir(exist_ok=True)
        return join_blocks(
            plan, untrained(plan), scene, photos, dataclasses.replace(SETTINGS, **changes), blocks,
            tmp_path / folder, progress or Progress(), seed=1, threads=1,
        )  # fmt: skip

    whole = joined("whole")
    assert whole.iterations == 90
    assert len(whole.gaussians) == len(plan.coarse.gaussians)
    assert [f.name for f in whole.held_out] == ["000.png", "008.png", "016.png"]
    with pytest.raises(Cancelled):
        joined("parts", StopAt(70).progress())
    assert_same(whole.gaussians, joined("parts").gaussians)
    still = join_blocks(
        plan, untrained(plan), scene, photos, SETTINGS, BlockSettings(2, polish_iterations=0.0),
        tmp_path, Progress(), threads=1,
    )  # fmt: skip
    before = joined_blocks(plan, untrained(plan))
    assert torch.equal(still.gaussians.means, before.means)
    assert not torch.equal(whole.gaussians.means, before.means)
    assert whole.held_out_psnr > still.held_out_psnr
    # Measured without an optimizer, and so without a checkpoint.
    assert [f.name for f in still.held_out] == [f.name for f in whole.held_out]
    assert still.iterations == SETTINGS.iterations
    assert not list(tmp_path.glob("checkpoint*"))
    longer = joined("parts", extra_iterations=10)
    assert longer.iterations == 100


@pytest.mark.proof
def test_two_blocks_are_as_good_as_one_training(tmp_path: Path) -> None:
    """All of it, from the sparse points on: whole photos, and what lies about the border."""
    scene, photos = row_scene(48)
    settings = dataclasses.replace(
        SETTINGS, iterations=500, max_gaussians=4000, densify_every=40, growth="auto",
        wrapping="off", sh_degree=0,
    )  # fmt: skip
    blocks = BlockSettings(2)
    for name in ("whole", "coarse", "0", "1", "joined"):
        (tmp_path / name).mkdir()
    progress = Progress()
    whole = train(scene, photos, settings, tmp_path / "whole", progress, seed=2, threads=1)
    coarse = train_coarse(
        scene, photos, blocks.coarse(settings), tmp_path / "coarse", progress, seed=2, threads=1
    )
    plan = plan_blocks(coarse, scene, photos, settings, blocks, progress, threads=1)
    parts = [
        train_block(
            plan, index, scene, photos, settings, tmp_path / str(index), progress, seed=2, threads=1
        ).gaussians
        for index in range(2)
    ]
    joined = join_blocks(
        plan,
        parts,
        scene,
        photos,
        settings,
        blocks,
        tmp_path / "joined",
        progress,
        seed=2,
        threads=1,
    )
    assert len(joined.gaussians) <= settings.max_gaussians
    found = {
        name: _psnr_of(result.gaussians, whole.gaussians, plan.near_border)
        for name, result in (("whole", whole), ("joined", joined))
    }
    assert found["joined"][0] > found["whole"][0] - 0.5
    assert found["joined"][1] > found["whole"][1] - 0.5
    assert found["joined"][0] > 27.0


def _psnr_of(
    gaussians: OrientedGaussians,
    depths_of: OrientedGaussians,
    near: Callable[[np.ndarray, float], np.ndarray],
) -> tuple[float, float]:
    """Return the PSNR of the held-out photos, whole and of surface about the border."""
    scene, photos = row_scene(48)
    errors, border = [], []
    for view in range(0, 48, 8):
        camera = scene.views[view].camera
        with torch.no_grad():
            color = render(gaussians, camera, RenderOptions(depth=False)).color.numpy()
            depth = render(depths_of, camera, RenderOptions()).depth.numpy()
        squared = ((np.clip(color, 0, 1) - photos.photo(view) / 255.0) ** 2).mean(2)
        errors.append(squared.reshape(-1))
        rays = camera.rays() * depth[..., None]
        points = (rays.reshape(-1, 3) - camera.cam_from_world[:, 3]) @ camera.rotation
        border.append(near(points, 0.6) & (depth.reshape(-1) > 0))
    squared, at = np.concatenate(errors), np.concatenate(border)
    assert at.sum() > 300
    return tuple(-10.0 * np.log10(part.mean()) for part in (squared, squared[at]))
