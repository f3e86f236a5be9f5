# SPDX-License-Identifier: GPL-3.0-or-later
"""Colour, normal and depth losses with their gradients."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..compiled import inline, kernel, part
from ..image_metrics import compare, has_windows
from ..parallel import ArrayStore, default_threads, run_rows
from ..render.types import ImageGradients, VisibleGradients
from ..scene.camera import Camera
from ..stereo.depth_maps import DepthPrior

# -- Opacity prior: what photos leave open is opaque ----------------------------------------------

FAINT, SURE = 0.2, 0.5
"""Opacity up to which a Gaussian is left to the photos, and from which the prior counts fully."""


def add_opacity_prior(
    gradients: VisibleGradients, opacity_logits: np.ndarray, shares: np.ndarray, weight: float
) -> float:
    """Add the gradient of ``-weight`` times the mean prior of the Gaussians over a pixel.

    A thin dark rod before a lawn looks the same as a darker one that is half transparent: photos
    alone leave its opacity open, and where that is below 0.5 there is no surface. Things are
    opaque, so the opaque one is taken. See docs/method.md, section 3.7.

    Parameters
    ----------
    gradients : VisibleGradients
        The gradient is added to ``opacity_logits``, but for Gaussians whose opacity no pixel asks
        about.
    opacity_logits : (n,) float32
        Raw, of all Gaussians.
    shares : (v,) float32
        Of the Gaussians that the gradient belongs to (:func:`footprint_shares`).
    weight : float
        Setting ``lambda_opacity``.

    Returns
    -------
    float
        Mean over the pixels of the sum over Gaussians of ``4 k(o)``, where ``k`` is the integral of
        a ramp from 0 at :data:`FAINT` to 1 at :data:`SURE`.
    """
    # The optimizer takes a 0 for a Gaussian not seen.
    area = shares * (gradients.opacity_logits != 0.0)
    opacity = 1.0 / (1.0 + np.exp(-opacity_logits[gradients.ids]))
    ramp = np.clip((opacity - FAINT) / (SURE - FAINT), 0.0, 1.0)
    gradients.opacity_logits[...] -= 4.0 * weight * area * ramp * opacity * (1.0 - opacity)
    integral = 0.5 * (SURE - FAINT) * ramp**2 + np.maximum(opacity - SURE, 0.0)
    return float(4.0 * (area * integral).sum())


# -- Footprint regulariser: penalise the mean number of Gaussians that overlap a pixel ------------


def footprint_shares(boxes: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Return the share of an image that lies in each Gaussian's box, (v,) float32.

    ``boxes`` (v, 4) float32 are footprints on the screen: x0, y0, x1, y1 in pixels. ``size_px`` is
    the width and height of the image; area outside it does not count.
    """
    width, height = size_px
    box = np.clip(boxes, 0.0, np.array([width, height, width, height], np.float32))  # (v, 4)
    area = (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1])  # (v,)
    return area / np.float32(width * height)


def add_footprint_regulariser(
    gradients: VisibleGradients, log_scales: np.ndarray, shares: np.ndarray, weight: float
) -> float:
    """Add the gradient of ``weight`` times the mean number of Gaussians over a pixel; return it.

    Blending costs time for every Gaussian whose footprint contains a pixel, visible or occluded.
    Photos alone do not penalise this: half-transparent layers that overlap a hundredfold look the
    same as a few small opaque ones, but take longer and have no surface. The footprint is the box
    on the screen; its area grows with the square of the scale, and the gradient is distributed over
    the axes by their squares. The weight is the setting ``overlap_price``.

    Parameters
    ----------
    gradients : VisibleGradients
        The gradient is added to ``log_scales``.
    log_scales : (n, 3) float32
        Raw, of all Gaussians.
    shares : (v,) float32
        Of the Gaussians that the gradient belongs to (:func:`footprint_shares`).
    """
    squares = np.exp(2.0 * log_scales[gradients.ids])  # (v, 3)
    squares *= (2.0 * weight * shares / squares.sum(1))[:, None]
    gradients.log_scales[...] += squares
    return float(shares.sum())


