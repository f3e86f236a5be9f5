# SPDX-License-Identifier: GPL-3.0-or-later
"""Sections of the report about a region's mesh and texture."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...mesh.components import face_components, volumes_and_areas
from ...mesh.surface_mesh import edge_lengths
from ...scene.camera import Similarity
from .figures import (
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

# -- Size of a mesh, its edges and its texels in world units (the units of the input) -------------


def sizes_in_world(
    vertices: np.ndarray, faces: np.ndarray, world_from_scene: Similarity, texels: int
) -> dict[str, Any]:
    """Return lengths of a mesh in world units, as plain JSON values; none without faces.

    Vertices (v, 3) float64 are in the scene frame; without ``texels`` on the surface, their density
    is left out. The values are ``size`` (of the axis-aligned box of the used vertices),
    ``diagonal``, ``area``, ``edge_mean``, ``edge_median`` (each edge once for each of its faces),
    ``texels_per_unit`` and ``texel_size`` (side of a square texel).
    """
    if len(faces) == 0:
        return {}
    # Rotated but not translated: far from the origin the size would lose digits.
    turned = world_from_scene.scale * world_from_scene.directions(vertices[np.unique(faces)])
    size = np.ptp(turned, axis=0)  # (3,)
    edges = world_from_scene.scale * edge_lengths(np.asarray(vertices, np.float64), faces)
    parts, part = face_components(len(vertices), faces)
    _, areas = volumes_and_areas(vertices, faces, part, parts)
    area = float(areas.sum()) * world_from_scene.scale**2
    figures: dict[str, Any] = {
        "size": size.tolist(),
        "diagonal": float(np.linalg.norm(size)),
        "area": area,
        "edge_mean": float(edges.mean()),
        "edge_median": float(np.median(edges)),
    }
    if texels > 0 and area > 0.0:
        figures["texels_per_unit"] = float(np.sqrt(texels / area))
        figures["texel_size"] = float(np.sqrt(area / texels))
    return figures


# -- Report section of one region: mesh, texture, and comparison with photos ----------------------


Picture = Callable[[str, str], list[str]]
"""Markdown lines of a picture (path below the result folder, caption); none if it is missing."""


def region_summary(name: str, region: dict[str, Any]) -> str:
    """Return one sentence about a region: number of faces, closedness, texture coverage."""
    statistics = part(region, "statistics")
    coverage = measured(part(region, "texture").get("coverage"))
    seen = (
        "its texture coverage was not measured"
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
    """Return whether a mesh is closed; an open boundary may be a setting."""
    closed = statistics.get("closed")
    if not isinstance(closed, bool):
        return "closedness not measured"
    if not closed and provenance.get("boundary") == "open":
        return "open by request at the region boundary"
    return "closed (watertight)" if closed else "not closed"


def region_lines(name: str, region: dict[str, Any], picture: Picture) -> list[str]:
    """Return the Markdown lines of a region's section, without its heading.

    The region's name is that of its folder; missing figures are reported as not measured.
    """
    rendering = part(region, "mesh_rendering")
    return [
        region_summary(name, region), "",
        *picture(f"{name}/preview.png", "Left: part of a photo. Right: the textured mesh."),
        "### Mesh", "", *_mesh(region), "",
        "### Texture", "", *_texture(region), "",
        "### Textured mesh compared with photos", "", *_rendering(rendering), "",
        *_comparisons(name, rendering, picture),
    ]  # fmt: skip


_RESIDUALS = {"median": "median", "mean": "mean", "99th percentile": "p99", "largest": "max"}


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
        ("Check of the mesh (closed, manifold)", _check_text(part(region, "check"))),
        ("Connected components", plural(statistics.get("components"), "part")),
        *_removal_rows(provenance),
        *_tile_rows(provenance),
        ("Size (x, y, z)", extent),
        ("Surface area", number(world.get("area"), "square world units")),
        ("Edge length, mean", number(world.get("edge_mean"), "world units")),
        ("Edge length, median", number(world.get("edge_median"), "world units")),
        *(
            (f"Residual, {words}", number(provenance.get(f"level_error_{which}"), "of vacancy"))
            for words, which in _RESIDUALS.items()
        ),
        *_simplification_rows(provenance),
        ("Time", duration(seconds.get("mesh"))),
        *_estimate_rows(part(region, "estimate")),
    ]
    text = (
        "The residual is |v - 0.5|, where the vacancy v is 0 inside objects and 1 in free "
        "space; the surface lies at 0.5. It measures how well the mesh follows the Gaussians, "
        "not how well the Gaussians follow the real object."
    )
    vertices = measured(statistics.get("vertices"))
    on_surface = measured(provenance.get("vertices_on_surface"))
    if vertices and on_surface is not None:
        text += f" It is measured at the {percent(on_surface / vertices)} of the vertices"
        text += " that should lie on the surface."
        if capped := measured(provenance.get("vertices_on_region_boundary")):
            does = "end" if provenance.get("boundary") == "open" else "close"
            text += f" {percent(capped / vertices)} of the vertices {does} the mesh at the boundary"
            text += " of the region."
    return [*table(("mesh", "figure"), rows, "lr"), "", text]


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
    rows = [("Small components removed", text)]
    if pieces := measured(provenance.get("removed_open_pieces")):
        share = percent(provenance.get("removed_open_area_share"))
        text = f"{plural(int(pieces), 'small piece')}: {share} of the area"
        rows.append(("Small open components removed", text))
    if handles := measured(provenance.get("small_handles_closed")):
        rows.append(("Small handles closed (below the resolution of the edges)", f"{int(handles)}"))
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
        rows.append(("Target number of faces", number(target, "faces")))
    return rows


def _tile_rows(provenance: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the number of tiles, the cameras of the field, and what none of them sees."""
    rows = []
    if tiles := measured(provenance.get("tiles")):
        text = plural(int(tiles), "tile")
        if processes := measured(provenance.get("tile_processes")):
            text += f", by {plural(int(processes), 'process', 'processes')}"
        rows.append(("Tiles", text))
    if cameras := measured(provenance.get("field_cameras")):
        text = number(cameras)
        if provenance.get("cameras") == "training":
            text += ", those that were trained on"
        rows.append(("Cameras of the mesh", text))
    evaluated = measured(provenance.get("field_evaluations"))
    unseen = measured(provenance.get("unseen_evaluations"))
    if evaluated and unseen is not None:
        text = f"{percent(unseen / evaluated)} of the points evaluated"
        if provenance.get("unseen") in ("empty", "occupied"):
            text += f", treated as {provenance['unseen']}"
        rows.append(("Seen by no camera", text))
    return rows


