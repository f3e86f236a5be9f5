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
    origin: np.ndarray | None = None
    """(3,) float64: the point that is mapped to 0, where it is known. It is subtracted first, so
    that points near it keep the digits that a huge translation would take from them."""

    def points(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 3) points; float64 in, float64 out."""
        points = np.asarray(points, np.float64)
        if self.origin is not None:
            return self.scale * ((points - self.origin) @ self.rotation.T)
        return self.scale * (points @ self.rotation.T) + self.translation

    def directions(self, directions: np.ndarray) -> np.ndarray:
        """Rotate (n, 3) directions; lengths stay."""
        return np.asarray(directions, np.float64) @ self.rotation.T

    def inverse(self) -> Similarity:
        """Return the inverse transform; twice gives the translation bit for bit."""
        rotation = self.rotation.T
        if self.origin is not None:
            return Similarity(1.0 / self.scale, rotation, self.origin)
        translation = -(rotation @ self.translation) / self.scale
        return Similarity(1.0 / self.scale, rotation, translation, self.translation)

    def after(self, first: Similarity) -> Similarity:
        """Return the composition that applies ``first``, then this transform."""
        return Similarity(
            self.scale * first.scale,
            self.rotation @ first.rotation,
            self.points(first.translation[None])[0],
        )

    def matrix(self) -> np.ndarray:
        """Return the (4, 4) float64 matrix; not finite where numbers are too large."""
        matrix = np.eye(4)
        with np.errstate(over="ignore", invalid="ignore"):
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
        """Build from :meth:`to_json`'s values.

        Raises
        ------
        KeyError, TypeError, ValueError
            An entry is missing, of another kind, or beyond float64.
        """
        try:
            return cls(
                float(values["scale"]),
                np.asarray(values["rotation"], np.float64).reshape(3, 3),
                np.asarray(values["translation"], np.float64).reshape(3),
            )
        except OverflowError:
            raise ValueError("a number is too large") from None
