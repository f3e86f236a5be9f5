# SPDX-License-Identifier: GPL-3.0-or-later
"""The field under the earlier attenuation against the vacancy.

``python -m benchmarks.paper.attenuation``. Two trainings of the wheel, the method's and a plain one
whose losses know neither definition of depth, each with both fields: slices, meshes marched on the
same tetrahedra, scores, and how far the level lies from the true surface. Writes a record, three
pictures, and the page.
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
from gaussian_wrapping_addon.core.field.depth_samples import bracket_pairs, sample_depth_maps
from gaussian_wrapping_addon.core.field.vacancy import brute_force
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from gaussian_wrapping_addon.core.mesh.components import compacted
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.pivot_meshing import BRACKET_SHARE
from gaussian_wrapping_addon.core.meshing.points.candidate_surface import (
    halo_bounds,
    pivots_and_probes,
)
from gaussian_wrapping_addon.core.meshing.points.pivots import two_pivots
from gaussian_wrapping_addon.core.meshing.points.spacing import footprints
from gaussian_wrapping_addon.core.meshing.tetrahedra.boundary_faces import tetrahedron_neighbours
from gaussian_wrapping_addon.core.meshing.tetrahedra.delaunay import bounding_points, delaunay
from gaussian_wrapping_addon.core.meshing.tetrahedra.marching_tetrahedra import (
    bisect,
    marching_closed,
)
from gaussian_wrapping_addon.core.meshing.tetrahedra.tetrahedron_cut import cut_to_region
from gaussian_wrapping_addon.core.progress import Progress

from ..speed_error.runs import ROOT
from . import earlier_field
from .document import write_page
from .earlier_field import EarlierField
from .judging import area_and_volume, level_offsets, score_mesh, true_surface, truth_of
from .pictures import eye_at, grid, labelled, render_mesh, save_picture
from .records import ATTENUATION, origin, write_record
from .slices import (
    SIDE,
    Plane,
    draw_slice,
    inside_segments,
    level_segments,
    mesh_segments,
    rim_plane,
    spoke_planes,
)
from .trainings import FULL, PLAIN, Trained, finished

_logger = logging.getLogger("benchmarks")

SCENE = "wheel"
OURS, EARLIER = "vacancy", "earlier"
FIELDS = {OURS: VacancyField, EARLIER: EarlierField}
TRAININGS = (FULL, PLAIN)
ATTENUATIONS = {OURS: "one-sided attenuation", EARLIER: "earlier, two-sided"}
WORDS = {FULL: "method's training", PLAIN: "plain training"}

SPOKE_RADII, SPOKE_HALF = (0.30, 0.45), 0.014
RIM_DEGREES, RIM_RADIUS, RIM_HALF = 33.0, 0.655, 0.085
OURS_COLOR, EARLIER_COLOR, TRUTH_COLOR = (214, 110, 20), (190, 20, 60), (15, 15, 15)

ONE_ALPHAS = (0.95, 0.7)
"""Opacities of the single Gaussian: above and below 0.75."""


def fields_of(trained: Trained, *, threads: int) -> dict[str, VacancyField]:
    """Return both fields of a training."""
    arrays, bounds = trained.gaussians.arrays(), halo_bounds(trained.region)
    return {
        name: kind(arrays, trained.scene.cameras, threads=threads, region_bounds=bounds)
        for name, kind in FIELDS.items()
    }


def tetrahedra_for(
    trained: Trained, fields: dict[str, VacancyField], *, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (p, 3) and tetrahedra (t, 4), cut along the region, for all fields.

    The points are two pivots of each Gaussian, and for each field the pairs of points that its own
    sides allow across the depth maps: neither is at a disadvantage.
    """
    region, arrays = trained.region, trained.gaussians.arrays()
    samples = sample_depth_maps(
        trained.gaussians, trained.scene.cameras, lambda p: region.contains(p, 0.0), Progress(),
        threads=threads,
    )  # fmt: skip
    parts = [pivots_and_probes(arrays, region, 0, two_pivots).points]
    for field in fields.values():
        parts += bracket_pairs(samples, field.is_empty)
    points = np.concatenate(parts)
    low, high = halo_bounds(region)
    points = points[((points >= low) & (points <= high)).all(1)]
    points = np.concatenate([points, bounding_points(points, 0)])
    cut = cut_to_region(points, delaunay(points, seed=0, progress=Progress()), region)
    return cut.points, cut.tetrahedra


