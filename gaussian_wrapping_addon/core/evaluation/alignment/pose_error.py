# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors of solved camera poses after a similarity alignment of the camera centres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...dataset.camera import Camera
from ...dataset.frames.similarity_fit import umeyama
from ...dataset.similarity import Similarity
from ...errors import DatasetError


@dataclass(frozen=True)
class PoseErrors:
    """Errors of the cameras present in both sets."""

    names: tuple[str, ...]
    center_shares: np.ndarray
    """(n,) distance of the aligned centre from the true one, over the true cameras' spread: the
    root mean square distance of their centres from their mean."""
    given_shares: np.ndarray
    """(n,) the same distance before any alignment."""
    rotation_degrees: np.ndarray
    """(n,) angle between the aligned and the true orientation."""
    spread: float
    """The spread, units of the true frame."""
    transform: Similarity
    """``true_from_solved``."""
    missing: tuple[str, ...]
    """True cameras missing in the solved set."""

    def to_json(self) -> dict[str, Any]:
        """Return counts, medians and maxima as plain JSON values."""
        return {
            "cameras": len(self.names),
            "missing": list(self.missing),
            "spread": self.spread,
            "center_share_median": float(np.median(self.center_shares)),
            "center_share_max": float(self.center_shares.max()),
            "given_share_median": float(np.median(self.given_shares)),
            "rotation_degrees_median": float(np.median(self.rotation_degrees)),
            "rotation_degrees_max": float(self.rotation_degrees.max()),
            "transform": self.transform.to_json(),
        }


def pose_errors(cameras: Sequence[Camera], true_cameras: Sequence[Camera]) -> PoseErrors:
    """Align cameras of equal names by their centres (with scale) and return the residual errors.

    Parameters
    ----------
    cameras : sequence of Camera
        Solved cameras, in any frame.
    true_cameras : sequence of Camera
        Their true poses. Cameras are matched by ``name``.

    Raises
    ------
    DatasetError
        Duplicate names, fewer than three common names, or collinear centres.
    """
    solved, true = _by_name(cameras, "solved"), _by_name(true_cameras, "true")
    names = [name for name in true if name in solved]
    if len(names) < 3:
        raise DatasetError(
            f"{len(names)} of {len(true)} true cameras are named like one of the {len(solved)} "
            "solved ones.",
            "At least 3 names must be the same in both.",
        )
    centers = np.array([solved[name].center for name in names])
    true_centers = np.array([true[name].center for name in names])
    transform = umeyama(centers, true_centers, with_scale=True)
    spread = float(np.sqrt(((true_centers - true_centers.mean(0)) ** 2).sum(1).mean()))
    distances = np.linalg.norm(transform.points(centers) - true_centers, axis=1)
    given = np.linalg.norm(centers - true_centers, axis=1)
    moved = np.array([solved[name].rotation @ transform.rotation.T for name in names])
    difference = moved - np.array([true[name].rotation for name in names])  # (n, 3, 3)
    # ||A - B||_F = 2 sqrt(2) sin(angle / 2): accurate for tiny angles, unlike the trace.
    sines = np.linalg.norm(difference, axis=(1, 2)) / np.sqrt(8.0)
    angles = np.degrees(2.0 * np.arcsin(np.minimum(sines, 1.0)))
    missing = tuple(name for name in true if name not in solved)
    return PoseErrors(
        tuple(names), distances / spread, given / spread, angles, spread, transform, missing
    )


def _by_name(cameras: Sequence[Camera], kind: str) -> dict[str, Camera]:
    found: dict[str, Camera] = {}
    for camera in cameras:
        if camera.name in found:
            raise DatasetError(
                f"Two {kind} cameras are named {camera.name!r}.", "Give every camera its own name."
            )
        found[camera.name] = camera
    return found
