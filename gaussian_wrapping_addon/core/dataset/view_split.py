# SPDX-License-Identifier: GPL-3.0-or-later
"""Which views of a scene are held out, which are trained on, and a few of many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from .photo_source import PhotoSource
from .scene import Scene

FEW_PHOTOS = 8
"""Below this number of photos, only one is held out."""

_Item = TypeVar("_Item")


def held_out_views(scene: Scene, every: int) -> list[int]:
    """Return the held-out views, which are measured and never trained on.

    Every n-th photo sorted by name; only the first with fewer than :data:`FEW_PHOTOS` photos; none
    if ``every`` is 0 or too few photos would be left.
    """
    count = len(scene.views)
    if every <= 0 or count < 3:
        return []
    ranked = sorted(range(count), key=lambda i: (scene.views[i].camera.name, i))
    if count < FEW_PHOTOS or every == 1:
        return ranked[:1]
    return sorted(ranked[::every])


def training_views(scene: Scene, photos: PhotoSource, every: int) -> list[int]:
    """Return the views that are trained on: not held out, and not covered by their mask."""
    held_out = set(held_out_views(scene, every))
    return [
        i for i in range(len(scene.views)) if i not in held_out and _has_visible_pixels(photos, i)
    ]


def evenly_spaced(items: Sequence[_Item], most: int) -> list[_Item]:
    """Return up to ``most`` evenly spaced items, including the first and the last."""
    positions = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(np.int64)
    return [items[position] for position in positions.tolist()]


def _has_visible_pixels(photos: PhotoSource, index: int) -> bool:
    mask = photos.mask(index, 1)
    return mask is None or bool(mask.any())
