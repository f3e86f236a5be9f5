# SPDX-License-Identifier: GPL-3.0-or-later
"""Numerical tolerances and the constants of the method, in one place.

Lengths are in scene units unless a name says otherwise (camera centres' mean at 0,
radius :data:`SCENE_RADIUS`).
"""

from __future__ import annotations

SCENE_RADIUS = 5.0
"""Scenes are scaled so that 1.1 x the largest camera distance to their mean is this."""

NEAR_Z = 0.04 * SCENE_RADIUS
"""Gaussians whose centre is nearer than this (z-depth) are not rendered (method.md 1.7)."""

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
"""Blending constants (method.md 2.2)."""

ISO_LEVEL = 0.5
DEPTH_VALID_TRANSMITTANCE = 0.45
"""A pixel has an isosurface depth only where the final transmittance is at most this."""

SLOPE_FLOOR = 1e-3
"""Floor of -d(log T)/dt in the depth's gradient, in shares of 1/sigma along the ray
of the Gaussian at which the blending crosses 0.5 (method.md 2.5)."""

TILE_PX = 16

QUATERNION_MIN_NORM = 1e-12
DIRECTION_MIN_NORM = 1e-12
ORIENTED_MIN_NORM = 0.05
"""Normals shorter than this are treated as not oriented (method.md 11, row 17)."""
