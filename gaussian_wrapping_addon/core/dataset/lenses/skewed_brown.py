# SPDX-License-Identifier: GPL-3.0-or-later
"""Brown's polynomial with k4 and skew: project and unproject, as pycolmap's cameras do.

With ``r`` the length of the ray's slope (x, y): ``x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) +
2 p1 x y + p2 (r^2 + 2 x^2)`` and y' likewise with p1 and p2 swapped; ``u = fx x' + skew y' + cx``,
``v = fy y' + cy``. See docs/method.md, section 1.2.
"""

from __future__ import annotations

import numpy as np

from ..readers.source_model import LensCamera

_STEPS = 50
_SHORTEST_STEP = 1e-13
"""Of Newton's method, in slope: rounding ends it."""
_MISS = 1e-9
"""Largest miss of a solution, in slope: far below a pixel at any focal length."""


class SkewedBrown:
    """Projection of a :data:`~..readers.source_model.SKEWED_BROWN` camera."""

    def __init__(self, camera: LensCamera) -> None:
        self._fx, self._fy, self._cx, self._cy, self._skew, *self._terms = camera.params
        k1, k2, k3, k4 = self._terms[:4]
        # Slopes up to here bend outwards; the polynomial folds back beyond.
        turns = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        squares = turns.real[(np.abs(turns.imag) < 1e-12) & (turns.real > 0)]
        self._reach2 = float(squares.min()) if squares.size else np.inf

    def img_from_cam(self, rays: np.ndarray) -> np.ndarray:
        """Return (n, 2) pixels of (n, 3) rays in front of the camera."""
        slopes = np.asarray(rays, np.float64)
        bent, _ = self._bent(slopes[:, :2] / slopes[:, 2:])
        x, y = bent[:, 0], bent[:, 1]
        u = self._fx * x + self._skew * y + self._cx
        return np.stack([u, self._fy * y + self._cy], 1)

    def cam_from_img(self, pixels: np.ndarray) -> np.ndarray:
        """Return (n, 2) slopes of (n, 2) pixels; NaN where no ray short of the fold reaches."""
        pixels = np.asarray(pixels, np.float64)
        y = (pixels[:, 1] - self._cy) / self._fy
        target = np.stack([(pixels[:, 0] - self._cx - self._skew * y) / self._fx, y], 1)
        slopes = target.copy()
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(_STEPS):
                bent, slope = self._bent(slopes)
                a, b, d = slope[:, 0], slope[:, 1], slope[:, 2]
                miss = bent - target
                determinant = a * d - b * b
                step_x = (d * miss[:, 0] - b * miss[:, 1]) / determinant
                step_y = (a * miss[:, 1] - b * miss[:, 0]) / determinant
                step = np.stack([step_x, step_y], 1)
                slopes = slopes - step
                if not (np.abs(step) > _SHORTEST_STEP).any():
                    break
            bent, _ = self._bent(slopes)
            # As with a pixel that no ray reaches: the caller moves it towards the middle.
            found = (np.abs(bent - target).max(1) < _MISS) & ((slopes**2).sum(1) < self._reach2)
            slopes[~found] = np.nan
        return slopes

    def _bent(self, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (n, 2) distorted slopes and (n, 3) derivatives xx, xy = yx, yy."""
        k1, k2, k3, k4, p1, p2 = self._terms
        x, y = slopes[:, 0], slopes[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        growth = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * 4.0 * k4)))
        bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        bent_y = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
        xx = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + growth * y * y + 2.0 * p2 * x + 6.0 * p1 * y
        xy = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        return np.stack([bent_x, bent_y], 1), np.stack([xx, xy, yy], 1)
