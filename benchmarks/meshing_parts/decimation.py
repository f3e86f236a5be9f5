# SPDX-License-Identifier: GPL-3.0-or-later
"""Decimation against libraries: what stays closed, and how far the surface moves.

``python -m benchmarks.meshing_parts.decimation [--meshes FILE.npz ...]`` prints a table. Meshes are
thin and flat ones, one of many holes, a round one, and those of mesh stages (``mesh.npz``). libigl
is there with the add-on; fast-simplification is measured where it is installed (MIT, PyPI).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import trimesh

from gaussian_wrapping_addon.core.mesh.distance import distances_to_mesh
from gaussian_wrapping_addon.core.mesh.mesh_file import load_mesh
from gaussian_wrapping_addon.core.mesh.simplification.decimation import decimate
from gaussian_wrapping_addon.core.mesh.surface_sampling import sample_triangles
from gaussian_wrapping_addon.core.mesh.topology import normals_and_areas
from gaussian_wrapping_addon.core.meshing.checks.manifold_check import validate_manifold
from gaussian_wrapping_addon.core.progress import Progress

Mesh = tuple[np.ndarray, np.ndarray]
Method = Callable[[np.ndarray, np.ndarray, int], Mesh]

MESHES = Path(__file__).resolve().parents[1] / "meshes"
SHARES = (0.5, 0.1, 0.02)
SAMPLES = 20_000
"""Points of each surface whose distance to the other is measured."""

FOLD_COS = -0.97
"""Neighbouring faces bent by more than 166 degrees count as folded."""


@dataclass(frozen=True)
class Decimation:
    """One mesh, decimated by one method."""

    mesh: str
    method: str
    share: float
    """Faces asked for, of those that were there."""
    faces_ratio: float
    """Faces that came out, of those asked for."""
    defects: tuple[str, ...]
    same_genus: bool
    folds: int
    volume_ratio: float
    mean_distance: float
    """Of samples of both surfaces to the other one, shares of the diagonal of the mesh."""
    max_distance: float
    seconds: float
    """CPU time."""


def _own(vertices: np.ndarray, faces: np.ndarray, target: int) -> Mesh:
    result = decimate(vertices, faces, target, Progress())
    return result.vertices, result.faces


def _qslim(vertices: np.ndarray, faces: np.ndarray, target: int) -> Mesh:
    result = igl.qslim(np.asfortranarray(vertices), np.asfortranarray(faces, np.int32), target)
    return np.array(result[0]), np.array(result[1], np.int64)


def _shortest_edge(vertices: np.ndarray, faces: np.ndarray, target: int) -> Mesh:
    result = igl.decimate(np.asfortranarray(vertices), np.asfortranarray(faces, np.int32), target)
    return np.array(result[0]), np.array(result[1], np.int64)


def methods() -> dict[str, Method]:
    """Return the methods that this machine can run, by name."""
    found: dict[str, Method] = {
        "ours": _own,
        "libigl qslim": _qslim,
        "libigl decimate": _shortest_edge,
    }
    try:
        import fast_simplification
    except ImportError:
        return found

    def fast(vertices: np.ndarray, faces: np.ndarray, target: int) -> Mesh:
        result = fast_simplification.simplify(vertices, faces, target_count=target)
        return np.asarray(result[0], np.float64), np.asarray(result[1], np.int64)

    return {**found, "fast-simplification": fast}


def meshes(files: list[Path]) -> dict[str, Mesh]:
    """Return closed meshes by name, fine enough to lose faces."""
    found: dict[str, Mesh] = {}
    for name in ("spot", "spoked_wheel", "thin_cup", "wire_fence"):
        mesh = trimesh.load(MESHES / f"{name}.obj", process=True, force="mesh")
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        # Finer, and uneven by a hundredth of an edge, as measured surfaces are.
        mesh = mesh.subdivide() if len(mesh.faces) > 5000 else mesh.subdivide().subdivide()
        rng = np.random.default_rng(0)
        amount = 0.01 * mesh.edges_unique_length.mean()
        noise = amount * rng.normal(size=mesh.vertices.shape)
        found[name] = np.array(mesh.vertices + noise), np.array(mesh.faces, np.int64)
    plate = trimesh.creation.box([2.0, 2.0, 0.01]).subdivide_to_size(0.05)
    found["plate"] = np.array(plate.vertices), np.array(plate.faces, np.int64)
    for path in files:
        stored = load_mesh(path)
        found[path.parent.name] = stored.vertices, np.asarray(stored.faces, np.int64)
    return found


def measure(name: str, mesh: Mesh, method: str, work: Method, share: float) -> Decimation:
    """Decimate a closed mesh and measure what came out."""
    target = round(share * len(mesh[1]))
    begun_s = time.process_time()
    result = work(*mesh, target)
    seconds = time.process_time() - begun_s
    before, after = validate_manifold(*mesh), validate_manifold(*result)
    genus = [sorted(str(part.genus) for part in check.parts) for check in (before, after)]
    distance = _distances(mesh, result)
    return Decimation(
        mesh=name,
        method=method,
        share=share,
        faces_ratio=len(result[1]) / target,
        defects=tuple(after.defects()),
        same_genus=genus[0] == genus[1],
        folds=_folds(*result),
        volume_ratio=after.volume / before.volume,
        mean_distance=float(distance.mean()),
        max_distance=float(distance.max()),
        seconds=seconds,
    )


def _distances(first: Mesh, second: Mesh) -> np.ndarray:
    """Distances of samples of each mesh to the other, shares of the first one's diagonal."""
    found = []
    for here, there in ((first, second), (second, first)):
        points, _ = sample_triangles(here[0], here[1], SAMPLES, np.random.default_rng(1))
        found.append(distances_to_mesh(points, *there)[0])
    return np.concatenate(found) / np.linalg.norm(np.ptp(first[0], axis=0))


def _folds(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Count pairs of neighbouring faces that lie on each other, nearly."""
    normals, _ = normals_and_areas(vertices, faces)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(1)
    cosines = (normals[owner[1:][same]] * normals[owner[:-1][same]]).sum(1)
    return int((cosines < FOLD_COS).sum())


def table(rows: list[Decimation]) -> str:
    """Return a Markdown table; distances are in millionths of the diagonal."""
    header = (
        "mesh", "faces kept", "method", "faces/target", "closed manifold", "genus kept", "folds",
        "volume", "mean distance, 1e-6", "largest, 1e-6", "CPU s",
    )  # fmt: skip
    lines = [f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    for row in rows:
        lines.append(
            f"| {row.mesh} | {100 * row.share:g} % | {row.method} | {row.faces_ratio:.3f} "
            f"| {'no' if row.defects else 'yes'} | {'yes' if row.same_genus else 'no'} "
            f"| {row.folds} | {row.volume_ratio:.4f} | {1e6 * row.mean_distance:.1f} "
            f"| {1e6 * row.max_distance:.0f} | {row.seconds:.2f} |"
        )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Measure every method on every mesh and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.meshing_parts.decimation")
    parser.add_argument("--meshes", type=Path, nargs="*", default=[], metavar="mesh.npz")
    parser.add_argument("--shares", type=float, nargs="+", default=list(SHARES))
    options = parser.parse_args(arguments)
    found, ways = meshes(options.meshes), methods()
    ball = trimesh.creation.icosphere(subdivisions=2)
    _own(np.array(ball.vertices), np.array(ball.faces, np.int64), 100)  # compiles
    rows = [
        measure(name, mesh, method, work, share)
        for name, mesh in found.items()
        for share in options.shares
        for method, work in ways.items()
    ]
    print(table(rows))


if __name__ == "__main__":
    main()
