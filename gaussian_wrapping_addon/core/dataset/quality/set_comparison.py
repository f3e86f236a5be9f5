# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare the measures of a set's photos: which are blurred, brighter or darker, the same again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .photo_measures import PhotoMeasures

NEIGHBOURS = 4
"""Photos before and after one, by name, that it is compared with: they show much the same."""
SIDE = 3
"""Photos on each side that its light is compared with."""
MIN_PHOTOS = 5
"""With fewer photos there is nothing to compare with."""
BLURRED_SHARE = 0.45
"""Of its neighbours' sharpness and of the set's: a photo with less is blurred."""
JUMP_STOPS = 1.0
"""Difference in light from the neighbours that one sees, and that exposure correction should not
have to bridge."""
SAME_PX = 0.15
"""Apparent movement, in pixels of the small pictures, up to which two photos are the same."""
_SPREAD_QUANTILES = (0.05, 0.95)


def beside(values: np.ndarray) -> np.ndarray:
    """Return the median of the neighbours of each of (n,) values; NaN values are left out."""
    count = len(values)
    medians = np.full(count, np.nan)
    for i in range(count):
        low = min(max(i - NEIGHBOURS, 0), max(count - 2 * NEIGHBOURS - 1, 0))
        around = np.delete(values[low : low + 2 * NEIGHBOURS + 1], i - low)
        around = around[np.isfinite(around)]
        if len(around):
            medians[i] = np.median(around)
    return medians


def blurred(photos: Sequence[PhotoMeasures]) -> list[int]:
    """Return the photos that are much less sharp than those beside them and than most of the set.

    Both, as photos from another place or of a plainer part may be softer without a fault.
    """
    values = np.array([photo.sharpness for photo in photos])
    if np.isfinite(values).sum() < MIN_PHOTOS:
        return []
    limit = BLURRED_SHARE * np.fmin(beside(values), np.nanmedian(values))
    with np.errstate(invalid="ignore"):
        return [int(i) for i in np.flatnonzero(values < limit)]


def out_of_line(photos: Sequence[PhotoMeasures]) -> list[tuple[int, float]]:
    """Return the photos that are brighter or darker than those on both sides, with the stops."""
    light = np.array([photo.light for photo in photos])
    if len(light) < MIN_PHOTOS:
        return []
    found = []
    for i in range(len(light)):
        sides = (light[max(i - SIDE, 0) : i], light[i + 1 : i + 1 + SIDE])
        # On both sides: where the light changes from one place to the next, nothing is wrong.
        stops = [float(light[i] - np.median(side)) for side in sides if len(side)]
        if min(stops) > JUMP_STOPS or max(stops) < -JUMP_STOPS:
            found.append((i, min(stops, key=abs)))
    return found


def light_spread(photos: Sequence[PhotoMeasures]) -> float:
    """Return by how many stops the photos' mean light differs, without the most extreme."""
    low, high = np.quantile([photo.light for photo in photos], _SPREAD_QUANTILES)
    return float(high - low)


def same_again(photos: Sequence[PhotoMeasures]) -> list[tuple[int, int]]:
    """Return pairs of photos that show the same from the same place, each second photo once."""
    of_shape: dict[tuple[int, ...], list[int]] = {}
    for i, photo in enumerate(photos):
        of_shape.setdefault(photo.small.shape, []).append(i)
    pairs: list[tuple[int, int]] = []
    for members in of_shape.values():
        pixels = np.stack([photos[i].small for i in members]).astype(np.float32)
        edges = np.array([_edge_strength(small) for small in pixels])
        pixels -= pixels.mean((1, 2), keepdims=True)
        spread = np.maximum(pixels.std((1, 2), keepdims=True), 1e-3)
        flat = (pixels / spread).reshape(len(members), -1)
        # Standardised: exposure does not count. Moved in units of the edges' strength.
        alike = 2.0 * (1.0 - np.clip(flat @ flat.T / flat.shape[1], -1.0, 1.0))
        moved_px = np.sqrt(np.maximum(alike, 0.0)) * spread[:, 0] / np.maximum(edges, 1e-3)[:, None]
        for b in range(1, len(members)):
            a = int(np.argmin(moved_px[b, :b]))
            if moved_px[b, a] < SAME_PX and edges[b] > 0.0:
                pairs.append((members[a], members[b]))
    return sorted(pairs)


def _edge_strength(small: np.ndarray) -> float:
    """Return the root mean square gradient of (h, w) grey, levels per pixel; 0 of a line."""
    if min(small.shape) < 2:
        return 0.0
    rows, columns = np.diff(small, axis=0), np.diff(small, axis=1)
    return float(np.sqrt((np.mean(rows**2) + np.mean(columns**2)) / 2.0))
