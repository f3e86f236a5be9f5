# SPDX-License-Identifier: GPL-3.0-or-later
"""The tables of the report."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from ..tables import Cell, Table
from .plan import MAIN_SCENES, THRESHOLD_SHARES
from .results import Result, is_plain, mean_and_spread, pick, plain

SHARES = tuple(f"{100 * share:g} %" for share in THRESHOLD_SHARES)
MIDDLE = 1
"""The threshold that is shown where there is room for one: 0.5 %."""


def cost_table(results: Sequence[Result]) -> Table:
    """Return time, memory and size of every preset."""
    rows: list[tuple[Cell, ...]] = []
    for r in plain(results):
        stages = [r.seconds(name) for name in ("cameras", "train", "mesh", "texture")]
        rows.append(
            (
                r.run.scene, r.run.preset, *(f"{s:.1f}" for s in stages), f"{r.wall_s:.0f}",
                f"{r.memory_gib:.2f}", r.scores["gaussians"]["count"], r.scores["vertices"],
                r.scores["texture_side_px"],
            )
        )  # fmt: skip
    header = (
        "scene", "preset", "cameras s", "train s", "mesh s", "texture s", "whole command s",
        "peak memory GiB", "Gaussians", "vertices", "texture px",
    )  # fmt: skip
    note = (
        "The cameras are given, so their stage only reads them; the whole command includes "
        "starting Python and writing the results."
    )
    return Table("What it costs", header, rows, (note,))


def surface_table(results: Sequence[Result], ceilings: dict[str, dict[str, Any]]) -> Table:
    """Return the errors of the mesh of every preset, and what the true surface itself gets."""
    rows: list[tuple[Cell, ...]] = []
    for scene in dict.fromkeys(r.run.scene for r in results):
        if scene in ceilings:
            rows.append((scene, "true surface", *_surface_cells(ceilings[scene]), ""))
        rows += [
            (
                scene, r.run.preset, *_surface_cells(r.scores),
                "yes" if r.region["statistics"]["closed"] else "NO",
            )
            for r in plain(results, scene)
        ]  # fmt: skip
    header = (
        "scene", "preset", *(f"F1 {s}" for s in SHARES), *(f"scan F1 {s}" for s in SHARES),
        f"precision {SHARES[MIDDLE]}", f"visible recall {SHARES[MIDDLE]}",
        f"thin recall {SHARES[MIDDLE]}", "Chamfer %", "normals", "closed",
    )  # fmt: skip
    notes = (
        (
            "Thresholds and Chamfer (mean of both directions) are shares of the crop volume's "
            "diagonal. F1: uniform samples of the whole mesh against the whole true surface, "
            "hidden sides included. Scan: only what the cameras see of either."
        ),
        "Normals: mean |cosine| between normals of counterparts, both directions.",
        (
            "The rows of the true surface show what a protocol can reach: a scan's points stand as "
            "far apart as the pixels of its cameras."
        ),
    )
    return Table("How exact the mesh is", header, rows, notes)


def _surface_cells(scores: dict[str, Any]) -> tuple[str, ...]:
    uniform, scan = scores["surface"]["uniform"], scores["surface"]["scan"]
    thin, chamfer = uniform["thin_recall"], uniform["chamfer_mean"]
    return (
        *(f"{value:.3f}" for value in uniform["f1"]),
        *(f"{value:.3f}" for value in scan["f1"]),
        f"{uniform['precision'][MIDDLE]:.3f}",
        f"{_first(uniform['visible_recall']):.3f}",
        "" if thin is None else f"{thin[MIDDLE]:.3f}",
        "no mesh" if chamfer is None else f"{100 * chamfer / scores['diagonal']:.3f}",
        f"{uniform['normal_consistency']:.3f}",
    )


def _first(shares: Sequence[float] | None) -> float:
    return float("nan") if shares is None else shares[MIDDLE]


def image_table(results: Sequence[Result]) -> Table:
    """Return the errors of images: Gaussians and textured mesh at the test views."""
    rows: list[tuple[Cell, ...]] = []
    for r in plain(results):
        figures, texture = r.scores["gaussians"], r.scores["texture"]
        whole = figures["object_psnr"]
        rows.append(
            (
                r.run.scene, r.run.preset, f"{figures['psnr']:.2f}", f"{figures['ssim']:.4f}",
                None if whole is None else f"{whole:.2f}", f"{texture['psnr']:.2f}",
                f"{texture['ssim']:.4f}", f"{100 * r.region['texture']['coverage']:.1f}",
            )
        )  # fmt: skip
    header = (
        "scene", "preset", "Gaussians PSNR dB", "SSIM", "on the surface PSNR dB",
        "textured mesh PSNR dB", "SSIM", "texels seen %",
    )  # fmt: skip
    notes = (
        (
            "Eight test views that the job was never given. The textured mesh (and the Gaussians "
            "in the third figure) are compared over the pixels that show the true surface: a hole "
            "is an error."
        ),
        (
            "spot_exposure: the test views have the unaltered exposure, which no single model of "
            "the altered photos can match; the loss against spot is the price of not modelling it."
        ),
    )
    return Table("How exact the images are", header, rows, notes)


def stage_table(results: Sequence[Result], poses: dict[str, dict[str, Any]]) -> Table:
    """Return the error after each stage, so that one sees where it comes from."""
    rows: list[tuple[Cell, ...]] = []
    for r in plain(results):
        depth, vacancy = r.scores["depth"], r.scores["vacancy"]
        pose = poses.get(r.run.scene)
        turned = None if pose is None else f"{pose['errors']['rotation_degrees_median']:.3f}"
        rows.append(
            (
                r.run.scene, r.run.preset, turned,
                _percent(depth["median"]), f"{depth['within'][MIDDLE]:.3f}",
                _percent(vacancy["median_offset"]), _percent(vacancy["median"]),
                f"{vacancy['within'][MIDDLE]:.3f}",
                f"{100 * r.distance_share('accuracy_median'):.3f}",
                f"{r.surface('uniform', 'recall')[MIDDLE]:.3f}",
                f"{r.scores['gaussians']['psnr'] - r.scores['texture']['psnr']:.2f}",
            )
        )  # fmt: skip
    header = (
        "scene", "preset", "solved poses, median deg", "depth median %",
        f"depth in {SHARES[MIDDLE]}",
        "vacancy offset %", "offset size %", f"in {SHARES[MIDDLE]}", "mesh median %",
        f"mesh recall {SHARES[MIDDLE]}", "Gaussians less texture dB",
    )  # fmt: skip
    notes = (
        (
            "Depth: isosurface depth of the test views against the true surface's, over all pixels "
            "that show it. Vacancy: where it crosses 0.5 along true normals of samples that two "
            "cameras see (positive: outside of the surface). Mesh: distances of its samples to the "
            "true surface. Per cent of the crop volume's diagonal."
        ),
        (
            "Poses were solved from the photos alone for the scenes with a figure; the runs of "
            "this report were given the exact ones."
        ),
    )
    return Table("Where the error comes from", header, rows, notes)


def _percent(share: float | None) -> str:
    return "none found" if share is None else f"{100 * share:.3f}"


def pose_table(poses: dict[str, dict[str, Any]]) -> Table:
    """Return the errors of cameras that were solved from photos alone."""
    rows: list[tuple[Cell, ...]] = [
        (
            name, f"{found['solved']} of {found['photos']}", f"{found['seconds']:.0f}",
            f"{100 * found['errors']['center_share_median']:.3f}",
            f"{100 * found['errors']['center_share_max']:.3f}",
            f"{found['errors']['rotation_degrees_median']:.4f}",
            f"{found['errors']['rotation_degrees_max']:.4f}",
        )
        for name, found in poses.items()
    ]  # fmt: skip
    header = (
        "scene", "photos solved", "s", "centre median %", "centre largest %", "rotation median deg",
        "rotation largest deg",
    )  # fmt: skip
    note = "After a similarity fitted to the centres; per cent of the spread of the true centres."
    return Table("Cameras from photos alone", header, rows, (note,))


def kernel_table(kernels: dict[str, dict[str, Any]]) -> Table:
    """Return time and error of the vacancy kernel against its definition."""
    rows: list[tuple[Cell, ...]] = [
        (
            name, found["gaussians"], found["cameras"], f"{found['definition_us']:.0f}",
            f"{found['kernel_us']:.2f}", f"{found['definition_us'] / found['kernel_us']:.0f}",
            f"{found['error_median']:.1e}", f"{found['error_max']:.1e}",
            f"{100 * found['same_side']:.1f}",
        )
        for name, found in kernels.items()
    ]  # fmt: skip
    header = (
        "scene", "Gaussians", "cameras", "definition, us a point", "kernel, us a point", "ratio",
        "median error", "largest error", "same side of 0.5, %",
    )  # fmt: skip
    points = next(iter(kernels.values()))["definition_points"] if kernels else 0
    note = (
        "Vacancy of points within 1 % of the true surface, Gaussians of the Draft run. The "
        f"definition evaluates every Gaussian and every camera in float64, at {points} points."
    )
    return Table("The vacancy kernel against its definition", header, rows, (note,))


def seed_table(results: Sequence[Result]) -> Table:
    """Return mean and standard deviation over the seeds."""
    rows: list[tuple[Cell, ...]] = []
    for scene in MAIN_SCENES:
        same = pick(
            results,
            lambda r, s=scene: r.run.scene == s and r.run.preset == "draft" and not r.run.name
            and r.variant is None,
        )  # fmt: skip
        if len(same) < 2:
            continue
        rows.append(
            (
                scene, len(same),
                *(mean_and_spread([r.f1("uniform", i) for r in same]) for i in range(len(SHARES))),
                mean_and_spread([r.f1("scan", MIDDLE) for r in same]),
                mean_and_spread([r.scores["gaussians"]["psnr"] for r in same]),
                mean_and_spread([r.scores["texture"]["psnr"] for r in same]),
                f"{statistics.fmean(r.wall_s for r in same):.0f}",
            )
        )  # fmt: skip
    header = (
        "scene", "seeds", *(f"F1 {s}" for s in SHARES), f"scan F1 {SHARES[MIDDLE]}",
        "Gaussians PSNR dB", "textured mesh PSNR dB", "mean s",
    )  # fmt: skip
    note = "Draft; mean ± standard deviation. A difference below twice that says nothing."
    return Table("Variance over seeds", header, rows, (note,))


def bias_table(results: Sequence[Result]) -> Table:
    """Return the legacy score beside the uniform one for meshes of one training."""
    rows: list[tuple[Cell, ...]] = []
    for r in varied(results, "points", ("spot", "wheel")):
        rows.append(
            (
                r.run.scene, r.scores["vertices"],
                *(f"{r.f1(p, MIDDLE):.3f}" for p in ("uniform", "scan", "legacy")),
                f"{100 * r.distance_share('chamfer_mean'):.3f}",
                f"{r.seconds('mesh'):.1f}",
            )
        )  # fmt: skip
    header = (
        "scene", "vertices", f"F1 {SHARES[MIDDLE]}", f"scan F1 {SHARES[MIDDLE]}",
        f"legacy F1 {SHARES[MIDDLE]}", "Chamfer %", "mesh s",
    )  # fmt: skip
    note = (
        "One training, meshed at several point budgets. Legacy counts vertices and face centres: a "
        "coarse mesh loses recall for having few points, not for being wrong."
    )
    return Table("Resolution of the mesh, and the bias of the legacy score", header, rows, (note,))


def varied_tables(results: Sequence[Result]) -> list[Table]:
    """Return the tables of Gaussian counts, image sizes and texture sizes."""
    tables = []
    for name, title, word in (
        ("gaussians", "Number of Gaussians", "cap"),
        ("image", "Size of the training images", "long side px"),
    ):
        rows: list[tuple[Cell, ...]] = [
            (
                r.run.scene, _parameter(r), r.scores["gaussians"]["count"],
                f"{r.seconds('train'):.1f}", f"{r.memory_gib:.2f}",
                *(f"{r.f1('uniform', i):.3f}" for i in range(len(SHARES))),
                f"{r.scores['gaussians']['psnr']:.2f}", f"{r.scores['texture']['psnr']:.2f}",
            )
            for r in varied(results, name, ("spot",))
        ]  # fmt: skip
        header = (
            "scene", word, "Gaussians", "train s", "peak memory GiB", *(f"F1 {s}" for s in SHARES),
            "Gaussians PSNR dB", "textured mesh PSNR dB",
        )  # fmt: skip
        tables.append(Table(title, header, rows, ("All else as in Draft.",)))
    rows = [
        (
            r.run.scene, r.scores["texture_side_px"], f"{r.seconds('texture'):.1f}",
            f"{r.scores['texture']['psnr']:.2f}", f"{r.scores['texture']['ssim']:.4f}",
        )
        for r in varied(results, "texture", ("spot",))
    ]  # fmt: skip
    header = ("scene", "texture side px", "texture s", "textured mesh PSNR dB", "SSIM")
    note = "One mesh of one training."
    return [*tables, Table("Size of the texture", header, rows, (note,))]


def varied(results: Sequence[Result], name: str, scenes: tuple[str, ...]) -> list[Result]:
    """Return the results of a varied parameter with the plain Draft among them."""
    names = {r.run.scene for r in results if _name(r) == name}
    chosen = [
        r
        for r in results
        if r.run.scene in names & set(scenes)
        and (_name(r) == name or (not r.variant and is_plain(r.run) and r.run.preset == "draft"))
    ]
    return sorted(chosen, key=lambda r: (scenes.index(r.run.scene), _place(r, name)))


def _name(result: Result) -> str:
    return result.variant.name if result.variant else result.run.name


def _parameter(result: Result) -> int | str:
    return result.run.parameter or "Draft's"


def _place(result: Result, name: str) -> float:
    if name == "points":
        return float(result.scores["vertices"])
    if name == "texture":
        return float(result.scores["texture_side_px"])
    training = result.report["settings"]["training"]
    return float(training["max_gaussians" if name == "gaussians" else "max_image_px"])
