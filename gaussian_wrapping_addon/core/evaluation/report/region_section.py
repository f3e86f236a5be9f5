# SPDX-License-Identifier: GPL-3.0-or-later
"""The section of a report about one region: its mesh, its texture, and how both were measured."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .text import (
    NOT_MEASURED,
    duration,
    escaped,
    escaped_or,
    items,
    measured,
    number,
    part,
    percent,
    plural,
    table,
)

Picture = Callable[[str, str], list[str]]
"""Gives the lines that show a picture (path below the result folder, caption), none without it."""


def region_summary(name: str, region: dict[str, Any]) -> str:
    """Return one sentence about a region: size, closed or not, how much photos saw."""
    statistics = part(region, "statistics")
    coverage = measured(part(region, "texture").get("coverage"))
    seen = (
        "how much of its texture photos saw was not measured"
        if coverage is None
        else f"photos saw {percent(coverage)} of its texture, the rest is filled in"
        if coverage < 1.0
        else "photos saw all of its texture"
    )
    return (
        f"Region **{escaped(name)}** is a mesh of {number(statistics.get('faces'), 'faces')}, "
        f"{closedness(statistics, part(region, 'provenance'))}; {seen}."
    )


def closedness(statistics: dict[str, Any], provenance: dict[str, Any]) -> str:
    """Return whether a mesh is closed, in words; an open boundary may have been asked for."""
    closed = statistics.get("closed")
    if not isinstance(closed, bool):
        return "closedness not measured"
    if not closed and provenance.get("boundary") == "open":
        return "open by request where the region cuts through things"
    return "closed (watertight)" if closed else "not closed"


def region_lines(name: str, region: dict[str, Any], picture: Picture) -> list[str]:
    """Return the Markdown lines of a region's section, without its heading.

    Parameters
    ----------
    name : str
        Also the folder of its files in the result folder.
    region : dict
        Its figures; whatever lacks is said to be not measured.
    picture : callable
        See :data:`Picture`.
    """
    return [
        region_summary(name, region),
        "",
        *picture(f"{name}/preview.png", "Left: part of a photo. Right: the textured mesh."),
        "### Mesh",
        "",
        *_mesh(region),
        "",
        "### Texture",
        "",
        *_texture(region),
        "",
        "### The textured mesh against photos",
        "",
        *_rendering(part(region, "mesh_rendering")),
        "",
        *_comparisons(name, region, picture),
    ]


def _mesh(region: dict[str, Any]) -> list[str]:
    statistics, provenance = part(region, "statistics"), part(region, "provenance")
    world, seconds = part(region, "world"), part(region, "seconds")
    size = [measured(side) for side in items(world.get("size"))]
    extent = " x ".join(number(s) for s in size) + " world units" if size else NOT_MEASURED
    holes = statistics.get("boundary_edges")
    topology = closedness(statistics, provenance)
    if statistics.get("closed") is False:
        topology += f", {plural(holes, 'open edge')}"
    rows = [
        ("Faces", number(statistics.get("faces"), "faces")),
        ("Vertices", number(statistics.get("vertices"), "vertices")),
        ("Closed", topology),
        ("Check of closedness and manifold", _check_text(part(region, "check"))),
        ("Separate parts", plural(statistics.get("components"), "part")),
        *_removal_rows(provenance),
        *_tile_rows(provenance),
        ("Size (x, y, z)", extent),
        ("Surface area", number(world.get("area"), "square world units")),
        ("Edge length, mean", number(world.get("edge_mean"), "world units")),
        ("Edge length, median", number(world.get("edge_median"), "world units")),
        ("Residual, median", _residual(provenance, "median")),
        ("Residual, mean", _residual(provenance, "mean")),
        ("Residual, 99 % of vertices below", _residual(provenance, "p99")),
        ("Residual, largest", _residual(provenance, "max")),
        *_simplification_rows(provenance),
        ("Time", duration(seconds.get("mesh"))),
        *_estimate_rows(part(region, "estimate")),
    ]
    lines = table(("mesh", "figure"), rows, "lr")
    vertices = measured(statistics.get("vertices"))
    on_surface = measured(provenance.get("vertices_on_surface"))
    lines += [
        "",
        (
            "The residual is |v - 0.5|: v is the vacancy, 0 inside of things and 1 in the open, so "
            "that the surface lies at 0.5. It tells how well the mesh follows the Gaussians, not "
            "how well the Gaussians follow the real thing."
        ),
    ]
    if vertices and on_surface is not None:
        capped = measured(provenance.get("vertices_on_region_boundary")) or 0.0
        lines[-1] += f" Measured at the {percent(on_surface / vertices)} of the vertices"
        lines[-1] += " that should lie on the surface."
        if capped:
            does = "end" if provenance.get("boundary") == "open" else "close"
            lines[-1] += (
                f" {percent(capped / vertices)} of the vertices {does} the mesh where the region "
                "cuts through things."
            )
    return lines


def _check_text(check: dict[str, Any]) -> str:
    defects = check.get("defects")
    if not isinstance(defects, list):
        return NOT_MEASURED
    return "; ".join(escaped_or(defect) for defect in defects) or "no defect"


def _removal_rows(provenance: dict[str, Any]) -> list[tuple[str, str]]:
    solids = measured(provenance.get("removed_solids"))
    cavities = measured(provenance.get("removed_cavities"))
    if solids is None or cavities is None:
        return []
    cavity_count = plural(int(cavities), "small cavity", "small cavities")
    text = f"{plural(int(solids), 'floater')}, {cavity_count}"
    if solids or cavities:
        text += f": {percent(provenance.get('removed_area_share'))} of the area"
    rows = [("Removed for their size", text)]
    if pieces := measured(provenance.get("removed_open_pieces")):
        share = percent(provenance.get("removed_open_area_share"))
        text = f"{plural(int(pieces), 'small piece')}: {share} of the area"
        rows.append(("Removed after opening at the region", text))
    if handles := measured(provenance.get("small_handles_closed")):
        rows.append(("Handles closed, smaller than the edges resolve", f"{int(handles)}"))
    return rows


def _simplification_rows(provenance: dict[str, Any]) -> list[tuple[str, str]]:
    before = measured(provenance.get("faces_before_clean_up"))
    if before is None:
        return []
    rows = []
    if steps := measured(provenance.get("smooth_steps")):
        rows.append(("Smoothed", plural(int(steps), "step")))
    if target := measured(provenance.get("target_faces")):
        rows.append(("Faces before decimation", number(before, "faces")))
        rows.append(("Faces asked for", number(target, "faces")))
    return rows


def _tile_rows(provenance: dict[str, Any]) -> list[tuple[str, str]]:
    """Return in how many tiles the mesh was made, and how much of the space nobody has seen."""
    rows = []
    if tiles := measured(provenance.get("tiles")):
        text = plural(int(tiles), "tile")
        if processes := measured(provenance.get("tile_processes")):
            text += f", by {plural(int(processes), 'process', 'processes')}"
        rows.append(("Made in", text))
    evaluated = measured(provenance.get("field_evaluations"))
    unseen = measured(provenance.get("unseen_evaluations"))
    if evaluated and unseen is not None:
        text = f"{percent(unseen / evaluated)} of the points asked for"
        if provenance.get("unseen") in ("empty", "occupied"):
            text += f", taken as {provenance['unseen']}"
        rows.append(("Seen by no camera", text))
    return rows


def _estimate_rows(estimate: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what was said before the mesh was made; nothing of reports that had no estimate."""
    few, many = (measured(estimate.get(f"points_{end}")) for end in ("low", "high"))
    soon, late = (measured(estimate.get(f"seconds_{end}")) for end in ("low", "high"))
    if few is None or many is None or soon is None or late is None:
        return []
    return [
        ("Faces, as estimated", f"{number(2 * few)} to {number(2 * many, 'faces')}"),
        ("Time, as estimated", f"{duration(soon)} to {duration(late)}"),
    ]


