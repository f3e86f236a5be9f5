# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluate a Gaussian on the rays of a block of pixels, in explicit vectors; exponentials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from . import raster_math as constants
from .simd import Block, Vector

SHORT_END, WIDE_END = 8.0 * float(constants.FIT_END), 32.0 * float(constants.FIT_END)
"""Where :func:`exp_short` (exp(-5.6) < 1/255) and :func:`exp_wide` (exp(-22.4) = 2e-10) end."""


def exp_short(x: Vector, scale: float = 1.0) -> Vector:
    """Return exp(-scale x) for 0 <= scale x <= SHORT_END (relative error 1.6e-6)."""
    return _power(_fit(x * (scale / 8.0)), 3)


def exp_wide(x: Vector, scale: float = 1.0) -> Vector:
    """Return exp(-scale x) for 0 <= scale x <= WIDE_END, and 0 above (relative error 7e-6).

    A small value instead of 0 would be amplified by the 1 / sigma^2 of thin Gaussians far behind.
    """
    value = _power(_fit(x * (scale / 32.0)), 5)
    return (x < WIDE_END / scale).select(value, 0.0)


def _fit(y: Vector) -> Vector:
    total = y * float(constants.FIT[-1]) + float(constants.FIT[-2])
    for coefficient in reversed(constants.FIT[:-2]):
        total = total * y + float(coefficient)
    return total


def _power(value: Vector, squarings: int) -> Vector:
    for _ in range(squarings):
        value = value * value
    return value


@dataclass(frozen=True)
class RayEvaluation:
    """One Gaussian evaluated on the rays of a block; names as in docs/architecture.md."""

    dx: Vector  # pixel - projected mean
    dy: Vector
    inverse: Vector  # 1 / den
    den: Vector
    distance: Vector
    """Smallest squared Mahalanobis distance on the ray; clamped where alpha is below 1/255."""
    raw: Vector  # opacity on the ray before the cap
    alpha: Vector  # after the cap
    row: Row


class Row:
    """One row of params; each column is loaded and broadcast where it is used."""

    def __init__(self, block: Block, params: Any, gaussian: Any) -> None:
        self.block, self.params = block, params
        self.base = block.builder.mul(gaussian, block.index(constants.ROW_VALUES))

    def single(self, column: int) -> Any:
        """Return a column as an SSA float32."""
        return self.block.scalar(self.params, self.block.offset(self.base, column))

    def __getitem__(self, column: int) -> Vector:
        return self.block.splat(self.single(column))


def first_pixel(block: Block, number: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Return the centre of a block's first pixel; that of the tile is ``(x, y)``."""
    builder, flags = block.builder, ("contract",)
    columns = constants.BLOCK_COLUMNS
    column = builder.and_(number, block.index(columns - 1))
    row = builder.lshr(number, block.index(columns.bit_length() - 1))
    across = builder.mul(column, block.index(constants.BLOCK_WIDTH))
    down = builder.mul(row, block.index(block.lanes // constants.BLOCK_WIDTH))
    left = builder.fadd(x, builder.sitofp(across, x.type), flags=flags)
    return left, builder.fadd(y, builder.sitofp(down, y.type), flags=flags)


def evaluate_rays(block: Block, params: Any, gaussian: Any, left: Any, top: Any) -> RayEvaluation:
    """Evaluate a Gaussian on the rays of the block whose first pixel centre is ``(left, top)``."""
    row = Row(block, params, gaussian)
    builder, flags = block.builder, ("contract",)
    dx = block.constants(constants.LANE_X[: block.lanes].tolist()) - block.splat(
        builder.fsub(row.single(0), left, flags=flags)
    )
    dy = block.constants(constants.LANE_Y[: block.lanes].tolist()) - block.splat(
        builder.fsub(row.single(1), top, flags=flags)
    )
    num = ((dx * row[2] + dy * row[3]) * dx + dy * row[4] * dy).max(0.0)
    den = (dx * row[7] + (dy * row[8] + row[5] * 2.0)) * dx + (
        (dy * row[9] + row[6] * 2.0) * dy + 1.0
    )
    den = den.max(float(constants.DENOMINATOR_MIN))
    inverse = den.reciprocal()
    distance = (num * inverse).min(2.0 * SHORT_END)
    raw = exp_short(distance, 0.5) * row[11]
    return RayEvaluation(
        dx, dy, inverse, den, distance, raw, raw.min(float(constants.ALPHA_MAX)), row
    )


def peak_depth(rays: RayEvaluation) -> Vector:
    """Return the z-depth of the Gaussian's maximum along each ray.

    Rounded identically wherever it is used: thin Gaussians resolve a depth's last bits.
    """
    row = rays.row
    return ((rays.dx * row[5] + (rays.dy * row[6] + 1.0)) * rays.inverse).times(row[10])