# -- Loss on rendered depths that leave those that stereo confirmed (docs/method.md, section 3.6)

TOLERANCE_SHARE = 0.01
"""Relative difference in depth up to which the loss is quadratic; beyond, it is linear."""

OUTLIER_SHARE = 0.03
"""Relative difference from which the photos are believed: stereo misses what is thin."""

NO_MASK = np.zeros((0, 0), np.bool_)


def kernel_mask(mask: np.ndarray | None) -> np.ndarray:
    """Return a mask as kernels take it: contiguous (h, w) bool, or (0, 0) for none."""
    return NO_MASK if mask is None else np.ascontiguousarray(mask, np.bool_)


@kernel(fast=False, fused=True)
def _prior_rows(
    begin: int, end: int, depth: np.ndarray, lens: np.ndarray, prior: np.ndarray,
    confidence: np.ndarray, prior_lens: np.ndarray, mask: np.ndarray, weight: float,
    sums: np.ndarray, by_depth: np.ndarray,
) -> None:  # fmt: skip
    """Add the loss of each row to ``sums`` (h,) and write its gradient by the depth (h, w).

    ``lens`` and ``prior_lens`` are (4,): fx, fy, cx, cy.
    """
    last_row, last_column = prior.shape[0] - 1, prior.shape[1] - 1
    for row in range(begin, end):
        y = (row + 0.5 - lens[3]) / lens[1] * prior_lens[1] + prior_lens[3]
        prior_row = min(max(int(y), 0), last_row)
        total = 0.0
        for column in range(depth.shape[1]):
            by_depth[row, column] = 0.0
            x = (column + 0.5 - lens[2]) / lens[0] * prior_lens[0] + prior_lens[2]
            prior_column = min(max(int(x), 0), last_column)
            there = float(prior[prior_row, prior_column])
            here = float(depth[row, column])
            if not (there > 0.0 and here > 0.0):
                continue
            if mask.shape[0] > 0 and not mask[row, column]:
                continue
            off = (here - there) / there
            if abs(off) >= OUTLIER_SHARE:
                continue
            trust = weight * confidence[prior_row, prior_column]
            off /= TOLERANCE_SHARE
            if abs(off) < 1.0:
                total += trust * 0.5 * off * off
                slope = off
            else:
                total += trust * (abs(off) - 0.5)
                slope = 1.0 if off > 0.0 else -1.0
            by_depth[row, column] = trust * slope / (TOLERANCE_SHARE * there)
        sums[row] = total


def depth_prior_loss(
    depth: np.ndarray, camera: Camera, prior: DepthPrior, mask: np.ndarray | None = None, *,
    weight: float, threads: int = 0, store: ArrayStore | None = None,
) -> tuple[float, ImageGradients]:  # fmt: skip
    """Return ``weight mean(c h(|d / d_prior - 1| / 0.01))`` and its gradient on the depth.

    Parameters
    ----------
    depth : (h, w) float32 or float64
        Rendered z-depth; <= 0 where there is none.
    camera : Camera
        Of the rendered image, or window of an image, at the prior's pose.
    prior : DepthPrior
        Of any size; the nearest pixel counts, as interpolation would join what edges separate.
    mask : (h, w) bool, optional
        False pixels count in no term.
    """
    store = store or ArrayStore()
    depth = np.ascontiguousarray(depth)
    by_depth = store.take("by depth of the prior", depth.shape, depth.dtype)
    flat_mask = kernel_mask(mask)
    pixels = max(1, depth.size if mask is None else int(np.count_nonzero(flat_mask)))
    sums = np.zeros(len(depth))
    run_rows(
        _prior_rows, len(depth), threads, depth, lens_of(camera), prior.depth, prior.confidence,
        lens_of(prior.camera), flat_mask, weight / pixels, sums, by_depth, chunks=1,
    )  # fmt: skip
    return float(sums.sum()), ImageGradients(depth=by_depth)


