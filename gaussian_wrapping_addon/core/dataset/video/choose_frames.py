# SPDX-License-Identifier: GPL-3.0-or-later
"""Choose the frames of a video: the sharpest of each stretch of motion.

docs/method.md, section 14.3.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from .sharpness import are_blurred, relative_sharpness

MOTION_STEP = 0.08
"""Way of the picture from one chosen frame to the next, in its long sides."""
FEWEST_FRAMES, MOST_FRAMES = 40, 200
"""Bounds of the automatic number of frames."""
STILL_WAY = 0.001
"""A frame that has moved less, in sides, since the one before it that counts shows the same."""
_FAR = 0.3
"""Way between two chosen frames, in sides, that leaves little overlap where things are near."""
_MIDDLE = 0.6
"""Part of a stretch, around its middle, in which the sharpest frame is looked for first: frames
from the ends of two stretches would be almost the same."""


@dataclass(frozen=True)
class FrameMeasures:
    """What is known of each frame that was read."""

    indices: np.ndarray
    """(n,) int64, number in the video."""
    times_s: np.ndarray
    """(n,) float64, ascending."""
    ways: np.ndarray
    """(n,) float64: way of the picture so far, in its long sides; never decreases."""
    details: np.ndarray
    """(n, 2, 4) float64, of :func:`~.sharpness.details`."""


@dataclass(frozen=True)
class Choice:
    """The chosen frames, and why others are not used."""

    positions: np.ndarray
    """(k,) int64: positions in the measures, ascending."""
    blurred: int
    still: int
    """Sharp frames that show the same as another one before them."""
    gaps_s: tuple[tuple[float, float], ...]
    """Times between which all frames are blurred, while the picture goes far."""


def choose_frames(measures: FrameMeasures, *, frames: int = 0, fps: float = 0.0) -> Choice:
    """Choose frames.

    Parameters
    ----------
    measures : FrameMeasures
    frames : int
        Number of stretches of equal motion, so the most frames; 0: by the motion.
    fps : float
        If not 0 and ``frames`` is: stretches of equal time instead, so many a second.
    """
    ways, times_s = measures.ways, measures.times_s
    if not len(ways):
        return Choice(np.zeros(0, np.int64), 0, 0, ())
    relative = relative_sharpness(measures.details, times_s, ways)
    blurred = are_blurred(measures.details, relative)
    still = ~blurred & _show_the_same(ways, blurred)
    if fps and not frames:
        place = (times_s - times_s[0]) * fps
    else:
        total = float(ways[-1])
        count = frames or automatic_count(total)
        place = ways / total * count if total > 0.0 else np.zeros(len(ways))
        place = np.minimum(place, np.nextafter(count, 0.0))
    stretch = np.floor(place).astype(np.int64)
    chosen: list[int] = []
    empty: list[int] = []
    for number in np.unique(stretch):
        inside = np.flatnonzero(stretch == number)
        usable = inside[~blurred[inside]]
        if not len(usable):
            empty.append(int(inside[0]))
            continue
        middle = usable[np.abs(place[usable] - number - 0.5) <= _MIDDLE / 2]
        best = middle if len(middle) else usable
        pick = int(best[np.argmax(relative[best])])
        if chosen and ways[pick] - ways[chosen[-1]] < STILL_WAY:
            if relative[pick] > relative[chosen[-1]]:
                chosen[-1] = pick
            continue
        chosen.append(pick)
    positions = np.array(chosen, np.int64)
    gaps = [
        (float(times_s[before]), float(times_s[after]))
        for before, after in itertools.pairwise(chosen)
        if ways[after] - ways[before] > _FAR and any(before < i < after for i in empty)
    ]
    return Choice(positions, int(blurred.sum()), int(still.sum()), tuple(gaps))


def automatic_count(way: float) -> int:
    """Return the number of frames for a way of the picture, in its long sides."""
    return int(np.clip(round(way / MOTION_STEP), FEWEST_FRAMES, MOST_FRAMES))


def _show_the_same(ways: np.ndarray, blurred: np.ndarray) -> np.ndarray:
    """Tell which frames have not moved since the last frame that counts, (n,) bool."""
    same = np.zeros(len(ways), bool)
    last = -np.inf
    for i in np.flatnonzero(~blurred):
        if ways[i] - last < STILL_WAY:
            same[i] = True
        else:
            last = ways[i]
    return same