def _residual(provenance: dict[str, Any], which: str) -> str:
    return number(provenance.get(f"level_error_{which}"), "of vacancy")


def _texture(region: dict[str, Any]) -> list[str]:
    texture, world = part(region, "texture"), part(region, "world")
    side = number(texture.get("size_px"))
    if side != NOT_MEASURED:
        side = f"{side} x {side} texels"
        atlases = measured(texture.get("atlases")) or 1
        if atlases > 1:
            side = f"{int(atlases)} textures of {side}"
        if texture.get("size_automatic") is True:
            side += ", chosen from the photos"
    rows = [
        ("Size", side),
        ("Texel density", number(world.get("texels_per_unit"), "texels per world unit")),
        ("One texel", number(world.get("texel_size"), "world units")),
        ("Coverage: seen by photos", percent(texture.get("coverage"))),
        ("Surface area seen", percent(texture.get("area_seen_share"))),
        (
            "Area of faces smaller than a texel",
            percent(texture.get("area_without_texel_share")),
        ),
        (
            "Photos behind each seen texel",
            number(texture.get("views_per_seen_texel"), "photos", digits=1),
        ),
        ("Pieces (charts)", plural(texture.get("charts"), "chart")),
        ("Image used by the mesh", percent(texture.get("utilisation"))),
        ("Stretch, mean over the surface (1 is even)", number(texture.get("stretch_mean"))),
        ("Stretch that 95 % of the surface stay below", number(texture.get("stretch_p95"))),
        ("Time", duration(part(region, "seconds").get("texture"))),
    ]
    return table(("texture", "figure"), rows, "lr")


