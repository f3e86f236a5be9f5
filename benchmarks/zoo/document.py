# SPDX-License-Identifier: GPL-3.0-or-later
"""The page of the zoo as Markdown, written from records alone."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.files import write_bytes

from ..speed_error.tables import AT, MIDDLE, SHARES, Row, table_of, three, two
from ..study.figures import f1_middle, f1_seen, thin, view_psnr
from ..study.origin import made_by, reading
from ..study.record import RECORDS, Record, read_record
from ..tables import Table
from .catalogue import FAMILIES, PARTS, SCENES, ZooScene
from .runs import BASELINES, FIGURES, STUDY, TAKEN, is_present

PAGE, READING = "zoo.md", "zoo-reading.md"
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
        "# Zoo of scenes",
        "",
        "Nine families of scenes drawn from seeds (`benchmarks/zoo`), rendered on first use; exact",
        "truth, poses and sparse points as a solver returns them. Settings may be tuned on",
        "the part *development* only.",
        "",
        *reading(out / READING),
    ]
    for label, records in found.items():
        given = next(iter(records.values())).case
        more = f" -- {' '.join(given.arguments)}" if given.arguments else ""
        taken = " --taken" if label.endswith(TAKEN) else ""
        own = label.removesuffix(TAKEN)
        name = taken if own == given.preset else f" --label {own}{taken}"
        command = f"{COMMAND} --preset {given.preset}{name}{more}"
        judged = {r.case.scene for r in records.values()}
        others = [dataclasses.replace(given, scene=name) for name in SCENES if name not in judged]
        planned = [*(r.case for r in records.values()), *others]
        lines += [f"## {label}", "", *made_by(command, list(records.values()), planned), ""]
        tables = [
            make(records, baselines, part) for part in PARTS for make in (family_table, scene_table)
        ]
        lines += [table.markdown() for table in tables if table.rows]
    path = out / PAGE
    write_bytes(path, ("\n".join(lines).rstrip() + "\n").encode())
    return path