def lens_of(camera: Camera) -> np.ndarray:
    """Return fx, fy, cx, cy of a camera, (4,) float64."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


# -- Compiled normal losses: normals of a depth map and their agreement with blended normals ------

MIN_NORMAL_SQ = 1e-30
"""Cross products whose squared length (scene units^4) is below this give no normal."""

BLOCK_PX = 256
"""Columns per block, so that its planes fit into the L1 cache."""

_PLANE = BLOCK_PX + 16
# Planes of a block. Constant offsets in one array let LLVM see that they do not overlap.
_HERE, _UP, _DOWN, _ALPHA, _KEEP = 0, _PLANE, 2 * _PLANE, 3 * _PLANE, 4 * _PLANE
_GEOMETRIC, _LEARNED = 5 * _PLANE, 8 * _PLANE  # three planes each
_BY_GEOMETRIC, _BY_LEARNED = 11 * _PLANE, 14 * _PLANE
_BY_ALPHA, _BY_UP, _BY_DOWN, _BY_LEFT, _BY_RIGHT = (k * _PLANE for k in range(17, 22))
_PLANES = 22


@inline
def _edges(x: Any, y: Any, fx: Any, fy: Any, up: Any, down: Any, left: Any, right: Any) -> Any:
    """Differences of back-projected neighbours, along the column and along the row.

    ``x``, ``y``: the pixel's ray; ``fx``, ``fy``: 1 / focal length in pixels.
    """
    high, wide = down - up, right - left
    return (
        x * high, y * high + (down + up) * fy, high,
        x * wide + (right + left) * fx, y * wide, wide,
    )  # fmt: skip


@inline
def _cross(a0: Any, a1: Any, a2: Any, b0: Any, b1: Any, b2: Any) -> Any:
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@kernel(fast=False)
def normal_rows(begin, end, depth, camera, max_jump, normals, valid):  # type: ignore[no-untyped-def]
    """Compute camera-frame normals of the surface z = depth, rows [begin, end).

    See docs/method.md, section 2.8.

    Parameters
    ----------
    depth : (h, w) float
        z-depth; <= 0 where there is none.
    camera : (4,) float64
        fx, fy, cx, cy.
    max_jump : float
        No normal where opposite neighbours differ by more than this share of the depth; 0
        disables the test.
    normals : (h, w, 3), valid : (h, w) bool
        Written.
    """
    height, width = depth.shape
    fx, fy, cx, cy = 1.0 / camera[0], 1.0 / camera[1], camera[2], camera[3]
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
            x, y = (j + 0.5 - cx) * fx, (i + 0.5 - cy) * fy
            a0, a1, a2, b0, b1, b2 = _edges(x, y, fx, fy, up, down, left, right)
            c0, c1, c2 = _cross(a0, a1, a2, b0, b1, b2)
            length_sq = c0 * c0 + c1 * c1 + c2 * c2
            if not length_sq > MIN_NORMAL_SQ:
                continue
            inverse = 1.0 / math.sqrt(length_sq)
            normals[i, j, 0] = c0 * inverse
            normals[i, j, 1] = c1 * inverse
            normals[i, j, 2] = c2 * inverse
            valid[i, j] = True


@part(fast=True)
def _load_planes(row, first, count, depth, alpha, mask, geometric, learned, planes):  # type: ignore[no-untyped-def]
    """Copy ``count`` pixels of a row and its neighbours to planes; masked and border pixels get a
    keep flag of 0."""
    width = depth.shape[1]
    one, zero = planes.dtype.type(1.0), planes.dtype.type(0.0)
    here, up, down = depth[row], depth[row - 1, first:], depth[row + 1, first:]
    cover = alpha[row, first:]
    normals, others = geometric[row, 3 * first :], learned[row, 3 * first :]
    planes[_HERE] = here[first - 1] if first > 0 else zero
    planes[_HERE + 1 + count] = here[first + count] if first + count < width else zero
    middle = here[first:]
    for j in range(count):
        planes[_HERE + 1 + j] = middle[j]
    for j in range(count):
        planes[_UP + j] = up[j]
        planes[_DOWN + j] = down[j]
    for j in range(count):
        planes[_ALPHA + j] = cover[j]
        planes[_KEEP + j] = one
    for j in range(count):
        planes[_GEOMETRIC + j] = normals[3 * j]
        planes[_GEOMETRIC + _PLANE + j] = normals[3 * j + 1]
        planes[_GEOMETRIC + 2 * _PLANE + j] = normals[3 * j + 2]
    for j in range(count):
        planes[_LEARNED + j] = others[3 * j]
        planes[_LEARNED + _PLANE + j] = others[3 * j + 1]
        planes[_LEARNED + 2 * _PLANE + j] = others[3 * j + 2]
    if mask.shape[0] > 0:
        for j in range(count):
            planes[_KEEP + j] = one if mask[row, first + j] else zero
    if first == 0:
        planes[_KEEP] = zero
    if first + count == width:
        planes[_KEEP + count - 1] = zero


@part(fast=True)
def _agree(  # type: ignore[no-untyped-def]
    first, count, y, camera, rotation, max_jump, weight_geometric, weight_learned, planes
):
    """Compute losses and gradients of ``count`` pixels; return the sums of ``1 - cos`` and the
    number of pixels with a normal."""
    kind = planes.dtype.type
    zero, half, one = kind(0.0), kind(0.5), kind(1.0)
    fx, fy, cx = kind(1.0 / camera[0]), kind(1.0 / camera[1]), kind(camera[2])
    row_y, jump = kind(y), kind(max_jump if max_jump > 0.0 else 1e30)
    w_geometric, w_learned = kind(weight_geometric), kind(weight_learned)
    r00, r01, r02 = kind(rotation[0, 0]), kind(rotation[0, 1]), kind(rotation[0, 2])
    r10, r11, r12 = kind(rotation[1, 0]), kind(rotation[1, 1]), kind(rotation[1, 2])
    r20, r21, r22 = kind(rotation[2, 0]), kind(rotation[2, 1]), kind(rotation[2, 2])
    least = kind(MIN_NORMAL_SQ)
    total_geometric, total_learned, found = zero, zero, zero
    for j in range(count):
        left, here, right = planes[_HERE + j], planes[_HERE + 1 + j], planes[_HERE + 2 + j]
        up, down, alpha = planes[_UP + j], planes[_DOWN + j], planes[_ALPHA + j]
        x = (kind(first + j) + half - cx) * fx
        a0, a1, a2, b0, b1, b2 = _edges(x, row_y, fx, fy, up, down, left, right)
        c0, c1, c2 = _cross(a0, a1, a2, b0, b1, b2)
        length_sq = c0 * c0 + c1 * c1 + c2 * c2
        nearest = min(
            min(min(up, down), min(left, right)), min(min(here, alpha), planes[_KEEP + j])
        )
        spread = max(abs(a2), abs(b2))
        valid = (nearest > zero) & (spread <= jump * here) & (length_sq > least)
        inverse = one / np.sqrt(length_sq if valid else one)
        cover = one / (alpha if valid else one)
        used = one if valid else zero
        n0, n1, n2 = c0 * inverse, c1 * inverse, c2 * inverse
        # The depth's normal in the scene frame.
        s0 = r00 * n0 + r10 * n1 + r20 * n2
        s1 = r01 * n0 + r11 * n1 + r21 * n2
        s2 = r02 * n0 + r12 * n1 + r22 * n2
        g0, g1 = planes[_GEOMETRIC + j], planes[_GEOMETRIC + _PLANE + j]
        g2 = planes[_GEOMETRIC + 2 * _PLANE + j]
        l0, l1 = planes[_LEARNED + j], planes[_LEARNED + _PLANE + j]
        l2 = planes[_LEARNED + 2 * _PLANE + j]
        cos_geometric = (g0 * s0 + g1 * s1 + g2 * s2) * cover
        cos_learned = l0 * s0 + l1 * s1 + l2 * s2
        found += used
        total_geometric += used * (one - cos_geometric)
        total_learned += used * (one - cos_learned)
        share, learned = used * w_geometric * cover, used * w_learned
        planes[_BY_ALPHA + j] = share * cos_geometric
        planes[_BY_GEOMETRIC + j] = -share * s0
        planes[_BY_GEOMETRIC + _PLANE + j] = -share * s1
        planes[_BY_GEOMETRIC + 2 * _PLANE + j] = -share * s2
        planes[_BY_LEARNED + j] = -learned * s0
        planes[_BY_LEARNED + _PLANE + j] = -learned * s1
        planes[_BY_LEARNED + 2 * _PLANE + j] = -learned * s2
        # Gradient with respect to the normal, back in the camera frame.
        t0, t1, t2 = share * g0 + learned * l0, share * g1 + learned * l1, share * g2 + learned * l2
        u0 = -(r00 * t0 + r01 * t1 + r02 * t2)
        u1 = -(r10 * t0 + r11 * t1 + r12 * t2)
        u2 = -(r20 * t0 + r21 * t1 + r22 * t2)
        along = n0 * u0 + n1 * u1 + n2 * u2
        d0, d1, d2 = u0 - n0 * along, u1 - n1 * along, u2 - n2 * along
        d0, d1, d2 = d0 * inverse, d1 * inverse, d2 * inverse
        # d(a x b) . d = da . (b x d) + db . (d x a)
        p0, p1, p2 = _cross(b0, b1, b2, d0, d1, d2)
        q0, q1, q2 = _cross(d0, d1, d2, a0, a1, a2)
        ray_p, ray_q = x * p0 + row_y * p1 + p2, x * q0 + row_y * q1 + q2
        planes[_BY_UP + j] = p1 * fy - ray_p
        planes[_BY_DOWN + j] = p1 * fy + ray_p
        planes[_BY_LEFT + j] = q0 * fx - ray_q
        planes[_BY_RIGHT + j] = q0 * fx + ray_q
    return total_geometric, total_learned, found


@part(fast=True)
def _store_planes(first, count, planes, by_geometric, by_learned, by_alpha):  # type: ignore[no-untyped-def]
    """Write the gradients on the normals and alpha of ``count`` pixels to a row of the images."""
    normals, others, cover = by_geometric[3 * first :], by_learned[3 * first :], by_alpha[first:]
    for j in range(count):
        normals[3 * j] = planes[_BY_GEOMETRIC + j]
        normals[3 * j + 1] = planes[_BY_GEOMETRIC + _PLANE + j]
        normals[3 * j + 2] = planes[_BY_GEOMETRIC + 2 * _PLANE + j]
    for j in range(count):
        others[3 * j] = planes[_BY_LEARNED + j]
        others[3 * j + 1] = planes[_BY_LEARNED + _PLANE + j]
        others[3 * j + 2] = planes[_BY_LEARNED + 2 * _PLANE + j]
    for j in range(count):
        cover[j] = planes[_BY_ALPHA + j]


@part(fast=True)
def _spread_planes(first, count, planes, by_up, by_down, by_here):  # type: ignore[no-untyped-def]
    """Write the gradients of ``count`` pixels on the depths above and below; add those on the
    depths beside them, one index to the right because ``by_here`` begins a pixel early."""
    up, down, here = by_up[first:], by_down[first:], by_here[first:]
    for j in range(count):
        up[j] = planes[_BY_UP + j]
        down[j] = planes[_BY_DOWN + j]
    for j in range(count):
        here[j] += planes[_BY_LEFT + j]
    for j in range(count):
        here[j + 2] += planes[_BY_RIGHT + j]


@part(fast=True)
def _sum_rows(count, above, below, here, out):  # type: ignore[no-untyped-def]
    for j in range(count):
        out[j] = above[j] + below[j] + here[1 + j]


@kernel(fast=True)
def agreement_rows(  # type: ignore[no-untyped-def]
    begin, end, depth, camera, rotation, mask, geometric, learned, alpha, max_jump,
    weight_geometric, weight_learned, sums, by_depth, by_geometric, by_learned, by_alpha,
):  # fmt: skip
    """Compare blended normals with the depth's normals, rows [begin, end), with gradients.

    A strip includes the rows above and below it, whose normals depend on its depth, so that results
    do not depend on where strips begin.

    Parameters
    ----------
    depth, camera, max_jump
        As for :func:`normal_rows`.
    rotation : (3, 3) float64
        Camera from scene.
    mask : (h, w) bool, or (0, 0) for none
    geometric, learned : (h, 3 w)
        Blended normals, scene frame; the geometric ones are divided by ``alpha`` here.
    alpha : (h, w)
    weight_geometric, weight_learned : float
        Loss of one pixel per unit of ``1 - cos``.
    sums : (h, 3) float64
        Written: sums of ``1 - cos`` over the row, geometric and learned, and pixels with a normal.
    by_depth, by_alpha : (h, w), by_geometric, by_learned : (h, 3 w)
        Written: gradients.
    """
    height, width = depth.shape
    kind = depth.dtype.type
    planes = np.zeros(_PLANES * _PLANE, kind)
    # Gradients of the last three rows on the depths above, below and in them.
    by_up, by_down = np.zeros((3, width), kind), np.zeros((3, width), kind)
    by_here = np.zeros((3, width + 2), kind)
    for i in range(begin - 1, end + 1):
        slot = (i + 3) % 3
        by_up[slot] = kind(0.0)
        by_down[slot] = kind(0.0)
        by_here[slot] = kind(0.0)
        inside = 0 < i < height - 1
        total_geometric, total_learned, found = 0.0, 0.0, 0.0
        y = (i + 0.5 - camera[3]) / camera[1]
        for first in range(0, width if inside else 0, BLOCK_PX):
            count = min(BLOCK_PX, width - first)
            _load_planes(i, first, count, depth, alpha, mask, geometric, learned, planes)
            g, o, n = _agree(
                first, count, y, camera, rotation, max_jump, weight_geometric, weight_learned,
                planes,
            )  # fmt: skip
            total_geometric += g
            total_learned += o
            found += n
            if begin <= i < end:
                _store_planes(first, count, planes, by_geometric[i], by_learned[i], by_alpha[i])
            _spread_planes(first, count, planes, by_up[slot], by_down[slot], by_here[slot])
        if begin <= i < end:
            sums[i, 0] = total_geometric
            sums[i, 1] = total_learned
            sums[i, 2] = found
            if not inside:
                by_geometric[i] = kind(0.0)
                by_learned[i] = kind(0.0)
                by_alpha[i] = kind(0.0)
        if i > begin:
            middle, above = (slot + 2) % 3, (slot + 1) % 3
            _sum_rows(width, by_up[slot], by_down[above], by_here[middle], by_depth[i - 1])


# -- Colour and normal losses with their gradients on the rendered images -------------------------
#
# See docs/method.md, section 3.


def color_loss(
    image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None, *,
    lambda_dssim: float = 0.2, threads: int = 0, store: ArrayStore | None = None,
) -> tuple[float, np.ndarray, float]:  # fmt: skip
    """Return ``(1 - lambda) L1 + lambda (1 - SSIM)``, its gradient and the mean squared error.

    See docs/method.md, section 3.1. The loss is 0 if the mask leaves no pixel; the gradient has the
    image's type and, with a ``store``, is valid until the next call.

    Parameters
    ----------
    image : (h, w, 3) float32 or float64
        The render.
    photo : (h, w, 3) uint8, or floats in [0, 1]
    mask : (h, w) bool, optional
        False pixels count in no term.
    lambda_dssim : float
        Weight of the SSIM term; 0 is used if no window of SSIM fits or is unmasked.

    Raises
    ------
    UsageError
        If the shapes differ.
    """
    threads, store = threads or default_threads(), store or ArrayStore()
    if not has_windows(image.shape, mask):
        lambda_dssim = 0.0
    weights = (1.0 - lambda_dssim, -lambda_dssim)
    out = store.take("by color", image.shape, image.dtype)
    found = compare(image, photo, mask, weights=weights, threads=threads, out=out)
    assert found.gradient is not None
    value = (1.0 - lambda_dssim) * found.absolute + lambda_dssim * (1.0 - found.similarity)
    return value, found.gradient, found.squared


def normals_from_depth(
    depth: np.ndarray, camera: Camera, *, max_jump: float = 0.0, threads: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals of a depth map, facing the camera (docs/method.md, section 2.8).

    Cross products of central differences of the back-projected depth.

    Parameters
    ----------
    depth : (h, w)
        z-depth, scene units; <= 0 where there is none.
    camera : Camera
        Camera of the same size.
    max_jump : float
        No normal where opposite neighbours differ by more than this share of the depth; 0 = off.

    Returns
    -------
    normals : (h, w, 3)
        Scene frame, of the depth's float type; 0 where not valid.
    valid : (h, w) bool
        The pixel is not on the border and all five pixels of the cross have depth.
    """
    depth = np.ascontiguousarray(depth)
    local = np.empty((*depth.shape, 3), depth.dtype)  # camera frame
    valid = np.empty(depth.shape, np.bool_)
    given = (depth, lens_of(camera), max_jump, local, valid)
    run_rows(normal_rows, len(depth), threads, *given, chunks=2)
    return local @ camera.rotation.astype(local.dtype), valid


