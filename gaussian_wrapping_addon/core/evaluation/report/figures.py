# SPDX-License-Identifier: GPL-3.0-or-later
"""The table of all figures of a report, each with its unit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ...settings import TrainingSettings, declarations
from .text import escaped, measured, number

# Lists of records that have tables or pictures of their own.
_SHOWN_ELSEWHERE = {
    "decisions",
    "history",
    "pictures",
    "warnings",
    "packages",
    "stages",
    "notes",
    "blocks",
}

_UNITS = {
    "psnr": "dB",
    "held_out_psnr": "dB",
    "ssim": "1 is identical",
    "held_out_ssim": "1 is identical",
    "lpips": "0 is identical",
    "held_out_lpips": "0 is identical",
    "seconds_training": "s",
    "wall_seconds": "s",
    "mesh_seconds": "s",
    "volume": "cubic scene units",
    "area": "square scene units",
    "candidate_area": "square scene units",
    "cap_area": "square scene units",
    "processor_seconds": "s of all cores",
    "mean_edge": "scene units",
    "edge_length": "world units",
    "edge_length_scene": "scene units",
    "edge_length_world": "world units, 0 is automatic",
    "texels_per_unit": "texels per world unit",
    "texel_size": "world units",
    "views_per_seen_texel": "photos",
    "utilisation": "of 1",
    "coverage": "of 1",
    "covered": "of 1",
    "uncovered": "of 1",
    "whole_psnr": "dB",
    "exposure_spread": "of 1, standard deviation",
    "brightness_spread_within_photos": "of 1, standard deviation",
    "stretch_mean": "1 is even",
    "stretch_p95": "1 is even",
    "seed": "number",
    "version": "number",
    "sh_degree": "degree",
    "extra_iterations": "count",
    "pixels_per_iteration": "px",
    "multi_view_pixels": "px",
    "multi_view_every": "iterations",
    "region_weight": "weight",
    "overlap_price": "weight",
    "seconds_low": "s",
    "seconds_high": "s",
    "speed": "times the reference machine",
    "video_fps": "1/s",
    "euler": "number",
    "genus": "number",
}
_WORLD_UNITS = {
    "area": "square world units",
    "size": "world units",
    "diagonal": "world units",
    "edge_mean": "world units",
    "edge_median": "world units",
}
_ENDINGS = (
    ("_unix_s", "s since 1970"),
    ("_bytes", "bytes"),
    ("_px", "px"),
    ("_spacing_scene", "scene units"),
    ("cage_scene", "scene units"),
    ("reach_scene", "scene units"),
    ("_share", "of 1"),
    ("_from", "of 1 (of all iterations)"),
    ("_until", "of 1 (of all iterations)"),
    ("_s", "s"),
)
_COUNTS = frozenset(
    (
        "atlases", "bad_indices", "boundary_edges", "candidates",
        "cap_faces_left_out", "cap_points",
        "charts", "components", "cores", "degenerate_faces", "degenerate_faces_left",
        "dense_faces", "dense_high", "dense_low", "dense_vertices", "densify_every",
        "dropped_candidates",
        "faces", "faces_before_clean_up", "faces_without_texel", "field_cameras",
        "field_evaluations",
        "frames", "gaussians", "gaussians_in_region", "holdout_every", "images_in_model",
        "inconsistent_edges", "interior_samples", "iterations", "jump_points", "left_out", "lods",
        "max_atlases", "max_gaussians", "most_parts",
        "nonmanifold_edges", "nonmanifold_vertices", "not_finite_vertices",
        "open_at_region", "open_edges", "pairs_contradicting_cameras", "pairs_matched",
        "pairs_verified", "part_count", "photos", "photos_joined", "photos_masked",
        "photos_masked_as_turning", "photos_placed",
        "photos_undistorted", "photos_used", "photos_with_focal_length", "pivots",
        "pivots_each", "pivots_high", "pivots_low",
        "points", "points_high", "points_in_model", "points_low",
        "projection_evaluations", "rays", "relabelled_tetrahedra", "removed_cavities",
        "removed_open_pieces",
        "removed_solids", "sightings", "small_handles_closed", "small_handles_left",
        "smooth_steps", "split_edges", "split_vertices",
        "surface_points", "target_faces", "tetrahedra", "tetrahedra_high",
        "tetrahedra_low", "texels_filled",
        "texels_overlapping", "texels_seen", "texels_seen_at_outlines_only",
        "texels_seen_badly", "texels_used",
        "processes", "threads", "tile_processes", "turntable_photos", "undecided_tetrahedra",
        "unseen_evaluations",
        "unused_vertices",
        "vertices", "video_frames", "video_frames_blurred", "video_frames_damaged",
        "video_frames_kept", "video_frames_read", "video_frames_still",
        "vertices_at_end_of_sight", "vertices_moved_apart",
        "vertices_on_region_boundary", "vertices_on_surface", "views", "wrap_rounds",
    )
)  # fmt: skip
_STARTS = (("level_error_", "of vacancy"), ("lambda_", "weight"))


def figure_rows(report: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return name, value and unit of every figure of a report, escaped for Markdown."""
    rows = []
    for path, value in _leaves(report, ()):
        name = ", ".join(step.replace("_", " ") for step in path)
        unit = unit_of(path) if measured(value) is not None else ""
        rows.append((escaped(name), _text(value), unit))
    return rows


def unit_of(path: tuple[str, ...]) -> str:
    """Return the unit of a figure by its name; empty for an unknown name."""
    key = path[-1]
    if key.isdigit():  # an entry of a list
        path, key = path[:-1], path[-2]
    if "settings" in path and (unit := _setting_unit(key)):
        return unit
    if "seconds" in path:
        return "s"
    if "peak_memory_bytes" in path:
        return "bytes"
    if "world" in path and key in _WORLD_UNITS:
        return _WORLD_UNITS[key]
    if key in _UNITS:
        return _UNITS[key]
    for ending, unit in _ENDINGS:
        if key.endswith(ending):
            return unit
    for start, unit in _STARTS:
        if key.startswith(start):
            return unit
    return "count" if key in _COUNTS else ""


def _setting_unit(name: str) -> str:
    """Return the unit of a setting of the training as it is declared, ``"number"`` without one."""
    units = {entry.name: entry.unit or "number" for entry in declarations(TrainingSettings)}
    unit = units.get(name, "")
    return f"of 1 ({unit})" if unit.startswith("share") else unit


def _leaves(values: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(values, dict):
        for key, value in values.items():
            if key not in _SHOWN_ELSEWHERE:
                yield from _leaves(value, (*path, str(key)))
    elif isinstance(values, list) and any(isinstance(v, (dict, float)) for v in values):
        for index, value in enumerate(values):
            yield from _leaves(value, (*path, str(index)))
    else:
        yield path, values


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (int, float)) or value is None:
        return number(value)
    if isinstance(value, list):
        return escaped(", ".join(map(str, value))) or "none"
    return escaped(value) or "none"
