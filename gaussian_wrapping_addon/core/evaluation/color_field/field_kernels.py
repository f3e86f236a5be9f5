# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled products of the colour field: samples from coefficients, and back.

The colour of a sample is that of two lattices: three values at each fine vertex, and harmonics of
degree 0 to 2 (9 x 3 values) at each coarse vertex, both interpolated trilinearly.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...kernels.compiled import inline, kernel

HARMONICS = 9
"""Real spherical harmonics of degree 0 to 2."""
COARSE_VALUES = 3 * HARMONICS


@inline
def _corner_weights(x: Any, y: Any, z: Any, weights: Any) -> None:
    one = np.float32(1.0)
    ax, ay, az = one - x, one - y, one - z
    weights[0] = ax * ay * az
    weights[1] = ax * ay * z
    weights[2] = ax * y * az
    weights[3] = ax * y * z
    weights[4] = x * ay * az
    weights[5] = x * ay * z
    weights[6] = x * y * az
    weights[7] = x * y * z


@inline
def _harmonics(x: Any, y: Any, z: Any, basis: Any) -> None:
    # Scaled so that degree 0 is 1: its coefficient is the mean colour over directions.
    basis[0] = np.float32(1.0)
    basis[1] = np.float32(1.7320508) * x
    basis[2] = np.float32(1.7320508) * y
    basis[3] = np.float32(1.7320508) * z
    basis[4] = np.float32(3.8729833) * x * y
    basis[5] = np.float32(3.8729833) * y * z
    basis[6] = np.float32(1.1180340) * (np.float32(3.0) * z * z - np.float32(1.0))
    basis[7] = np.float32(3.8729833) * x * z
    basis[8] = np.float32(1.9364917) * (x * x - y * y)


@kernel(fast=True)
def normal_product(
    begin: int,
    end: int,
    coarse_starts: Any,
    fine_starts: Any,
    fine_corners: Any,
    coarse_corners: Any,
    places: Any,
    sub_places: Any,
    directions: Any,
    colors: Any,
    share: Any,
    fine: Any,
    coarse: Any,
    fine_sums: Any,
    coarse_sums: Any,
) -> None:
    """Write ``A^T (A p - share y)`` of the coarse cells from begin to end, by cell and corner.

    ``coarse_starts`` (c + 1,) numbers the fine cells of each coarse cell, ``fine_starts`` (f + 1,)
    the samples of each fine cell; ``sub_places`` (f, 3) is the fine cell's corner in its coarse
    one, in coarse cells. ``fine_sums`` (f, 8, 3) and ``coarse_sums`` (c, 8, 27) are overwritten.
    """
    weights = np.empty(8, np.float32)
    basis = np.empty(9, np.float32)
    wide = np.empty(8, np.float32)
    # One colour after the other, so that the inner loops run over neighbouring numbers.
    factors = np.empty(72, np.float32)
    own = np.empty((3, 72), np.float32)
    total = np.empty((3, 72), np.float32)
    near = np.empty((8, 3), np.float32)
    near_total = np.empty((8, 3), np.float32)
    quarter = np.float32(0.25)
    for c in range(begin, end):
        for k in range(8):
            vertex = coarse_corners[c, k]
            for h in range(9):
                for j in range(3):
                    own[j, 9 * k + h] = coarse[vertex, 3 * h + j]
                    total[j, 9 * k + h] = np.float32(0.0)
        for f in range(coarse_starts[c], coarse_starts[c + 1]):
            for k in range(8):
                vertex = fine_corners[f, k]
                for j in range(3):
                    near[k, j] = fine[vertex, j]
                    near_total[k, j] = np.float32(0.0)
            for s in range(fine_starts[f], fine_starts[f + 1]):
                x, y, z = places[s, 0], places[s, 1], places[s, 2]
                _corner_weights(x, y, z, weights)
                _corner_weights(
                    sub_places[f, 0] + quarter * x,
                    sub_places[f, 1] + quarter * y,
                    sub_places[f, 2] + quarter * z,
                    wide,
                )
                _harmonics(directions[s, 0], directions[s, 1], directions[s, 2], basis)
                for k in range(8):
                    for h in range(9):
                        factors[9 * k + h] = wide[k] * basis[h]
                red = -share * colors[s, 0]
                green = -share * colors[s, 1]
                blue = -share * colors[s, 2]
                for q in range(72):
                    red += factors[q] * own[0, q]
                    green += factors[q] * own[1, q]
                    blue += factors[q] * own[2, q]
                for k in range(8):
                    red += weights[k] * near[k, 0]
                    green += weights[k] * near[k, 1]
                    blue += weights[k] * near[k, 2]
                for q in range(72):
                    total[0, q] += factors[q] * red
                    total[1, q] += factors[q] * green
                    total[2, q] += factors[q] * blue
                for k in range(8):
                    near_total[k, 0] += weights[k] * red
                    near_total[k, 1] += weights[k] * green
                    near_total[k, 2] += weights[k] * blue
            for k in range(8):
                for j in range(3):
                    fine_sums[f, k, j] = near_total[k, j]
        for k in range(8):
            for h in range(9):
                for j in range(3):
                    coarse_sums[c, k, 3 * h + j] = total[j, 9 * k + h]


