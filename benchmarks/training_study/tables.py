# SPDX-License-Identifier: GPL-3.0-or-later
"""The tables of the training study; a row is a dictionary, so no heading stands over another's
figure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from ..speed_error.results import Result
from ..speed_error.tables import AT, MIDDLE, SHARES, Row, table_of, thin_recall, three, two
from ..tables import Table
from .carry_out import Measured
from .plan import ABLATION, AUTO, LABELS, NEEDS, ON, PRESET, REAL, ROWS


def ablation_table(runs: Sequence[Measured]) -> Table:
    """Return the rows of the rendered scenes, each scene from the baseline on."""
    rows: list[Row] = [
        {"scene": m.case.run.scene, "losses": m.case.label, **_cost(m.result), **_error(m.result)}
        for m in _ordered(runs, ABLATION)
    ]
    return table_of(
        "Ablation on rendered scenes",
        rows,
        "Each row has all that stands above it. Harmonics on, exposure off, growth up to the cap; "
        "Draft's settings with fewer iterations, the same in all rows.",
        "PSNR and SSIM: Gaussians at eight test views that the job was never given. F1 at shares "
        "of the crop volume's diagonal, whole surface; seen F1: what the cameras see of both "
        "surfaces. Thin recall: true samples on parts thinner than 1.5 % of the diagonal that at "
        "least two cameras see, where at least 1 % of the samples are thin.",
    )


def real_table(runs: Sequence[Measured]) -> Table:
    """Return the rows of real photos, which have no true surface."""
    rows: list[Row] = [
        {
            "photos": m.case.run.scene,
            "losses": m.case.label,
            **_cost(m.result),
            **_images(m.result),
            "closed": _closed(m.result),
            "components": m.result.region["statistics"]["components"],
        }
        for m in _ordered(runs, REAL)
    ]
    return table_of(
        "Ablation on real photos",
        rows,
        "PSNR and SSIM of the photos that the job held out itself (every eighth). No true surface "
        "is known, so what the geometric losses are for is not measured here.",
    )


def pivot_table(pivots: dict[str, dict[str, Any]]) -> Table:
    """Return the surfaces from two and from nine pivots of one training."""
    rows: list[Row] = []
    for scene, numbers in pivots.items():
        for name, found in numbers.items():
            score = found["surface"]
            rows.append(
                {
                    "scene": scene,
                    "pivots": int(name),
                    "points": found["points"],
                    "s": f"{found['seconds']:.1f}",
                    "faces": found["faces"],
                    **{f"F1 {s}": f"{v:.3f}" for s, v in zip(SHARES, score["f1"], strict=True)},
                    f"precision {AT}": f"{score['precision'][MIDDLE]:.3f}",
                    f"recall {AT}": f"{score['recall'][MIDDLE]:.3f}",
                    f"thin recall {AT}": three(thin_recall(score)),
                }
            )
    return table_of(
        "Two pivots or nine",
        rows,
        "Marching tetrahedra on the Delaunay edges of the pivots, of one training with all losses: "
        "centre and one point outside along the orientation, or centre and the corners of the "
        "3-sigma box on the normal. Judged as extracted, without removing small parts. The add-on "
        "samples its mesh from the surface of two pivots and of points that its cameras see, which "
        "are left out here.",
    )


def preset_table(runs: Sequence[Measured]) -> Table:
    """Return Draft, Standard and Fine."""
    rows: list[Row] = [
        {"scene": m.case.run.scene, "preset": m.case.run.preset, **_cost(m.result),
         **_error(m.result)}
        for m in runs
        if PRESET in m.case.parts
    ]  # fmt: skip
    return table_of("Presets", rows, "The photos decide what the scene needs (the default).")


def needs_table(runs: Sequence[Measured]) -> Table:
    """Return what letting the photos decide saves, and what it loses."""
    rows: list[Row] = []
    for auto, everything in pairs(runs, NEEDS):
        rows.append(comparison(auto, everything))
    return table_of(
        "What the photos decide, against everything on",
        rows,
        "Lost: everything on less what the photos decided; negative where deciding was better.",
    )


def decision_table(runs: Sequence[Measured]) -> Table:
    """Return the decisions with their evidence."""
    rows: list[Row] = [
        {
            "scene": m.case.run.scene,
            "preset": m.case.run.preset,
            "what": decision["name"],
            "chosen": decision["chosen"],
            "evidence": decision["evidence"].replace("|", "/"),
        }
        for m in runs
        if m.case.run.name == AUTO
        for decision in decisions(m.result.report)
    ]
    return table_of("Decisions and their evidence", rows)


def missing_table(missing: Sequence[tuple[str, str]]) -> Table:
    """Return runs that were planned and have no figures."""
    rows: list[Row] = [
        {"run": name, "reason": reason.replace("|", "/")} for name, reason in missing
    ]
    return table_of("Not measured", rows)


def pairs(runs: Sequence[Measured], part: str) -> list[tuple[Measured, Measured]]:
    """Return runs that let the photos decide with those of the same scene with everything on."""
    found = []
    for auto in runs:
        if part not in auto.case.parts or auto.case.run.name != AUTO:
            continue
        for other in runs:
            same = (other.case.run.scene, other.case.run.preset, other.case.photos) == (
                auto.case.run.scene, auto.case.run.preset, auto.case.photos,
            )  # fmt: skip
            if same and other.case.run.name == ON:
                found.append((auto, other))
    return found


def comparison(auto: Measured, everything: Measured) -> Row:
    """Return one row of :func:`needs_table`."""
    a, b = auto.result, everything.result
    saved = 100 * (1 - a.processor_s("train") / b.processor_s("train"))
    row: Row = {
        "scene": auto.case.run.scene,
        "preset": auto.case.run.preset,
        "decided s": f"{a.wall_s:.0f}",
        "everything s": f"{b.wall_s:.0f}",
        "time saved %": f"{100 * (1 - a.wall_s / b.wall_s):.0f}",
        "processor saved, training %": f"{saved:.0f}" if math.isfinite(saved) else "not recorded",
        "Gaussians": a.scores["gaussians"]["count"],
        "of everything": b.scores["gaussians"]["count"],
    }
    if "surface" in a.scores:
        first, second = a.f1("uniform", MIDDLE), b.f1("uniform", MIDDLE)
        row |= {f"F1 {AT}": f"{first:.3f}", "F1 lost": f"{second - first:.3f}"}
    psnr = a.scores["gaussians"]["psnr"], b.scores["gaussians"]["psnr"]
    row |= {"PSNR dB": f"{psnr[0]:.2f}", "PSNR lost dB": f"{psnr[1] - psnr[0]:.2f}"}
    return {**row, "decided": _decided(a.report)}


def decisions(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the decision records of a job, empty where it took none."""
    return list(report["training"].get("decisions", ()))


