# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of a plan: read again as written, refused when damaged or mixed up."""

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

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.training.block_plan import (
    ARRAYS_NAME,
    PLAN_NAME,
    BlockPlan,
    load_plan,
    save_plan,
)
from gaussian_wrapping_addon.core.training.exposure import Exposure
from tests.core.training.blocks.row_scene import two_blocks


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
