# SPDX-License-Identifier: GPL-3.0-or-later
"""The trivial surface: the alpha shape of the sparse points that every job starts from.

Tetrahedra of the Delaunay triangulation count as solid where their circumscribed sphere is smaller
than alpha; the surface is what bounds them (Edelsbrunner and Muecke 1994). Alpha is chosen by the
truth, of :data:`ALPHA_SHARES`: a bound of what any rule could choose.
"""

from __future__ import annotations

import datetime
import time
from pathlib import Path

import numpy as np
from scipy.spatial import Delaunay

from gaussian_wrapping_addon.core.evaluation.command import read_cameras
from gaussian_wrapping_addon.core.evaluation.surface_scores import read_truth, score_protocols
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.machine import processor_name
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.scene_regions import read_region

from .provenance import code_of_tree, versions
from .runs import THRESHOLD_SHARES
from .score import SURFACE_SAMPLES
from .study import Case, Record, SceneFinder, kept_surface, rendered_scene, write_record
from .tables import MIDDLE

ALPHA_SHARES = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16)
"""Of the crop volume's diagonal."""
CHOOSING_SAMPLES = 20_000
"""Of the mesh, to choose alpha by; the chosen one is judged like every other mesh."""
FLAT = 1e-12
"""Tetrahedra of less volume, as a share of the cubed diagonal, have no sphere."""
LEAST_POINTS = 5
"""Fewer make no tetrahedra (with the point that Qhull adds)."""


def alpha_shape(points: np.ndarray, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and outward faces of an alpha shape.

    Parameters
    ----------
    points : (n, 3) float64
    alpha : float
        Largest radius of a solid tetrahedron's circumscribed sphere, in units of the points.

    Returns
    -------
    vertices : (v, 3) float64
    faces : (f, 3) int64
        None where no tetrahedron is small enough, or too few points make one.
    """
    if len(points) < LEAST_POINTS:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    tetrahedra = Delaunay(points).simplices  # (t, 4)
    edges = points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]]  # (t, 3, 3)
    volume = np.linalg.det(edges)
    scale = np.ptp(points, axis=0).max()
    solid = np.abs(volume) > FLAT * scale**3
    tetrahedra, edges, volume = tetrahedra[solid], edges[solid], volume[solid]
    right = 0.5 * (edges**2).sum(2)  # of the equations of the sphere's centre
    radius = np.linalg.norm(np.linalg.solve(edges, right[..., None])[..., 0], axis=1)
    kept = radius < alpha
    tetrahedra, volume = tetrahedra[kept], volume[kept]
    swapped = tetrahedra[:, [1, 0, 2, 3]]
    tetrahedra = np.where((volume < 0)[:, None], swapped, tetrahedra)
    faces = tetrahedra[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3)
    _, index, counts = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    outer = faces[index[counts == 1]]
    used, inverse = np.unique(outer, return_inverse=True)
    return points[used], inverse.reshape(-1, 3)


def make_alpha(
    case: Case, *, threads: int, kept: Path, find_scene: SceneFinder = rendered_scene
) -> Record:
    """Score the best alpha shape of a scene's sparse points, or none, and write its record."""
    scene_folder = find_scene(case)
    folder = kept / case.study / case.identity
    folder.mkdir(parents=True, exist_ok=True)
    scene = load_scene(scene_folder, folder, Progress(), seed=0, threads=threads)
    points = scene.world_from_scene.points(scene.points)
    points = points[read_region(scene_folder / "region.json").contains(points)]
    truth = read_truth(scene_folder)
    diagonal = float(read_json(scene_folder / "scene.json")["diagonal"])
    thresholds = [share * diagonal for share in THRESHOLD_SHARES]
    cameras = read_cameras(scene_folder)
    code = code_of_tree()
    none = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    best: tuple[float, float | None, tuple[np.ndarray, np.ndarray], float, float]
    best = 0.0, None, none, 0.0, 0.0
    for share in ALPHA_SHARES:
        wall_s, used_s = time.monotonic(), time.process_time()
        mesh = alpha_shape(points, share * diagonal)
        wall_s, used_s = time.monotonic() - wall_s, time.process_time() - used_s
        if not len(mesh[1]):
            continue
        found = score_protocols(
            *mesh, truth, cameras, thresholds[MIDDLE : MIDDLE + 1], count=CHOOSING_SAMPLES,
            seed=0, threads=threads, protocols=("uniform",),
        )["uniform"].f1[0]  # fmt: skip
        if found > best[0]:
            best = found, share, mesh, wall_s, used_s
    _, share, mesh, wall_s, used_s = best
    scores = score_protocols(
        *mesh, truth, cameras, thresholds, count=SURFACE_SAMPLES, seed=0, threads=threads,
        protocols=("uniform", "scan"),
    )  # fmt: skip
    json = {name: score.to_json() for name, score in scores.items()}
    record = Record(
        case=case,
        code=code,
        machine=processor_name(),
        versions=versions(),
        threads=threads,
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
        load_before=None,
        wall_s=round(wall_s, 3),
        processor_s={"mesh": round(used_s, 3)},
        memory_gib=None,
        mesh={
            "vertices": len(mesh[0]), "faces": len(mesh[1]), "closed": None, "components": None,
            "points": len(points), "alpha_share": share,
        },
        scores={"surface": kept_surface(json, diagonal)},
    )  # fmt: skip
    write_record(record)
    return record
