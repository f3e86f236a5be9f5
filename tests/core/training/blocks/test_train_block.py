# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of a block: what stands still, interruptions, what is taken over."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import Cancelled, UsageError
from gaussian_wrapping_addon.core.gaussians.model import TRAINED, mip_filter
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training import density, trainer
from gaussian_wrapping_addon.core.training.backend import Backend
from gaussian_wrapping_addon.core.training.block_plan import BlockPlan
from gaussian_wrapping_addon.core.training.blocks import block_settings, train_block
from gaussian_wrapping_addon.core.training.exposure import Exposure
from gaussian_wrapping_addon.core.training.model_selection import Decision
from gaussian_wrapping_addon.core.training.schedule import Schedule
from gaussian_wrapping_addon.core.training.state import TrainingResult, TrainingState
from tests.core.device_kernels import DEVICES
from tests.core.training.blocks.row_scene import SETTINGS, row_scene, two_blocks
from tests.core.training.devices.device_training import backend_of
from tests.core.training.test_trainer import StopAt, assert_same


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
    SETTINGS, densify_every=6, min_opacity=0.3, prune_share=0.2, growth="auto", wrap_rounds=3,
    wrap_share=0.3, densify_score=0.0,
)  # fmt: skip


@pytest.mark.parametrize("device", [None, *DEVICES])
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
    ).with_decision(Decision("growth", "auto", "stopped", "It paid no more."))
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
    growth = result.model_selection.get("growth")
    assert growth is not None
    assert growth.evidence != "It paid no more.", "decided at another size of photos"
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
