# SPDX-License-Identifier: GPL-3.0-or-later
"""Figures of a job's report in the panel: selected at import, then stored in the .blend file."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from typing import Any

from ..core.evaluation.report.figures import (
    NOT_MEASURED,
    bytes_text,
    collect_warnings,
    duration,
    items,
    measured,
    number,
    part,
    percent,
    plural,
)

MAX_WARNINGS = 50
MAX_TEXT = 400
"""Characters stored of one warning or name."""
MAX_ROWS = 100
"""Stages and regions stored at most."""

_DECISIONS = {
    "exposure": "Exposure", "multi_view": "Compare Photos",
    "full_size": "Photo Size", "dense_start": "Dense Start", "refine_poses": "Refine Cameras",
    "region_weight": "Regions First",
}  # fmt: skip
"""Labels of what was decided, as the panel Training has them."""

_STAGES = {
    "cameras": "Cameras", "masks": "Masks", "masked": "Masked Photos", "train": "Training",
    "mesh": "Mesh", "texture": "Texture",
}  # fmt: skip

Row = tuple[str, str]


@dataclass(frozen=True)
class RegionRows:
    """Figures of one region as label and text."""

    name: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class ReportData:
    """Rows of the panel, ready to draw."""

    rows: tuple[Row, ...] = ()
    stages: tuple[Row, ...] = ()
    decisions: tuple[Row, ...] = ()
    """Model selection: decided from the photos, or by the user."""
    regions: tuple[RegionRows, ...] = ()
    warnings: tuple[str, ...] = ()
    device_reason: str = ""
    """Why the job ran on the device that the rows name."""
    known: bool = False
    """Whether there is a report."""

    @property
    def training(self) -> str:
        """Summary of the training, for a heading: ``"12,235 Gaussians, 23.0 dB"``, or ``""``."""
        rows = dict(self.rows)
        gaussians, quality = rows.get("Gaussians"), rows.get("Held-Out PSNR")
        parts = [f"{gaussians} Gaussians"] if gaussians and gaussians != NOT_MEASURED else []
        if quality and quality != NOT_MEASURED:
            parts.append(quality.partition(" (")[0])
        return ", ".join(parts)

    def as_text(self) -> str:
        """Return all of it as text, a line for each row."""
        lines = [f"{name}: {value}" for name, value in (*self.rows, *self.stages, *self.decisions)]
        for region in self.regions:
            lines += ["", region.name, *(f"  {name}: {value}" for name, value in region.rows)]
        if self.device_reason:
            lines += ["", f"Device: {self.device_reason}"]
        if self.warnings:
            lines += ["", "Warnings", *(f"  {text}" for text in self.warnings)]
        return "\n".join(lines) + "\n"


def figures_of_report(report: Any) -> dict[str, Any]:
    """Select the figures that the panel shows; those missing from the report are omitted.

    ``report``: content of ``report.json``, of any version.
    Returns dict: ``seconds``, ``gaussians``, ``psnr`` (held-out photos, dB), ``psnr_count``,
    ``memory_bytes``, ``device``, ``device_reason``, ``stages`` (pairs of name and seconds),
    ``decisions`` (name, choice and setting), ``warnings`` (texts), and ``regions``: for each name
    ``faces``, ``vertices``, ``closed``, ``coverage``, ``mesh_psnr`` (dB, where the mesh covers the
    photos), ``exposed_psnr`` (dB, the same in each photo's exposure), ``uncovered`` (share of the
    photos) and ``whole_psnr`` (dB, uncovered pixels black).
    """
    if not isinstance(report, dict) or not report:
        return {}
    training = part(report, "training")
    held_out = items(training.get("held_out"))
    memory = [measured(value) for value in part(report, "peak_memory_bytes").values()]
    figures: dict[str, Any] = _measured(
        seconds=report.get("wall_seconds"),
        gaussians=training.get("gaussians"),
        psnr=training.get("held_out_psnr") if held_out else None,
        psnr_count=len(held_out),
        memory_bytes=max((value for value in memory if value), default=None),
    )
    figures |= {
        key: str(report[key])[:MAX_TEXT] for key in ("device", "device_reason") if key in report
    }
    figures["stages"] = [
        [str(stage.get("name", ""))[:MAX_TEXT], stage["seconds"]]
        for stage in map(part, items(report.get("stages"))[:MAX_ROWS])
        if measured(stage.get("seconds")) is not None
    ]
    figures["decisions"] = [
        [str(entry.get(key, ""))[:MAX_TEXT] for key in ("name", "chosen", "setting")]
        for entry in map(part, items(training.get("decisions"))[:MAX_ROWS])
    ]
    figures["warnings"] = [
        f"{warning.stage}: {warning.text} {warning.hint}".strip()[:MAX_TEXT]
        for warning in collect_warnings(report)[:MAX_WARNINGS]
    ]
    figures["regions"] = {
        str(name)[:MAX_TEXT]: _rows_of_region(region)
        for name, region in list(part(report, "regions").items())[:MAX_ROWS]
    }
    return figures


def _rows_of_region(region: Any) -> dict[str, Any]:
    statistics = part(region, "statistics")
    figures = _measured(
        faces=statistics.get("faces"),
        vertices=statistics.get("vertices"),
        coverage=part(region, "texture").get("coverage"),
        mesh_psnr=part(region, "mesh_rendering").get("psnr"),
        exposed_psnr=part(region, "mesh_rendering").get("exposed_psnr"),
        uncovered=part(region, "mesh_rendering").get("uncovered"),
        whole_psnr=part(region, "mesh_rendering").get("whole_psnr"),
    )
    if isinstance(statistics.get("closed"), bool):
        figures["closed"] = statistics["closed"]
    figures["open_by_request"] = part(region, "provenance").get("boundary") == "open"
    return figures


def _measured(**values: Any) -> dict[str, Any]:
    return {key: value for key, value in values.items() if measured(value) is not None}


@functools.lru_cache(maxsize=16)
def report_of(text: str) -> ReportData:
    """Parse the figures stored in a .blend for the panel; any text is accepted.

    ``text``: JSON text of :func:`figures_of_report`; parsed once, as panels draw often.
    """
    try:
        figures = json.loads(text)
    except (ValueError, RecursionError):
        return ReportData()
    return _report_data(figures) if isinstance(figures, dict) and figures else ReportData()


def _report_data(figures: dict[str, Any]) -> ReportData:
    psnr, count = measured(figures.get("psnr")), measured(figures.get("psnr_count"))
    quality = number(psnr, "dB", digits=1)
    if psnr is not None and count:
        quality += f" ({plural(int(count), 'photo')})"
    device = figures.get("device")
    rows: tuple[Row, ...] = (
        ("Time of Last Job", duration(figures.get("seconds"))),
        ("Peak Memory", bytes_text(figures.get("memory_bytes"))),
        ("Gaussians", number(figures.get("gaussians"))),
        ("Held-Out PSNR", quality),
    )
    if isinstance(device, str):  # version 0.1.0 had no choice
        rows = (*rows, ("Device", "Processor" if device == "cpu" else device[:MAX_TEXT]))
    reason = figures.get("device_reason")
    stages = tuple(
        (_stage(str(entry[0])), duration(entry[1]))
        for entry in items(figures.get("stages"))[:MAX_ROWS]
        if isinstance(entry, list) and len(entry) == 2
    )
    regions = tuple(
        RegionRows(name, _region_rows(part(region)))
        for name, region in list(part(figures, "regions").items())[:MAX_ROWS]
    )
    warnings = tuple(
        text[:MAX_TEXT]
        for text in items(figures.get("warnings"))[:MAX_WARNINGS]
        if isinstance(text, str)
    )
    decisions = tuple(
        _decision(*map(str, entry))
        for entry in items(figures.get("decisions"))[:MAX_ROWS]
        if isinstance(entry, list) and len(entry) == 3
    )
    why = reason[:MAX_TEXT] if isinstance(reason, str) else ""
    return ReportData(rows, stages, decisions, regions, warnings, why, True)


def _decision(name: str, chosen: str, setting: str) -> Row:
    """Return label and choice of a decision, and whether the user made it."""
    value = chosen.capitalize()[:MAX_TEXT]
    return _DECISIONS.get(name, name), value if setting == "auto" else f"{value} (set by you)"


def _region_rows(region: dict[str, Any]) -> tuple[Row, ...]:
    closed = region.get("closed")
    no = "Open by request" if region.get("open_by_request") else "No"
    rows: tuple[Row, ...] = (
        ("Faces", number(region.get("faces"))),
        ("Closed", ("Yes" if closed else no) if isinstance(closed, bool) else NOT_MEASURED),
        ("Texture Coverage", percent(region.get("coverage"))),
        ("Textured Mesh PSNR", number(region.get("mesh_psnr"), "dB", digits=1)),
    )
    exposed = measured(region.get("exposed_psnr"))
    if exposed is not None:
        rows = (*rows, ("PSNR, Photo's Exposure", number(exposed, "dB", digits=1)))
    uncovered = measured(region.get("uncovered"))
    if uncovered is None:  # version 0.1.0 did not measure it
        return rows
    return (
        *rows,
        ("Photo Not Covered", percent(uncovered)),
        ("PSNR, That as Black", number(region.get("whole_psnr"), "dB", digits=1)),
    )


def _stage(name: str) -> str:
    kind, _, region = name.partition("-")
    return f"{_STAGES.get(kind, kind)} {region}".strip()
