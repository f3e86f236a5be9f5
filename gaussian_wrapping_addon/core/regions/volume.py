# SPDX-License-Identifier: GPL-3.0-or-later
"""Validate that the corners of a region enclose a volume."""

from __future__ import annotations

import numpy as np

from .. import limits
from ..errors import MeshingError

FLAT_SHARE = 1e-6
"""A body thinner than this share of its diagonal counts as flat."""


def check_volume(vertices: np.ndarray, name: str) -> None:
    """Raise an error for corners that enclose no volume.

    Parameters
    ----------
    vertices : (n, 3) float64
    name : str
        Name of the region, for messages.

    Raises
    ------
    MeshingError
        Fewer than four corners, too many, not finite, or all in one plane.
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < 4:
        raise MeshingError(
            f"Region {name!r} needs at least four corners.", "Draw a box around the object."
        )
    if len(vertices) > limits.MAX_REGION_VERTICES:
        raise MeshingError(
            f"Region {name!r} has {len(vertices)} corners; the limit is "
            f"{limits.MAX_REGION_VERTICES}.",
            "Use a simpler body, such as a box.",
        )
    if not np.isfinite(vertices).all():
        raise MeshingError(f"Region {name!r} has a corner that is not finite.", "Draw it again.")
    if not _is_thick(vertices):
        raise flat_region_error(name)


def flat_region_error(name: str) -> MeshingError:
    """Return the error for a region without volume."""
    return MeshingError(f"Region {name!r} is flat: it encloses no volume.", "Give it some height.")


def _is_thick(vertices: np.ndarray) -> bool:
    low, high = vertices.min(0), vertices.max(0)
    diagonal = float(np.linalg.norm(high - low))
    if diagonal <= 0.0:
        return False
    # Rounded as where the hull is made: far from the origin, rounding alone makes bodies flat.
    scaled = (vertices - (low + high) / 2) / diagonal  # (n, 3)
    widths = np.linalg.svd(scaled - scaled.mean(0), compute_uv=False)  # (3,)
    return bool(widths[2] / np.sqrt(len(scaled)) >= FLAT_SHARE)