def _rendering(rendering: dict[str, Any]) -> list[str]:
    views = [part(view) for view in items(rendering.get("views"))]
    if measured(rendering.get("psnr")) is None and not views:
        lines = [f"How well the textured mesh reproduces photos was {NOT_MEASURED}."]
        return lines + note_lines(rendering)
    perceptual = any(measured(view.get("lpips")) is not None for view in views)
    where = {
        "mask": "Counted are the pixels inside of the photos' masks.",
        "covered": "Counted are only the pixels that the mesh covers.",
    }.get(str(rendering.get("pixels")), "")
    rows = [_view_row(escaped_or(view.get("name")), view, perceptual) for view in views]
    rows.append(_view_row("**mean**", rendering, perceptual))
    header = ["photo", "PSNR", "SSIM (1 is equal)", "of the photo covered"]
    trained = {
        "True": "The Gaussians were not trained on these photos.",
        "False": "The Gaussians were trained on these photos.",
    }.get(str(rendering.get("held_out")), "")
    intro = ("The textured mesh, unlit, seen from the photos' cameras.", where, trained)
    lines = [" ".join(filter(None, intro)), ""]
    lines += table(header + ["LPIPS (0 is equal)"] * perceptual, rows, "lrrr" + "r" * perceptual)
    left_out = measured(rendering.get("left_out"))
    if left_out:
        lines += ["", f"{plural(int(left_out), 'photo')} could not be judged: no pixel counts."]
    return lines + note_lines(rendering)


def _view_row(name: str, view: dict[str, Any], perceptual: bool) -> list[str]:
    covered = "" if "views" in view and "covered" not in view else percent(view.get("covered"))
    row = [
        name,
        number(view.get("psnr"), "dB", digits=2),
        number(view.get("ssim"), digits=4),
        covered,
    ]
    return [*row, number(view.get("lpips"), digits=4)] if perceptual else row


def note_lines(figures: dict[str, Any]) -> list[str]:
    """Return what a measurement says of itself: ``note``, and ``lpips_note``, why LPIPS lacks."""
    lines = []
    for key in ("note", "lpips_note"):
        text = figures.get(key)
        if not isinstance(text, str) or not text.strip():
            continue
        text = text.strip().rstrip(".")
        if key == "lpips_note" and not text.startswith("LPIPS"):
            text = f"LPIPS was {NOT_MEASURED}: {text}"
        lines += ["", escaped(text[:1].upper() + text[1:]) + "."]
    return lines


def _comparisons(name: str, region: dict[str, Any], picture: Picture) -> list[str]:
    rendering = part(region, "mesh_rendering")
    shown = {view.get("picture"): view for view in map(part, items(rendering.get("views")))}
    lines = []
    for file in items(rendering.get("pictures")):
        if not isinstance(file, str):
            continue
        caption = "Left the photo, right the textured mesh."
        if file in shown:
            psnr = number(shown[file].get("psnr"), "dB", digits=1)
            caption = f"{shown[file].get('name') or 'photo'}, {psnr}. {caption}"
        lines += picture(f"{name}/{file}", caption)
    return lines
