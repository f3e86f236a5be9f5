# SPDX-License-Identifier: GPL-3.0-or-later
"""The page of the comparisons, written from their records alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.files import write_bytes

from ..study.origin import reading
from ..tables import Cell, Table
from .comparison import COARSE, JOINED, MESH, WHOLE
from .judging import ALL, ALPHA, ELSEWHERE, NEAR, NEAR_M, TOLERANCES_M
from .paper_plan import PowerLaw, costs, peaks, plan_table
from .record import Record, labelled
from .street_mesh import MESHED_M

PAGE, READING = "blocks.md", "blocks-reading.md"
COMMAND = "python -m benchmarks.blocks"
SHORT = "short"
"""Label of comparisons of less work, for the curve of cost."""
PAPER_PHOTOS, PAPER_MACHINES = 10_000, 32
MIB = 2**20
_NAMES = {
    WHOLE: "one training", JOINED: "blocks, joined", COARSE: "coarse training alone",
    ALPHA: "alpha shape of the sparse points",
}  # fmt: skip

_BESIDE = (
    "Other programs ran beside: wall times are as measured, and half of the processor seconds is "
    "what they come to where nothing does and two threads are twice as fast as one."
)
_AGAINST = (
    "Against the boxes' faces that two training photos or more see from "
    f"{NEAR_M:g} m or less; of a mesh, what they would see of it, in the street's middle "
    f"{MESHED_M:g} m with a border across. Alpha: the best of four, by F1."
)
_CURVE = (
    "Processor seconds and peak memory of a process. The street is as long as it has photos, with "
    "iterations and Gaussians in proportion. Exponents: least squares of the logarithms over all "
    "rows."
)


def write_document(out: Path, records: Mapping[str, Record]) -> Path | None:
    """Write the page into a folder and return its path; ``None`` if there is no record."""
    if not records:
        return None
    path = out / PAGE
    text = page(records, reading(out / READING))
    write_bytes(path, (text.rstrip() + "\n").encode())
    return path


def page(records: Mapping[str, Record], read: Sequence[str] = ()) -> str:
    """Return the page."""
    usual = labelled(records, "")
    every = list(records.values())
    days = sorted({record["date"][:10] for record in every})
    machines = "; ".join(dict.fromkeys(f"{r['machine']}, 2 cores; {r['versions']}" for r in every))
    lines = ["# Blocks against one training", "", *read]
    lines += [f"`{COMMAND} FOLDER --photos N`, {' and '.join(days)}. {machines}.", ""]
    lines += [_said(max(usual, key=lambda record: record["photos"])), ""]
    tables = []
    if usual:
        most = max(usual, key=lambda record: record["photos"])
        tables += [steps_table(most), road_table(most)]
    tables += [photos_table(records), surface_table(records)]
    for label in ("", SHORT):
        mine = labelled(records, label)
        if len(mine) > 1:
            tables.append(curve_table(mine))
    plan = paper_plan(records, PAPER_PHOTOS, PAPER_MACHINES)
    tables += [] if plan is None else [plan]
    return "\n".join([*lines, *(table.markdown() for table in tables if table.rows)])


def paper_plan(records: Mapping[str, Record], photos: int, machines: int) -> Table | None:
    """Return the plan of a scene; ``None`` without a comparison and a curve.

    The curve is that of the usual comparisons where there are as many of them as of short ones.
    """
    usual = labelled(records, "")
    curve = max(usual, labelled(records, SHORT), key=len)
    if not usual or len(curve) < 2:
        return None
    return plan_table(usual[-1], curve, photos, machines)


def _said(record: Record) -> str:
    return (
        f"Preset Standard, {_turns(record)}, exact cameras; margin {record['margin']:g}, polish "
        f"{record['polish']:g}. Mesh: uniform edges of {record['edge_m']:g} m."
    )


def _turns(record: Record) -> str:
    """Say what a training of the street is."""
    matched = (
        "no dense start"
        if record["dense_start"] == "off"
        else f"photos matched {record['match_px']} pixels wide for a dense start"
    )
    return (
        f"{record['iterations'] / record['photos']:g} iterations for each photo, "
        f"{record['max_gaussians'] / record['photos']:g} Gaussians at most, photos "
        f"{record['max_image_px']} pixels wide, {matched}"
    )


def steps_table(record: Record) -> Table:
    """Return what each step of a comparison took."""
    rows: list[tuple[Cell, ...]] = []
    names = [WHOLE, COARSE, *(f"block-{k}" for k in range(record["blocks"])), JOINED]
    names += [f"{MESH}{name}" for name in (WHOLE, JOINED, COARSE)]
    for name in names:
        if name in record["steps"]:
            of = record["steps"][name]
            size = of["gaussians"] if "gaussians" in of else of["faces"]
            rows.append(
                (
                    name, of["threads"], round(of["processor_s"]), round(of["wall_s"]),
                    round(of["peak_bytes"] / MIB), size,
                )
            )  # fmt: skip
    return Table(
        f"Steps, {record['photos']} photos",
        ("step", "threads", "processor s", "wall s", "peak MiB", "Gaussians, faces"), rows,
        (f"Photos of the blocks: {', '.join(map(str, record['steps'][COARSE]['photos']))}.",),
    )  # fmt: skip


def road_table(record: Record) -> Table:
    """Return the wall time and the memory of both ways, on two processors."""
    walls, used, memory = record["walls"], costs(record), peaks(record)
    ways = {
        "one training": ([WHOLE], used[WHOLE], memory[WHOLE]),
        "blocks, two at a time": (
            [COARSE, "block-0", JOINED], used["together"],
            max(memory[name] for name in (COARSE, "blocks", JOINED)),
        ),
    }  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for name, (stages, used_s, peak) in ways.items():
        if all(stage in walls for stage in stages):
            wall_s = math.fsum(walls[stage]["wall_s"] for stage in stages)
            busy = [walls[stage]["machine_s"] for stage in stages]
            others = None if None in busy else max(0.0, 1.0 - used_s / math.fsum(busy))
            rows.append(
                (
                    name, round(wall_s), round(used_s), round(used_s / 2),
                    None if others is None else f"{others:.0%}", round(peak / MIB),
                )
            )  # fmt: skip
    return Table(
        f"Both ways on two processors, {record['photos']} photos",
        (
            "way", "wall s", "processor s", "half of them", "used by other programs",
            "largest process MiB",
        ),
        rows,
        (_BESIDE,),
    )  # fmt: skip


def photos_table(records: Mapping[str, Record]) -> Table:
    """Return the PSNR of the held-out photos."""
    rows: list[tuple[Cell, ...]] = []
    for name, record in records.items():
        for result, places in record["psnr"].items():
            values = [places.get(place) for place in (ALL, NEAR, ELSEWHERE)]
            rows.append((name, _NAMES[result], *(v if v is None else f"{v:.2f}" for v in values)))
    return Table(
        "Held-out photos", ("street", "result", "PSNR dB", "near borders dB", "elsewhere dB"), rows
    )


def surface_table(records: Mapping[str, Record]) -> Table:
    """Return F1 by place, and the differences of both ways."""
    rows: list[tuple[Cell, ...]] = []
    for name, record in records.items():
        found = record["surface"]
        for place in (ALL, NEAR, ELSEWHERE):
            for result in (WHOLE, JOINED, COARSE, ALPHA):
                of = found.get(result, {}).get(place)
                if of:
                    values = [f"{value:.3f}" for value in of["f1"]]
                    rest = [f"{of[key][1]:.3f}" for key in ("precision", "recall")]
                    rows.append((name, place, _NAMES[result], *values, *rest))
            both = [found.get(result, {}).get(place) for result in (WHOLE, JOINED)]
            if all(both):
                apart = [b - a for a, b in zip(both[0]["f1"], both[1]["f1"], strict=True)]
                shown = [f"{value:+.3f}" for value in apart]
                rows.append((name, place, "**blocks less one training**", *shown, "", ""))
    bands = ", ".join(
        f"{name}: {record['band_m']:g} m" for name, record in records.items() if record["surface"]
    )
    return Table(
        "Surface",
        (
            "street", "where", "result", *(f"F1 {100 * t:.0f} cm" for t in TOLERANCES_M),
            "precision 10 cm", "recall 10 cm",
        ),
        rows,
        (f"{_AGAINST} Near borders: to either side of one between cells, {bands}.",),
    )  # fmt: skip


def curve_table(records: Sequence[Record]) -> Table:
    """Return cost against photos, with fitted exponents."""
    counts = [record["photos"] for record in records]
    work, memory = [costs(r) for r in records], [peaks(r) for r in records]
    names = (WHOLE, COARSE, "blocks", JOINED, "together")
    rows: list[tuple[Cell, ...]] = [
        (
            str(record["photos"]), record["blocks"], *(round(of[name]) for name in names),
            round(held[WHOLE] / MIB), round(held["blocks"] / MIB),
            round(max(held[COARSE], held[JOINED]) / MIB),
        )
        for record, of, held in zip(records, work, memory, strict=True)
    ]  # fmt: skip
    fits = [PowerLaw.of(counts, [of[name] for of in work]).exponent for name in names]
    fits += [
        PowerLaw.of(counts, values).exponent
        for values in (
            [held[WHOLE] for held in memory], [held["blocks"] for held in memory],
            [max(held[COARSE], held[JOINED]) for held in memory],
        )
    ]  # fmt: skip
    rows.append(("**exponent**", None, *(f"{value:.2f}" for value in fits)))
    return Table(
        f"Cost against photos: {_turns(records[-1])}",
        (
            "photos", "blocks", "one training s", "coarse s", "blocks s", "joining s",
            "coarse + blocks + joining s", "one training MiB", "largest block MiB",
            "coarse, joining MiB",
        ),
        rows,
        (_CURVE,),
    )  # fmt: skip
