# SPDX-License-Identifier: GPL-3.0-or-later
"""Primal adaptive meshing against two and nine pivots: ``python -m benchmarks.paper.meshers``.

The meshes are of one training and field, as each method makes them and then at equal numbers of
triangles. Writes a record, a picture of close-ups, one of the mesher's steps, and the page.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.field.depth_samples import DepthSamples, sample_depth_maps
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.mesh.simplification.decimation import decimate
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.pivot_meshing import mesh_by_pivots
from gaussian_wrapping_addon.core.meshing.points.candidate_surface import halo_bounds
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import MeshingSettings

from ..speed_error.runs import ROOT
from .document import write_page
from .judging import score_mesh, true_surface
from .pictures import dots, eye_at, grid, labelled, render_mesh, save_picture
from .records import MESHERS, origin, write_record
from .refinement import Step, pam, shown, steps_of
from .trainings import WRAPPED, Trained, finished

_logger = logging.getLogger("benchmarks")

SCENE, TRAINING = "wheel", WRAPPED
"""The training that holds most spokes and has orientation, which two pivots need."""

TWO, NINE, PAM, PAM_DEPTH = "2 pivots", "9 pivots", "PAM", "PAM, depth maps"
METHODS = (TWO, NINE, PAM, PAM_DEPTH)
TRIANGLES = 20_000
SPARE = 1.15
"""Primal adaptive meshing is asked for this many times the triangles, so that it, too, ends by
decimation: all methods go through the same last step."""

EYE, TARGET, DEGREES = (0.14, -0.66, 0.62), (0.40, 0.0, 0.38), 26.0
STEPS_SHOWN = (
    "candidate surface", "samples of it", "after 14 rounds of projection", "faces between labels",
    "final mesh",
)  # fmt: skip
NEAR_COLOR, FAR_COLOR, FAR = (0.02, 0.10, 0.45), (0.90, 0.30, 0.02), 0.1
"""Linear colours of samples on the isosurface, and of those whose residual is FAR or more."""
DOT_RADIUS = 0.0022
WIRED = 100_000
"""The wires of more triangles would hide the surface."""
ACROSS = 3
"""Close-ups beside one another."""


def at_equal_count(mesh: SurfaceMesh, trained: Trained, triangles: int) -> SurfaceMesh:
    """Return the mesh decimated to a number of triangles.

    Raises
    ------
    MeshingError
        The mesh has fewer, or cannot be brought to that number.
    """
    if len(mesh.faces) < triangles:
        raise MeshingError(
            f"A mesh has {len(mesh.faces)} triangles of {triangles}.", "Ask for less."
        )
    found = decimate(
        mesh.vertices, np.asarray(mesh.faces, np.int64), triangles, Progress(),
        region=trained.region,
    )  # fmt: skip
    # A closed mesh has an even number: the count is met exactly.
    if len(found.faces) != triangles:
        raise MeshingError(f"Decimation ended at {len(found.faces)} of {triangles} triangles.")
    return SurfaceMesh(found.vertices, found.faces.astype(np.int32))


def make(
    name: str, trained: Trained, field: VacancyField, samples: DepthSamples, *, threads: int
) -> SurfaceMesh:
    """Return the mesh of a method as the method makes it.

    Pivots stand alone, as the paper has them: without points of the depth maps, which the second
    of the two primal adaptive meshes takes besides.
    """
    if name in (TWO, NINE):
        settings = MeshingSettings(
            method="pivots", pivots=2 if name == TWO else 9, pivot_samples="none"
        )
        return mesh_by_pivots(
            field, trained.gaussians.arrays(), trained.scene.cameras, trained.region, settings,
            Progress(), seed=0,
        )  # fmt: skip
    settings = MeshingSettings(points=round(SPARE * TRIANGLES / 2))
    return pam(trained, field, settings, samples if name == PAM_DEPTH else None, threads=threads)


def close_ups(meshes: dict[str, SurfaceMesh], trained: Trained, *, threads: int) -> np.ndarray:
    """Return the close-ups of the meshes of equal count with their wires, and of the truth."""
    world = trained.scene.world_from_scene
    eye = eye_at(EYE, TARGET, width=400, height=340, degrees=DEGREES)
    true = render_mesh(*true_surface(trained), eye, threads=threads)
    row = [labelled(true, "true surface")]
    for name, mesh in meshes.items():
        image = render_mesh(world.points(mesh.vertices), mesh.faces, eye, threads=threads)
        row.append(labelled(image, f"{name}, {len(mesh.faces)} triangles"))
    row += [np.full_like(row[0], 255)] * (-len(row) % ACROSS)
    return grid([row[k : k + ACROSS] for k in range(0, len(row), ACROSS)])


def step_strip(steps: Sequence[Step], trained: Trained, *, threads: int) -> np.ndarray:
    """Return the strip of the mesher's steps: samples as dots by their residual, faces as wires."""
    world = trained.scene.world_from_scene
    eye = eye_at(EYE, TARGET, width=300, height=300, degrees=DEGREES - 6)
    row = []
    for number, step in enumerate(steps):
        points = world.points(step.points)
        if step.faces is None:
            share = np.clip(step.residual / FAR, 0, 1)[:, None]
            colors = (1 - share) * np.array(NEAR_COLOR) + share * np.array(FAR_COLOR)
            vertices, faces, shades = dots(points, DOT_RADIUS, colors)
            image = render_mesh(vertices, faces, eye, wires=False, colors=shades, threads=threads)
        else:
            wires = len(step.faces) <= WIRED
            image = render_mesh(points, step.faces, eye, wires=wires, threads=threads)
        facts = step.figures()
        words = f"{number + 1}. {step.name}\nmedian {facts['median']:.4f}, 99 % {facts['p99']:.3f}"
        row.append(labelled(image, words, size=13))
    return grid([row])


