# SPDX-License-Identifier: GPL-3.0-or-later
"""What meshing has to reach, each target beside its figure."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from ..meshing_parts.spacing import vertex_ratio
from ..speed_error.tables import Row, table_of
from ..tables import Table
from .carry_out import Made, Outcome
from .plan import (
    ADAPTIVE,
    FUSION,
    LABELS,
    LARGE_POINTS,
    LARGE_SCENE,
    METHODS,
    PAM,
    SPACING_SCENES,
    UNIFORM,
)

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
