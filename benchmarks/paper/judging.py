# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores of a mesh, of a field and of images, as the other reports have them."""

from __future__ import annotations

from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.evaluation.surface.field_errors import vacancy_errors
from gaussian_wrapping_addon.core.evaluation.surface.scores import score_protocols
from gaussian_wrapping_addon.core.evaluation.surface.truth import Truth, read_truth
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.imaging.view_metrics import score_images
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.topology import normals_and_areas
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

from ..speed_error.plan import THRESHOLD_SHARES
from ..speed_error.score import SURFACE_SAMPLES, test_views
from .trainings import Trained

PROBED = 3000
"""True samples of thin parts, and of the others, at which a field's level is searched."""


def truth_of(trained: Trained) -> tuple[Truth, float]:
    """Return the true surface and the crop volume's diagonal, world units."""
    diagonal = float(read_json(trained.truth_folder / "scene.json")["diagonal"])
    return read_truth(trained.truth_folder), diagonal


def true_surface(trained: Trained) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (v, 3) and faces (f, 3) of the true surface, world units."""
    mesh = truth_of(trained)[0].mesh
    assert mesh is not None, "scenes of the benchmarks have a true mesh"
    return mesh[0], np.asarray(mesh[1], np.int64)


def score_mesh(trained: Trained, mesh: SurfaceMesh, *, threads: int) -> dict[str, Any]:
    """Return F1, precision, recall, thin recall, normals and size of a mesh in the scene frame.

    Judged is the whole surface (protocol ``uniform``, docs/method.md, section 9.1) in world
    coordinates with the known poses.
    """
    truth, diagonal = truth_of(trained)
    world = trained.scene.world_from_scene
    vertices = world.points(mesh.vertices)
    score = score_protocols(
        vertices, mesh.faces, truth, [], [share * diagonal for share in THRESHOLD_SHARES],
        count=SURFACE_SAMPLES, seed=0, threads=threads, protocols=("uniform",),
    )["uniform"].to_json()  # fmt: skip
    names = (
        "f1", "precision", "recall", "visible_recall", "thin_recall", "normal_consistency",
        "chamfer_mean", "thin_count", "truth_count",
    )  # fmt: skip
    faces = np.asarray(mesh.faces, np.int64)
    area, volume = area_and_volume(vertices, faces)
    return {
        **{name: score[name] for name in names},
        "chamfer_mean": score["chamfer_mean"] / diagonal,
        "faces": len(faces), "vertices": len(vertices), "area": area, "volume": volume,
    }  # fmt: skip


def area_and_volume(vertices: np.ndarray, faces: np.ndarray) -> tuple[float, float]:
    """Return area and volume of a closed mesh."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = float(np.einsum("nd,nd->n", a, np.cross(b, c)).sum() / 6)
    return float(normals_and_areas(vertices, faces)[1].sum()), volume


def level_offsets(trained: Trained, field: VacancyField) -> dict[str, Any]:
    """Return where a field crosses 0.5 along the true normals, on thin parts and elsewhere.

    Lengths are shares of the diagonal; negative offsets lie inside of the true solid.
    """
    truth, diagonal = truth_of(trained)
    inverse = trained.scene.world_from_scene.inverse()
    limits = [inverse.scale * share * diagonal for share in THRESHOLD_SHARES]
    seen = truth.visible()
    found: dict[str, Any] = {}
    thin = np.zeros(len(seen), bool) if truth.thin is None else truth.thin
    parts = {"thin": np.flatnonzero(seen & thin), "other": np.flatnonzero(seen & ~thin)}
    for name, rows in parts.items():
        if len(rows) < PROBED // 10:
            continue
        chosen = np.random.default_rng(0).choice(rows, min(PROBED, len(rows)), replace=False)
        errors = vacancy_errors(
            field, inverse.points(truth.samples.points[chosen]),
            inverse.directions(truth.samples.normals[chosen]), limits,
        )  # fmt: skip
        length = inverse.scale * diagonal
        found[name] = {
            "found": errors.found,
            "within": list(errors.within),
            "median_offset": errors.median_offset / length,
            "median": errors.median / length,
        }
    return found


def held_out_psnr(trained: Trained, *, threads: int) -> float:
    """Return the mean PSNR, dB, of the test views, which no training was given."""
    views = test_views(trained.truth_folder, trained.scene.world_from_scene.inverse())
    options = RenderOptions(depth=False, threads=threads)
    return float(
        np.mean(
            [
                score_images(render(trained.gaussians, c, options).color.numpy(), photo).psnr
                for c, photo in views
            ]
        )
    )
