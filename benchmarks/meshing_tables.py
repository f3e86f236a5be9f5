# SPDX-License-Identifier: GPL-3.0-or-later
"""The meshing study: targets, tables and plots."""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.evaluation.surface_scores import (
    Truth,
    read_truth,
    score_protocols,
)
from gaussian_wrapping_addon.core.field.samples import sample_depth_maps
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.field.vector_field import VectorField
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.mesh.sampling import distances_to_mesh, sample_triangles
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import mesh_statistics
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.surface_points import Field
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.scene_regions import automatic_region, parse_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.settings import SPACINGS, MeshingSettings

from .field_errors import field_gaussians
from .meshing_runs import (
    ADAPTIVE,
    FUSION,
    LABELS,
    LARGE_POINTS,
    LARGE_SCENE,
    METHODS,
    PAM,
    SPACING_SCENES,
    UNIFORM,
    UNITS,
    Made,
    Outcome,
)
from .plots import Panel, Series, write_svg
from .tables import AT, MIDDLE, SHARES, Row, Table, table_of, thin_recall, three

_logger = logging.getLogger(__name__)

SAMPLES = 100_000
"""Points on each surface that distances are measured from."""

REFERENCE_FACTOR = 8
"""The reference has so many times the points of the finest mesh that is judged: about three times
shorter edges, an eighth of its chord errors."""

F1_SHARE = 0.005
"""Threshold of the F1 to the truth, of the region's diagonal."""

ERRORS = ("mean", "p99", "reference_mean", "reference_p99")


class MeasuredScene:
    """Fields of trained Gaussians over a region, meshed again and again."""

    def __init__(
        self,
        gaussians: OrientedGaussians,
        cameras: Sequence[Camera],
        region: Region,
        *,
        threads: int,
        truth: Truth | None = None,
        world_from_scene: Similarity | None = None,
    ) -> None:
        self.cameras, self.region, self.threads = list(cameras), region, threads
        self.arrays = gaussians.arrays()
        self.vacancy = VacancyField(self.arrays, self.cameras, threads=threads)
        self.vectors = VectorField(self.arrays, threads=threads)
        self.depth_samples = sample_depth_maps(
            gaussians, self.cameras, lambda p: region.contains(p, 0.0), Progress(), threads=threads
        )
        self.truth, self.world_from_scene = truth, world_from_scene

    def mesh(self, points: int, spacing: str) -> tuple[SurfaceMesh, float, float]:
        """Return a mesh, its wall seconds and its processor seconds."""
        begun_s, cpu_s = time.monotonic(), time.process_time()
        mesh = mesh_region(
            Field(self.vacancy, self.vectors, self.threads),
            self.arrays,
            self.cameras,
            self.region,
            MeshingSettings(points=points, spacing=spacing),
            Progress(),
            seed=0,
            depth_samples=self.depth_samples,
        )
        return mesh, time.monotonic() - begun_s, time.process_time() - cpu_s

    def judged(self, mesh: SurfaceMesh, reference: SurfaceMesh) -> dict[str, float]:
        """Return distances both ways in shares of the diagonal, and F1 to the truth if known.

        Caps on the region's boundary are part of both surfaces.
        """
        to, back = (
            _sampled_distances(a, b) / self.region.diagonal
            for a, b in ((mesh, reference), (reference, mesh))
        )
        figures = {
            "mean": float(to.mean()),
            "p99": float(np.quantile(to, 0.99)),
            "reference_mean": float(back.mean()),
            "reference_p99": float(np.quantile(back, 0.99)),
        }
        if self.truth is not None and self.world_from_scene is not None:
            world = self.world_from_scene
            threshold = F1_SHARE * self.region.diagonal * world.scale
            scores = score_protocols(
                world.points(mesh.vertices), mesh.faces, self.truth,
                [camera.moved(world) for camera in self.cameras], [threshold], count=SAMPLES,
                seed=0, threads=self.threads,
            )["uniform"].to_json()  # fmt: skip
            figures["f1"] = scores["f1"][0]
            if scores.get("thin_recall"):
                figures["thin_recall"] = scores["thin_recall"][0]
        return figures


