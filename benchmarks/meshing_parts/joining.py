# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory of joining tiles, against their number: ``python -m benchmarks.meshing_parts.joining``.

The shape is a sphere with bumps, cut by the region, whose vacancy is a formula; tiles have about
the same number of points each. Joining tile by tile is compared with repair and simplification of
the whole dense surface, as in a mesh without tiles. Each join runs in a process of its own, which
reports how far its memory grew beyond the modules and compiled kernels, and what the mesh is like.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.memory import resident_mib
from benchmarks.tables import Table
from benchmarks.workload import view
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyResult
from gaussian_wrapping_addon.core.field.vector_field import VectorFieldResult
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.surface_sampling import sample_triangles
from gaussian_wrapping_addon.core.mesh.topology import normals_and_areas
from gaussian_wrapping_addon.core.meshing.checks.mesh_statistics import mesh_statistics
from gaussian_wrapping_addon.core.meshing.points.candidate_surface import CandidateSurface
from gaussian_wrapping_addon.core.meshing.points.resolution import ResolutionRequest
from gaussian_wrapping_addon.core.meshing.primal_adaptive import (
    made_manifold,
    simplified,
    small_handles_closed,
)
from gaussian_wrapping_addon.core.meshing.tiles.border_faces import BorderFaces
from gaussian_wrapping_addon.core.meshing.tiles.plan import Field, TilePlan, make_plan
from gaussian_wrapping_addon.core.meshing.tiles.store import (
    faces_path,
    gathered_path,
    load_gathered,
    load_plan,
    load_point_figures,
    load_surface,
    save_gathered,
    save_plan,
    save_surface,
)
from gaussian_wrapping_addon.core.meshing.tiles.tile_faces import TileFaces, tile_faces
from gaussian_wrapping_addon.core.meshing.tiles.tile_points import gather, tile_points
from gaussian_wrapping_addon.core.meshing.tiles.tile_surface import tile_surface
from gaussian_wrapping_addon.core.meshing.tiles.tiled_mesh import join_tiles
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.convex_region import Region
from gaussian_wrapping_addon.core.settings import MeshingSettings

SIGMA = 0.01
"""Width of the field's step."""
BUMP, WAVES = 0.04, 9.0
SAMPLES = 200_000
STREAMED, WHOLE = "tile by tile", "in one piece"
SETTINGS = MeshingSettings()