def chosen(report: dict[str, Any], name: str) -> str | None:
    """Return what was decided about one part of the model; ``None`` without a record."""
    for decision in decisions(report):
        if decision["name"] == name:
            return str(decision["chosen"])
    return None


def _decided(report: dict[str, Any]) -> str:
    return ", ".join(f"{d['name'].replace('_', '-')} {d['chosen']}" for d in decisions(report))


def _ordered(runs: Sequence[Measured], part: str) -> list[Measured]:
    """Return the rows of a part scene by scene, in the order of the ablation."""
    same = [m for m in runs if part in m.case.parts and m.case.run.name in ROWS]
    scenes = list(dict.fromkeys(m.case.run.scene for m in same))
    order = list(LABELS)
    return sorted(
        same, key=lambda m: (scenes.index(m.case.run.scene), order.index(m.case.run.name))
    )


def _cost(result: Result) -> Row:
    training = result.report["training"]
    each_ms = 1000 * training["seconds_training"] / max(1, training["iterations"])
    return {
        "command s": f"{result.wall_s:.0f}",
        "training s": f"{result.seconds('train'):.0f}",
        "ms an iteration": f"{each_ms:.0f}",
        "peak GiB": f"{result.memory_gib:.2f}",
        "Gaussians": result.scores["gaussians"]["count"],
    }


def _images(result: Result) -> Row:
    figures = result.scores["gaussians"]
    ssim = figures["ssim"]
    return {"PSNR dB": two(figures["psnr"]), "SSIM": None if ssim is None else f"{ssim:.4f}"}


def _error(result: Result) -> Row:
    uniform = result.scores["surface"]["uniform"]
    return {
        **_images(result),
        **{f"F1 {s}": f"{result.f1('uniform', i):.3f}" for i, s in enumerate(SHARES)},
        f"seen F1 {AT}": f"{result.f1('scan', MIDDLE):.3f}",
        f"thin recall {AT}": three(thin_recall(uniform)),
        "closed": _closed(result),
    }


def _closed(result: Result) -> str:
    return "yes" if result.region["statistics"]["closed"] else "NO"