def measure_spacings(scene: MeasuredScene, points: Sequence[int]) -> dict[str, Any]:
    """Mesh with both spacings at each number of points, and judge every mesh.

    Returns
    -------
    dict
        ``meshes``: one entry a mesh; ``vertex_ratio``: for each kind of error, vertices that
        adaptive spacing needs, of those of uniform spacing (see :func:`vertex_ratio`).
    """
    reference, _, _ = scene.mesh(REFERENCE_FACTOR * max(points), "uniform")
    meshes = []
    for spacing in SPACINGS:
        for count in points:
            mesh, wall_s, cpu_s = scene.mesh(count, spacing)
            statistics, notes = mesh_statistics(mesh), mesh.provenance
            meshes.append({
                "spacing": spacing, "points": count, "vertices": len(mesh.vertices),
                "wall_s": wall_s, "cpu_s": cpu_s,
                "level_error_median": notes.get("level_error_median"),
                "level_error_p99": notes.get("level_error_p99"),
                "closed": statistics.closed, "genus": statistics.genus,
                "components": statistics.components, **scene.judged(mesh, reference),
            })  # fmt: skip
            _logger.info("%s", json.dumps(meshes[-1]))
    ratios = {error: vertex_ratio(meshes, error) for error in ERRORS}
    return {"reference_vertices": len(reference.vertices), "meshes": meshes, "vertex_ratio": ratios}


def vertex_ratio(meshes: Sequence[dict[str, Any]], error: str) -> list[float]:
    """Return, for each adaptive mesh, its vertices over those of a uniform mesh of equal error.

    The uniform counts are interpolated between two meshes, and extrapolated from the two nearest
    beyond them, on logarithmic axes. Infinite where no number of vertices would do.
    """
    uniform = sorted(
        (m["vertices"], m[error]) for m in meshes if m["spacing"] == "uniform"
    )  # fmt: skip
    log_count, log_error = np.log(np.array(uniform, np.float64)).T
    ratios = []
    for mesh in meshes:
        if mesh["spacing"] != "adaptive":
            continue
        wanted = float(np.log(mesh[error]))
        # The last segment whose left end is still worse than what is wanted.
        at = min(max(int((log_error > wanted).sum()) - 1, 0), len(log_error) - 2)
        slope = (log_error[at + 1] - log_error[at]) / (log_count[at + 1] - log_count[at])
        if slope >= 0:
            ratios.append(float("inf"))
            continue
        equal = log_count[at] + (wanted - log_error[at]) / slope
        ratios.append(float(np.exp(np.log(mesh["vertices"]) - equal)))
    return ratios


def _sampled_distances(mesh: SurfaceMesh, other: SurfaceMesh) -> np.ndarray:
    points, _ = sample_triangles(mesh.vertices, mesh.faces, SAMPLES, np.random.default_rng(0))
    return distances_to_mesh(points, other.vertices, other.faces)[0]


def open_scene(scene_folder: Path, gaussian_file: Path, *, threads: int) -> MeasuredScene:
    """Read cameras, region (automatic where none lies there), truth and Gaussians."""
    with tempfile.TemporaryDirectory(prefix="gwrap_spacing_") as work:
        scene = load_scene(scene_folder, Path(work), Progress(), seed=0, threads=threads)
    region_file = scene_folder / "region.json"
    if region_file.exists():
        region = parse_region(read_json(region_file), region_file)
        region = region.transformed(scene.world_from_scene.inverse())
    else:
        region = automatic_region(scene)
    truth = read_truth(scene_folder) if (scene_folder / "truth.npz").exists() else None
    return MeasuredScene(
        field_gaussians(gaussian_file), scene.cameras, region, threads=threads, truth=truth,
        world_from_scene=scene.world_from_scene,
    )  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure one scene and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("gaussians", type=Path)
    parser.add_argument("--points", type=int, nargs="+", default=[6000, 12_000, 24_000])
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    scene = open_scene(options.scene, options.gaussians, threads=options.threads)
    figures = measure_spacings(scene, options.points)
    _logger.info("vertex ratio %s", json.dumps(figures["vertex_ratio"]))
    if options.out is not None:
        write_json(options.out, figures)


