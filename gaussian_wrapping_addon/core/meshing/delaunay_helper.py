# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper process: triangulate ``points.npy`` with Qhull, write ``tetrahedra.npy``."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def main(folder: Path) -> int:
    """Triangulate the points of ``folder``; see :func:`.delaunay.qhull_tetrahedra`.

    Raises MeshingError: Qhull found the points degenerate even after joggling them.
    """
    from scipy.spatial import Delaunay, QhullError

    from ..errors import MeshingError

    points = np.load(folder / "points.npy", allow_pickle=False)
    try:
        tetrahedra = Delaunay(points, qhull_options="QJ Qbb Qc").simplices
    except (QhullError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise MeshingError(
            f"{len(points)} points could not be triangulated ({reason}).", "Choose another region."
        ) from None
    np.save(folder / "tetrahedra.npy", tetrahedra)
    return 0
