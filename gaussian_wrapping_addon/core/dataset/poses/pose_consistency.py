# SPDX-License-Identifier: GPL-3.0-or-later
"""Do solved cameras agree with the matches of their photos? (docs/method.md, section 15.3)

Plain geometry, no solver: pairs of photos whose matches agree with some motion, against the motion
that the solved cameras have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

EPIPOLAR_PX = 6.0
"""Largest Sampson distance of a match that agrees; the matcher lets 4 pass."""
REPROJECTION_PX = 10.0
"""Largest distance between a match and where the other photo's point is projected."""
MIN_MATCHES = 30
"""Pairs with fewer matches are no evidence: chance finds them, too."""
AGREES, CONTRADICTS = 0.6, 0.3
"""Shares of a pair's matches, at least and at most, from which the pair counts so."""
STRONG = 0.2
"""Least matches of a strong pair, over those of the strongest pair of its weaker photo. Fur and
leaves make weak pairs that contradict right cameras; true neighbours are strong."""
DOUBTFUL_SHARE, MIN_CONTRADICTING = 0.05, 3
"""Share of the matches of strong pairs, and number of strong pairs, that contradict the cameras,
from which on these are doubtful."""
_FEW = 1e-12


@dataclass(frozen=True)
class PairEvidence:
    """Matches of two placed photos, and how many of them fit the cameras."""

    first: str
    second: str
    matches: int
    agreeing: int

    @property
    def share(self) -> float:
        """Of the matches, those that agree."""
        return self.agreeing / max(self.matches, 1)

    @property
    def contradicts(self) -> bool:
        """Tell whether the pair shows another motion than the cameras have."""
        return self.matches >= MIN_MATCHES and self.share <= CONTRADICTS

    @property
    def agrees(self) -> bool:
        """Tell whether the pair supports the cameras."""
        return self.agreeing >= MIN_MATCHES and self.share >= AGREES


@dataclass(frozen=True)
class Side:
    """One photo of a pair."""

    pose: np.ndarray
    """(3, 4) cam_from_world."""
    rays: np.ndarray
    """(n, 2) matches on the plane at depth 1."""
    points: np.ndarray
    """(n, 3) world points of the matches' features, not a number where a feature has none."""
    focal_px: float


def agreeing_matches(first: Side, second: Side) -> np.ndarray:
    """Tell which of n matches agree with the poses, (n,) bool.

    Where a feature has a point, the point must appear at the match in the other photo; else the
    match must lie on its epipolar line, before both cameras.
    """
    forth = _reprojection_px(first.points, second)
    back = _reprojection_px(second.points, first)
    has_point = ~(np.isnan(forth) & np.isnan(back))
    # Features of one thing may have two points, one of them poor: either is enough.
    near = np.fmin(forth, back) <= REPROJECTION_PX
    return np.where(has_point, near, _is_on_line(first, second))


def _reprojection_px(points: np.ndarray, side: Side) -> np.ndarray:
    """Return (n,) distances in pixels, infinite behind the camera, not a number without a point."""
    local = points @ side.pose[:, :3].T + side.pose[:, 3]
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.linalg.norm(local[:, :2] / depth[:, None] - side.rays, axis=1) * side.focal_px
    return np.where(np.isnan(depth), np.nan, np.where(depth > 0.0, apart, np.inf))


def _is_on_line(first: Side, second: Side) -> np.ndarray:
    rotation = second.pose[:, :3] @ first.pose[:, :3].T
    shift = second.pose[:, 3] - rotation @ first.pose[:, 3]
    shift = shift / max(float(np.linalg.norm(shift)), _FEW)
    ones = np.ones((len(first.rays), 1))
    a, b = np.hstack([first.rays, ones]), np.hstack([second.rays, ones])
    turned = a @ rotation.T
    essential = np.cross(np.broadcast_to(shift, turned.shape), turned)  # E a, (n, 3)
    across = b @ np.cross(np.eye(3), shift) @ rotation  # E^T b up to sign, (n, 3)
    scale = np.sqrt((essential[:, :2] ** 2).sum(1) + (across[:, :2] ** 2).sum(1))
    apart = np.abs((b * essential).sum(1)) / np.maximum(scale, _FEW)
    apart *= 0.5 * (first.focal_px + second.focal_px)
    # Depths z a' + t = w b by least squares; far points have either sign of a tiny angle.
    aa, bb, ab = (turned**2).sum(1), (b**2).sum(1), (turned * b).sum(1)
    at, bt = turned @ shift, b @ shift
    size = aa * bb - ab**2
    z, w = (ab * bt - bb * at), (aa * bt - ab * at)
    is_far = size < (REPROJECTION_PX / first.focal_px) ** 2 * aa * bb
    return (apart <= EPIPOLAR_PX) & (is_far | ((z > 0.0) & (w > 0.0)))


@dataclass(frozen=True)
class Verdict:
    """All pairs of a solution together."""

    pairs: tuple[PairEvidence, ...]

    @property
    def agreeing(self) -> int:
        """Matches that fit, of all pairs."""
        return sum(pair.agreeing for pair in self.pairs)

    @property
    def strong(self) -> tuple[PairEvidence, ...]:
        """Pairs with many matches for their photos, the ones with most first."""
        strongest: dict[str, int] = {}
        for pair in self.pairs:
            for name in (pair.first, pair.second):
                strongest[name] = max(strongest.get(name, 0), pair.matches)
        found = [
            pair
            for pair in self.pairs
            if pair.matches >= MIN_MATCHES
            and pair.matches >= STRONG * min(strongest[pair.first], strongest[pair.second])
        ]
        return tuple(sorted(found, key=lambda p: (-p.matches, p.first, p.second)))

    @property
    def contradicting(self) -> tuple[PairEvidence, ...]:
        """Strong pairs that show another motion, the ones with most matches first."""
        return tuple(pair for pair in self.strong if pair.contradicts)

    @property
    def contradicting_share(self) -> float:
        """Share of the matches of strong pairs that belong to contradicting ones."""
        counted = sum(pair.matches for pair in self.strong)
        return sum(pair.matches for pair in self.contradicting) / max(counted, 1)

    @property
    def is_doubtful(self) -> bool:
        """Tell whether so many matches contradict the cameras that these are likely wrong."""
        return (
            len(self.contradicting) >= MIN_CONTRADICTING
            and self.contradicting_share >= DOUBTFUL_SHARE
        )

    def parts(self, names: Sequence[str]) -> list[list[str]]:
        """Return photos in parts that no agreeing pair links, the largest part first."""
        part = {name: name for name in names}

        def root(name: str) -> str:
            while part[name] != name:
                part[name] = part[part[name]]
                name = part[name]
            return name

        for pair in self.pairs:
            if pair.agrees:
                one, other = sorted((root(pair.first), root(pair.second)))
                part[other] = one
        groups: dict[str, list[str]] = {}
        for name in names:
            groups.setdefault(root(name), []).append(name)
        return sorted(groups.values(), key=lambda group: (-len(group), group[0]))

    def to_json(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the figures and the strongest evidence."""
        counted = self.strong
        return {
            "pairs": sum(pair.matches >= MIN_MATCHES for pair in self.pairs),
            "strong_pairs": len(counted),
            "contradicting_pairs": len(self.contradicting),
            "contradicting_share": self.contradicting_share,
            "median_share": float(np.median([p.share for p in counted])) if counted else 0.0,
            "strongest": [
                [p.first, p.second, p.matches, p.agreeing] for p in self.contradicting[:10]
            ],
            "parts": self.parts(names),
        }
