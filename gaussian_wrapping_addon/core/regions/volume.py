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
    diagonal = float(np.linalg.norm(vertices.max(0) - vertices.min(0)))
    if diagonal <= 0.0:
        return False
    centred = vertices - vertices.mean(0)  # (n, 3)
    widths = np.linalg.svd(centred / diagonal, compute_uv=False)  # (3,)
    return bool(widths[2] / np.sqrt(len(centred)) >= FLAT_SHARE)
