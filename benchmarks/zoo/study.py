# SPDX-License-Identifier: GPL-3.0-or-later
"""The zoo as a study: its cases, what is judged besides, and its page."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion, binary_fill_holes

from gaussian_wrapping_addon.core.evaluation.surface_scores import read_truth
from gaussian_wrapping_addon.core.files import finite_json, read_json
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene

from ..alpha_shape import make_alpha
from ..provenance import RECORDS, write_page
from ..runs import Photos
from ..score import read_textured, stage_folder, true_mask
from ..study import (
    KEPT_RUNS,
    Case,
    Record,
    commits,
    f1_middle,
    f1_seen,
    made_by,
    make,
    read_record,
    reading,
    record_path,
    rounded,
    run_folder,
    thin,
    view_psnr,
    write_record,
)
from ..tables import AT, MIDDLE, SHARES, Row, Table, table_of, three, two
from .catalogue import FAMILIES, PARTS, SCENES, ZooScene, draw_photography, zoo_scene
from .scene import ensure_taken_scene, ensure_zoo_scene, scene_folder, taken_folder

STUDY = "zoo"
BASELINES = "baselines"
ALPHA = "alpha"
"""The alpha shape of the sparse points, with the best alpha by the truth."""

TAKEN = "-taken"
"""Ends the labels of runs on photos as a camera takes them (:func:`.scene.ensure_taken_scene`)."""

FIGURES = "zoo"
"""Key of a record's scores for what :func:`judged` returns, and the scene's folder (``scene``)."""
_FEWEST_PX = 200
"""Openings of fewer pixels in all test views together are not judged."""


def scene_photos(name: str) -> Photos:
    """Return number and size of a scene's photos."""
    shot = draw_photography(zoo_scene(name))
    return Photos(shot.photos, shot.width, shot.height)


def alpha_case(name: str) -> Case:
    """Return the alpha shape of a scene's sparse points."""
    return Case(f"{STUDY}/{BASELINES}", name, ALPHA, 0, "", (), photos=scene_photos(name))


def run_case(name: str, label: str, preset: str, arguments: Sequence[str]) -> Case:
    """Return a job on a scene; further arguments make it a variant, which has its own label."""
    photos = scene_photos(name)
    return Case(f"{STUDY}/{label}", name, label, 0, preset, tuple(arguments), photos=photos)


def find_scene(case: Case) -> Path:
    """Return the folder of a case's scene; render it where missing."""
    return (ensure_taken_scene if _is_taken(case) else ensure_zoo_scene)(case.scene)


def is_present(record: Record) -> bool:
    """Tell whether a run was made on the scene as today's sources draw it."""
    made_on = record.scores.get(FIGURES, {}).get("scene")
    folder = (taken_folder if _is_taken(record.case) else scene_folder)(record.case.scene)
    return bool(made_on == folder.name)


def _is_taken(case: Case) -> bool:
    return case.study.endswith(TAKEN)


def is_made(case: Case) -> bool:
    """Tell whether a case has a record of the scene as today's sources draw it."""
    path = record_path(case)
    return path.is_file() and is_present(read_record(path))


def make_one(case: Case, *, threads: int, kept: Path = KEPT_RUNS) -> Record:
    """Make a job or an alpha shape, judge it, and write its record.

    Raises
    ------
    WorkerError
        With the last lines of the job's output.
    """
    scene = find_scene(case)
    # The folder found here stays the run's, even if the sources of the scenes change meanwhile.
    figures: dict[str, Any] = {"scene": scene.name}
    if case.name == ALPHA:
        made = make_alpha(case, threads=threads, kept=kept, find_scene=lambda _: scene)
    else:
        made = make(case, threads=threads, kept=kept, find_scene=lambda _: scene)
        figures |= judged(scene, run_folder(case, kept), threads)
    record = dataclasses.replace(made, scores={**made.scores, FIGURES: rounded(figures)})
    write_record(record)
    return record


