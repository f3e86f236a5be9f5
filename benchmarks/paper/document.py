# SPDX-License-Identifier: GPL-3.0-or-later
"""The page of the paper's figures, written from the records alone.

``python -m benchmarks.paper.document``.

A record that is missing leaves its section out. The reading beside the page is written by hand.
"""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import write_bytes

from ..meshing_study.document import reading
from ..speed_error.runs import ROOT
from ..speed_error.tables import AT, MIDDLE, SHARES, Row, table_of, thin_recall, three
from ..tables import Table
from .records import ATTENUATION, FOLDER, MESHERS, PLUG_IN, read_record

PAGE = "paper-figures"
_HELD = "\x00"
"""Stands for a space at which no line may end."""
PERCENT = "% of the diagonal"

TRAININGS = {
    "plain": "plain 3DGS",
    "longer": "plain 3DGS, 1.3 times the iterations",
    "untrained": "PLY of plain, no photos, not trained",
    "alone": "PLY of plain, no photos, wrapped",
    "wrapped": "PLY of plain, wrapped with photos",
    "full": "the method from the start",
}
"""Words of the table; names are those of :mod:`.trainings`."""


def write_page(out: Path, records: Path = FOLDER) -> Path:
    """Write ``paper-figures.md`` into a folder, with all records that exist.

    Parameters
    ----------
    out : Path
        Must exist; a hand-written ``paper-figures-reading.md`` may lie there.
    records : Path
        Folder of the records.
    """
    found = {
        name: record
        for name in (PLUG_IN, ATTENUATION, MESHERS)
        if (record := read_record(name, records)) is not None
    }
    dates = sorted({record["origin"]["date"] for record in found.values()})
    lines = [
        "# Figures of the paper",
        "",
        *paragraph(
            "What the paper shows, on scenes of this repository whose surface is known: the splat "
            "of a plain training with and without Gaussian Wrapping, the field under the earlier "
            "attenuation, and primal adaptive meshing beside marching tetrahedra on pivots. Each "
            "section names its command, machine and date. `python -m benchmarks.paper.document` "
            "writes the page again from the records in `benchmarks/records/paper`."
        ),
        *reading(out / f"{PAGE}-reading.md", dates[-1] if dates else ""),
    ]
    sections: dict[str, Callable[[dict[str, Any]], list[str]]] = {
        PLUG_IN: _plug_in, ATTENUATION: _attenuation, MESHERS: _meshers,
    }  # fmt: skip
    for name, record in found.items():
        lines += sections[name](record)
    path = out / f"{PAGE}.md"
    write_bytes(path, ("\n".join(lines).rstrip() + "\n").encode())
    return path


def paragraph(text: str) -> list[str]:
    """Return the lines of a paragraph and an empty one; no line ends inside of code."""
    held = re.sub(r"`[^`]*`", lambda code: code.group().replace(" ", _HELD), text)
    lines = textwrap.wrap(held, 104, break_long_words=False, break_on_hyphens=False)
    return [*(line.replace(_HELD, " ") for line in lines), ""]


def made_by(origin: dict[str, Any]) -> list[str]:
    """Return command, date, machine, versions, code and load, as lines."""
    load = origin["load_before"]
    return [
        f"`{origin['command']}`, {origin['date']}. {origin['machine']};",
        f"{origin['versions']}. Code: {origin['code']}; load average before it:",
        f"{'not recorded' if load is None else load}.",
    ]


# -- the plug-in table ----------------------------------------------------------------------------


def _plug_in(record: dict[str, Any]) -> list[str]:
    count, width, height = record["photos"]
    plain = next((row["settings"] for row in record["rows"] if row["training"] == "plain"), {})
    off = ", ".join(f"`{name}` {value}" for name, value in plain.items())
    codes = ", ".join(sorted({row["code"] for row in record["rows"] if row.get("code")}))
    return [
        "## A plain splat, and the same with Gaussian Wrapping",
        "",
        *made_by(record["origin"]),
        "",
        *paragraph(
            f"{count} photos of {width} x {height} pixels, all trained on; preset "
            f"{record['preset']}, {record['iterations']} iterations, selection fixed: harmonics, "
            "growth and full size on, exposure off. Plain 3DGS is the same trainer with "
            f"{off}; density control is this program's, and its 3D filter stays, which 3DGS has "
            "not (3DGS blurs the image instead; no setting does that here). The PLY holds what "
            "viewers read and nothing else: the filter is baked in, there is no orientation. "
            "Wrapping it is the training that `--start-splat` starts: 0.3 of the iterations, no "
            "growth. Without photos, generated cameras take their place, and their views of the "
            "splat. All rows are meshed alike, by primal adaptive meshing with the samples of the "
            f"depth maps and {record['points']} points. The trainings were made by the code of "
            f"{codes or 'an unknown commit'}."
        ),
        plug_in_table(record).markdown(),
    ]


