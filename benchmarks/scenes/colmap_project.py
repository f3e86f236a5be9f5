# SPDX-License-Identifier: GPL-3.0-or-later
"""Writer of COLMAP's text model: cameras, images with observations, points with tracks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.dataset.camera import Camera

from .sparse_points import SparsePoints


def write_colmap(folder: Path, cameras: Sequence[Camera], sparse: SparsePoints) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``; numbers with full precision.

    All cameras must share one lens. Ids start at 1, as COLMAP's do.
    """
    folder.mkdir(parents=True, exist_ok=True)
    c = cameras[0]
    lens = f"{c.fx!r} {c.fy!r} {c.cx!r} {c.cy!r}"
    (folder / "cameras.txt").write_text(
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 PINHOLE {c.width} {c.height} {lens}\n"
    )  # fmt: skip
    place = np.zeros(len(sparse.point_ids), np.int64)  # index among the image's observations
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# X, Y, POINT3D_ID ..."]
    for index, camera in enumerate(cameras):
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat(canonical=True).tolist()
        pose = [w, x, y, z, *camera.cam_from_world[:, 3].tolist()]
        lines.append(f"{index + 1} {' '.join(map(repr, pose))} 1 {camera.name}")
        mine = np.flatnonzero(sparse.camera_ids == index)
        place[mine] = np.arange(len(mine))
        lines.append(
            " ".join(
                f"{u:.4f} {v:.4f} {point + 1}"
                for (u, v), point in zip(
                    sparse.pixels[mine].tolist(), sparse.point_ids[mine].tolist(), strict=True
                )
            )
        )
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    ends = np.searchsorted(sparse.point_ids, np.arange(len(sparse.points) + 1))
    for index in range(len(sparse.points)):
        begin, end = ends[index], ends[index + 1]
        track = " ".join(
            f"{camera + 1} {at}"
            for camera, at in zip(
                sparse.camera_ids[begin:end].tolist(), place[begin:end].tolist(), strict=True
            )
        )
        position = " ".join(map(repr, sparse.points[index].tolist()))
        color = " ".join(map(str, sparse.colors[index].tolist()))
        lines.append(f"{index + 1} {position} {color} {sparse.errors_px[index]:.4f} {track}")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
