# SPDX-License-Identifier: GPL-3.0-or-later
"""Sums of gradients against dense sums."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.render.types import ImageGradients, VisibleGradients
from gaussian_wrapping_addon.core.training.adam import add_image_gradients, merge_gradients

COUNT = 50
SHAPES = {
    "means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "sh": (4, 3),
    "orientation": (4,),
}  # fmt: skip


def gradients(listed: int, seed: int) -> VisibleGradients:
    random = np.random.default_rng(seed)
    ids = np.sort(random.choice(COUNT, listed, replace=False)).astype(np.int32)
    values = {
        name: random.normal(size=(listed, *shape)).astype(np.float32)
        for name, shape in SHAPES.items()
    }
    return VisibleGradients(ids, **values)


def dense(part: VisibleGradients, name: str) -> np.ndarray:
    out = np.zeros((COUNT, *SHAPES[name]), np.float32)
    out[part.ids] = getattr(part, name)
    return out


@pytest.mark.parametrize("listed", [(30, 20), (50, 50), (0, 7), (7, 0), (0, 0), (1, 49)])
@pytest.mark.parametrize("threads", [1, 3])
def test_merged_is_the_dense_sum(listed: tuple[int, int], threads: int) -> None:
    first, second = gradients(listed[0], 0), gradients(listed[1], 1)
    merged = merge_gradients(first, second, COUNT, threads=threads)
    assert np.array_equal(merged.ids, np.union1d(first.ids, second.ids))
    assert merged.ids.dtype == np.int32
    for name in SHAPES:
        assert np.array_equal(dense(merged, name), dense(first, name) + dense(second, name))
        assert getattr(merged, name).flags.c_contiguous


def test_memory_is_reused() -> None:
    store = ArrayStore()
    before = merge_gradients(gradients(30, 0), gradients(20, 1), COUNT, store=store)
    again = merge_gradients(gradients(10, 2), gradients(5, 3), COUNT, store=store)
    assert np.shares_memory(before.means, again.means)
    wanted = dense(gradients(10, 2), "sh") + dense(gradients(5, 3), "sh")
    assert np.array_equal(dense(again, "sh"), wanted)


def test_sum_of_image_gradients() -> None:
    one = ImageGradients(color=np.ones((2, 3, 3)), depth=np.ones((2, 3)))
    two = ImageGradients(alpha=np.full((2, 3), 4.0), depth=np.full((2, 3), 2.0))
    summed = add_image_gradients(one, two)
    assert summed.color is one.color
    assert summed.alpha is two.alpha
    assert np.array_equal(summed.depth, np.full((2, 3), 3.0))
    assert summed.normal is None
