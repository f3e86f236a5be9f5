# SPDX-License-Identifier: GPL-3.0-or-later
"""Fisheye lenses of other programs as COLMAP's models."""

from __future__ import annotations

from ..source_model import LensCamera


def fisheye_lens(
    width: int,
    height: int,
    focal: tuple[float, float],
    center: tuple[float, float],
    k: tuple[float, float, float, float],
    p: tuple[float, float] = (0.0, 0.0),
) -> LensCamera:
    """Return an equidistant fisheye: OPENCV_FISHEYE, or THIN_PRISM_FISHEYE where it is decentred.

    ``k`` are the coefficients of the angle's powers 3, 5, 7 and 9, ``p`` the tangential ones as of
    OpenCV, applied to the ray's direction at a length of its angle.
    """
    if not any(p):
        return LensCamera("OPENCV_FISHEYE", width, height, (*focal, *center, *k))
    params = (*focal, *center, k[0], k[1], *p, k[2], k[3], 0.0, 0.0)
    return LensCamera("THIN_PRISM_FISHEYE", width, height, params)
