# SPDX-License-Identifier: GPL-3.0-or-later
"""Minimum cut: agreement with an independent solver on random, long, tied and large graphs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.meshing.classification import minimum_cut
from gaussian_wrapping_addon.core.progress import Progress


def scipy_cut(links: np.ndarray, capacity: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """The least set inside, from scipy's maximum flow (Dinic): what the source still reaches."""
    count = len(links)
    row, column = np.nonzero(links >= 0)
    strong, weak = np.flatnonzero(pull > 0), np.flatnonzero(pull < 0)
    begins = np.concatenate([row, np.full(len(strong), count), weak])
    ends = np.concatenate([links[row, column], strong, np.full(len(weak), count + 1)])
    values = np.concatenate([capacity[row, column], pull[strong], -pull[weak]])
    graph = csr_matrix((values.astype(np.int32), (begins, ends)), shape=(count + 2, count + 2))
    residual = graph - maximum_flow(graph, count, count + 1).flow
    residual.data[residual.data < 0] = 0
    residual.eliminate_zeros()
    result = np.zeros(count + 2, np.bool_)
    result[breadth_first_order(residual, count, return_predecessors=False)] = True
    return result[:count]


def cost(label: np.ndarray, links: np.ndarray, capacity: np.ndarray, pull: np.ndarray) -> int:
    row, column = np.nonzero(links >= 0)
    cut = label[row] & ~label[links[row, column]]
    return int(capacity[row, column][cut].sum() + np.abs(pull[label != (pull > 0)]).sum())


def random_graph(count: int, rng: np.random.Generator, top: int) -> tuple[np.ndarray, np.ndarray]:
    """Four perfect matchings, of which links that occur twice are left out."""
    links = np.full((count, 4), -1, np.int64)
    capacity = np.zeros((count, 4), np.int64)
    for k in range(4):
        order = rng.permutation(count)[: 2 * int(0.45 * count)]
        for i, j in order.reshape(-1, 2):
            if j not in links[i]:
                links[i, k], links[j, k] = j, i
                capacity[i, k] = capacity[j, k] = rng.integers(0, top)
    return links, capacity


def grid_graph(side: int) -> np.ndarray:
    """A square grid, which wraps around nowhere."""
    index = np.arange(side * side).reshape(side, side)
    padded = np.pad(index, 1, constant_values=-1)
    around = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
    return np.stack([part.ravel() for part in around], 1)


@pytest.mark.parametrize("top", [2, 50, 100_000])
@pytest.mark.parametrize("count", [1, 2, 40, 3000])
def test_labels_are_those_of_another_solver(count: int, top: int) -> None:
    rng = np.random.default_rng(count + top)
    links, capacity = random_graph(count, rng, top)
    pull = np.rint(rng.normal(0, 1.5 * top, count)).astype(np.int64)
    pull[rng.random(count) < 0.5] = 0
    label = minimum_cut(links, capacity, pull)
    expected = scipy_cut(links, capacity, pull)
    np.testing.assert_array_equal(label, expected)
    assert cost(label, links, capacity, pull) == cost(expected, links, capacity, pull)


def test_order_of_the_nodes_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    links, capacity = random_graph(500, rng, 3)  # many ties
    pull = rng.integers(-4, 5, 500)
    label = minimum_cut(links, capacity, pull)
    order = rng.permutation(500)
    place = np.argsort(order)
    moved = np.where(links >= 0, place[links], -1)[order]
    np.testing.assert_array_equal(minimum_cut(moved, capacity[order], pull[order]), label[order])


def test_flow_far_across_a_grid() -> None:
    side = 120
    links = grid_graph(side)
    rng = np.random.default_rng(1)
    high = rng.integers(1, 1000, (side * side, 4))
    capacity = np.zeros_like(high)
    for k, opposite in enumerate((1, 0, 3, 2)):
        there = links[:, k]
        capacity[:, k] = np.where(there >= 0, np.minimum(high[:, k], high[there, opposite]), 0)
    pull = np.zeros(side * side, np.int64)
    pull[:side], pull[-side:] = 2000, -2000
    label = minimum_cut(links, capacity, pull)
    np.testing.assert_array_equal(label, scipy_cut(links, capacity, pull))
    assert 0 < label.sum() < side * side


def test_a_long_chain_is_cut_at_its_weakest_link() -> None:
    count = 200_000
    chain = np.full((count, 4), -1)
    chain[1:, 0], chain[:-1, 1] = np.arange(count - 1), np.arange(1, count)
    capacity = np.full((count, 4), 9)
    capacity[120_000, 1] = capacity[120_001, 0] = 3
    pull = np.zeros(count, np.int64)
    pull[0], pull[-1] = 7, -8
    np.testing.assert_array_equal(minimum_cut(chain, capacity, pull), np.arange(count) <= 120_000)


def test_large_capacities_do_not_overflow() -> None:
    links = np.array([[1, -1, -1, -1], [0, -1, -1, -1]])
    pull = np.array([2**40, -(2**29)])
    for size, expected in ((2**29 - 1, [True, False]), (2**29 + 1, [True, True])):
        capacity = np.full((2, 4), size)
        assert minimum_cut(links, capacity, pull).tolist() == expected


def test_nothing_and_what_nobody_pulls() -> None:
    none = np.zeros((0, 4), np.int64)
    assert minimum_cut(none, none, np.zeros(0, np.int64)).shape == (0,)
    alone = np.full((3, 4), -1)
    label = minimum_cut(alone, np.zeros((3, 4), np.int64), np.array([1, 0, -1]))
    assert label.tolist() == [True, False, False]  # the fewest inside


def test_a_cut_can_be_stopped() -> None:
    links, capacity = random_graph(50, np.random.default_rng(3), 9)
    with pytest.raises(Cancelled):
        minimum_cut(links, capacity, np.ones(50, int), Progress(is_cancelled=lambda: True))