def _estimate_rows(estimate: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the estimates made before meshing; empty for reports without them."""
    few, many = (measured(estimate.get(f"points_{end}")) for end in ("low", "high"))
    soon, late = (measured(estimate.get(f"seconds_{end}")) for end in ("low", "high"))
    if few is None or many is None or soon is None or late is None:
        return []
    return [
        ("Faces, estimated", f"{number(2 * few)} to {number(2 * many, 'faces')}"),
        ("Time, estimated", f"{duration(soon)} to {duration(late)}"),
    ]


def _texture(region: dict[str, Any]) -> list[str]:
    texture, world = part(region, "texture"), part(region, "world")
    blended = texture.get("views_per_seen_texel")
    side = number(texture.get("size_px"))
    if side != NOT_MEASURED:
        side = f"{side} x {side} texels"
        atlases = measured(texture.get("atlases")) or 1
        if atlases > 1:
            side = f"{int(atlases)} textures of {side}"
        if texture.get("size_automatic") is True:
            side += ", chosen from the resolution of the photos"
    rows = [
        ("Size", side),
        ("Texel density", number(world.get("texels_per_unit"), "texels per world unit")),
        ("One texel", number(world.get("texel_size"), "world units")),
        ("Coverage: seen by photos", percent(texture.get("coverage"))),
        ("Surface area seen by photos", percent(texture.get("area_seen_share"))),
        ("Area of faces smaller than a texel", percent(texture.get("area_without_texel_share"))),
        ("Photos blended per seen texel", number(blended, "photos", digits=1)),
        ("Charts", plural(texture.get("charts"), "chart")),
        ("Share of the image covered by charts", percent(texture.get("utilisation"))),
        ("Stretch, mean over the surface (1 is uniform)", number(texture.get("stretch_mean"))),
        ("Stretch, 95th percentile of the surface", number(texture.get("stretch_p95"))),
        ("Time", duration(part(region, "seconds").get("texture"))),
    ]
    return table(("texture", "figure"), rows, "lr")


def _rendering(rendering: dict[str, Any]) -> list[str]:
    views = [part(view) for view in items(rendering.get("views"))]
    if measured(rendering.get("psnr")) is None and not views:
        unknown = f"How well the textured mesh reproduces photos was {NOT_MEASURED}."
        return [unknown, *note_lines(rendering)]
    columns = [
        column for column in _COLUMNS
        if column.if_measured is None
        or any(measured(view.get(column.if_measured)) is not None for view in (*views, rendering))
    ]  # fmt: skip
    named = [*((escaped_or(view.get("name")), view) for view in views), ("**mean**", rendering)]
    rows = [[name, *(column.value(view) for column in columns)] for name, view in named]
    pixels = {
        "mask": "Only pixels inside the photos' masks are compared.",
        "covered": "PSNR and SSIM are over the pixels that the mesh covers wholly.",
    }.get(str(rendering.get("pixels")), "")
    trained = {
        "True": "The Gaussians were not trained on these photos.",
        "False": "The Gaussians were trained on these photos.",
    }.get(str(rendering.get("held_out")), "")
    intro = ["The textured mesh, unlit, rendered from the cameras of the photos.", pixels]
    intro += [*(column.explained for column in columns), trained]
    header = ["photo", *(column.title for column in columns)]
    lines = [" ".join(filter(None, intro)), "", *table(header, rows, "l" + "r" * len(columns))]
    left_out = measured(rendering.get("left_out"))
    if left_out:
        lines += ["", f"{plural(int(left_out), 'photo')} could not be compared: no valid pixel."]
    return lines + note_lines(rendering)


class _Column(NamedTuple):
    """A column of the comparisons with photos."""

    title: str
    value: Callable[[dict[str, Any]], str]
    if_measured: str | None = None
    """Shown only if some view has this figure."""
    explained: str = ""


def _psnr(key: str) -> Callable[[dict[str, Any]], str]:
    return lambda view: number(view.get(key), "dB", digits=2)


def _covered(view: dict[str, Any]) -> str:
    return "" if "views" in view and "covered" not in view else percent(view.get("covered"))


_COLUMNS = (
    _Column("PSNR", _psnr("psnr")),
    _Column("SSIM (1 is identical)", lambda view: number(view.get("ssim"), digits=4)),
    _Column("covered share of the photo", _covered),
    _Column(
        "share that no face covers", lambda view: percent(view.get("uncovered")), "uncovered"
    ),
    _Column(
        "PSNR, uncovered pixels black", _psnr("whole_psnr"), "uncovered",
        "The PSNR with uncovered pixels black counts every pixel.",
    ),
    _Column(
        "PSNR in the photo's exposure", _psnr("exposed_psnr"), "exposed_psnr",
        "The texture has one exposure, each photo its own: in the photo's, each half of the "
        "rendering is corrected by a fit to the other half, as for the Gaussians.",
    ),
    _Column(
        "LPIPS (0 is identical)", lambda view: number(view.get("lpips"), digits=4), "lpips"
    ),
)  # fmt: skip


def note_lines(figures: dict[str, Any]) -> list[str]:
    """Return the notes of a measurement: ``note``, and ``lpips_note``, why LPIPS is missing."""
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


def _comparisons(name: str, rendering: dict[str, Any], picture: Picture) -> list[str]:
    shown = {view.get("picture"): view for view in map(part, items(rendering.get("views")))}
    lines = []
    for file in (f for f in items(rendering.get("pictures")) if isinstance(f, str)):
        caption = "Left: the photo. Right: the textured mesh."
        if file in shown:
            psnr = number(shown[file].get("psnr"), "dB", digits=1)
            caption = f"{shown[file].get('name') or 'photo'}, {psnr}. {caption}"
        lines += picture(f"{name}/{file}", caption)
    return lines