def plug_in_table(record: dict[str, Any]) -> Table:
    """Return a row for each training of each scene."""
    rows: list[Row] = []
    for row in record["rows"]:
        mesh, level = row["mesh"], row["level"]
        rows.append(
            {
                "scene": row["scene"],
                "training": TRAININGS[row["training"]],
                "iterations": row["iterations"],
                "processor s": f"{row['processor_s']:.0f}",
                "Gaussians": row["gaussians"],
                "PSNR dB": f"{row['psnr']:.2f}",
                **{f"F1 {s}": three(v) for s, v in zip(SHARES, mesh["f1"], strict=True)},
                f"thin recall {AT}": three(thin_recall(mesh)),
                "normals": three(mesh["normal_consistency"]),
                "level, thin": _offset(level, "thin"),
                "level, other": _offset(level, "other"),
            }
        )
    return table_of(
        "Plain 3DGS against Gaussian Wrapping",
        rows,
        "Iterations and seconds are those of the row's own training: those of the plain one come "
        "on top where a PLY is wrapped. PSNR: eight test views that no training was given. F1 of "
        "the whole surface at shares of the crop volume's diagonal. Thin recall: true samples on "
        "parts thinner than 1.5 % of the diagonal that at least two cameras see. Normals: mean "
        "absolute cosine.",
        f"Level: median place, in {PERCENT}, at which the vacancy crosses 0.5 along the true "
        "normal on thin parts and elsewhere, negative inside; in brackets the share of samples "
        "with a crossing.",
    )


def _offset(level: dict[str, Any], part: str) -> str:
    if part not in level or level[part]["median_offset"] is None:
        return ""
    found = level[part]
    return f"{100 * found['median_offset']:+.3f} ({found['found']:.2f})"


# -- attenuation ----------------------------------------------------------------------------------


def _attenuation(record: dict[str, Any]) -> list[str]:
    method = "../method.md#26-other-definitions-of-depth"
    return [
        "## Attenuation against the earlier definition",
        "",
        *made_by(record["origin"]),
        "",
        *paragraph(
            f"The earlier definition, that of GGGS ([method.md]({method})): a Gaussian attenuates "
            "on the way to its peak by `sqrt(1 - G)`, and as much again behind it; here it "
            "attenuates on the way to the peak alone, by `1 - G`. A point is empty where at least "
            "one camera sees it before the depth at which its transmittance falls to 0.5. That "
            "rule is the same for both, so the fields differ by the attenuation alone; and as no "
            "factor of the earlier one is smaller, its solid lies inside the other."
        ),
        "![One Gaussian](paper-attenuation-one.png)",
        "",
        *paragraph(
            "Transmittance from a camera far below to every point of a plane through one round "
            "Gaussian; dark is hidden. Black: the sphere `a exp(-r^2 / 2) = 1/2`. Coloured: the "
            "0.5 level. Under the one-sided attenuation it is the visible part of the sphere, at "
            "`sqrt(2 log(2 a))` deviations. Under the two-sided one it lies at "
            "`sqrt(2 log(a / 0.75))` where the opacity exceeds 0.75, and behind the centre where "
            "it does not: two cameras that face each other then leave nothing."
        ),
        "![Slices](paper-attenuation-slices.png)",
        "",
        *paragraph(
            f"Sections of {record['scene']}, bars in world units: the field (dark is solid), its "
            "0.5 level (coloured) and the true outline (black). The spoke is the most solitary of "
            "60 random places whose axis both trainings hold solid under the one-sided "
            "attenuation. Both trainings are rows of the table above; the losses of the plain one "
            "know no depth, so they favour neither definition."
        ),
        attenuation_table(record).markdown(),
        "![Meshes](paper-attenuation-meshes.jpg)",
        "",
        *paragraph("Close-ups of the table's meshes beside the true surface."),
    ]