LEVEL_P99, LEVEL_MEDIAN = 0.02, 0.002
VERTEX_SHARE = 0.5
VACANCY_S, LARGE_S, LARGE_GB = 12.0, 120.0, 3.0
TOPOLOGY_SCENES = ("torus", "spot", "fence", "wheel")
OTHER_LARGE_SHARE = 0.8
"""Vertices that a mesh of "200k" has to have at least, of those."""


@dataclasses.dataclass(frozen=True)
class Check:
    """One target and what was measured."""

    what: str
    target: str
    figure: str
    met: bool | None
    """``None``: shown for comparison, without a target."""


def checks(outcome: Outcome) -> list[Check]:
    """Return every target whose meshes exist, in the order of the issue."""
    made = outcome.made
    return [
        *_solid(outcome), *_level(made), *_spacing(made), *_vacancy(outcome), *_large(made),
        *_doubled(made), *_topology(made),
    ]  # fmt: skip


def acceptance_table(outcome: Outcome) -> Table:
    """Return target, figure and whether it was met."""
    words = {True: "yes", False: "NO", None: ""}
    rows: list[Row] = [
        {"what": c.what, "target": c.target, "measured": c.figure, "met": words[c.met]}
        for c in checks(outcome)
    ]
    return table_of(
        "Targets",
        rows,
        "Closed: by our own check (closed, oriented, 2-manifold, positive volume, no degenerate "
        "face) and by trimesh (watertight, consistent winding, positive volume). Seconds and "
        "memory are those of the mesh's own process, from loaded Gaussians and cameras; memory is "
        "its peak and that of its largest helper added, an upper bound.",
        "Rows without a target are for comparison. What needs no training is held by tests and "
        "is not measured here: invariance to scale, thin plates, the torus, hard cases of Delaunay "
        "and marching tetrahedra, regions without a surface.",
    )


def _solid(outcome: Outcome) -> list[Check]:
    """Return how many meshes of each method are good solids, and those of the jobs themselves."""
    found = []
    jobs = {
        name: bool(run["report"]["regions"][run["region"]]["check"]["good"])
        for name, run in outcome.trainings.items()
    }
    if jobs:
        found.append(_good("meshes of the jobs themselves", jobs, bound=True))
    for method in METHODS:
        goods = {f"{m.subject.name} {m.method.size}": good(m) for m in outcome.made
                 if m.method.name == method}  # fmt: skip
        if goods:
            found.append(_good(f"{LABELS[method]}: closed", goods, bound=method != FUSION))
    return found


def good(made: Made) -> bool:
    """Tell whether our own check and trimesh both call a mesh a good solid."""
    return bool(made.scores["check"]["good"] and made.scores["trimesh_good"])


def _good(what: str, goods: dict[str, bool], *, bound: bool) -> Check:
    bad = [name for name, value in goods.items() if not value]
    words = f"{len(goods) - len(bad)} of {len(goods)}"
    if bad:
        words += f"; not: {', '.join(bad)}"
    return Check(what, "all" if bound else "", words, not bad if bound else None)


