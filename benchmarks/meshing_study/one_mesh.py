# SPDX-License-Identifier: GPL-3.0-or-later
"""Make one mesh in a process of its own, and keep what it took.

``python -m benchmarks.meshing_study.one_mesh SCENE JOB FOLDER --method uniform --size 6000``

The clock runs from loaded Gaussians and cameras to the mesh: preparing the field, sightings and
depth maps count, reading files and importing do not. Kernels come compiled from the disk's cache.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.field.depth_samples import sample_depth_maps
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.field.vector_field import VectorField
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.kernels.parallel import default_threads
from gaussian_wrapping_addon.core.mesh.mesh_file import save_mesh
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.cleanup.clean_up import clean_up
from gaussian_wrapping_addon.core.meshing.pivot_meshing import mesh_by_pivots
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.processes.peak_memory import largest_helper_bytes, own_peak_bytes
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import MeshingSettings

from .fusion import fuse, require_open3d
from .plan import FUSION, METHODS, PAM, TETRAHEDRA, Method
from .trained import Trained, open_trained

MESH, MEASURED = "mesh.npz", "measured.json"


def make_mesh(trained: Trained, method: Method, *, threads: int, seed: int = 0) -> SurfaceMesh:
    """Return the mesh of a method, scene frame.

    Raises
    ------
    MeshingError
        There is no surface.
    ResourceError
        TSDF fusion was asked for and Open3D is missing.
    """
    if method.name == FUSION:
        vertices, faces = fuse(trained, method.size, threads=threads)
        if len(faces) == 0:
            raise MeshingError("The depth maps show no surface.", "Look at the training.")
        return SurfaceMesh(vertices, faces.astype(np.int32))
    arrays, cameras, region = trained.gaussians.arrays(), trained.scene.cameras, trained.region
    vacancy = VacancyField(arrays, cameras, threads=threads)
    depth_samples = sample_depth_maps(
        trained.gaussians, cameras, lambda p: region.contains(p, 0.0), Progress(), threads=threads
    )
    if method.name == TETRAHEDRA:
        settings = MeshingSettings(method="pivots", pivots=method.size)
        return mesh_by_pivots(
            vacancy,
            arrays,
            cameras,
            region,
            settings,
            Progress(),
            seed=seed,
            depth_samples=depth_samples,
        )
    settings = MeshingSettings(points=method.size, spacing=method.name)
    mesh = mesh_region(
        vacancy, VectorField(arrays, threads=threads), arrays, cameras, region, settings,
        Progress(), seed=seed, threads=threads, depth_samples=depth_samples,
    )  # fmt: skip
    return clean_up(mesh, region, settings, vacancy, Progress()).mesh


def cpu_seconds() -> float:
    """Return the processor time of this process and its ended children; NaN where unknown."""
    try:
        import resource
    except ImportError:
        return float("nan")
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    usages = [resource.getrusage(kind) for kind in kinds]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def measure(trained: Trained, method: Method, folder: Path, *, threads: int) -> dict[str, Any]:
    """Make a mesh, save it, and return seconds and memory."""
    if method.name == FUSION:
        require_open3d()
        import open3d  # noqa: F401  importing it takes seconds that fusion does not

    before_bytes = own_peak_bytes()
    wall_s, cpu_s = time.monotonic(), cpu_seconds()
    mesh = make_mesh(trained, method, threads=threads)
    wall_s, cpu_s = time.monotonic() - wall_s, cpu_seconds() - cpu_s
    own, helper = own_peak_bytes(), largest_helper_bytes()
    folder.mkdir(parents=True, exist_ok=True)
    save_mesh(folder / MESH, mesh)
    return {
        "method": method.name,
        "size": method.size,
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "peak_bytes": own + helper,
        "helper_bytes": helper,
        "before_bytes": before_bytes,
        "gaussians": len(trained.gaussians),
        "cameras": len(trained.scene.cameras),
        "provenance": mesh.provenance if method.name in PAM else {},
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the mesh and write ``mesh.npz`` and ``measured.json`` into the folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("job", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--method", choices=METHODS, required=True)
    parser.add_argument("--size", type=int, required=True)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args(arguments)
    trained = open_trained(options.scene, options.job)
    method = Method(options.method, options.size)
    threads = options.threads or default_threads()
    figures = measure(trained, method, options.folder, threads=threads)
    write_json(options.folder / MEASURED, figures)


if __name__ == "__main__":
    main()