def march(
    trained: Trained, field: VacancyField, points: np.ndarray, tetrahedra: np.ndarray
) -> SurfaceMesh:
    """Return the closed mesh of a field's 0.5 level on given tetrahedra, nothing removed."""
    used = np.unique(tetrahedra)
    inside = np.zeros(len(points), np.bool_)
    inside[used] = ~field.is_empty(points[used])
    edges, faces = marching_closed(tetrahedra, tetrahedron_neighbours(tetrahedra), inside)
    begin, end = points[edges[:, 0]], points[edges[:, 1]]
    pixel, length = (
        footprints((begin + end) / 2, trained.scene.cameras),
        np.linalg.norm(end - begin, axis=1),
    )
    limit = np.where(pixel > 0, np.minimum(pixel, length), length)
    ends = bisect(begin, end, field.is_empty, BRACKET_SHARE * limit, Progress())
    vertices, kept, _ = compacted((ends[0] + ends[1]) / 2, faces)
    return SurfaceMesh(vertices, kept.astype(np.int32))


def planes(trained: dict[str, Trained], fields: dict[str, dict[str, VacancyField]]) -> list[Plane]:
    """Return the planes of the slices: across the rim, and across a spoke that there is.

    The spoke is the most solitary one of some places whose axis is solid in every training under
    the method's own definition: where a training has lost a spoke there is nothing to compare.
    """
    first = next(iter(trained.values()))
    truth, _ = truth_of(first)
    assert truth.thin is not None, "the wheel's spokes are labelled"
    candidates = spoke_planes(truth.samples.points[truth.thin], SPOKE_RADII, SPOKE_HALF)
    centers = np.array([plane.center for plane in candidates])
    solid = np.ones(len(centers), np.bool_)
    for name, one in trained.items():
        inverse = one.scene.world_from_scene.inverse()
        solid &= ~fields[name][OURS].is_empty(inverse.points(centers))
    if not solid.any():
        raise MeshingError("No spoke is held by all trainings.", "Train for longer.")
    spoke = candidates[int(np.flatnonzero(solid)[0])]
    return [spoke, rim_plane(RIM_DEGREES, RIM_RADIUS, RIM_HALF)]


def slices_of(
    cuts: Sequence[Plane], trained: Trained, fields: dict[str, VacancyField]
) -> tuple[dict[str, Any], dict[str, list[np.ndarray]]]:
    """Return the areas of the sections, and (side, side) values of each field, by plane."""
    surface = true_surface(trained)
    inverse = trained.scene.world_from_scene.inverse()
    areas: dict[str, Any] = {}
    values: dict[str, list[np.ndarray]] = {name: [] for name in fields}
    for plane in cuts:
        cut = plane.pixels(mesh_segments(plane, *surface))
        true = float(inside_segments(cut, SIDE).mean())
        row: dict[str, float] = {}
        for name, field in fields.items():
            where = inverse.points(plane.points().reshape(-1, 3))
            found = field.vacancy(where).vacancy.reshape(SIDE, SIDE)
            values[name].append(found)
            row[name] = float((found <= 0.5).mean()) / true
        areas[plane.name] = row
    return areas, values


def slice_picture(
    cuts: Sequence[Plane], all_values: dict[str, dict[str, list[np.ndarray]]], trained: Trained
) -> np.ndarray:
    """Return rows of planes, columns of trainings and fields."""
    surface = true_surface(trained)
    rows = []
    for number, plane in enumerate(cuts):
        cut = plane.pixels(mesh_segments(plane, *surface))
        bar = 0.005 if plane.half < 0.05 else 0.05
        row = []
        for training, values in all_values.items():
            for name, color in ((OURS, OURS_COLOR), (EARLIER, EARLIER_COLOR)):
                found = values[name][number]
                image = draw_slice(
                    found,
                    [(cut, TRUTH_COLOR, 1), (level_segments(found), color, 2)],
                    scale=(bar / plane.half * SIDE / 2, f"{bar:g}"),
                )
                words = f"{plane.name}: {name},\n{WORDS[training]}"
                row.append(labelled(image, words))
        rows.append(row)
    return grid(rows)