def normal_losses(
    depth: np.ndarray, geometric_normal: np.ndarray, normal: np.ndarray, alpha: np.ndarray,
    camera: Camera, mask: np.ndarray | None = None, *, lambda_depth_normal: float = 0.05,
    lambda_normal: float = 0.03, threads: int = 0,
    store: ArrayStore | None = None,
) -> tuple[float, ImageGradients]:  # fmt: skip
    """Return ``lambda_DN L_DN + lambda_N L_N`` and its gradients on all images but the colour.

    See docs/method.md, sections 3.2 and 3.3.

    ``L_DN = mean(valid (1 - n_geo / alpha . n_depth))`` and ``L_N = mean(valid (1 - N . n_depth))``
    over all pixels of the image (of the mask), with the normals of :func:`normals_from_depth`.
    Gradients flow through all terms; with a ``store``, they are valid until the next call.

    Parameters
    ----------
    depth, alpha : (h, w) float32 or float64
        Rendered images.
    geometric_normal, normal : (h, w, 3), the same type
        Blended normals of the render, scene frame.
    camera : Camera
        Of the same size, scene frame.
    mask : (h, w) bool, optional
        False pixels count in no term.
    """
    store = store or ArrayStore()
    height, width = depth.shape
    z, cover = np.ascontiguousarray(depth), np.ascontiguousarray(alpha)
    geometric = np.ascontiguousarray(geometric_normal).reshape(height, -1)  # (h, 3 w)
    learned = np.ascontiguousarray(normal).reshape(height, -1)
    flat_mask = kernel_mask(mask)
    pixels = max(1, height * width if mask is None else int(np.count_nonzero(flat_mask)))
    sums = np.empty((height, 3))
    by_geometric, by_learned = (
        store.take(name, geometric.shape, geometric.dtype)
        for name in ("by geometric normal", "by normal")
    )
    by_depth, by_alpha = (store.take(name, z.shape, z.dtype) for name in ("by depth", "by alpha"))
    run_rows(
        agreement_rows, height, threads, z, lens_of(camera), np.ascontiguousarray(camera.rotation),
        flat_mask, geometric, learned, cover, 0.0, lambda_depth_normal / pixels,
        lambda_normal / pixels, sums, by_depth, by_geometric, by_learned, by_alpha, chunks=1,
    )  # fmt: skip
    depth_normal, oriented, _ = (sums.sum(0) / pixels).tolist()
    value = lambda_depth_normal * depth_normal + lambda_normal * oriented
    return value, ImageGradients(
        normal=by_learned.reshape(height, width, 3),
        geometric_normal=by_geometric.reshape(height, width, 3), alpha=by_alpha, depth=by_depth,
    )  # fmt: skip
