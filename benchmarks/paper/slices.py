# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes through a scene, and pictures of a field on them with its 0.5 level and the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

SIDE = 300
"""Points, and pixels, along each side of a slice."""
EMPTY_COLOR, SOLID_COLOR = (247, 244, 236), (58, 84, 126)
"""Of a vacancy of 1 and 0; between them the colours are blended."""
STEPS = 10
"""Bands of the colours: a field without steps would look smooth where it is not."""
TRUTH_COLOR = (20, 20, 20)

PLACES = 60
_RUN = 0.02
"""Half the length of a spoke, world units, whose samples give its axis."""


@dataclasses.dataclass(frozen=True)
class Plane:
    """A square piece of a plane, world units."""

    name: str
    center: np.ndarray
    right: np.ndarray
    up: np.ndarray
    """Unit directions in the plane."""
    half: float
    """Half its side."""

    def points(self, side: int = SIDE) -> np.ndarray:
        """Return (side, side, 3) centres of the pixels, the first row at the top."""
        at = ((np.arange(side) + 0.5) / side * 2 - 1) * self.half
        return self.center + at[None, :, None] * self.right - at[:, None, None] * self.up

    def pixels(self, points: np.ndarray, side: int = SIDE) -> np.ndarray:
        """Return (..., 2) pixel coordinates (column, row) of points projected into the plane."""
        away = points - self.center
        column, row = away @ self.right, -(away @ self.up)
        return (np.stack([column, row], -1) / self.half + 1) * side / 2