class Bumps:
    """Vacancy and vectors of a sphere with bumps."""

    cameras = (view(64, 48),)

    def value(self, points: np.ndarray) -> np.ndarray:
        """Return a function that is 0 on the surface, positive outside."""
        radius = np.linalg.norm(points, axis=1)
        waves = np.sin(WAVES * points)
        return np.asarray(radius - 1.0 - BUMP * waves.prod(1))

    def slope(self, points: np.ndarray) -> np.ndarray:
        """Return its gradient, (n, 3)."""
        radius = np.maximum(np.linalg.norm(points, axis=1), 1e-9)[:, None]
        sine, cosine = np.sin(WAVES * points), WAVES * np.cos(WAVES * points)
        others = sine[:, [1, 2, 0]] * sine[:, [2, 0, 1]]
        return np.asarray(points / radius - BUMP * cosine * others)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return distances to the surface, to first order."""
        return np.asarray(np.abs(self.value(points)) / np.linalg.norm(self.slope(points), axis=1))

    def vacancy(self, points: np.ndarray) -> VacancyResult:
        """Return the vacancy, as the field of a scene does."""
        depth = np.clip(self.value(points) / SIGMA, -60, 60)
        vacancy = (1.0 / (1.0 + np.exp(-depth))).astype(np.float32)
        return VacancyResult(vacancy, np.zeros(len(points), np.int32))

    def is_empty(self, points: np.ndarray) -> np.ndarray:
        """Return which points are empty."""
        return self.value(points) > 0.0

    def evaluate(self, points: np.ndarray) -> VectorFieldResult:
        """Return the vector field, as the field of a scene does."""
        count, slope = len(points), self.slope(points)
        vacancy = self.vacancy(points).vacancy.astype(np.float64)
        outward = slope / np.linalg.norm(slope, axis=1)[:, None]
        return VectorFieldResult(
            slope * ((1.0 - vacancy) / SIGMA)[:, None], np.full(count, SIGMA),
            np.zeros(count, np.int32), outward,
        )  # fmt: skip


def region() -> Region:
    """Return the region: it cuts the sphere below."""
    return Region.box("bumps", np.array([-1.2, -1.2, -0.8]), np.full(3, 1.2))


def sphere(rows: int) -> CandidateSurface:
    """Return a triangle soup of the sphere without bumps."""
    theta, phi = np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    points = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    corners = np.concatenate([np.stack(s, -2).reshape(-1, 3, 3) for s in ((a, b, c), (a, c, d))])
    vertices, faces = corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)
    faces = faces[normals_and_areas(vertices, faces)[1] > 1e-12]  # not at the poles
    return CandidateSurface(vertices, faces, 1, 1)


def make(folder: Path, tiles: int, per_tile: int) -> None:
    """Plan, sample and label all tiles."""
    field = Field(Bumps(), Bumps(), 1)
    plan = make_plan(
        field, region(), sphere(160), ResolutionRequest(0.0, tiles * per_tile), Progress(),
        tiles=tiles, seed=0, cameras=(), adaptive=False, depth_samples=0,
    )  # fmt: skip
    count = len(plan.tiling)
    gathered = gather(plan, [tile_points(field, plan, tile, Progress()) for tile in range(count)])
    save_plan(folder, plan, {})
    save_gathered(gathered_path(folder), gathered)
    for tile in range(count):
        part = tile_faces(field, plan, gathered, tile, Progress())
        np.savez(
            folder / f"raw-{tile}.npz", faces=part.faces, border=part.border, solid=part.solid,
            whole=part.whole,
        )  # fmt: skip


def load_raw(folder: Path, tile: int) -> TileFaces:
    """Read the labelled faces of a tile."""
    with np.load(folder / f"raw-{tile}.npz", allow_pickle=False) as held:
        return TileFaces(held["faces"], held["border"], held["solid"], {}, held["whole"])


def kept(folder: Path, keep: float) -> TilePlan:
    """Return the plan of tiles with a share or number of vertices that stay."""
    plan, _ = load_plan(folder)
    points = load_point_figures(gathered_path(folder))
    dense = points["surface_points"] + points["cap_points"]
    return dataclasses.replace(plan, share=keep if keep < 1.0 else keep / dense, target=0)


def prepare(folder: Path, keep: float) -> None:
    """Make the tiles' surfaces: repaired, in order of their mergers."""
    plan, gathered = kept(folder, keep), load_gathered(gathered_path(folder))
    for tile in range(len(plan.tiling)):
        save_surface(faces_path(folder, tile), tile_surface(plan, gathered, load_raw(folder, tile)))


def join(folder: Path, keep: float, how: str) -> dict[str, Any]:
    """Join the tiles; return peak memory, time, and what the mesh is like."""
    plan = kept(folder, keep)
    _warm_up()
    now = resident_mib()[0]
    Path("/proc/self/clear_refs").write_text("5")
    begun_s = time.process_time()
    if how == STREAMED:
        mesh = join_tiles(
            Field(Bumps(), Bumps(), 1), plan, load_point_figures(gathered_path(folder)),
            lambda tile: load_surface(faces_path(folder, tile)), SETTINGS, Progress(),
        )  # fmt: skip
    else:
        mesh = _in_one_piece(folder, plan)
    seconds, peak = time.process_time() - begun_s, resident_mib()[1] - now
    figures = mesh_statistics(mesh)
    points, _ = sample_triangles(mesh.vertices, mesh.faces, SAMPLES, np.random.default_rng(0))
    # Caps lie on the region's boundary.
    away = Bumps().distance(points[plan.region.distance(points) < -1e-6])
    near = _at_borders(plan, points)
    error = np.where(plan.region.distance(points) < -1e-6, Bumps().distance(points), np.nan)
    return {
        "peak_mib": peak, "seconds": seconds, "vertices": figures.vertices,
        "faces": figures.faces, "dense": mesh.provenance["dense_vertices"],
        "closed": figures.closed, "bad": figures.nonmanifold_edges + figures.nonmanifold_vertices,
        "components": figures.components, "genus": figures.genus, "mean": float(away.mean()),
        "p99": float(np.quantile(away, 0.99)), "most": float(away.max()),
        "mean_near": float(np.nanmean(error[near])),
        "density_near": _density(plan, mesh),
    }  # fmt: skip


