# SPDX-License-Identifier: GPL-3.0-or-later
"""Solve doubtful cameras again from the pairs that are most alike (docs/method.md, section 15.3).

Runs in the helper process of :mod:`.pose_solver`. Where things repeat, photos match that show
different things. They have less in common than true neighbours: beside what repeats, each shows
things that the other does not.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...processes.helper_process import emit
from ..matching.feature_steps import MATCH_END
from ..pycolmap_import import import_pycolmap
from .pose_consistency import Verdict
from .solution_check import check_solution

MOST_ALIKE = 3
"""Pairs of each photo by which two solutions are compared."""
TREE_STEPS = 3
"""Pairs are kept whose photos are at most so many steps apart along the tree of the most alike."""
MAX_LEFT = 0.5
"""Most alike pairs that may contradict a better solution, over those that contradict the first."""
MIN_PLACED = 0.9
"""Photos that a mended solution places, over those of the one that it replaces."""

Alike = Mapping[tuple[int, int], float]
"""Of pairs of photos' numbers: features that match over all features of both that match any."""


def mended(
    database: Path,
    folder: Path,
    solve: Callable[[Path], Any],
    model: Any,
    verdict: Verdict,
) -> tuple[Any, Verdict, bool]:
    """Solve again from the most alike pairs; keep the result if these contradict it far less.

    Parameters
    ----------
    database : Path
        With the verified pairs, all of which judge every solution.
    folder : Path
        For temporary files.
    solve : callable
        Returns the reconstruction of a database, or None.
    model, verdict
        The doubtful solution.

    Returns
    -------
    model, verdict
        Those given where the other is not better.
    is_mended : bool
        They are the other.
    """
    emit(
        fraction=MATCH_END,
        message=f"{len(verdict.contradicting)} pairs of photos contradict the cameras: solving "
        "again from the most alike",
    )
    trial = folder / "alike.db"
    _copy(database, trial)
    alike = pair_likeness(database)
    kept = near_in_tree(alike)
    pycolmap = import_pycolmap()
    with pycolmap.Database.open(trial) as db:
        names = {image.image_id: image.name for image in db.read_all_images()}
        for pair in alike:
            if pair not in kept:
                db.delete_two_view_geometry(*pair)
    found = solve(trial)
    if found is None or found.num_reg_images() < MIN_PLACED * model.num_reg_images():
        return model, verdict, False
    judged = check_solution(database, found)
    closest = {frozenset((names[a], names[b])) for a, b in most_alike(alike)}
    if _contradictions(judged, closest) <= MAX_LEFT * _contradictions(verdict, closest):
        return found, judged, True
    return model, verdict, False


def _contradictions(verdict: Verdict, pairs: set[frozenset[str]]) -> int:
    return sum(
        pair.contradicts and frozenset((pair.first, pair.second)) in pairs for pair in verdict.pairs
    )


def pair_likeness(database: Path) -> dict[tuple[int, int], float]:
    """Return how alike the photos of verified pairs are, in (0, 1]."""
    pycolmap = import_pycolmap()

    with pycolmap.Database.open(database) as db:
        matches = {
            pycolmap.pair_id_to_image_pair(pair_id): geometry.inlier_matches
            for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True)
            if len(geometry.inlier_matches)
        }
    features: dict[int, list[np.ndarray]] = {}
    for pair, found in matches.items():
        for side, number in enumerate(pair):
            features.setdefault(number, []).append(found[:, side])
    useful = {number: len(np.unique(np.concatenate(all_))) for number, all_ in features.items()}
    return {
        (a, b): len(found) / (useful[a] + useful[b] - len(found))
        for (a, b), found in matches.items()
    }


def most_alike(alike: Alike) -> set[tuple[int, int]]:
    """Return the ``MOST_ALIKE`` pairs of each photo."""
    of_photo: dict[int, list[tuple[float, tuple[int, int]]]] = {}
    for pair, value in alike.items():
        for number in pair:
            of_photo.setdefault(number, []).append((-value, pair))
    return {pair for pairs in of_photo.values() for _, pair in sorted(pairs)[:MOST_ALIKE]}


def near_in_tree(alike: Alike) -> set[tuple[int, int]]:
    """Return the pairs few steps apart in the spanning tree of the most alike pairs."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import minimum_spanning_tree, shortest_path

    numbers = sorted({number for pair in alike for number in pair})
    index = {number: k for k, number in enumerate(numbers)}
    rows = [index[a] for a, _ in alike]
    columns = [index[b] for _, b in alike]
    # Zero would mean no edge.
    apart = np.array([1.0 + 1e-9 - value for value in alike.values()])
    shape = (len(numbers), len(numbers))
    tree = minimum_spanning_tree(csr_matrix((apart, (rows, columns)), shape=shape))
    steps = shortest_path(tree, directed=False, unweighted=True)
    return {pair for pair in alike if steps[index[pair[0]], index[pair[1]]] <= TREE_STEPS}


def _copy(source: Path, target: Path) -> None:
    with (
        contextlib.closing(sqlite3.connect(source)) as one,
        contextlib.closing(sqlite3.connect(target)) as other,
    ):
        one.backup(other)