def spoke_planes(points: np.ndarray, radii: tuple[float, float], half: float) -> list[Plane]:
    """Return planes across spokes of the wheel, from samples (n, 3) on thin parts.

    The wheel's axis is y. Solitary places come first: those whose samples within :data:`_RUN` lie
    most nearly along one line. The middle of a plane lies on its spoke's axis.
    """
    radius = np.hypot(points[:, 0], points[:, 2])
    rng = np.random.default_rng(0)
    places = np.flatnonzero((radius > radii[0]) & (radius < radii[1]))
    found: list[tuple[float, Plane]] = []
    for place in rng.choice(places, min(PLACES, len(places)), replace=False):
        near = points[np.linalg.norm(points - points[place], axis=1) < _RUN]
        middle = near.mean(0)
        _, spread, axes = np.linalg.svd(near - middle, full_matrices=False)
        axis = axes[0]
        right = np.cross(axis, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        plane = Plane("across a spoke", middle, right, np.cross(right, axis), half)
        found.append((float(spread[1] / spread[0]), plane))
    return [plane for _, plane in sorted(found, key=lambda item: item[0])]


def rim_plane(degrees: float, radius: float, half: float) -> Plane:
    """Return the plane through the wheel's axis (y) that cuts the rim at an angle."""
    turn = np.radians(degrees)
    out = np.array([np.cos(turn), 0.0, np.sin(turn)])
    return Plane("across the rim", radius * out, out, np.array([0.0, 1.0, 0.0]), half)


def level_segments(values: np.ndarray, level: float = 0.5) -> np.ndarray:
    """Return the level set of (h, w) values as (n, 2, 2) segments, pixel coordinates (x, y).

    Each square between four centres is cut into two triangles, on each of which the values are
    linear.
    """
    h, w = values.shape
    y, x = np.mgrid[:h, :w] + 0.5
    corner = np.stack([x, y], -1)
    found = []
    for a, b, c in (((0, 0), (0, 1), (1, 0)), ((1, 1), (1, 0), (0, 1))):
        place = [
            corner[i : h - 1 + i, j : w - 1 + j].reshape(-1, 2) for i, j in (a, b, c)
        ]  # fmt: skip
        here = [
            values[i : h - 1 + i, j : w - 1 + j].reshape(-1).astype(float) for i, j in (a, b, c)
        ]
        cuts, known = [], []
        for p, q in ((0, 1), (1, 2), (2, 0)):
            crosses = (here[p] > level) != (here[q] > level)
            gap = np.where(crosses, here[q] - here[p], 1.0)
            share = np.clip((level - here[p]) / gap, 0.0, 1.0)
            cuts.append(place[p] + share[:, None] * (place[q] - place[p]))
            known.append(crosses)
        for p, q in ((0, 1), (1, 2), (2, 0)):
            both = known[p] & known[q]
            found.append(np.stack([cuts[p][both], cuts[q][both]], 1))
    return np.concatenate(found)


def mesh_segments(plane: Plane, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return where a mesh meets the plane as (n, 2, 3) segments, world units."""
    normal = np.cross(plane.right, plane.up)
    height = (vertices - plane.center) @ normal  # (v,)
    side = height > 0
    mixed = faces[side[faces].any(1) & ~side[faces].all(1)]
    cuts = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        p, q = mixed[:, a], mixed[:, b]
        crosses = side[p] != side[q]
        share = np.where(crosses, height[p] / np.where(crosses, height[p] - height[q], 1.0), np.nan)
        cuts.append(vertices[p] + share[:, None] * (vertices[q] - vertices[p]))
    ends = np.stack(cuts, 1)  # (n, 3, 3) of which one row is NaN
    known = ~np.isnan(ends[:, :, 0])
    return ends[known].reshape(-1, 2, 3)


def draw_slice(
    values: np.ndarray,
    lines: Sequence[tuple[np.ndarray, tuple[int, int, int], int]],
    *,
    zoom: int = 1,
    scale: tuple[float, str] | None = None,
) -> np.ndarray:
    """Return (h, w, 3) uint8: the field in bands of colour, and lines over it.

    Parameters
    ----------
    values : (h, w)
        Vacancy in [0, 1].
    lines : sequence of (segments, colour, width)
        (n, 2, 2) segments in the slice's pixels.
    zoom : int
        Pixels of the picture a value.
    scale : (pixels, words), optional
        A bar of this length in the slice's pixels.
    """
    share = np.round(np.clip(values, 0.0, 1.0) * STEPS)[:, :, None] / STEPS
    image = share * np.array(EMPTY_COLOR) + (1 - share) * np.array(SOLID_COLOR)
    fine = 3 * zoom  # drawn larger and shrunk: smooth lines
    picture = Image.fromarray(image.round().astype(np.uint8))
    size = (values.shape[1] * fine, values.shape[0] * fine)
    picture = picture.resize(size, Image.Resampling.NEAREST)
    draw = ImageDraw.Draw(picture)
    for segments, color, width in lines:
        for (x0, y0), (x1, y1) in (segments * fine).tolist():
            draw.line((x0, y0, x1, y1), fill=color, width=width * 3)
    picture = picture.resize((size[0] // 3, size[1] // 3), Image.Resampling.LANCZOS)
    if scale is not None:
        draw = ImageDraw.Draw(picture)
        length, words = scale
        y = picture.height - 12
        draw.line((10, y, 10 + length * zoom, y), fill=TRUTH_COLOR, width=3)
        font = ImageFont.load_default(13)
        draw.text((10, y - 19), words, fill=TRUTH_COLOR, font=font)
    return np.asarray(picture)


def inside_segments(segments: np.ndarray, side: int) -> np.ndarray:
    """Return which pixel centres lie inside of closed outlines, (side, side) bool, even-odd.

    Parameters
    ----------
    segments : (n, 2, 2)
        Ends (x, y) in pixels.
    """
    centers = np.arange(side) + 0.5
    inside = np.zeros((side, side), np.bool_)
    (x0, y0), (x1, y1) = segments[:, 0].T, segments[:, 1].T
    for row, y in enumerate(centers):
        crosses = (y0 > y) != (y1 > y)
        at = x0[crosses] + (y - y0[crosses]) / (y1 - y0)[crosses] * (x1 - x0)[crosses]
        inside[row] = (at[None, :] > centers[:, None]).sum(1) % 2 == 1
    return inside