def _level(made: Sequence[Made]) -> list[Check]:
    """Return the worst mesh of both spacings: vertices on the isosurface, and all of them."""
    found = []
    meshes = [m for m in made if m.method.name in PAM]
    for figure, bound, words in (("p99", LEVEL_P99, "99 %"), ("median", LEVEL_MEDIAN, "median")):
        for title, of in (
            ("vertices put on the isosurface", _own_level),
            ("all vertices", _level_of),
        ):
            values = {f"{m.subject.name}, {m.method.identity}": of(m, figure) for m in meshes}
            known = {name: value for name, value in values.items() if value is not None}
            if not known:
                continue
            worst = max(known, key=lambda name: known[name])
            within = sum(value <= bound for value in known.values())
            found.append(Check(
                f"PAM, {title} in the region: \\|v - 0.5\\|, {words}",
                f"at most {bound:g}",
                f"{within} of {len(known)} meshes; worst {known[worst]:.2g} ({worst})",
                within == len(known),
            ))  # fmt: skip
    return found


def _own_level(made: Made, figure: str) -> float | None:
    """Return what meshing measured at the vertices that it put on the isosurface."""
    value = made.figures["provenance"].get(f"level_error_{figure}")
    return None if value is None else float(value)


def _level_of(made: Made, figure: str) -> float | None:
    """Return what the judge measured at all vertices well inside of the region."""
    value = made.scores["level"].get(f"level_error_{figure}")
    return None if value is None else float(value)


def _spacing(made: Sequence[Made]) -> list[Check]:
    """Return vertices of adaptive over those of uniform meshes of equal error."""
    found = []
    for scene in SPACING_SCENES:
        meshes = [
            {"spacing": m.method.name, "vertices": m.figures["vertices"], **m.scores["distance"]}
            for m in made
            if m.subject.name == scene and m.method.name in PAM
        ]
        for error, words, bound in (
            ("mean", "mean distance to the isosurface", True),
            ("reference_mean", "mean distance from it", True),
            ("p99", "99 % of the distance to it", False),
        ):
            usable = [m for m in meshes if m[error]]
            kinds = [m["spacing"] for m in usable]
            if kinds.count(UNIFORM) < 2 or ADAPTIVE not in kinds:
                continue
            ratios = vertex_ratio(usable, error)
            found.append(Check(
                f"{scene}: vertices of adaptive of those of uniform meshes, equal {words}",
                f"at most {VERTEX_SHARE:g}" if bound else "",
                ", ".join(f"{ratio:.2f}" for ratio in ratios),
                max(ratios) <= VERTEX_SHARE if bound else None,
            ))  # fmt: skip
    return found


def _vacancy(outcome: Outcome) -> list[Check]:
    v = outcome.vacancy
    if v is None:
        return []
    task = f"{v['points']} points, {v['cameras']} cameras, {v['gaussians']} Gaussians"
    return [
        Check(
            f"vacancy of {task}, {v['threads']} threads",
            f"at most {VACANCY_S:g} s",
            f"{v['seconds']:.1f} s (processor {v['prepare_cpu_s'] + v['values_cpu_s']:.1f} s)",
            v["seconds"] <= VACANCY_S,
        ),
        Check(
            "the same: largest error of a sample against the definition",
            "",
            f"{v['error_max']:.1g}; right side of 0.5: {100 * v['same_side_share']:.4g} %",
            None,
        ),
    ]


def _large(made: Sequence[Made]) -> list[Check]:
    found = []
    for m in made:
        if (m.subject.name, m.method.size) != (LARGE_SCENE, LARGE_POINTS):
            continue
        f, gb = m.figures, m.figures["peak_bytes"] / 1e9
        name = f"{LARGE_SCENE}, {m.method.label}, {f['vertices']} vertices"
        enough = f["vertices"] >= OTHER_LARGE_SHARE * LARGE_POINTS
        short = "" if enough else "; fewer vertices than asked for"
        found += [
            Check(f"{name}: time", f"at most {LARGE_S:g} s",
                  f"{f['wall_s']:.0f} s (processor {f['cpu_s']:.0f} s){short}",
                  enough and f["wall_s"] <= LARGE_S),
            Check(f"{name}: peak memory", f"at most {LARGE_GB:g} GB", f"{gb:.2f} GB{short}",
                  enough and gb <= LARGE_GB),
        ]  # fmt: skip
    return found


