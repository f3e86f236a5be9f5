# SPDX-License-Identifier: GPL-3.0-or-later
"""Unwrap and bake a large, bumpy mesh in this process; print time and memory as JSON."""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh

from .known_texture import RenderedPhotos, cameras_around, spot

SUBDIVISIONS = 3
BUMP = 0.0003
"""Standard deviation of the vertices' offsets, scene units: 6 % of an edge."""
PHOTOS, WIDTH, HEIGHT = 40, 1632, 1224
SIZE_PX = 4096


def bumpy_spot() -> SurfaceMesh:
    """Return spot with 374,784 faces, moved a little at random."""
    import trimesh

    mesh = spot()
    vertices, faces = trimesh.remesh.subdivide_loop(
        mesh.vertices, mesh.faces, iterations=SUBDIVISIONS
    )
    vertices = vertices + BUMP * np.random.default_rng(0).normal(size=vertices.shape)
    return SurfaceMesh(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int32))


def main(threads: int, size_px: int = SIZE_PX) -> None:
    """Measure once.

    Parameters
    ----------
    size_px : int
        Side of the texture.
    """
    mesh = bumpy_spot()
    random = np.random.default_rng(1)
    coarse = random.integers(40, 215, (PHOTOS, HEIGHT // 8, WIDTH // 8, 3), np.uint8)
    # What the photos show decides nothing of the time.
    images = [image.repeat(8, axis=0).repeat(8, axis=1) for image in coarse]
    photos = RenderedPhotos(cameras_around(PHOTOS, WIDTH, HEIGHT), images)
    begun_s = time.monotonic()
    own, helper = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    before_s = _cpu_s(own) + _cpu_s(helper)
    with tempfile.TemporaryDirectory() as folder:
        textured = texture_mesh(
            mesh, photos.scene(), photos, TextureSettings(size_px), Path(folder), Progress(),
            threads=threads,
        )  # fmt: skip
    worker_kib = resource.getrusage(own).ru_maxrss
    peak_kib = resource.getrusage(own).ru_maxrss + resource.getrusage(helper).ru_maxrss
    figures = {
        "faces": len(mesh.faces),
        "size_px": size_px,
        "photos": PHOTOS,
        "megapixels": WIDTH * HEIGHT / 1e6,
        "wall_s": time.monotonic() - begun_s,
        "cpu_s": _cpu_s(own) + _cpu_s(helper) - before_s,
        "worker_peak_mib": worker_kib / 1024,
        "peak_mib": peak_kib / 1024,
        "unwrap": textured.statistics["unwrap"],
        "charts": textured.statistics["charts"],
        "utilisation": textured.statistics["utilisation"],
        "overlaps": textured.statistics["texels_overlapping"],
    }
    sys.stdout.write(json.dumps(figures) + "\n")


def _cpu_s(who: int) -> float:
    usage = resource.getrusage(who)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
