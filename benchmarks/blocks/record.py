# SPDX-License-Identifier: GPL-3.0-or-later
"""Records of comparisons: what each step took, and the quality of both results."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.machine import processor_name

from ..study.record import code_of_tree
from ..tables import versions
from .comparison import JOINED, MESH, WHOLE, Comparison
from .judging import band_reach, judged_photos, judged_surface
from .road import WALLS
from .street_mesh import EDGE_M

RECORDS = Path(__file__).resolve().parents[1] / "records" / "blocks"

Record = dict[str, Any]


def record_path(photos: int, label: str, root: Path = RECORDS) -> Path:
    """Return the file of a comparison."""
    return root / f"street-{photos}{label and '-' + label}.json"


def make_record(comparison: Comparison, threads: int) -> Record:
    """Judge a finished comparison and return its record, plain JSON values."""
    folder, plan = comparison.folder, comparison.plan()
    steps = {path.parent.name: read_json(path) for path in sorted(folder.glob("*/figures.json"))}
    walls = {path.parent.name: read_json(path) for path in sorted(folder.glob(f"*/{WALLS}"))}
    settings, blocks = comparison.settings, comparison.blocks
    meshed = all(f"{MESH}{name}" in steps for name in (WHOLE, JOINED))
    reach_m = band_reach(plan) * comparison.scene("judged", threads).world_from_scene.scale
    return {
        "photos": comparison.photos,
        "blocks": blocks.blocks,
        "margin": blocks.margin,
        "polish": blocks.polish_iterations,
        "iterations": settings.iterations,
        "max_gaussians": settings.max_gaussians,
        "max_image_px": settings.max_image_px,
        "dense_start": settings.dense_start,
        "match_px": settings.match_px,
        "edge_m": EDGE_M,
        "band_m": round(reach_m, 3),
        "machine": processor_name(),
        "versions": versions(),
        "code": code_of_tree().name,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
        "steps": steps,
        "walls": walls,
        "psnr": judged_photos(comparison, threads),
        "surface": judged_surface(comparison, threads) if meshed else {},
    }


def read_records(root: Path = RECORDS) -> dict[str, Record]:
    """Return the records there are, by their files' names, fewest photos first."""
    found = {path.stem: dict(read_json(path)) for path in root.glob("street-*.json")}
    return dict(sorted(found.items(), key=lambda item: (item[1]["photos"], item[0])))


def labelled(records: Mapping[str, Record], label: str) -> list[Record]:
    """Return the records of a label, fewest photos first."""
    return [
        record
        for name, record in records.items()
        if name == record_path(record["photos"], label).stem
    ]


def write_record(record: Record, label: str, root: Path = RECORDS) -> Path:
    """Write a record and return its path."""
    path = record_path(record["photos"], label, root)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, record)
    return path