def main(arguments: Sequence[str] | None = None) -> None:
    """Mesh, measure, draw, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "benchmarks")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    threads = options.threads
    found: dict[str, Any] = {
        "origin": origin("meshers", threads), "scene": SCENE, "training": TRAINING,
        "triangles": TRIANGLES,
    }  # fmt: skip
    trained = finished(SCENE, TRAINING, threads=threads)
    region = trained.region
    field = VacancyField(
        trained.gaussians.arrays(), trained.scene.cameras, threads=threads,
        region_bounds=halo_bounds(region),
    )  # fmt: skip
    field.prepare()
    samples = sample_depth_maps(
        trained.gaussians, trained.scene.cameras, lambda p: region.contains(p, 0.0), Progress(),
        threads=threads,
    )  # fmt: skip
    rows: list[dict[str, Any]] = []
    equal: dict[str, SurfaceMesh] = {}
    for name in METHODS:
        begun_s = time.process_time()
        mesh = make(name, trained, field, samples, threads=threads)
        seconds = time.process_time() - begun_s
        equal[name] = at_equal_count(mesh, trained, TRIANGLES)
        rows.append(
            {
                "method": name,
                "processor_s": seconds,
                "made": score_mesh(trained, mesh, threads=threads),
                "equal": score_mesh(trained, equal[name], threads=threads),
            }
        )
        _logger.info("%s: %d faces, F1 %s", name, len(mesh.faces), rows[-1]["equal"]["f1"])
    settings = MeshingSettings(points=round(SPARE * TRIANGLES / 2))
    steps = steps_of(trained, field, settings, samples, threads=threads)
    found |= {"rows": rows, "steps": [step.figures() for step in steps]}
    write_record(MESHERS, found)
    out: Path = options.out
    save_picture(out / "paper-meshers.jpg", close_ups(equal, trained, threads=threads))
    strip = step_strip(shown(steps, STEPS_SHOWN), trained, threads=threads)
    save_picture(out / "paper-refinement.jpg", strip)
    _logger.info("written: %s", write_page(out))


if __name__ == "__main__":
    main()
