# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarity transforms in float64: scale, rotation, translation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Similarity:
    """Map ``x -> scale * rotation @ x + translation``.

    A variable that holds one is named ``target_from_source``.
    """

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3) float64, orthonormal, determinant +1."""
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) float64, units of the target frame."""

    def points(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 3) points; float64 in, float64 out."""
        return self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + self.translation

    def directions(self, directions: np.ndarray) -> np.ndarray:
        """Rotate (n, 3) directions; lengths stay."""
        return np.asarray(directions, np.float64) @ self.rotation.T

    def inverse(self) -> Similarity:
        """Return the inverse transform."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def after(self, first: Similarity) -> Similarity:
        """Return the composition that applies ``first``, then this transform."""
        return Similarity(
            self.scale * first.scale,
            self.rotation @ first.rotation,
            self.points(first.translation[None])[0],
        )

    def matrix(self) -> np.ndarray:
        """Return the (4, 4) float64 matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "scale": float(self.scale),
            "rotation": np.asarray(self.rotation).tolist(),
            "translation": np.asarray(self.translation).tolist(),
        }

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Similarity:
        """Build from :meth:`to_json`'s values."""
        return cls(
            float(values["scale"]),
            np.asarray(values["rotation"], np.float64).reshape(3, 3),
            np.asarray(values["translation"], np.float64).reshape(3),
        )