def _in_one_piece(folder: Path, plan: TilePlan) -> SurfaceMesh:
    gathered = load_gathered(gathered_path(folder))
    border, faces, corners = BorderFaces(), [], []
    for tile in range(len(plan.tiling)):
        part = load_raw(folder, tile)
        faces += [part.faces, border.add(part.border, part.solid)]
        corners.append(np.unique(part.border))
    faces.append(border.close(np.unique(np.concatenate(corners))))
    all_faces = np.concatenate(faces)
    del faces
    cloud = gathered.cloud
    vertices, joined, kind, figures = made_manifold(
        cloud.points, all_faces, cloud, plan.region, SETTINGS, Progress()
    )
    dense = len(vertices)
    vertices, joined, kind = simplified(
        vertices, joined, kind, plan.target, plan.share, plan.region
    )
    vertices, joined, _, handles = small_handles_closed(vertices, joined, kind)
    figures |= handles | {"dense_vertices": dense}
    return SurfaceMesh(vertices, joined.astype(np.int32), None, figures)


def _at_borders(plan: TilePlan, points: np.ndarray) -> np.ndarray:
    """Return which points lie within four spacings of a border between tiles."""
    reach, owner = 4.0 * plan.radius, plan.tiling.owner(points)
    near = np.zeros(len(points), np.bool_)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            near |= plan.tiling.owner(points + sign * reach * np.eye(3)[axis]) != owner
    return near


def _density(plan: TilePlan, mesh: SurfaceMesh) -> float:
    """Return the vertices per area near borders, over those elsewhere."""
    _, areas = normals_and_areas(mesh.vertices, mesh.faces)
    valence = np.bincount(mesh.faces.ravel(), minlength=len(mesh.vertices))
    each = (1.0 / valence)[mesh.faces].sum(1)  # vertices that a face stands for
    middles = mesh.vertices[mesh.faces].mean(1)
    inner = plan.region.distance(middles) < -1e-6
    near = _at_borders(plan, middles)
    return float(
        (each[near & inner].sum() / areas[near & inner].sum())
        / (each[~near & inner].sum() / areas[~near & inner].sum())
    )


def _warm_up() -> None:
    """Load what a join needs, so that its memory is not counted."""
    box = sphere(8)
    points, index = np.unique(np.round(box.vertices, 9), axis=0, return_inverse=True)
    faces = index.reshape(-1)[box.faces]
    simplified(points, faces, np.zeros(len(points), np.uint8), 20, 0.0, region())


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tiles", type=int, nargs="+", default=[8, 27, 64])
    parser.add_argument("--per-tile", type=int, default=12_000, help="points of a tile")
    parser.add_argument(
        "--keep", type=float, nargs="+", default=[20_000.0, 1 / 6],
        help="vertices that stay: a number, or a share of the dense ones below 1",
    )  # fmt: skip
    parser.add_argument("--step", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.step:
        return _step(options.step)
    rows: list[tuple[str | float | int | None, ...]] = []
    for tiles in options.tiles:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            _run("make", name, tiles, options.per_tile)
            for keep in options.keep:
                _run("prepare", name, keep)
                for how in (STREAMED, WHOLE):
                    _run("join", name, keep, how)
                    held = read_json(folder / "result.json")
                    rows.append(_row(tiles, how, held))
                    sys.stdout.write(json.dumps({"tiles": tiles, "how": how, **held}) + "\n")
                    sys.stdout.flush()
    header = (
        "tiles", "joined", "dense vertices", "vertices", "peak MiB", "bytes per dense",
        "bytes per vertex", "s", "sound", "genus", "mean error", "p99", "largest",
        "mean near borders", "density near borders",
    )  # fmt: skip
    sys.stdout.write(Table("Joining tiles", header, rows).markdown())
    return 0


def _row(tiles: int, how: str, held: dict[str, Any]) -> tuple[str | float | int | None, ...]:
    sound = "yes" if held["closed"] and held["bad"] == 0 and held["components"] == 1 else "no"
    return (
        tiles, how, held["dense"], held["vertices"], round(held["peak_mib"]),
        round(held["peak_mib"] * 2**20 / held["dense"]),
        round(held["peak_mib"] * 2**20 / held["vertices"]), round(held["seconds"]), sound,
        held["genus"], f"{held['mean']:.2e}", f"{held['p99']:.2e}", f"{held['most']:.2e}",
        f"{held['mean_near']:.2e}", f"{held['density_near']:.3f}",
    )  # fmt: skip


def _run(*step: object) -> None:
    command = [sys.executable, "-m", "benchmarks.meshing_parts.joining", "--step"]
    subprocess.run([*command, *map(str, step)], check=True)


def _step(words: Sequence[str]) -> int:
    folder = Path(words[1])
    if words[0] == "make":
        make(folder, int(words[2]), int(words[3]))
    elif words[0] == "prepare":
        prepare(folder, float(words[2]))
    else:
        write_json(folder / "result.json", join(folder, float(words[2]), words[3]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