def judged(scene: Path, folder: Path, threads: int) -> dict[str, Any]:
    """Return figures of a kept run besides its scores.

    Returns
    -------
    dict
        ``training_psnr``, dB, of the photos that were trained on last; ``held_out_psnr`` of those
        that were not, ``None`` without any; ``open_share``: see :func:`open_share`.
    """
    report = read_json(folder / "out" / "result" / "report.json")["training"]
    saved = load_saved_scene(stage_folder(folder / "out", "cameras"))
    mesh = read_textured(folder / "mesh").mesh
    truth = read_truth(scene)
    assert truth.mesh is not None
    values = read_json(scene / "test" / "cameras.json")["cameras"]
    surface = (saved.world_from_scene.points(mesh.vertices), mesh.faces)
    found = {
        "training_psnr": report["history"][-1]["psnr"] if report.get("history") else None,
        "held_out_psnr": report.get("held_out_psnr"),
        "open_share": open_share(
            surface, truth.mesh, [Camera.from_json(v) for v in values], threads
        ),
    }
    return dict(finite_json(found))


def open_share(
    mesh: tuple[np.ndarray, np.ndarray],
    truth: tuple[np.ndarray, np.ndarray],
    cameras: Sequence[Camera],
    threads: int,
) -> float | None:
    """Return which share of the true surface's openings a mesh leaves open.

    Openings are the pixels that its outline encloses and that it does not cover, without those at
    their edges; ``None`` where there are practically none.
    """
    seen = opened = 0
    for camera in cameras:
        solid = true_mask(*truth, camera, threads)
        through = binary_erosion(binary_fill_holes(solid) & ~solid)
        seen += int(through.sum())
        opened += int((through & ~true_mask(*mesh, camera, threads)).sum())
    return opened / seen if seen >= _FEWEST_PX else None


PAGE = "zoo.md"
COMMAND = "python -m benchmarks.zoo"
_WIDEST = 2
"""Index of the threshold beyond which a part of the mesh is a floater: 1 %."""

ByScene = Mapping[str, Record]


def read_labels(root: Path = RECORDS) -> dict[str, dict[str, Record]]:
    """Return all records by label and scene, in the order of the catalogue."""
    labels = sorted(p.name for p in (root / STUDY).glob("*") if p.is_dir())
    found: dict[str, dict[str, Record]] = {}
    for label in labels:
        records = [read_record(path) for path in (root / STUDY / label).glob("*.json")]
        mine = {record.case.scene: record for record in records}
        found[label] = {name: mine[name] for name in SCENES if name in mine}
    return found


def floaters(record: Record) -> float:
    """Share of the mesh's area that is farther than 1 % of the diagonal from the truth."""
    return 1.0 - float(record.scores["surface"]["uniform"]["precision"][_WIDEST])


def _figure(record: Record, name: str) -> float | None:
    value = record.scores.get(FIGURES, {}).get(name)
    return None if value is None else float(value)


def scene_table(records: ByScene, baselines: ByScene, part: str) -> Table:
    """Return one row a scene, beside its alpha shape."""
    rows: list[Row] = []
    for name, r in records.items():
        if SCENES[name].part != part:
            continue
        scan, photos, alpha = r.scores["surface"]["scan"], r.case.photos, baselines.get(name)
        rows.append(
            {
                "scene": name + ("" if is_present(r) else " *"),
                "shown": _shown(SCENES[name]),
                "photos": f"{photos.count} x {photos.width} x {photos.height}",
                **{
                    f"seen F1 {share}": three(scan["f1"][k]) for k, share in enumerate(SHARES)
                },
                f"precision {AT}": three(scan["precision"][MIDDLE]),
                f"recall {AT}": three(scan["recall"][MIDDLE]),
                f"whole F1 {AT}": three(f1_middle(r)),
                f"thin recall {AT}": three(thin(r)),
                "open": three(_figure(r, "open_share")),
                "floaters": three(floaters(r)),
                "test dB": two(view_psnr(r)),
                "training dB": two(_figure(r, "training_psnr")),
                f"alpha shape seen F1 {AT}": None if alpha is None else three(f1_seen(alpha)),
                "processor s": f"{r.spent_s:.0f}",
            }
        )  # fmt: skip
    return table_of(
        f"Scenes, {part}",
        rows,
        "Seen: what the cameras see of both surfaces inside the region; whole: hidden sides "
        "included. Open: share of the true openings, in the test views, that the mesh leaves "
        "open. Floaters: share of the mesh's area farther than 1 % of the diagonal from the "
        "truth. Test dB: whole photos of six views that the job was never given. Alpha shape: of "
        "the sparse points, with the best alpha by the truth. *: made on an earlier version of the "
        "scene.",
    )


