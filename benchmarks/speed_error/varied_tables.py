# SPDX-License-Identifier: GPL-3.0-or-later
"""The tables of what is varied: seeds, Gaussians, images, meshes, textures."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from ..tables import Table
from .plan import MAIN_SCENES
from .results import Result, is_plain, mean_and_spread, pick
from .tables import AT, MIDDLE, SHARES, Row, percent, table_of, two


def seed_table(results: Sequence[Result]) -> Table:
    """Return mean and standard deviation over the seeds."""
    rows: list[Row] = []
    for scene in MAIN_SCENES:
        same = pick(
            results,
            lambda r, s=scene: r.run.scene == s and r.run.preset == "draft" and not r.run.name
            and r.variant is None,
        )  # fmt: skip
        if len(same) < 2:
            continue
        figures = {
            **{f"F1 {s}": [r.f1("uniform", i) for r in same] for i, s in enumerate(SHARES)},
            f"scan F1 {AT}": [r.f1("scan", MIDDLE) for r in same],
            "Gaussians PSNR dB": [r.scores["gaussians"]["psnr"] for r in same],
            "textured mesh PSNR dB": [r.texture_psnr for r in same if r.texture_psnr is not None],
        }
        rows.append(
            {
                "scene": scene,
                "seeds": len(same),
                **{name: mean_and_spread(values) for name, values in figures.items()},
                "mean s": f"{statistics.fmean(r.wall_s for r in same):.0f}",
            }
        )
    note = "Draft; mean ± standard deviation. A difference below twice that says nothing."
    return table_of("Variance over seeds", rows, note)


def mesh_table(results: Sequence[Result]) -> Table:
    """Return meshes of one training at several point budgets, with the legacy score beside."""
    rows: list[Row] = [
        {
            "scene": r.run.scene,
            "vertices": r.scores["vertices"],
            f"F1 {AT}": f"{r.f1('uniform', MIDDLE):.3f}",
            f"scan F1 {AT}": f"{r.f1('scan', MIDDLE):.3f}",
            f"legacy F1 {AT}": f"{r.f1('legacy', MIDDLE):.3f}",
            f"F1 {SHARES[0]}": f"{r.f1('uniform', 0):.3f}",
            f"legacy F1 {SHARES[0]}": f"{r.f1('legacy', 0):.3f}",
            "Chamfer %": percent(r.share("chamfer_mean")),
            "mesh s": f"{r.seconds('mesh'):.1f}",
        }
        for r in varied(results, "points", ("spot", "wheel"))
    ]
    note = (
        "One training, meshed at several point budgets. Legacy counts vertices and face centres: a "
        "coarse mesh loses recall for having few points, not for being wrong."
    )
    return table_of("Resolution of the mesh, and the bias of the legacy score", rows, note)


def gaussian_table(results: Sequence[Result]) -> Table:
    """Return Draft with other caps of the number of Gaussians."""
    rows: list[Row] = []
    for r in varied(results, "gaussians", ("spot",)):
        cap = r.report["settings"]["training"]["max_gaussians"]
        rows.append({"scene": r.run.scene, "cap": cap, **_training_cells(r)})
    return table_of("Number of Gaussians", rows, "All else as in Draft.")


def image_size_table(results: Sequence[Result], long_side_px: int) -> Table:
    """Return Draft with smaller training images; the photos' own long side is the largest."""
    rows: list[Row] = []
    for r in varied(results, "image", ("spot",)):
        limit = r.report["settings"]["training"]["max_image_px"]
        side = min(limit, long_side_px)
        rows.append({"scene": r.run.scene, "long side px": side, **_training_cells(r)})
    return table_of("Size of the training images", rows, "All else as in Draft.")


def _training_cells(result: Result) -> Row:
    return {
        "Gaussians": result.scores["gaussians"]["count"],
        "train s": f"{result.seconds('train'):.1f}",
        "peak memory GiB": f"{result.memory_gib:.2f}",
        **{f"F1 {s}": f"{result.f1('uniform', i):.3f}" for i, s in enumerate(SHARES)},
        "Gaussians PSNR dB": f"{result.scores['gaussians']['psnr']:.2f}",
        "textured mesh PSNR dB": two(result.texture_psnr),
    }


def texture_table(results: Sequence[Result]) -> Table:
    """Return one mesh with textures of several sizes."""
    rows: list[Row] = [
        {
            "scene": r.run.scene,
            "texture side px": r.scores["texture_side_px"],
            "texture s": f"{r.seconds('texture'):.1f}",
            "textured mesh PSNR dB": two(r.texture_psnr),
            "SSIM": None
            if r.scores["texture"].get("ssim") is None
            else f"{r.scores['texture']['ssim']:.4f}",
        }
        for r in varied(results, "texture", ("spot",))
    ]
    return table_of("Size of the texture", rows, "One mesh of one training.")


def varied(results: Sequence[Result], name: str, scenes: tuple[str, ...]) -> list[Result]:
    """Return the results of a varied parameter with the plain Draft among them, in its order."""
    chosen = {r.run.scene for r in results if _name(r) == name} & set(scenes)
    kept = [
        r
        for r in results
        if r.run.scene in chosen
        and (_name(r) == name or (not r.variant and is_plain(r.run) and r.run.preset == "draft"))
    ]
    return sorted(kept, key=lambda r: (scenes.index(r.run.scene), _place(r, name)))


def _name(result: Result) -> str:
    return result.variant.name if result.variant else result.run.name


def _place(result: Result, name: str) -> float:
    if name == "points":
        return float(result.scores["vertices"])
    if name == "texture":
        return float(result.scores["texture_side_px"])
    training = result.report["settings"]["training"]
    return float(training["max_gaussians" if name == "gaussians" else "max_image_px"])
