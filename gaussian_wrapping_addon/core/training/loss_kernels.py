# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled rows of the losses: absolute colour error, normals of a depth map, their agreement."""

from __future__ import annotations

import math

from ..compiled import kernel

MIN_NORMAL_SQ = 1e-30
"""Cross products whose squared length (scene units^4) is below this give no normal."""


@kernel(fast=True)
def color_error_rows(begin, end, image, photo, mask, factor, gradient, absolute, squared):  # type: ignore[no-untyped-def]
    """L1 over rows [begin, end), with its gradient.

    Parameters
    ----------
    image, photo : (h, 3 w) float
        Interleaved colours.
    mask : (h, w) bool, or (0, 0) for none
    factor : float
        What a value contributes to the loss per unit of absolute error.
    gradient : (h, 3 w) float
        Added to.
    absolute, squared : (h,) float64
        Written: sums over the row.
    """
    width = image.shape[1]
    kind = image.dtype.type
    step = kind(factor)
    zero = kind(0.0)
    masked = mask.shape[0] > 0
    for row in range(begin, end):
        x, y, out = image[row], photo[row], gradient[row]
        total, total_sq = 0.0, 0.0
        for j in range(width):
            difference = x[j] - y[j]
            if masked and not mask[row, j // 3]:
                difference = zero
            total += abs(difference)
            total_sq += difference * difference
            if difference > zero:
                out[j] += step
            elif difference < zero:
                out[j] -= step
        absolute[row] = total
        squared[row] = total_sq


@kernel(fast=False)
def normal_rows(begin, end, depth, camera, max_jump, normals, valid, inverse_length):  # type: ignore[no-untyped-def]
    """Camera-frame normals of the surface z = depth, rows [begin, end) (method.md 2.8).

    Parameters
    ----------
    depth : (h, w) float
        z-depth; <= 0 where there is none.
    camera : (4,) float64
        fx, fy, cx, cy.
    max_jump : float
        Where opposite neighbours differ by more than this share of the depth, there is no normal;
        0 switches the test off.
    normals : (h, w, 3), valid : (h, w) bool, inverse_length : (h, w)
        Written. The inverse length of the cross product is what the gradient needs.
    """
    height, width = depth.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for i in range(begin, end):
        for j in range(width):
            valid[i, j] = False
            normals[i, j, 0] = normals[i, j, 1] = normals[i, j, 2] = 0.0
            if i == 0 or j == 0 or i == height - 1 or j == width - 1:
                continue
            here, up, down = depth[i, j], depth[i - 1, j], depth[i + 1, j]
            left, right = depth[i, j - 1], depth[i, j + 1]
            if not (here > 0 and up > 0 and down > 0 and left > 0 and right > 0):
                continue
            if max_jump > 0 and (
                abs(down - up) > max_jump * here or abs(right - left) > max_jump * here
            ):
                continue
            x, y = (j + 0.5 - cx) / fx, (i + 0.5 - cy) / fy
            # a: along the column of pixels, downwards; b: along the row, to the right.
            a0, a1, a2 = x * (down - up), y * (down - up) + (down + up) / fy, down - up
            b0, b1, b2 = x * (right - left) + (right + left) / fx, y * (right - left), right - left
            c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            length_sq = c0 * c0 + c1 * c1 + c2 * c2
            if not length_sq > MIN_NORMAL_SQ:
                continue
            inverse = 1.0 / math.sqrt(length_sq)
            normals[i, j, 0] = c0 * inverse
            normals[i, j, 1] = c1 * inverse
            normals[i, j, 2] = c2 * inverse
            inverse_length[i, j] = inverse
            valid[i, j] = True


@kernel(fast=False)
def agreement_rows(  # type: ignore[no-untyped-def]
    begin, end, depth, camera, rotation, mask, geometric, learned, alpha, normals, valid,
    inverse_length, weight_geometric, weight_learned, losses,
    by_geometric, by_learned, by_alpha, by_neighbour,
):  # fmt: skip
    """Disagreement of blended normals with the depth's normals, rows [begin, end), and gradients.

    Parameters
    ----------
    rotation : (3, 3) float64
        Camera from scene.
    geometric, learned : (h, w, 3)
        Blended normals, scene frame; the geometric ones are divided by ``alpha`` here.
    normals, valid, inverse_length
        What :func:`normal_rows` wrote.
    weight_geometric, weight_learned : float
        What one pixel contributes to the loss per unit of ``1 - cos``.
    losses : (h, 2) float64
        Written: sums of ``1 - cos`` over the row, geometric and learned.
    by_geometric, by_learned : (h, w, 3), by_alpha : (h, w)
        Written: gradients.
    by_neighbour : (4, h, w)
        Written: gradients with respect to the depth of the pixel above, below, left and right.
    """
    width = depth.shape[1]
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    masked = mask.shape[0] > 0
    for i in range(begin, end):
        total_geometric, total_learned = 0.0, 0.0
        for j in range(width):
            by_alpha[i, j] = 0.0
            for k in range(3):
                by_geometric[i, j, k] = 0.0
                by_learned[i, j, k] = 0.0
            for k in range(4):
                by_neighbour[k, i, j] = 0.0
            if not valid[i, j] or (masked and not mask[i, j]) or not alpha[i, j] > 0:
                continue
            n0, n1, n2 = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
            # The depth's normal in the scene frame.
            s0 = rotation[0, 0] * n0 + rotation[1, 0] * n1 + rotation[2, 0] * n2
            s1 = rotation[0, 1] * n0 + rotation[1, 1] * n1 + rotation[2, 1] * n2
            s2 = rotation[0, 2] * n0 + rotation[1, 2] * n1 + rotation[2, 2] * n2
            cover = 1.0 / alpha[i, j]
            g0, g1, g2 = geometric[i, j, 0], geometric[i, j, 1], geometric[i, j, 2]
            l0, l1, l2 = learned[i, j, 0], learned[i, j, 1], learned[i, j, 2]
            cos_geometric = (g0 * s0 + g1 * s1 + g2 * s2) * cover
            total_geometric += 1.0 - cos_geometric
            total_learned += 1.0 - (l0 * s0 + l1 * s1 + l2 * s2)
            share = weight_geometric * cover
            by_alpha[i, j] = weight_geometric * cos_geometric * cover
            by_geometric[i, j, 0] = -share * s0
            by_geometric[i, j, 1] = -share * s1
            by_geometric[i, j, 2] = -share * s2
            by_learned[i, j, 0] = -weight_learned * s0
            by_learned[i, j, 1] = -weight_learned * s1
            by_learned[i, j, 2] = -weight_learned * s2
            # Gradient with respect to the normal, back in the camera frame.
            t0 = -share * g0 - weight_learned * l0
            t1 = -share * g1 - weight_learned * l1
            t2 = -share * g2 - weight_learned * l2
            u0 = rotation[0, 0] * t0 + rotation[0, 1] * t1 + rotation[0, 2] * t2
            u1 = rotation[1, 0] * t0 + rotation[1, 1] * t1 + rotation[1, 2] * t2
            u2 = rotation[2, 0] * t0 + rotation[2, 1] * t1 + rotation[2, 2] * t2
            along = n0 * u0 + n1 * u1 + n2 * u2
            inverse = inverse_length[i, j]
            c0 = (u0 - n0 * along) * inverse
            c1 = (u1 - n1 * along) * inverse
            c2 = (u2 - n2 * along) * inverse
            x, y = (j + 0.5 - cx) / fx, (i + 0.5 - cy) / fy
            up, down = depth[i - 1, j], depth[i + 1, j]
            left, right = depth[i, j - 1], depth[i, j + 1]
            a0, a1, a2 = x * (down - up), y * (down - up) + (down + up) / fy, down - up
            b0, b1, b2 = x * (right - left) + (right + left) / fx, y * (right - left), right - left
            # d(a x b) . c = da . (b x c) + db . (c x a)
            p0, p1, p2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
            q0, q1, q2 = c1 * a2 - c2 * a1, c2 * a0 - c0 * a2, c0 * a1 - c1 * a0
            ray_p, ray_q = x * p0 + y * p1 + p2, x * q0 + y * q1 + q2
            by_neighbour[0, i, j] = p1 / fy - ray_p
            by_neighbour[1, i, j] = p1 / fy + ray_p
            by_neighbour[2, i, j] = q0 / fx - ray_q
            by_neighbour[3, i, j] = q0 / fx + ray_q
        losses[i, 0] = total_geometric
        losses[i, 1] = total_learned


@kernel(fast=False)
def gather_depth_rows(begin, end, by_neighbour, by_depth):  # type: ignore[no-untyped-def]
    """Sum what the four neighbours of each pixel of rows [begin, end) say about its depth."""
    height, width = by_depth.shape
    for i in range(begin, end):
        for j in range(width):
            total = by_depth.dtype.type(0.0)
            if i + 1 < height:
                total += by_neighbour[0, i + 1, j]
            if i > 0:
                total += by_neighbour[1, i - 1, j]
            if j + 1 < width:
                total += by_neighbour[2, i, j + 1]
            if j > 0:
                total += by_neighbour[3, i, j - 1]
            by_depth[i, j] = total