def _doubled(made: Sequence[Made]) -> list[Check]:
    """Return growth of time and vertices where the edges of a uniform mesh become half as long."""
    found = []
    for scene in dict.fromkeys(m.subject.name for m in made):
        by_size = {m.method.size: m.figures for m in made
                   if m.subject.name == scene and m.method.name == UNIFORM}  # fmt: skip
        for size, coarse in by_size.items():
            fine = by_size.get(4 * size)
            if fine is None:
                continue
            grown = fine["vertices"] / coarse["vertices"]
            wall, cpu = fine["wall_s"] / coarse["wall_s"], fine["cpu_s"] / coarse["cpu_s"]
            words = f"{wall:.2f} times" + (f" (processor {cpu:.2f})" if math.isfinite(cpu) else "")
            found.append(Check(
                f"{scene}: time at twice the resolution, {size} to {4 * size} points",
                f"at most {grown:.2f} times, as the vertices", words, wall <= grown,
            ))  # fmt: skip
    return found


def _topology(made: Sequence[Made]) -> list[Check]:
    found = []
    for scene in TOPOLOGY_SCENES:
        same = [m for m in made if m.subject.name == scene and m.method.name in PAM]
        if not same:
            continue
        true = same[0].scores["truth"]["euler"]
        values = {m.method.identity: m.scores["check"]["euler"] for m in same}
        words = ", ".join(f"{name} {value}" for name, value in values.items())
        met = all(value == true for value in values.values())
        found.append(Check(f"{scene}: Euler characteristic of the truth", f"{true}", words, met))
    return found


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


SHOWN = ("spot", "wheel", "room", "fence")
"""Scenes with plots, where they were measured."""

Value = Callable[[Made], float]


def write_plots(made: Sequence[Made], path: Path) -> None:
    """Write all panels into one SVG; none where no scene of :data:`SHOWN` was measured."""
    panels = []
    for scene in SHOWN:
        same = [m for m in made if m.subject.name == scene]
        off, seconds = "mean distance to isosurface, %", "seconds"
        for title, x_label, y_label, x, y, log in (
            ("time against isosurface", seconds, off, _seconds, _off, True),
            ("vertices against isosurface", "vertices", off, _vertices, _off, True),
            ("time against truth", seconds, f"F1 at {AT}", _seconds, _f1, False),
        ):
            series = _series(same, x, y)
            if series:
                panels.append(
                    Panel(f"{scene}: {title}", x_label, y_label, series, legend_low=not log,
                          y_log=log)
                )  # fmt: skip
    if panels:
        write_svg(panels, path)


def _series(made: Sequence[Made], x: Value, y: Value) -> list[Series]:
    """Return a series a method, its sizes joined from small to large."""
    found = []
    for method in METHODS:
        same = sorted((m for m in made if m.method.name == method), key=lambda m: m.method.size)
        kept = [m for m in same if math.isfinite(x(m)) and math.isfinite(y(m))]
        points = [(x(m), y(m)) for m in kept]
        if points:
            labels = tuple(str(m.method.size) for m in kept)
            found.append(Series(LABELS[method], points, labels=labels))
    return found


def _seconds(made: Made) -> float:
    return float(made.figures["wall_s"])


def _vertices(made: Made) -> float:
    return float(made.figures["vertices"])


def _off(made: Made) -> float:
    value = made.scores["distance"]["mean"]
    # A logarithmic axis has no zero.
    return 100 * value if value else math.nan


def _f1(made: Made) -> float:
    if "truth" not in made.scores:
        return math.nan
    return float(made.scores["truth"]["uniform"]["f1"][MIDDLE])


if __name__ == "__main__":
    main()
