# SPDX-License-Identifier: GPL-3.0-or-later
"""Choose the pairs of a set of photos to match, in two rounds (docs/method.md, section 15.1).

Up to 150 photos: all. Beyond, the nearest by order, by GPS and by resemblance; then, for photos
with few verified neighbours, the neighbours of their neighbours.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .match_pairs import (
    EXHAUSTIVE_LIMIT,
    Pairs,
    all_pairs,
    nearest_pairs,
    pairs_by_name,
    pairs_in_order,
)

ALIKE_NEIGHBOURS = 20
ALIKE_IN_ORDER = 8
"""Of a video, whose order gives the others: these close loops."""
GPS_NEIGHBOURS = 10
GPS_FAR_RANKS = (16, 32)
"""Ranks by distance of photos farther away, which close loops."""
VERIFIED_MATCHES = 30
"""Matches that agree with one motion, from which on two photos count as neighbours."""
WELL_CONNECTED = 8
"""With as many neighbours a photo needs no second round."""
SECOND_ROUND_PAIRS = 10
"""Most new pairs of a photo in the second round."""


def choose_pairs(
    count: int,
    *,
    in_order: bool = False,
    metres: np.ndarray | None = None,
    resemblance: np.ndarray | None = None,
) -> Pairs:
    """Return the pairs of the first round.

    Parameters
    ----------
    count : int
        Photos, sorted by name.
    in_order : bool
        They were taken one after the other, as of a video.
    metres : (count, count) array or None
        Distances by GPS, infinite where unknown. They may be wrong: they add pairs only.
    resemblance : (count, count) array or None
        The more alike, the larger; needed for more than ``EXHAUSTIVE_LIMIT`` photos.
    """
    if count <= EXHAUSTIVE_LIMIT:
        return all_pairs(count)
    pairs = set(pairs_in_order(count) if in_order else pairs_by_name(count))
    if resemblance is not None:
        pairs.update(nearest_pairs(-resemblance, ALIKE_IN_ORDER if in_order else ALIKE_NEIGHBOURS))
    if metres is not None:
        pairs.update(nearest_pairs(metres, GPS_NEIGHBOURS))
        pairs.update(_at_ranks(metres))
    return sorted(pairs)


def second_round(
    count: int,
    tried: Pairs,
    verified: Mapping[tuple[int, int], int],
    resemblance: np.ndarray,
) -> Pairs:
    """Return more pairs for photos with few neighbours.

    Parameters
    ----------
    tried : list of (int, int)
        Pairs of the first round.
    verified : mapping of (int, int) to int
        Matches of a pair that agree with one motion.
    resemblance : (count, count) array
        Decides between equals, and for photos without any neighbour.
    """
    linked = np.zeros((count, count), bool)
    for (i, j), matches in verified.items():
        if matches >= VERIFIED_MATCHES:
            linked[i, j] = linked[j, i] = True
    done = np.eye(count, dtype=bool)
    for i, j in tried:
        done[i, j] = done[j, i] = True
    # Neighbours in common, then resemblance, which lies in [-1, 1].
    common = linked.astype(np.float32) @ linked.astype(np.float32)
    apart = _components(linked)
    largest = np.bincount(apart).argmax()
    pairs: set[tuple[int, int]] = set()
    for i in range(count):
        is_outside = apart[i] != largest
        if linked[i].sum() >= WELL_CONNECTED and not is_outside:
            continue
        worth = common[i] + 0.49 * (1.0 + resemblance[i])
        if is_outside:
            # What it is linked to is no way out of its part.
            worth = np.where(apart == apart[i], -1.0, worth)
        worth[done[i]] = -1.0
        order = np.argsort(-worth, kind="stable")[:SECOND_ROUND_PAIRS]
        pairs.update((min(i, j), max(i, j)) for j in order.tolist() if worth[j] >= 0.0)
    return sorted(pairs)


def _at_ranks(metres: np.ndarray) -> set[tuple[int, int]]:
    known = np.where(np.eye(len(metres), dtype=bool), np.inf, metres)
    order = np.argsort(known, axis=1, kind="stable")
    return {
        (min(i, j), max(i, j))
        for rank in GPS_FAR_RANKS
        if rank < len(metres) - 1
        for i, j in enumerate(order[:, rank].tolist())
        if np.isfinite(known[i, j])
    }


def _components(linked: np.ndarray) -> np.ndarray:
    """Return the number of each item's connected part."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    return connected_components(csr_matrix(linked), directed=False)[1]
