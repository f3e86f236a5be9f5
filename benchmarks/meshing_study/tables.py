# SPDX-License-Identifier: GPL-3.0-or-later
"""The tables of the meshing study; a row is a dictionary, so no heading stands over another's
figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..speed_error.tables import AT, SHARES, Row, table_of, thin_recall, three
from ..tables import Table
from .acceptance import good
from .carry_out import Made
from .plan import METHODS, PAM, UNITS

FINER = 3
"""A reference with so many times the vertices has a third of the chord errors: below that, what is
measured would be its own."""


def ordered(made: Sequence[Made]) -> list[Made]:
    """Return the meshes scene by scene, method by method, from small to large."""
    scenes = list(dict.fromkeys(m.subject.name for m in made))
    return sorted(
        made,
        key=lambda m: (
            scenes.index(m.subject.name), METHODS.index(m.method.name), m.method.size,
        ),
    )  # fmt: skip


def _named(made: Made) -> Row:
    size = f"{made.method.size} {UNITS[made.method.name]}"
    return {"scene": made.subject.name, "method": made.method.label, "size": size}


def cost_table(made: Sequence[Made]) -> Table:
    """Return size, time and memory of every mesh."""
    rows: list[Row] = [
        {
            **_named(m),
            "vertices": m.figures["vertices"],
            "faces": m.figures["faces"],
            "s": f"{m.figures['wall_s']:.1f}",
            "processor s": f"{m.figures['cpu_s']:.1f}",
            "peak GB": f"{m.figures['peak_bytes'] / 1e9:.2f}",
            "GB before": f"{m.figures['before_bytes'] / 1e9:.2f}",
        }
        for m in ordered(made)
    ]
    return table_of(
        "What it costs",
        rows,
        "Each mesh has a process of its own. Seconds run from loaded Gaussians and cameras to the "
        "mesh: sightings, preparation of the field and depth maps count. Processor seconds add up "
        "all threads and helpers. Peak: the process and its largest helper added; before: the "
        "process when the clock starts, with its libraries (Open3D's are large).",
    )


def isosurface_table(made: Sequence[Made]) -> Table:
    """Return how far every mesh is from the surface that all of them stand for."""
    rows: list[Row] = []
    for m in ordered(made):
        level, distance = m.scores["level"], m.scores["distance"]
        if too_fine(m):
            distance = dict.fromkeys(distance)
        rows.append({
            **_named(m),
            "vertices": m.figures["vertices"],
            **{f"\\|v - 0.5\\| {name}": _small(level.get(f"level_error_{name}"))
               for name in ("median", "p95", "p99")},
            "mean %": _percent(distance["mean"]),
            "99 % of it": _percent(distance["p99"]),
            "mean from it %": _percent(distance["reference_mean"]),
            "Hausdorff %": _percent(distance["hausdorff"]),
        })  # fmt: skip
    return table_of(
        "How exact: the isosurface of the trained field",
        rows,
        "\\|v - 0.5\\|: at all vertices of the mesh inside of the region, whatever they were made "
        "for; those where the sight of all cameras ends lie on no isosurface. Distances are shares "
        "of the region's diagonal, to a uniform mesh of the same field with "
        f"{_counts(made)} points. That reference is made by the same program and has an error of "
        f"its own: PAM meshes with more than 1/{FINER} of its vertices get no distances. Mean and "
        "99 %: from the mesh to it; mean "
        "from it: large where the mesh lacks a part. Hausdorff: the largest of both directions, "
        "over 100 000 samples and all vertices of either. What lies within 0.5 % of the region's "
        "boundary is not judged.",
    )


def too_fine(made: Made) -> bool:
    """Tell whether a mesh is about as fine as the reference that it would be compared with."""
    finest = made.scores["reference_vertices"] / FINER
    return made.method.name in PAM and made.figures["vertices"] > finest


def _counts(made: Sequence[Made]) -> str:
    """Return the points of the references, in words."""
    return " or ".join(str(n) for n in sorted({m.subject.reference_points for m in made}))


def truth_table(made: Sequence[Made]) -> Table:
    """Return the scores against the true surface, where there is one."""
    rows: list[Row] = []
    for m in ordered(made):
        if "truth" not in m.scores:
            continue
        uniform = m.scores["truth"]["uniform"]
        rows.append({
            **_named(m),
            "vertices": m.figures["vertices"],
            **{f"F1 {s}": f"{v:.3f}" for s, v in zip(SHARES, uniform["f1"], strict=True)},
            f"precision {AT}": f"{uniform['precision'][1]:.3f}",
            f"recall {AT}": f"{uniform['recall'][1]:.3f}",
            f"thin recall {AT}": three(thin_recall(uniform)),
        })  # fmt: skip
    return table_of(
        "How exact: the true surface",
        rows,
        "Uniform samples of the whole mesh against the whole true surface, hidden sides included; "
        "thresholds are shares of the crop volume's diagonal. What training got wrong is in all "
        "rows of a scene alike. Thin recall: true samples on parts thinner than 1.5 % of the "
        "diagonal that at least two cameras see, where at least 1 % of the samples are thin.",
    )


def solid_table(made: Sequence[Made]) -> Table:
    """Return whether every mesh is a solid, what is wrong, and its topology."""
    rows: list[Row] = []
    for m in ordered(made):
        check: dict[str, Any] = m.scores["check"]
        truth = m.scores.get("truth", {}).get("euler")
        defects = list(check["defects"])
        if not m.scores["trimesh_good"]:
            defects.append("trimesh: not a closed volume")
        rows.append({
            **_named(m),
            "closed": "yes" if good(m) else "NO",
            "parts": check["part_count"],
            "Euler": check["euler"],
            "truth's": "" if truth is None else f"{truth}",
            "defects": "; ".join(defects).replace("|", "/"),
        })  # fmt: skip
    return table_of(
        "Solids",
        rows,
        "Closed: every edge has two faces, of one orientation; every vertex one ring of faces; no "
        "degenerate face; positive volume; trimesh agrees. Marching tetrahedra are judged as "
        "extracted, a little beyond the region: open where the surface goes on. TSDF fusion has "
        "no surface where no camera looks, and is cut at the region.",
    )


def training_table(trainings: dict[str, dict[str, Any]]) -> Table:
    """Return what the meshes were made of."""
    rows: list[Row] = []
    for scene, run in trainings.items():
        report = run["report"]
        psnr = report["training"].get("held_out_psnr")
        mesh = report["regions"][run["region"]]
        rows.append({
            "scene": scene,
            "Gaussians": report["training"]["gaussians"],
            "iterations": report["training"]["iterations"],
            "held-out PSNR dB": "" if psnr is None else f"{psnr:.2f}",
            "whole command s": f"{run['wall_s']:.0f}",
            "faces of the job's mesh": mesh["statistics"]["faces"],
            "closed": "yes" if mesh["check"]["good"] else "NO",
        })  # fmt: skip
    return table_of("Trainings", rows, "Each scene was trained once; all its meshes are of that.")


def _small(value: float | None) -> str | None:
    return None if value is None else f"{value:.1e}"


def _percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.4f}"
