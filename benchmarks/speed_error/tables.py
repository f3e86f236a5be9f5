# SPDX-License-Identifier: GPL-3.0-or-later
"""The tables of the presets: cost, surface, images, stages; poses and the vacancy kernel.

A row is a dictionary from column to value, so that a heading cannot stand over another figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gaussian_wrapping_addon.core.evaluation.surface.scores import MIN_THIN_SHARE

from ..tables import Cell, Table
from .plan import THRESHOLD_SHARES
from .results import Result, plain

SHARES = tuple(f"{100 * share:g} %" for share in THRESHOLD_SHARES)
MIDDLE = 1
"""The threshold that is shown where there is room for one: 0.5 %."""
AT = SHARES[MIDDLE]

Row = dict[str, Cell]


def table_of(title: str, rows: Sequence[Row], *notes: str) -> Table:
    """Return a table whose columns are the keys of its rows."""
    header = tuple(rows[0]) if rows else ()
    return Table(title, header, [tuple(row[name] for name in header) for row in rows], notes)


def cost_table(results: Sequence[Result]) -> Table:
    """Return time, memory and size of every preset."""
    rows: list[Row] = [
        {
            "scene": r.run.scene,
            "preset": r.run.preset,
            **{f"{n} s": f"{r.seconds(n):.1f}" for n in ("cameras", "train", "mesh", "texture")},
            "whole command s": f"{r.wall_s:.0f}",
            "peak memory GiB": f"{r.memory_gib:.2f}",
            "Gaussians": r.scores["gaussians"]["count"],
            "vertices": r.scores["vertices"],
            "texture px": r.scores["texture_side_px"],
        }
        for r in plain(results)
    ]
    note = (
        "The cameras are given, so their stage only reads them; the whole command includes "
        "starting Python and writing the results."
    )
    return table_of("What it costs", rows, note)


def surface_table(results: Sequence[Result], ceilings: dict[str, dict[str, Any]]) -> Table:
    """Return the errors of the mesh of every preset, and what the true surface itself gets."""
    rows: list[Row] = []
    for scene in dict.fromkeys(r.run.scene for r in results):
        if scene in ceilings:
            row = _surface_cells(ceilings[scene])
            rows.append({"scene": scene, "preset": "true surface", **row, "closed": None})
        for r in plain(results, scene):
            closed = "yes" if r.region["statistics"]["closed"] else "NO"
            row = _surface_cells(r.scores)
            rows.append({"scene": scene, "preset": r.run.preset, **row, "closed": closed})
    return table_of(
        "How exact the mesh is",
        rows,
        "Thresholds and Chamfer (mean of both directions) are shares of the crop volume's "
        "diagonal. F1: uniform samples of the whole mesh against the whole true surface, hidden "
        "sides included. Scan: what the training cameras see of the mesh, against those true "
        "samples that at least two of them see.",
        "Normals: mean size of the cosine between normals of counterparts, both directions.",
        "Thin recall: true samples on parts thinner than 1.5 % of the diagonal, where at least "
        "1 % of the samples are such.",
        "The rows of the true surface show what a protocol can reach: a scan's points stand as "
        "far apart as the pixels of its cameras.",
    )


def _surface_cells(scores: dict[str, Any]) -> Row:
    uniform, scan = scores["surface"]["uniform"], scores["surface"]["scan"]
    chamfer, seen = uniform["chamfer_mean"], uniform["visible_recall"]
    return {
        **{f"F1 {s}": f"{v:.3f}" for s, v in zip(SHARES, uniform["f1"], strict=True)},
        **{f"scan F1 {s}": f"{v:.3f}" for s, v in zip(SHARES, scan["f1"], strict=True)},
        f"precision {AT}": f"{uniform['precision'][MIDDLE]:.3f}",
        f"visible recall {AT}": None if seen is None else f"{seen[MIDDLE]:.3f}",
        f"thin recall {AT}": three(thin_recall(uniform)),
        "Chamfer %": "no mesh" if chamfer is None else f"{100 * chamfer / scores['diagonal']:.3f}",
        "normals": f"{uniform['normal_consistency']:.3f}",
    }


def thin_recall(surface: dict[str, Any]) -> float | None:
    """Return the recall of thin parts, or ``None`` where there are practically none."""
    few = surface["thin_count"] < MIN_THIN_SHARE * surface["truth_count"]
    return None if few or surface["thin_recall"] is None else surface["thin_recall"][MIDDLE]


def image_table(results: Sequence[Result]) -> Table:
    """Return the errors of images: Gaussians and textured mesh at the test views."""
    rows: list[Row] = []
    for r in plain(results):
        figures, texture = r.scores["gaussians"], r.scores["texture"]
        row: Row = {
            "scene": r.run.scene,
            "preset": r.run.preset,
            "Gaussians, whole photo: PSNR dB": f"{figures['psnr']:.2f}",
            "SSIM": f"{figures['ssim']:.4f}",
            "Gaussians, on the surface: PSNR dB": two(figures["object_psnr"]),
            "textured mesh, on the surface: PSNR dB": two(texture.get("psnr")),
            "SSIM of that": None if texture.get("ssim") is None else f"{texture['ssim']:.4f}",
            "texels seen %": f"{100 * r.region['texture']['coverage']:.1f}",
        }
        if any("lpips" in other.scores["texture"] for other in results):
            row["LPIPS of that"] = three(texture.get("lpips"))
        rows.append(row)
    lacks = {r.scores["texture"].get("lpips_note", "") for r in results} - {""}
    return table_of(
        "How exact the images are",
        rows,
        "Eight test views that the job was never given. On the surface: the pixels that show the "
        "true surface; a hole in the mesh is an error there. A pixel at an outline of the mesh "
        "mixes in a plain grey, the photo its own background: thin parts cannot reach high values.",
        "spot_exposure: the test views have the unaltered exposure, which no single model of "
        "the altered photos can match; the loss against spot is the price of not modelling it.",
        *sorted(lacks),
    )


def stage_table(results: Sequence[Result], poses: dict[str, dict[str, Any]]) -> Table:
    """Return the error after each stage, so that one sees where it comes from."""
    rows: list[Row] = []
    for r in plain(results):
        depth, vacancy = r.scores["depth"], r.scores["vacancy"]
        pose = poses.get(r.run.scene)
        both = r.scores["gaussians"]["object_psnr"], r.texture_psnr
        rows.append(
            {
                "scene": r.run.scene,
                "preset": r.run.preset,
                "solved poses, median deg": None
                if pose is None
                else f"{pose['errors']['rotation_degrees_median']:.3f}",
                "depth error, median %": percent(depth["median"]),
                f"depth in {AT}": f"{depth['within'][MIDDLE]:.3f}",
                "vacancy offset, median %": percent(vacancy["median_offset"]),
                "its size, median %": percent(vacancy["median"]),
                f"vacancy in {AT}": f"{vacancy['within'][MIDDLE]:.3f}",
                "mesh to truth, median %": percent(r.share("accuracy_median")),
                f"truth to mesh in {AT}": f"{r.surface('uniform', 'recall')[MIDDLE]:.3f}",
                "texture's loss dB": None if None in both else f"{both[0] - both[1]:.2f}",
            }
        )
    return table_of(
        "Where the error comes from",
        rows,
        "Depth: isosurface depth of the test views against the true surface's, over all pixels "
        "that show it. Vacancy: where it crosses 0.5 along true normals of samples that two "
        "cameras see (positive: outside of the surface). Per cent of the crop volume's diagonal.",
        "Texture's loss: PSNR of the Gaussians less that of the textured mesh, both on the pixels "
        "that show the true surface.",
        "Poses were solved from the photos alone for the scenes with a figure; the runs of "
        "this report were given the exact ones.",
    )


def pose_table(poses: dict[str, dict[str, Any]]) -> Table:
    """Return the errors of cameras that were solved from photos alone."""
    rows: list[Row] = [
        {
            "scene": name,
            "photos solved": f"{found['solved']} of {found['photos']}",
            "s": f"{found['seconds']:.0f}",
            "centre, median %": percent(found["errors"]["center_share_median"]),
            "centre, largest %": percent(found["errors"]["center_share_max"]),
            "rotation, median deg": f"{found['errors']['rotation_degrees_median']:.4f}",
            "rotation, largest deg": f"{found['errors']['rotation_degrees_max']:.4f}",
        }
        for name, found in poses.items()
    ]
    note = "After a similarity fitted to the centres; per cent of the spread of the true centres."
    return table_of("Cameras from photos alone", rows, note)


def kernel_table(kernels: dict[str, dict[str, Any]]) -> Table:
    """Return time and error of the vacancy kernel against its definition."""
    rows: list[Row] = [
        {
            "scene": name,
            "Gaussians": found["gaussians"],
            "cameras": found["cameras"],
            "definition, us a point": f"{found['definition_us']:.0f}",
            "kernel, us a point": f"{found['kernel_us']:.2f}",
            "ratio": f"{found['definition_us'] / found['kernel_us']:.0f}",
            "points compared": found["definition_points"],
            "median error": f"{found['error_median']:.1e}",
            "largest error": f"{found['error_max']:.1e}",
            "same side of 0.5, %": f"{100 * found['same_side']:.1f}",
        }
        for name, found in kernels.items()
    ]
    note = (
        "Vacancy of points within 1 % of the true surface, Gaussians of the Draft run. The "
        "definition evaluates every Gaussian and every camera in float64."
    )
    return table_of("The vacancy kernel against its definition", rows, note)


def percent(share: float | None) -> str:
    """Return a share in per cent, or words where nothing was found."""
    return "none found" if share is None else f"{100 * share:.3f}"


def two(value: float | None) -> str | None:
    """Return a figure with two decimals; an empty cell where it was not measured."""
    return None if value is None else f"{value:.2f}"


def three(value: float | None) -> str | None:
    """Return a figure with three decimals; an empty cell where it was not measured."""
    return None if value is None else f"{value:.3f}"