def depth_table(records: ByScene) -> Table:
    """Return one row a scene: depths of the start, after training and of the mesh."""
    rows: list[Row] = []
    for name, r in records.items():
        found = r.scores.get("depths")
        if found:
            rows.append(
                {
                    "scene": name,
                    **{
                        f"{stage} {share}": three(found[stage]["within"][k])
                        for stage in ("start", "trained", "mesh")
                        for k, share in enumerate(SHARES)
                    },
                }
            )
    return table_of(
        "Depths",
        rows,
        "Of the pixels of up to eight training photos that show the true surface, the share whose "
        "depth is within such a share of the diagonal: of the start (what matching photos knew), "
        "of the Gaussians, and of the mesh.",
    )


def _shown(scene: ZooScene) -> str:
    words = [scene.surroundings, scene.path, "few" if scene.few else ""]
    return ", ".join(word for word in words if word)


def family_table(records: ByScene, baselines: ByScene, part: str) -> Table:
    """Return one row a family: median and worst of its scenes."""
    rows: list[Row] = []
    for family in FAMILIES:
        mine = {
            name: r
            for name, r in records.items()
            if SCENES[name].family == family and SCENES[name].part == part
        }
        if not mine:
            continue
        seen = [f1_seen(r) for r in mine.values()]
        fine = [float(r.scores["surface"]["scan"]["f1"][0]) for r in mine.values()]
        lost = [floaters(r) for r in mine.values()]
        views = [v for r in mine.values() if (v := view_psnr(r)) is not None]
        thins = [v for r in mine.values() if (v := thin(r)) is not None]
        alphas = [f1_seen(baselines[name]) for name in mine if name in baselines]
        rows.append(
            {
                "family": family,
                "scenes": str(len(mine)),
                "seen F1 0.25 %": _both(fine, min),
                f"seen F1 {AT}": _both(seen, min),
                f"thin recall {AT}": _both(thins, min),
                "floaters": _both(lost, max),
                "test dB": _both(views, min, 2),
                f"alpha shape {AT}": _both(alphas, max),
            }
        )
    return table_of(
        f"Families, {part}", rows, "Median; in brackets the worst (of the alpha shape the best)."
    )


def _both(
    values: Sequence[float], extreme: Callable[[Sequence[float]], float], digits: int = 3
) -> str | None:
    if not values:
        return None
    return f"{statistics.median(values):.{digits}f} ({extreme(values):.{digits}f})"


def write_document(out: Path, root: Path = RECORDS) -> Path | None:
    """Write the page into a folder; return None where no run has a record."""
    found = read_labels(root)
    baselines = {n: r for n, r in found.pop(BASELINES, {}).items() if is_present(r)}
    found = {label: records for label, records in found.items() if records}
    if not found:
        return None
    lines = [
        "Nine families of scenes drawn from seeds (`benchmarks/zoo`), rendered on first use; exact",
        "truth, poses and sparse points as a solver returns them. Settings may be tuned on",
        "the part *development* only.",
        "",
        *reading("zoo"),
    ]
    for label, records in found.items():
        given = next(iter(records.values())).case
        more = f" -- {' '.join(given.arguments)}" if given.arguments else ""
        clean = "" if label.endswith(TAKEN) else " --clean"
        own = label.removesuffix(TAKEN)
        name = clean if own == given.preset else f" --label {own}{clean}"
        command = f"{COMMAND} --preset {given.preset}{name}{more}"
        judged = {r.case.scene for r in records.values()}
        others = [dataclasses.replace(given, scene=name) for name in SCENES if name not in judged]
        planned = [*(r.case for r in records.values()), *others]
        lines += [f"## {label}", "", *made_by(command, list(records.values()), planned), ""]
        tables = [
            make(records, baselines, part) for part in PARTS for make in (family_table, scene_table)
        ]
        tables.append(depth_table(records))
        lines += [table.markdown() for table in tables if table.rows]
    every = [record for records in found.values() for record in records.values()]
    return write_page(out / PAGE, "Zoo of scenes", commits(every), lines)
