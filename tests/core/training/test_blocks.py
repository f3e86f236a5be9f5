# SPDX-License-Identifier: GPL-3.0-or-later
"""One block around context that stands still, and joining."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import Cancelled, UsageError
from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians, mip_filter
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training import blocks as block_module
from gaussian_wrapping_addon.core.training import density, trainer
from gaussian_wrapping_addon.core.training.backend import Backend
from gaussian_wrapping_addon.core.training.block_plan import (
    BlockPlan,
    coarse_settings,
    plan_blocks,
    train_coarse,
)
from gaussian_wrapping_addon.core.training.blocks import (
    block_settings,
    joined_blocks,
)
from gaussian_wrapping_addon.core.training.exposure import Exposure
from gaussian_wrapping_addon.core.training.model_selection import Decision
from gaussian_wrapping_addon.core.training.schedule import Schedule
from gaussian_wrapping_addon.core.training.state import TrainingResult, TrainingState
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.device_kernels import DEVICES
from tests.core.training.device_training import backend_of
from tests.core.training.row_scene import SETTINGS, join_blocks, row_scene, train_block, two_blocks
from tests.core.training.test_trainer import StopAt, assert_same
from tests.proofs import first_then_proofs

# -- Training of a block: what stands still, interruptions, what is taken over --------------------


def trained(
    folder: Path,
    *,
    plan: BlockPlan | None = None,
    index: int = 0,
    settings: TrainingSettings = SETTINGS,
    progress: Progress | None = None,
    threads: int = 1,
    backend: Backend | None = None,
) -> TrainingResult:
    folder.mkdir(exist_ok=True)
    scene, photos = row_scene()
    return train_block(
        plan or two_blocks(), index, scene, photos, settings, folder, progress or Progress(),
        seed=2, threads=threads, backend=backend,
    )  # fmt: skip


def last_state(monkeypatch: pytest.MonkeyPatch) -> list[TrainingState]:
    """Return the list to which the last states of trainings are added."""
    states: list[TrainingState] = []
    honest = trainer.save_checkpoint

    def save(folder: Path, state: TrainingState, key: str) -> Any:
        states.append(state)
        return honest(folder, state, key)

    monkeypatch.setattr(trainer, "save_checkpoint", save)
    return states


# Everything that changes Gaussians happens: growth, splits, pruning of transparent ones and of what
# contributes little, orientations, wrapping, and in one test a reset of opacities.
BUSY = dataclasses.replace(
    SETTINGS, densify_every=6, min_opacity=0.3, prune_share=0.2, growth="on", wrap_rounds=3,
    wrap_share=0.3, densify_score=0.0,
)  # fmt: skip


@pytest.mark.parametrize("device", first_then_proofs([None, *DEVICES]))
def test_what_stands_still_keeps_every_bit(
    device: str | None,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Schedule, "resets_opacity", lambda _, iteration: iteration == 15)
    monkeypatch.setattr(density, "CLONE_SIZE", 0.05)
    backend = None if device is None else backend_of(device, request)
    states, plan = last_state(monkeypatch), two_blocks()
    block = plan.blocks[0]
    settings = BUSY if device is None else dataclasses.replace(BUSY, iterations=30)
    result = trained(tmp_path, settings=settings, backend=backend)
    adam, count = states[-1].adam.on_host(), len(block.still)
    assert adam.frozen == count > 50
    for name, tensor in plan.coarse.gaussians.tensors():
        assert np.array_equal(adam.array(name)[:count], tensor.numpy()[block.still]), name
    assert not adam.steps[:count].any()
    assert not adam.all_moments[:count].any()
    # The others are what is returned, and all of it has moved.
    assert len(result.gaussians) == len(adam) - count
    for name in TRAINED:
        found = getattr(result.gaussians, name).numpy()
        assert np.array_equal(found, adam.array(name)[count:]), name
    stayed = np.isin(result.gaussians.means[:, 0], plan.coarse.gaussians.means[block.trained, 0])
    assert stayed.mean() < 0.1
    assert len(result.gaussians) != len(block.trained)
    assert len(result.gaussians) <= block.max_gaussians
    assert result.held_out == ()
    # As in the whole training, the closest camera may be one whose photo is not the block's.
    scene, _ = row_scene()
    widths = mip_filter(
        result.gaussians.means.numpy(), [scene.views[view].camera for view in plan.views],
        variance_px=BUSY.filter_variance,
    )  # fmt: skip
    assert np.array_equal(result.gaussians.filter_3d.numpy(), widths.astype(np.float32))


def test_an_interrupted_block_ends_with_the_same_bits(tmp_path: Path) -> None:
    whole = trained(tmp_path / "whole", settings=BUSY)
    for stop in (20, 30):
        with pytest.raises(Cancelled):
            trained(tmp_path / "parts", settings=BUSY, progress=StopAt(stop).progress(), threads=2)
    assert len(list((tmp_path / "parts").glob("checkpoint-*.json"))) == 2
    resumed = trained(tmp_path / "parts", settings=BUSY, threads=2)
    assert_same(whole.gaussians, resumed.gaussians)
    assert whole.history == resumed.history


def test_a_checkpoint_of_another_block_or_plan_is_refused(tmp_path: Path) -> None:
    trained(tmp_path)
    with pytest.raises(UsageError):
        trained(tmp_path, index=1)
    plan = two_blocks()
    with pytest.raises(UsageError):
        trained(tmp_path, plan=dataclasses.replace(plan, margins=1.1 * plan.margins))
    with pytest.raises(IndexError):
        trained(tmp_path, index=2)


def test_exposures_and_decisions_stay_those_of_the_coarse_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, states = two_blocks(), last_state(monkeypatch)
    gains = np.random.default_rng(0).normal(size=(24, 3), scale=0.1)
    exposure = Exposure(24, plan.views, gains)
    decided = plan.coarse.model_selection.with_decision(
        Decision("exposure", "auto", "on", "Measured.", {"spread": 1.0})
    )
    coarse = dataclasses.replace(plan.coarse, exposure=exposure, model_selection=decided)
    before = exposure.values.copy()
    result = trained(tmp_path, plan=dataclasses.replace(plan, coarse=coarse), settings=BUSY)
    state = states[-1]
    assert state.exposure is not exposure
    assert state.exposure is not None
    assert np.array_equal(state.exposure.values, before)
    assert np.array_equal(exposure.values, before)
    assert state.poses is None
    for name in ("exposure", "multi_view"):
        assert result.model_selection.get(name) == decided.get(name)
    assert result.gaussians.sh_degree == 0
    without = trained(tmp_path / "without", settings=BUSY)
    assert not torch.equal(without.gaussians.sh[:20], result.gaussians.sh[:20])


def test_a_block_has_its_share_of_the_iterations_at_the_rates_of_the_whole() -> None:
    plan = two_blocks()
    whole = dataclasses.replace(SETTINGS, iterations=3000, densify_every=100)
    for index, block in enumerate(plan.blocks):
        share = len(block.views) / len(plan.views)
        part = block_settings(plan, index, whole)
        assert part.iterations == round(3000 * share)
        assert part.densify_every == round(100 * share)
        assert part.max_gaussians == block.max_gaussians
        ours, theirs = Schedule(part, 48), Schedule(whole, 48)
        assert ours.short_run_factor == pytest.approx(theirs.short_run_factor, rel=1e-12)
        for moment in (0.3, 0.6, 1.0):
            mine, other = (
                ours.rates(int(moment * part.iterations)),
                theirs.rates(int(moment * 3000)),
            )
            assert mine.keys() == other.keys()
            for name in mine:
                assert np.allclose(mine[name][:3], other[name][:3], rtol=0.01), name
    long = dataclasses.replace(SETTINGS, iterations=40_000)
    assert Schedule(block_settings(plan, 0, long), 48).short_run_factor == pytest.approx(1.0)


def test_a_state_keeps_the_number_of_those_that_stand_still() -> None:
    state = TrainingState.start(two_blocks().coarse.gaussians, 0)
    assert "frozen" not in state.to_json(), "checkpoints of other trainings stay as they are"
    state.adam.frozen = 17
    again = TrainingState.restore(state.to_arrays(), state.to_json())
    assert again.adam.frozen == TrainingState.of_snapshot(again.snapshot()).adam.frozen == 17
    for wrong in (-1, 501):
        with pytest.raises(ValueError, match="frozen"):
            TrainingState.restore(state.to_arrays(), {**state.to_json(), "frozen": wrong})


# -- Joined blocks: one owner for each Gaussian, and a result as good as that of one training -----


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


def test_more_gaussians_than_allowed_leave_those_that_show_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block_module, "POLISH_ITERATIONS", 0.0)
    plan, (scene, photos) = two_blocks(), row_scene()
    settings = dataclasses.replace(SETTINGS, max_gaussians=300)
    result = join_blocks(
        plan, untrained(plan), scene, photos, settings, tmp_path, Progress(), threads=1
    )
    assert len(result.gaussians) == 300
    # The photos look from the sides, so what faces along the row or inwards is what goes.
    dropped = ~np.isin(plan.coarse.gaussians.means[:, 0], result.gaussians.means[:, 0])
    facing = np.abs(plan.coarse.gaussians.means[:, 1].numpy())
    assert facing[dropped].mean() < 0.75 * facing[~dropped].mean()


def test_joined_gaussians_are_trained_together_and_can_be_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, (scene, photos) = two_blocks(), row_scene()
    monkeypatch.setattr(block_module, "POLISH_ITERATIONS", 0.5)

    def joined(folder: str, progress: Progress | None = None, **changes: int) -> TrainingResult:
        (tmp_path / folder).mkdir(exist_ok=True)
        return join_blocks(
            plan, untrained(plan), scene, photos, dataclasses.replace(SETTINGS, **changes),
            tmp_path / folder, progress or Progress(), seed=1, threads=1,
        )  # fmt: skip

    whole = joined("whole")
    assert whole.iterations == 90
    assert len(whole.gaussians) == len(plan.coarse.gaussians)
    assert [f.name for f in whole.held_out] == ["000.png", "008.png", "016.png"]
    with pytest.raises(Cancelled):
        joined("parts", StopAt(70).progress())
    assert_same(whole.gaussians, joined("parts").gaussians)
    longer = joined("parts", extra_iterations=10)
    assert longer.iterations == 100
    monkeypatch.setattr(block_module, "POLISH_ITERATIONS", 0.0)
    still = joined("still")
    before = joined_blocks(plan, untrained(plan))
    assert torch.equal(still.gaussians.means, before.means)
    assert not torch.equal(whole.gaussians.means, before.means)
    assert whole.held_out_psnr > still.held_out_psnr
    assert [f.name for f in still.held_out] == [f.name for f in whole.held_out]
    assert still.iterations == SETTINGS.iterations


@pytest.mark.proof
def test_two_blocks_are_as_good_as_one_training(tmp_path: Path) -> None:
    """All of it, from the sparse points on: whole photos, and what lies about the border."""
    scene, photos = row_scene(48)
    settings = dataclasses.replace(
        SETTINGS, iterations=500, max_gaussians=4000, densify_every=40, growth="on",
        wrapping="off", sh_degree=0,
    )  # fmt: skip
    settings = dataclasses.replace(settings, blocks=2)
    for name in ("whole", "coarse", "0", "1", "joined"):
        (tmp_path / name).mkdir()
    progress = Progress()
    whole = train(scene, photos, settings, tmp_path / "whole", progress, seed=2, threads=1)
    coarse = train_coarse(
        scene, photos, coarse_settings(settings), tmp_path / "coarse", progress, seed=2, threads=1
    )
    plan = plan_blocks(coarse, scene, photos, settings, progress, threads=1)
    parts = [
        train_block(
            plan, index, scene, photos, settings, tmp_path / str(index), progress, seed=2, threads=1
        ).gaussians
        for index in range(2)
    ]
    joined = join_blocks(
        plan, parts, scene, photos, settings, tmp_path / "joined", progress, seed=2, threads=1
    )
    assert len(joined.gaussians) <= settings.max_gaussians

    def near_border(points: np.ndarray, reach: float) -> np.ndarray:
        cells = sum(plan.tiling.within(k, points, reach).astype(np.int64) for k in range(2))
        return np.asarray(cells > 1)

    found = {
        name: _psnr_of(result.gaussians, whole.gaussians, near_border)
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