def one_gaussian_picture() -> np.ndarray:
    """Return the transmittance of one round Gaussian from one camera below it, both definitions."""
    images = []
    eye = np.array([0.0, 0.0, -6.0])
    plane = Plane("", np.zeros(3), np.array([1.0, 0, 0]), np.array([0.0, 0, 1.0]), 2.2)
    turn = np.linspace(0.0, 2 * np.pi, 120)
    for alpha in ONE_ALPHAS:
        arrays = GaussianArrays(
            np.zeros((1, 3)), np.ones((1, 3)), np.eye(3)[None], np.log([alpha]), np.zeros((1, 3)),
            np.zeros((1, 1, 3), np.float32),
        )  # fmt: skip
        radius = np.sqrt(2 * np.log(2 * alpha))
        ring = radius * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], 1)
        own = plane.pixels(np.stack([ring[:-1], ring[1:]], 1))
        for name, law, color in (
            (OURS, brute_force.log_transmittance, OURS_COLOR),
            (EARLIER, earlier_field.log_transmittance, EARLIER_COLOR),
        ):
            where = plane.points().reshape(-1, 3)
            found = np.exp(law(arrays, eye, where)).reshape(SIDE, SIDE)
            image = draw_slice(found, [(own, TRUTH_COLOR, 1), (level_segments(found), color, 2)])
            images.append(labelled(image, f"{ATTENUATIONS[name]},\nopacity {alpha:g}"))
    return grid([images])


def mesh_picture(
    meshes: dict[str, dict[str, SurfaceMesh]], trained: Trained, threads: int
) -> np.ndarray:
    """Return close-ups: truth and both fields' meshes, a row for each training."""
    eye = eye_at((0.05, -1.15, 0.55), (0.28, 0.0, 0.33), width=400, height=330, degrees=30)
    world = trained.scene.world_from_scene
    true = render_mesh(*true_surface(trained), eye, wires=False, threads=threads)
    rows = []
    for training, both in meshes.items():
        row = [labelled(true, "true surface\n")]
        for name, mesh in both.items():
            image = render_mesh(
                world.points(mesh.vertices), mesh.faces, eye, wires=False, threads=threads
            )
            row.append(labelled(image, f"{name},\n{WORDS[training]}"))
        rows.append(row)
    return grid(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, draw, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "benchmarks")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    threads = options.threads
    found: dict[str, Any] = {"origin": origin("attenuation", threads), "scene": SCENE}
    trained = {name: finished(SCENE, name, threads=threads) for name in TRAININGS}
    fields = {name: fields_of(one, threads=threads) for name, one in trained.items()}
    cuts = planes(trained, fields)
    rows: list[dict[str, Any]] = []
    all_values: dict[str, dict[str, list[np.ndarray]]] = {}
    meshes: dict[str, dict[str, SurfaceMesh]] = {}
    for training, one in trained.items():
        areas, all_values[training] = slices_of(cuts, one, fields[training])
        points, tetrahedra = tetrahedra_for(one, fields[training], threads=threads)
        meshes[training] = {}
        for name, field in fields[training].items():
            begun_s = time.process_time()
            mesh = march(one, field, points, tetrahedra)
            meshes[training][name] = mesh
            rows.append(
                {
                    "training": training,
                    "field": name,
                    "tetrahedra": len(tetrahedra),
                    "sections": {plane: areas[plane][name] for plane in areas},
                    "mesh": score_mesh(one, mesh, threads=threads),
                    "level": level_offsets(one, field),
                    "processor_s": time.process_time() - begun_s,
                }
            )
            _logger.info("%s, %s: F1 %s", training, name, rows[-1]["mesh"]["f1"])
    area, volume = area_and_volume(*true_surface(one))
    found |= {"true_area": area, "true_volume": volume, "rows": rows}
    write_record(ATTENUATION, found)
    out: Path = options.out
    save_picture(out / "paper-attenuation-one.png", one_gaussian_picture())
    save_picture(out / "paper-attenuation-slices.png", slice_picture(cuts, all_values, one))
    save_picture(out / "paper-attenuation-meshes.jpg", mesh_picture(meshes, one, threads))
    _logger.info("written: %s", write_page(out))


if __name__ == "__main__":
    main()
