# SPDX-License-Identifier: GPL-3.0-or-later
"""Semi-global matching: a plane for each pixel of a photo where windows alone do not decide.

See docs/method.md, section 11.13. Camera noise, blur and plain things leave windows that match
equally well at many depths, and PatchMatch then spreads the depths of edges over what lies beside
them. Here a pixel's depth is that which costs least together with those of its neighbours, along
eight directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from numba.extending import intrinsic
from scipy import ndimage

from ..compiled import kernel, part
from ..scene.camera import Camera
from .matching_cost import lens_matrix

MOST_HYPOTHESES = 256
LEAST_HYPOTHESES = 16
"""Depths that are tried, even in inverse depth: a pixel apart in the source that moves most, as far
as these limits let them."""

UNALIKE = 20
"""Bits, of 32, from which two pixels count as not alike at all; noise alone differs in 16."""

SMALL_JUMP = np.int16(12)
LARGE_JUMP, LEAST_LARGE_JUMP = np.float32(160), np.float32(16)
JUMP_FALL = np.float32(0.1)
"""Cost of a neighbour one hypothesis away; of one farther away, where both have the same grey, and
at the least; how fast it falls with the difference in grey. 255 is the cost of unlike pixels."""

FIT_RADIUS_PX = 3
FIT_STEPS = np.float32(2)
"""A plane is fitted to the pixels of such a square that lie within so many hypotheses of it."""
FIT_TURNS = 3
FEWEST_FITTED = 6

_FLAT = np.float32(1e-3)  # spread of the pixels of a fit, in both directions, below which it fails
_BEHIND = np.float32(1e-6)
_FAR_COST = np.int16(16000)
_NEAR_PLANE = 0.05
"""Least depth in a source, as a share of that here, up to which the place of a border counts."""

_CENSUS = np.array(
    [(y, x) for y in range(-3, 4) for x in range(-4, 5) if (x + y) % 2], np.int64
)  # (32, 2)
"""Pixels that a census compares with the middle one: a chequerboard of 7 rows and 9 columns."""


def matched_planes(
    camera: Camera, grey: np.ndarray, others: Sequence[Camera], other_greys: Sequence[np.ndarray],
    depth_range: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the (h, w, 3) float32 plane of each pixel (:mod:`~.matching_cost`); none is left out.

    Parameters
    ----------
    grey : (h, w) uint8
    others, other_greys : sequences of Camera and (h, w) uint8
        The sources, at least one.
    depth_range : (2,) float
        Least and largest inverse depth.

    Notes
    -----
    The volume of costs takes 3 bytes for each pixel and hypothesis (:func:`volume_bytes`).
    """
    found = [
        _turned(camera, other, image, depth_range)
        for other, image in zip(others, other_greys, strict=True)
    ]
    moves = np.array([move for _, _, move, _ in found], np.float32)
    inverse = _hypotheses(camera, moves, depth_range)
    height, width = (max(code.shape[k] for code, *_ in found) for k in (0, 1))
    codes = np.zeros((len(found), height, width), np.uint32)
    spans = np.zeros((len(found), height, 2), np.int32)
    for number, (code, _, _, span) in enumerate(found):
        codes[number, : code.shape[0], : code.shape[1]] = code
        spans[number, : len(span)] = span
    firsts = np.array([first for _, first, _, _ in found], np.float32)
    own = np.zeros(grey.shape, np.uint32)
    census(grey.astype(np.float32), _CENSUS, own)
    costs = np.zeros((*grey.shape, len(inverse)), np.uint8)
    cost_volume(own, codes, spans, firsts, moves, inverse, costs)
    sums = np.zeros(costs.shape, np.uint16)
    aggregate(costs, grey.astype(np.float32), sums)
    least = np.zeros(grey.shape, np.float32)
    cheapest(sums, inverse, least)
    planes = np.zeros((*grey.shape, 3), np.float32)
    fit_planes(least, FIT_STEPS * (inverse[1] - inverse[0]), planes)
    planes[..., 0] = planes[..., 0].clip(inverse[0], inverse[-1])
    return planes


def volume_bytes(pixels: int) -> int:
    """Return the memory that the costs of a photo of so many pixels take at most."""
    return 3 * MOST_HYPOTHESES * pixels