@kernel(fast=True)
def diagonal(
    begin: int,
    end: int,
    coarse_starts: Any,
    fine_starts: Any,
    places: Any,
    sub_places: Any,
    directions: Any,
    fine_sums: Any,
    coarse_sums: Any,
) -> None:
    """Write the diagonal of ``A^T A`` by cell and corner: (f, 8, 1) and (c, 8, 9)."""
    weights = np.empty(8, np.float32)
    basis = np.empty(9, np.float32)
    wide = np.empty(8, np.float32)
    quarter = np.float32(0.25)
    for c in range(begin, end):
        for k in range(8):
            for h in range(9):
                coarse_sums[c, k, h] = np.float32(0.0)
        for f in range(coarse_starts[c], coarse_starts[c + 1]):
            for k in range(8):
                fine_sums[f, k, 0] = np.float32(0.0)
            for s in range(fine_starts[f], fine_starts[f + 1]):
                x, y, z = places[s, 0], places[s, 1], places[s, 2]
                _corner_weights(x, y, z, weights)
                _corner_weights(
                    sub_places[f, 0] + quarter * x,
                    sub_places[f, 1] + quarter * y,
                    sub_places[f, 2] + quarter * z,
                    wide,
                )
                _harmonics(directions[s, 0], directions[s, 1], directions[s, 2], basis)
                for k in range(8):
                    fine_sums[f, k, 0] += weights[k] * weights[k]
                    for h in range(9):
                        coarse_sums[c, k, h] += (wide[k] * basis[h]) ** 2


@kernel(fast=True)
def gather(begin: int, end: int, incident: Any, sums: Any, out: Any) -> None:
    """Add up the parts (8 c, m) of the cells around each vertex from begin to end, into (v, m)."""
    for v in range(begin, end):
        for j in range(out.shape[1]):
            out[v, j] = np.float32(0.0)
        for k in range(8):
            at = incident[v, k]
            if at >= 0:
                for j in range(out.shape[1]):
                    out[v, j] += sums[at, j]


@kernel(fast=True)
def field_colors(
    begin: int,
    end: int,
    fine_vertices: Any,
    coarse_vertices: Any,
    places: Any,
    coarse_places: Any,
    directions: Any,
    fine: Any,
    coarse: Any,
    out: Any,
) -> None:
    """Write the colours (n, 3) at points whose corners are given, -1 where there is no vertex.

    A missing fine vertex has the value 0; missing coarse ones leave their weight to the others.
    """
    weights = np.empty(8, np.float32)
    basis = np.empty(9, np.float32)
    for s in range(begin, end):
        red = green = blue = np.float32(0.0)
        _corner_weights(coarse_places[s, 0], coarse_places[s, 1], coarse_places[s, 2], weights)
        _harmonics(directions[s, 0], directions[s, 1], directions[s, 2], basis)
        present = np.float32(0.0)
        for k in range(8):
            vertex = coarse_vertices[s, k]
            if vertex >= 0:
                w = weights[k]
                present += w
                for h in range(9):
                    red += w * basis[h] * coarse[vertex, 3 * h]
                    green += w * basis[h] * coarse[vertex, 3 * h + 1]
                    blue += w * basis[h] * coarse[vertex, 3 * h + 2]
        if present > np.float32(0.0):
            red, green, blue = red / present, green / present, blue / present
        _corner_weights(places[s, 0], places[s, 1], places[s, 2], weights)
        for k in range(8):
            vertex = fine_vertices[s, k]
            if vertex >= 0:
                red += weights[k] * fine[vertex, 0]
                green += weights[k] * fine[vertex, 1]
                blue += weights[k] * fine[vertex, 2]
        out[s, 0], out[s, 1], out[s, 2] = red, green, blue