def attenuation_table(record: dict[str, Any]) -> Table:
    """Return a row for each training and field."""
    words = {"vacancy": "vacancy (one-sided)", "earlier": "earlier (two-sided)"}
    rows: list[Row] = []
    for row in record["rows"]:
        mesh = row["mesh"]
        rows.append(
            {
                "training": TRAININGS[row["training"]],
                "field": words[row["field"]],
                **{f"F1 {s}": three(v) for s, v in zip(SHARES, mesh["f1"], strict=True)},
                f"recall {AT}": three(mesh["recall"][MIDDLE]),
                f"thin recall {AT}": three(thin_recall(mesh)),
                "area": f"{100 * mesh['area'] / record['true_area']:.0f} %",
                "volume": f"{100 * mesh['volume'] / record['true_volume']:.0f} %",
                **{
                    name.removeprefix("across "): f"{100 * share:.0f} %"
                    for name, share in row["sections"].items()
                },
                "level, thin": _offset(row["level"], "thin"),
                "level, other": _offset(row["level"], "other"),
            }
        )
    return table_of(
        "The same Gaussians under both attenuations",
        rows,
        "Meshes: marching tetrahedra on the same tetrahedra, from two pivots of each Gaussian and "
        "the points across the depth maps that either field accepts; nothing is removed. Area and "
        'volume: shares of the true mesh\'s; "a spoke" and "the rim": shares of the true section '
        "in the slices. Level: as in the table above.",
    )


# -- meshers --------------------------------------------------------------------------------------


def _meshers(record: dict[str, Any]) -> list[str]:
    return [
        "## Primal adaptive meshing, two pivots and nine",
        "",
        *made_by(record["origin"]),
        "",
        *paragraph(
            f"Scene {record['scene']}, the training of the row "
            f"{TRAININGS[record['training']]!r} above, one field for all. Two and nine pivots are "
            "the paper's (`--pivot-samples none`): of all Gaussians, nothing besides. Primal "
            "adaptive meshing (PAM) begins with the Gaussians alone, too; its last row adds the "
            "samples of the depth maps, as jobs do. For equal counts every mesh was decimated by "
            f"the same program to exactly {record['triangles']} triangles."
        ),
        mesher_table(record).markdown(),
        "![Close-ups](paper-meshers.jpg)",
        "",
        *paragraph(
            f"All with {record['triangles']} triangles but the true surface, shaded face by face; "
            "red is the back of a face."
        ),
        "![Steps of primal adaptive meshing](paper-refinement.jpg)",
        "",
        *paragraph(
            "Steps of the last row's mesh; in words the median and the 99 % quantile of "
            "`abs(v - 0.5)`. Samples are blue on the isosurface, and orange where the vacancy "
            "differs from 0.5 by 0.1 or more. "
            "Points and faces up to step 4 are spaced evenly; the final mesh is adaptive: made "
            "the same way with more points, of which those stay that the shape needs."
        ),
        step_table(record).markdown(),
    ]


def mesher_table(record: dict[str, Any]) -> Table:
    """Return two rows for each method: as it is made, and at the equal count."""
    rows: list[Row] = []
    for row in record["rows"]:
        for name, words in (("made", "as made"), ("equal", "equal count")):
            mesh = row[name]
            rows.append(
                {
                    "method": row["method"],
                    "mesh": words,
                    "triangles": mesh["faces"],
                    "processor s": f"{row['processor_s']:.0f}" if name == "made" else None,
                    **{f"F1 {s}": three(v) for s, v in zip(SHARES, mesh["f1"], strict=True)},
                    f"precision {AT}": three(mesh["precision"][MIDDLE]),
                    f"recall {AT}": three(mesh["recall"][MIDDLE]),
                    f"thin recall {AT}": three(thin_recall(mesh)),
                    "normals": three(mesh["normal_consistency"]),
                }
            )
    return table_of("Meshers of one training", rows, "Columns as in the first table.")


def step_table(record: dict[str, Any]) -> Table:
    """Return a row for each step of primal adaptive meshing."""
    rows: list[Row] = [
        {
            "step": step["step"],
            "points": step["points"],
            "faces": step["faces"] or None,
            "median of abs(v - 0.5)": f"{step['median']:.5f}",
            "99 %": f"{step['p99']:.4f}",
            "within 0.01": f"{100 * step['within']:.1f} %",
        }
        for step in record["steps"]
    ]
    return table_of(
        "Steps of primal adaptive meshing",
        rows,
        "A round is a batch of evaluations of the field. The samples that are followed through the "
        "rounds include those that never converge, which the mesher drops.",
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the page again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "benchmarks")
    write_page(parser.parse_args(arguments).out)


if __name__ == "__main__":
    main()
