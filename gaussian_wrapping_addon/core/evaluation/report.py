# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of a job: ``report.json`` for programs, ``report.md`` for people."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from ..files import write_bytes, write_json


def write_report(result: Path, summary: dict[str, Any], regions: dict[str, Any]) -> None:
    """Write both files into the result folder.

    Parameters
    ----------
    result : Path
        The result folder.
    summary : dict
        What was measured of the whole job: machine, stages, cameras, training.
    regions : dict
        For each region: mesh statistics, residuals, texture coverage, seconds.
    """
    report = {"version": 1, **summary, "regions": regions}
    write_json(result / "report.json", report)
    write_bytes(result / "report.md", _markdown(report).encode())


def headline(report: dict[str, Any]) -> list[str]:
    """Return the few figures of a report that a person wants first, one line each."""
    training = report["training"]
    lines = [f"time: {report['wall_seconds']:.0f} s, {training['gaussians']} Gaussians"]
    if training["held_out"]:
        count = len(training["held_out"])
        lines.append(f"held-out photos: PSNR {training['held_out_psnr']:.2f} dB ({count} photos)")
    for name, region in report["regions"].items():
        statistics = region["statistics"]
        closed = "closed" if statistics["closed"] else "not closed"
        coverage = region["texture"]["coverage"]
        lines.append(
            f"region {name}: {statistics['faces']} faces, {closed}, "
            f"{100 * coverage:.1f} % of the texture seen by photos"
        )
    return lines


def _markdown(report: dict[str, Any]) -> str:
    cameras, training = report["cameras"], report["training"]
    machine, settings = report["machine"], report["settings"]
    memory = report["peak_memory_bytes"]
    date = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(report["started_unix_s"]))
    lines = [
        f"# Report: {report['source']}",
        "",
        f"Preset {settings['preset']}, seed {settings['seed']}, {date}.",
        f"{machine['processor']}, {machine['threads']} threads, Python {machine['python']}.",
        "",
        "![preview](preview.png)",
        "",
        "## Time and memory",
        "",
        "| stage | seconds | |",
        "|---|---:|---|",
        *(
            f"| {s['name']} | {s['seconds']:.1f} | {'finished before' if s['reused'] else ''} |"
            for s in report["stages"]
        ),
        f"| this run, all in all | {report['wall_seconds']:.1f} | |",
        "",
        *(f"Peak memory, {k.replace('_', ' ')}: {v / 2**30:.2f} GiB." for k, v in memory.items()),
        "",
        "## Photos and cameras",
        "",
        f"{cameras['views']} photos used, {cameras['points']} sparse points.",
        "",
        *(f"- {k.replace('_', ' ')}: {v}" for k, v in cameras["facts"].items()),
        *(f"- Warning: {w}" for w in cameras["warnings"]),
        "",
        "## Training",
        "",
        f"{training['gaussians']} Gaussians after {training['iterations']} iterations.",
        "",
        *_held_out(training),
        *_warnings(training),
    ]
    for name, region in report["regions"].items():
        lines += ["", f"## Region {name}", "", *_region(region)]
    return "\n".join(lines) + "\n"


def _held_out(training: dict[str, Any]) -> list[str]:
    held_out = training["held_out"]
    if not held_out:
        return ["No photo was held out: there are too few. No PSNR is claimed."]
    lines = [
        f"Held-out photos (never trained on): PSNR {training['held_out_psnr']:.2f} dB,",
        f"SSIM {training['held_out_ssim']:.4f}, mean of {len(held_out)}.",
        "",
        "| photo | PSNR dB | SSIM |",
        "|---|---:|---:|",
    ]
    return lines + [f"| {p['name']} | {p['psnr']:.2f} | {p['ssim']:.4f} |" for p in held_out]


def _warnings(values: dict[str, Any]) -> list[str]:
    return [f"- Warning: {w}" for w in values.get("warnings", [])]


def _region(region: dict[str, Any]) -> list[str]:
    rows = [
        *(("mesh: " + k, v) for k, v in region["statistics"].items()),
        *((k, v) for k, v in _flat(region["provenance"]).items()),
        *(("texture: " + k, v) for k, v in _flat(region["texture"]).items()),
        *((f"seconds, {k}", v) for k, v in region["seconds"].items()),
    ]
    return ["| figure | value |", "|---|---:|", *(f"| {k} | {_text(v)} |" for k, v in rows)]


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{key}, "))
        else:
            flat[prefix + key] = value
    return flat


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)
