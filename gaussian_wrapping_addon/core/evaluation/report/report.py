# SPDX-License-Identifier: GPL-3.0-or-later
"""Write the report of a job (``report.json``, ``report.md``) and summarise it in a few lines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...files import finite_json, write_bytes, write_json
from .markdown import report_markdown
from .region_section import closedness
from .report_warnings import collect_warnings
from .text import duration, items, measured, number, part, percent, plural


def write_report(
    result: Path,
    summary: dict[str, Any],
    regions: dict[str, Any],
    earlier: Path | None = None,
) -> None:
    """Write both files into the result folder; the pictures must already be there.

    Parameters
    ----------
    result : Path
        The result folder.
    summary : dict
        Figures of the whole job: machine, stages, cameras, training.
    regions : dict
        For each region: mesh statistics, residuals, size in world units, texture coverage,
        renderings of the mesh, seconds.
    earlier : Path or None
        Result folder into which this one will be merged; it has the pictures of other regions.
    """
    report = finite_json({"version": 1, **summary, "regions": regions})
    report["warnings"] = [warning.to_json() for warning in collect_warnings(report)]
    write_json(result / "report.json", report)
    # File and region names may contain characters that cannot be encoded (lone surrogates).
    text = report_markdown(report, result, earlier).encode(errors="replace")
    write_bytes(result / "report.md", text)


def headline(report: dict[str, Any]) -> list[str]:
    """Return the main figures of a report, one line each."""
    training = part(report, "training")
    gaussians = number(training.get("gaussians"), "Gaussians")
    lines = [f"time: {duration(report.get('wall_seconds'))}, {gaussians}"]
    psnr, held_out = measured(training.get("held_out_psnr")), items(training.get("held_out"))
    if psnr is not None and held_out:
        count = plural(len(held_out), "photo")
        lines.append(f"held-out photos: PSNR {psnr:.2f} dB ({count})")
    else:
        lines.append("held-out photos: not measured")
    for name, region in part(report, "regions").items():
        statistics = part(region, "statistics")
        line = f"region {name}: {number(statistics.get('faces'), 'faces')}, "
        line += f"{closedness(statistics, part(region, 'provenance'))}, "
        line += f"{percent(part(region, 'texture').get('coverage'))} of the texture seen by photos"
        rendered = measured(part(region, "mesh_rendering").get("psnr"))
        if rendered is not None:
            line += f", textured mesh PSNR {rendered:.2f} dB"
            line += _uncovered(part(region, "mesh_rendering"))
        lines.append(line)
    warnings = collect_warnings(report)
    lines += [f"warning ({warning.stage}): {warning.text}" for warning in warnings]
    return lines


def _uncovered(rendering: dict[str, Any]) -> str:
    """Return over which pixels the PSNR is, and what it leaves out, where that was measured."""
    share, whole = measured(rendering.get("uncovered")), measured(rendering.get("whole_psnr"))
    if share is None or whole is None:
        return ""
    where = " where it covers the photos" if rendering.get("pixels") == "covered" else ""
    return f"{where} ({percent(share)} of them uncovered; {whole:.2f} dB with these black)"
