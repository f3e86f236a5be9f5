# SPDX-License-Identifier: GPL-3.0-or-later
"""Find photos of a camera that stands still while the object turns, by their matches.

Between two such photos the background's features stay where they are and the object's move. A
camera that moves leaves no feature in its place; a pause of it leaves all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

TURNTABLE_NAME = "turntable.json"
"""How many ``photos`` are of a turntable, and whether it ``is_masked``."""
TURNING_FOLDER = "turning"
"""Masks of what turns, named as the photos."""
STILL_SHARE, MIN_STILL_PX = 0.002, 1.5
"""A feature that moves less than this share of the photo's long side, or these pixels, is still."""
MOVED_SHARE = 0.01
MIN_STILL_MATCHES, MIN_ROWS, MIN_COLUMNS = 10, 3, 3
"""Still matches of a pair, and the rows and columns of cells that they lie in: a date, a logo, a
caption or a car's bonnet stays in its place, too."""
MIN_STILL_CELLS_SHARE = 0.4
"""Least share of the cells with matches in which most are still: the background is around what
turns; behind what is fixed to a camera that moves, all the rest moves."""
CELLS = 6
"""Cells along each side of a photo."""
MIN_TURNING_MATCHES = 12
"""Matches that move as one body which a photo of a turntable has with some other photo."""
MIN_PHOTOS_SHARE = 0.8
"""Share of all photos that must be of a turntable: a camera that waits on its way while somebody
walks by sees the same in a few of them."""
MIN_GROUP = 8
"""Fewer photos from one place give no background."""
MIN_PARTNERS_SHARE = 0.5
"""Share of a group's other photos, of those it was matched with, that show a photo's background."""


@dataclass(frozen=True)
class PairMotion:
    """What the matches of two photos say of the camera between them."""

    first: int
    second: int
    is_still: bool
    """Background stays where it is."""
    moved: int
    """Matches that move, right or wrong."""


def pair_motion(
    first: int, second: int, points: np.ndarray, others: np.ndarray, size: tuple[int, int]
) -> PairMotion:
    """Judge the matches of photos ``first`` and ``second``, both of ``size`` (width, height).

    Parameters
    ----------
    points, others : (n, 2) float
        Matched positions in the two photos, pixels.
    """
    long_side = max(size)
    distance = np.linalg.norm(np.subtract(points, others), axis=1)
    still = distance < max(STILL_SHARE * long_side, MIN_STILL_PX)
    moved = distance > MOVED_SHARE * long_side
    cells = np.floor(points / size * CELLS).astype(int).clip(0, CELLS - 1)
    place = np.zeros((2, CELLS, CELLS), int)
    for number, chosen in enumerate((still, moved)):
        np.add.at(place[number], (cells[chosen, 1], cells[chosen, 0]), 1)
    by_still = place[0] > place[1]
    is_still = (
        still.sum() >= MIN_STILL_MATCHES
        and by_still.any(axis=1).sum() >= MIN_ROWS
        and by_still.any(axis=0).sum() >= MIN_COLUMNS
        and by_still.sum() >= MIN_STILL_CELLS_SHARE * place.any(axis=0).sum()
    )
    return PairMotion(first, second, bool(is_still), int(moved.sum()))


def standing_groups(count: int, motions: Sequence[PairMotion]) -> list[list[int]]:
    """Return groups of photos, each from a camera that stands still while something moves.

    Whether what moves turns as one body is left to :func:`are_turning`.

    Parameters
    ----------
    count : int
        Number of photos.
    motions : sequence of PairMotion
        Of all pairs that were matched, also of those without a match.

    Returns
    -------
    list of list of int
        Ascending numbers of photos; photos of no such group are in none.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    still = [motion for motion in motions if motion.is_still]
    if not still:
        return []
    rows = [motion.first for motion in still]
    columns = [motion.second for motion in still]
    graph = coo_matrix((np.ones(len(still)), (rows, columns)), (count, count))
    label = connected_components(graph, directed=False)[1]
    partners, matched, moved = (np.zeros(count, int) for _ in range(3))
    for motion in motions:
        pair = [motion.first, motion.second]
        if label[motion.first] != label[motion.second]:
            continue
        matched[pair] += 1
        partners[pair] += motion.is_still
        moved[pair] = np.maximum(moved[pair], motion.moved)
    groups = []
    for number in np.unique(label):
        of_group = label == number
        group = np.flatnonzero(of_group & (partners >= MIN_PARTNERS_SHARE * matched))
        # Nothing that turns: the same photo many times, or a camera that waits.
        if len(group) >= MIN_GROUP and np.median(moved[group]) >= MIN_TURNING_MATCHES:
            groups.append(group.tolist())
    return groups if sum(map(len, groups)) >= MIN_PHOTOS_SHARE * count else []


def are_turning(most_inliers: Sequence[int]) -> bool:
    """Tell whether photos of still cameras show a body that turns.

    Parameters
    ----------
    most_inliers : sequence of int
        For each photo: the most matches with another photo that move and agree with one motion.
    """
    return len(most_inliers) > 0 and float(np.median(most_inliers)) >= MIN_TURNING_MATCHES