def _turned(
    camera: Camera, other: Camera, image: np.ndarray, depth_range: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Turn a source to face as the photo does, with its lens: pixels move along lines then.

    Returns the census of its pixels (h, w) uint32, the place (x, y) of the first one, how far the
    pixels of the photo move with inverse depth (3,), homogeneous, and the columns of each row
    that the source shows (h, 2) int32, from and up to.
    """
    rotation = other.rotation @ camera.rotation.T
    offset = other.cam_from_world[:, 3] - rotation @ camera.cam_from_world[:, 3]
    lens, lens_there = lens_matrix(camera), lens_matrix(other)
    move = lens @ rotation.T @ offset
    low, high = _reached(camera, move, depth_range)
    columns, rows = np.maximum(high - low + 1, 1)
    row, column = np.mgrid[:rows, :columns]
    here = np.stack([column + low[0], row + low[1], np.ones_like(row)], -1).astype(np.float64)
    there = here @ (lens_there @ rotation @ np.linalg.inv(lens)).T  # (rows, columns, 3)
    z = np.where(there[..., 2] > _BEHIND, there[..., 2], np.nan)
    x, y = there[..., 0] / z, there[..., 1] / z
    last_row, last_column = image.shape[0] - 1, image.shape[1] - 1
    shown = (x >= 0) & (y >= 0) & (x <= last_column) & (y <= last_row)
    at = [np.where(shown, y, 0.0), np.where(shown, x, 0.0)]
    turned = ndimage.map_coordinates(image.astype(np.float32), at, order=1)
    code = np.zeros(turned.shape, np.uint32)
    census(turned, _CENSUS, code)
    # What a photo shows is convex: one run of columns in each row.
    first, after = shown.argmax(1), shown.shape[1] - shown[:, ::-1].argmax(1)
    span = np.where(shown.any(1)[:, None], np.stack([first, after], 1), 0)
    return code, low, move, span.astype(np.int32)


def _reached(
    camera: Camera, move: np.ndarray, depth_range: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and last place (x, y) that pixels reach in a turned source, whole pixels.

    At most a photo's size beyond its borders.
    """
    size = np.array([camera.width, camera.height])
    corners = np.array([[x, y] for x in (0, size[0] - 1) for y in (0, size[1] - 1)], np.float64)
    places = []
    for inverse in depth_range:
        depth = max(1.0 + inverse * move[2], _NEAR_PLANE)
        places.append((corners + inverse * move[:2]) / depth)
    reached = np.concatenate(places)
    low = np.floor(np.clip(reached.min(0), -size, 2 * size)).astype(np.int64)
    high = np.ceil(np.clip(reached.max(0), -size, 2 * size)).astype(np.int64)
    return low, high


def _hypotheses(camera: Camera, moves: np.ndarray, depth_range: np.ndarray) -> np.ndarray:
    """Return the inverse depths to try, (d,) float32, rising."""
    middle = np.array([camera.width, camera.height]) / 2
    longest = np.linalg.norm(moves[:, :2] - moves[:, 2:] * middle, axis=1).max()
    low, high = (float(value) for value in depth_range)
    wanted = np.ceil((high - low) * float(longest))
    count = int(np.clip(wanted, LEAST_HYPOTHESES, MOST_HYPOTHESES))
    return np.linspace(low, high, count).astype(np.float32)


# -- Costs: how many bits of two census codes differ ----------------------------------------------


def _count_bits(context: Any, value: Any) -> Any:
    """Count the bits of a uint32 that are set."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return numba.types.uint32(numba.types.uint32), generate


_bits_set: Any = intrinsic(_count_bits)


@kernel(fast=False)
def census(image: np.ndarray, offsets: np.ndarray, codes: np.ndarray) -> None:
    """Tell for each pixel of an image (h, w) float32 which of its neighbours are brighter.

    ``offsets`` (32, 2) int64 are rows and columns; a bit each of ``codes`` (h, w) uint32, written.
    """
    last_row, last_column = image.shape[0] - 1, image.shape[1] - 1
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            code, here = np.uint32(0), image[row, column]
            for i in range(len(offsets)):
                y = min(max(row + offsets[i, 0], 0), last_row)
                x = min(max(column + offsets[i, 1], 0), last_column)
                code = np.uint32(code << np.uint32(1)) | np.uint32(image[y, x] > here)
            codes[row, column] = code


@part(fast=True)
def _compare_row(
    own: Any, codes: Any, base: Any, start: Any, step: Any, first: Any, after: Any, places: Any,
    read: Any, best: Any, second: Any,
) -> Any:  # fmt: skip
    """Count differing bits along a row in one source; keep the two least counts of each pixel.

    Three loops: LLVM vectorises all but the loads.
    """
    for column in range(first, after):
        places[column] = np.int32(start + step * np.float32(column))
    for column in range(first, after):
        read[column] = codes[base + np.int64(places[column])]
    for column in range(first, after):
        count = np.int32(_bits_set(np.uint32(read[column] ^ own[column])))
        before = best[column]
        best[column] = min(before, count)
        second[column] = min(second[column], max(before, count))


@kernel(fast=True)
def cost_volume(
    own: np.ndarray, codes: np.ndarray, spans: np.ndarray, firsts: np.ndarray, moves: np.ndarray,
    inverse: np.ndarray, costs: np.ndarray,
) -> None:  # fmt: skip
    """Fill the costs of all hypotheses: mean over the two best sources, 255 where nothing is alike.

    Parameters
    ----------
    own : (h, w) uint32
        Census of the photo.
    codes : (s, rows, columns) uint32
        Of its turned sources.
    spans : (s, rows, 2) int32
    firsts : (s, 2) float32
    moves : (s, 3) float32
        As from :func:`_turned`.
    inverse : (d,) float32
    costs : (h, w, d) uint8
        Written.
    """
    height, width = own.shape
    rows, columns = codes.shape[1], codes.shape[2]
    flat = codes.reshape(-1)
    best, second = np.empty(width, np.int32), np.empty(width, np.int32)
    places, read = np.empty(width, np.int32), np.empty(width, np.uint32)
    by_depth = np.empty((len(inverse), width), np.uint8)
    half, scale = np.float32(0.5), np.float32(255 / (2 * UNALIKE))
    for row in range(height):
        for d in range(len(inverse)):
            w = inverse[d]
            for column in range(width):
                best[column] = second[column] = UNALIKE
            for s in range(len(moves)):
                depth = np.float32(1) + w * moves[s, 2]
                if depth <= _BEHIND:
                    continue
                step = np.float32(1) / depth
                y = np.floor((np.float32(row) + w * moves[s, 1]) * step - firsts[s, 1] + half)
                if not (y >= 0 and y < rows):
                    continue
                there = np.int64(y)
                start = w * moves[s, 0] * step - firsts[s, 0] + half
                low, high = np.float32(spans[s, there, 0]), np.float32(spans[s, there, 1])
                # Columns whose place start + step * column lies in the span; a pixel less at the
                # ends, where rounding could lead beyond it.
                first = max(np.int64(0), np.int64(np.ceil((low - start) / step)))
                after = min(np.int64(width), np.int64(np.floor((high - start) / step)))
                base = (np.int64(s) * rows + there) * columns
                _compare_row(
                    own[row], flat, base, start, step, first, after, places, read, best, second
                )
            for column in range(width):
                total = np.float32(best[column] + second[column])
                by_depth[d, column] = np.uint8(total * scale)
        for column in range(width):
            for d in range(len(inverse)):
                costs[row, column, d] = by_depth[d, column]


# -- Costs of whole lines of pixels, and what is cheapest -----------------------------------------


@part(fast=True)
def _continue_path(costs: Any, before: Any, path: Any, sums: Any, large_jump: Any) -> Any:
    """Extend a line of pixels by one: (d,) costs, (d + 2,) int16 of the line, without and with it.

    The first and last of a line's entries are guards.
    """
    count = len(costs)
    least = _FAR_COST
    for k in range(1, count + 1):
        least = min(least, before[k])
    jump = np.int16(least + large_jump)
    for k in range(1, count + 1):
        step = min(np.int16(before[k - 1] + SMALL_JUMP), np.int16(before[k + 1] + SMALL_JUMP))
        cheapest_before = min(min(before[k], step), jump)
        path[k] = np.int16(np.int16(costs[k - 1]) + np.int16(cheapest_before - least))
    for k in range(count):
        sums[k] = np.uint16(sums[k] + np.uint16(path[k + 1]))


@part(fast=True)
def _large_jump(here: Any, there: Any) -> Any:
    """Return what it costs to leave a surface between two pixels of such grey levels."""
    cost = LARGE_JUMP / (np.float32(1) + JUMP_FALL * abs(here - there))
    return np.int16(max(LEAST_LARGE_JUMP, cost))


@kernel(fast=True)
def aggregate(costs: np.ndarray, grey: np.ndarray, sums: np.ndarray) -> None:
    """Add up the costs of the lines that end in each pixel, from eight directions.

    Parameters
    ----------
    costs : (h, w, d) uint8
    grey : (h, w) float32
    sums : (h, w, d) uint16
        Added to.
    """
    height, width, count = costs.shape
    nothing = np.zeros(count + 2, np.int16)
    nothing[0] = nothing[count + 1] = _FAR_COST
    before = np.zeros((3, width, count + 2), np.int16)
    now = np.zeros((3, width, count + 2), np.int16)
    beside, path = nothing.copy(), nothing.copy()
    for direction in range(3):
        for column in range(width):
            before[direction, column] = nothing
            now[direction, column] = nothing
    for back in range(2):
        sign = 1 - 2 * back
        for i in range(height):
            row = height - 1 - i if back else i
            beside[:] = nothing
            for j in range(width):
                column = width - 1 - j if back else j
                here = grey[row, column]
                there = grey[row, column - sign] if j > 0 else here
                _continue_path(
                    costs[row, column], beside, path, sums[row, column], _large_jump(here, there)
                )
                beside, path = path, beside
                for direction in range(3):
                    last = column - (direction - 1)
                    if i > 0 and last >= 0 and last < width:
                        jump = _large_jump(here, grey[row - sign, last])
                        _continue_path(
                            costs[row, column], before[direction, last], now[direction, column],
                            sums[row, column], jump,
                        )  # fmt: skip
                    else:
                        _continue_path(
                            costs[row, column], nothing, now[direction, column],
                            sums[row, column], np.int16(0),
                        )  # fmt: skip
            before, now = now, before


@kernel(fast=True)
def cheapest(sums: np.ndarray, inverse: np.ndarray, least: np.ndarray) -> None:
    """Write the inverse depth of the least sum of each pixel, (h, w) float32, between hypotheses.

    ``sums`` (h, w, d) uint16; a parabola through it and its two neighbours tells the place between.
    """
    step = inverse[1] - inverse[0]
    last = len(inverse) - 1
    for row in range(sums.shape[0]):
        for column in range(sums.shape[1]):
            found = 0
            for d in range(1, len(inverse)):
                if sums[row, column, d] < sums[row, column, found]:
                    found = d
            shift = np.float32(0)
            if found > 0 and found < last:
                here = np.float32(sums[row, column, found])
                nearer = np.float32(sums[row, column, found + 1])
                farther = np.float32(sums[row, column, found - 1])
                bend = nearer + farther - here - here
                if bend > np.float32(0):
                    shift = np.float32(0.5) * (farther - nearer) / bend
            least[row, column] = inverse[found] + shift * step


@kernel(fast=True)
def fit_planes(inverse: np.ndarray, reach: float, planes: np.ndarray) -> None:
    """Fit a plane to the pixels around each one that lie near it.

    Parameters
    ----------
    inverse : (h, w) float32
        Inverse depths.
    reach : float32
        Distance in inverse depth from which a pixel does not count; larger in the first turn, away
        from the middle, where the plane is not known yet.
    planes : (h, w, 3) float32
        Written: w, a, b.
    """
    height, width = inverse.shape
    zero, one = np.float32(0), np.float32(1)
    near = np.empty((2 * FIT_RADIUS_PX + 1, 2 * FIT_RADIUS_PX + 1), np.float32)
    for y in range(-FIT_RADIUS_PX, FIT_RADIUS_PX + 1):
        for x in range(-FIT_RADIUS_PX, FIT_RADIUS_PX + 1):
            share = np.float32(x * x + y * y) / np.float32(FIT_RADIUS_PX * FIT_RADIUS_PX)
            near[y + FIT_RADIUS_PX, x + FIT_RADIUS_PX] = np.exp(-share)
    for row in range(height):
        for column in range(width):
            w, a, b = inverse[row, column], zero, zero
            for turn in range(FIT_TURNS):
                total = sx = sy = sz = sxx = sxy = syy = sxz = syz = zero
                count = 0
                for y in range(max(-FIT_RADIUS_PX, -row), min(FIT_RADIUS_PX, height - 1 - row) + 1):
                    for x in range(
                        max(-FIT_RADIUS_PX, -column), min(FIT_RADIUS_PX, width - 1 - column) + 1
                    ):
                        fx, fy = np.float32(x), np.float32(y)
                        z = inverse[row + y, column + x] - w
                        wider = np.float32(0.5) * (abs(fx) + abs(fy)) if turn == 0 else zero
                        limit = reach * (one + wider)
                        off = (z - a * fx - b * fy) / limit
                        if off * off > one:
                            continue
                        like = one - off * off
                        weight = like * like * near[y + FIT_RADIUS_PX, x + FIT_RADIUS_PX]
                        count += 1
                        total += weight
                        sx += weight * fx
                        sy += weight * fy
                        sz += weight * z
                        sxx += weight * fx * fx
                        sxy += weight * fx * fy
                        syy += weight * fy * fy
                        sxz += weight * fx * z
                        syz += weight * fy * z
                if count < FEWEST_FITTED:
                    break
                mx, my, mz = sx / total, sy / total, sz / total
                xx, yy = sxx / total - mx * mx, syy / total - my * my
                xy, xz, yz = sxy / total - mx * my, sxz / total - mx * mz, syz / total - my * mz
                determinant = xx * yy - xy * xy
                if determinant < _FLAT:
                    break
                a, b = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
                w += mz - a * mx - b * my
            planes[row, column, 0], planes[row, column, 1], planes[row, column, 2] = w, a, b
