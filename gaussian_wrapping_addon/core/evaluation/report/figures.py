# SPDX-License-Identifier: GPL-3.0-or-later
"""Figures of the report: texts, numbers, warnings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ...progress import ReportWarning, read_warnings
from ...settings import TrainingSettings, declarations

# -- Text formatting for reports: numbers with units, durations, escaped Markdown, tables, bars


NOT_MEASURED = "not measured"

BAR_CHARACTERS = 24
_MARKUP = str.maketrans(
    {c: f"\\{c}" for c in "\\`*_[]#~|"} | {"<": "&lt;", ">": "&gt;", "&": "&amp;"}
)


def part(values: Any, *keys: str) -> dict[str, Any]:
    """Return a nested dictionary; empty if a key is missing or not a dictionary."""
    for key in keys:
        values = values.get(key) if isinstance(values, dict) else None
    return values if isinstance(values, dict) else {}


def items(values: Any) -> list[Any]:
    """Return a list unchanged, anything else as an empty list."""
    return values if isinstance(values, list) else []


def measured(value: Any) -> float | None:
    """Return a finite number, or ``None`` for anything else, including booleans and NaN."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def number(value: Any, unit: str = "", *, digits: int | None = None) -> str:
    """Return a finite number with its unit, or :data:`NOT_MEASURED`.

    It has so many digits after the decimal point; by default, integers are written in full and
    other numbers with four significant digits.
    """
    found = measured(value)
    if found is None:
        return NOT_MEASURED
    if digits is not None:
        text = f"{found:,.{digits}f}"
    elif found == int(found) and abs(found) < 1e15:
        text = f"{int(found):,}"
    else:
        text = f"{found:,.4g}" if 1e-3 <= abs(found) < 1e4 else f"{found:.3e}"
        if 1e4 <= abs(found) < 1e9:
            text = f"{found:,.0f}"
    return f"{text} {unit}" if unit else text


def plural(count: Any, one: str, many: str = "") -> str:
    """Return a count with its noun, as ``1 photo`` or ``3 photos``."""
    return number(count, one if count == 1 else many or one + "s")


def percent(value: Any, digits: int = 1) -> str:
    """Return a share as a percentage; 0 % and 100 % only if exact."""
    share = measured(value)
    if share is None:
        return NOT_MEASURED
    text = f"{100.0 * share:.{digits}f}"
    step = 10.0**-digits
    if share > 0.0 and float(text) == 0.0:
        return f"less than {step:g} %"
    if share < 1.0 and float(text) >= 100.0:
        return f"{100.0 - step:.{digits}f} %"
    return f"{text} %"


def duration(seconds: Any) -> str:
    """Return a duration in seconds, minutes or hours."""
    found = measured(seconds)
    if found is None:
        return NOT_MEASURED
    whole = max(0, round(found))
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 10:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(minutes + (rest >= 30), 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"


def bytes_text(value: Any) -> str:
    """Return bytes as MiB or GiB."""
    found = measured(value)
    if found is None or found <= 0:
        return NOT_MEASURED
    return f"{found / 2**30:.2f} GiB" if found >= 2**30 else f"{found / 2**20:.0f} MiB"


def escaped(text: Any) -> str:
    """Escape text for Markdown, on one line, valid inside a table."""
    return " ".join(str(text).split()).translate(_MARKUP)


def escaped_or(value: Any, default: str = "unknown") -> str:
    """Return escaped text, or ``default`` if it is missing or empty."""
    return default if value is None or value == "" else escaped(value)


def bar(share: float) -> str:
    """Return a text bar for a share in [0, 1]; any share above 0 is visible."""
    full = max(0.0, min(1.0, share)) * BAR_CHARACTERS
    count = max(1, round(full)) if share > 0 else 0
    return "█" * count + "░" * (BAR_CHARACTERS - count)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], align: str) -> list[str]:
    """Return the lines of a Markdown table; ``align`` has an ``l`` or ``r`` for each column.

    Cells are Markdown: text from outside must already be :func:`escaped`.
    """
    lines = [header, ["---:" if a == "r" else "---" for a in align], *rows]
    for row in lines:
        if len(row) != len(align):
            raise ValueError(f"a row of {len(row)} cells in a table of {len(align)} columns")
    return [f"| {' | '.join(row)} |" for row in lines]


# -- The table of all figures of a report, each with its unit -------------------------------------


# Lists of records that have tables or pictures of their own.
_SHOWN_ELSEWHERE = {
    "decisions", "history", "pictures", "warnings", "packages", "stages", "notes", "blocks",
}  # fmt: skip

_NAMES = {
    "dB": (
        "psnr", "held_out_psnr", "held_out_region_psnr", "region_psnr", "whole_psnr",
        "exposed_psnr",
    ),
    "1 is identical": ("ssim", "held_out_ssim"),
    "0 is identical": ("lpips", "held_out_lpips"),
    "s": ("seconds_training", "wall_seconds", "mesh_seconds", "seconds_low", "seconds_high"),
    "cubic scene units": ("volume",),
    "square scene units": ("area", "candidate_area", "cap_area"),
    "s of all cores": ("processor_seconds",),
    "scene units": ("mean_edge", "edge_length_scene"),
    "world units": ("edge_length", "texel_size"),
    "world units, 0 is automatic": ("edge_length_world",),
    "texels per world unit": ("texels_per_unit",),
    "photos": ("views_per_seen_texel",),
    "of 1": ("utilisation", "coverage", "covered", "uncovered"),
    "of 1, standard deviation": ("exposure_spread", "brightness_spread_within_photos"),
    "1 is even": ("stretch_mean", "stretch_p95"),
    "number": ("seed", "version", "euler", "genus"),
    "degree": ("sh_degree",),
    "count": ("extra_iterations",),
    "px": ("pixels_per_iteration", "multi_view_pixels"),
    "iterations": ("multi_view_every",),
    "weight": ("region_weight", "overlap_price"),
    "times the reference machine": ("speed",),
    "1/s": ("video_fps",),
    "of vacancy": ("level",),
    "px²": ("blur_variance",),
}  # fmt: skip
"""Names of figures by their unit."""
_UNITS = {name: unit for unit, names in _NAMES.items() for name in names}
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
_COUNTS = frozenset((
    "atlases", "bad_indices", "boundary_edges", "candidates", "cap_faces_left_out", "cap_points",
    "charts", "components", "cores", "degenerate_faces", "degenerate_faces_left", "dense_faces",
    "dense_high", "dense_low", "dense_vertices", "densify_every", "dropped_candidates", "faces",
    "faces_before_clean_up", "faces_without_texel", "field_cameras", "field_evaluations", "frames",
    "gaussians", "gaussians_in_region", "holdout_every", "images_in_model", "inconsistent_edges",
    "interior_samples", "iterations", "jump_points", "left_out", "lods", "max_atlases",
    "max_gaussians", "most_parts", "nonmanifold_edges", "nonmanifold_vertices",
    "not_finite_vertices", "open_at_region", "open_edges", "pairs_contradicting_cameras",
    "pairs_matched", "pairs_verified", "part_count", "photos", "photos_joined", "photos_masked",
    "photos_masked_as_turning", "photos_placed", "photos_undistorted", "photos_used",
    "photos_with_focal_length", "pivots", "pivots_each", "pivots_high", "pivots_low", "points",
    "points_high", "points_in_model", "points_low", "processes", "projection_evaluations", "rays",
    "relabelled_tetrahedra", "removed_cavities", "removed_open_pieces", "removed_solids",
    "sightings", "small_handles_closed", "small_handles_left", "smooth_steps", "split_edges",
    "split_vertices", "surface_points", "target_faces", "tetrahedra", "tetrahedra_high",
    "tetrahedra_low", "texels_filled", "texels_overlapping", "texels_seen",
    "texels_seen_at_outlines_only", "texels_seen_badly", "texels_used", "threads", "tile_processes",
    "turntable_photos", "undecided_tetrahedra", "unseen_evaluations", "unused_vertices", "vertices",
    "vertices_at_end_of_sight", "vertices_moved_apart", "vertices_on_region_boundary",
    "vertices_on_surface", "video_frames", "video_frames_blurred", "video_frames_damaged",
    "video_frames_kept", "video_frames_read", "video_frames_still", "views", "wrap_rounds",
))  # fmt: skip
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


# -- Warnings of a report: those of the stages, and those derived from its figures ----------------


FEW_HELD_OUT = 3  # the mean over fewer photos is not reliable
LOW_COVERAGE = 0.5  # below half, most of the texture is filled in and not photographed
GAP_DB = 20.0 * math.log10(2.0)  # held-out photos have more than twice the error of training photos
TEXELLESS_SHARE = 0.005
"""Share of the area in faces smaller than a texel that is worth a warning: scattered slivers take
the colour of their neighbours."""

MAX_RESIDUAL = 0.25
"""``|v - 0.5|`` beyond which a vertex is nearer to "empty" or "solid" than to the surface."""

REPROJECTION_PX = 2.0  # half of the 4 px at which structure from motion rejects a point


@dataclass(frozen=True)
class StageWarning:
    """One warning of one stage."""

    stage: str  # ``cameras``, ``training``, ``mesh NAME`` or ``texture NAME``
    code: str  # Stable identifier; empty for texts of version 0.1.0.
    text: str
    hint: str = ""
    """What the user can do; empty if no remedy is known."""

    def to_json(self) -> dict[str, str]:
        """Return plain JSON values."""
        return asdict(self)


def collect_warnings(report: dict[str, Any]) -> list[StageWarning]:
    """Return the warnings of every stage, in order, of a report of any version."""
    cameras, training = part(report, "cameras"), part(report, "training")
    by_stage: list[tuple[str, Sequence[Any], Iterable[ReportWarning]]] = [
        ("cameras", [cameras.get("warnings")], _camera_warnings(part(cameras, "facts"))),
        ("training", [training.get("warnings")], _training_warnings(training)),
    ]
    for name, region in part(report, "regions").items():
        provenance, texture = part(region, "provenance"), part(region, "texture")
        stored = [provenance.get("warnings"), provenance.get("notes")]
        by_stage.append((f"mesh {name}", stored, _mesh_warnings(part(region), provenance)))
        stored = [texture.get("warnings"), part(region).get("warnings")]
        by_stage.append((f"texture {name}", stored, _texture_warnings(texture)))
    found = [
        StageWarning(stage, warning.code, warning.text, warning.hint)
        for stage, stored, derived in by_stage
        for warning in (*(w for values in stored for w in read_warnings(values)), *derived)
    ]
    return list(dict.fromkeys(found))


def warning_lines(report: dict[str, Any]) -> list[str]:
    """Return the section "Warnings" as Markdown list entries."""
    lines = []
    for warning in collect_warnings(report):
        step = f" *Next step:* {escaped(warning.hint)}" if warning.hint else ""
        lines.append(f"- **{escaped(warning.stage)}**: {escaped(warning.text)}{step}")
    return lines or ["No stage reported a warning."]


def _camera_warnings(facts: dict[str, Any]) -> Iterator[ReportWarning]:
    error_px = measured(facts.get("mean_reprojection_error_px"))
    if error_px is not None and error_px > REPROJECTION_PX:
        text = (
            f"The mean reprojection error of the cameras is {number(error_px, 'px', digits=2)}; "
            f"above {REPROJECTION_PX:g} px details blur."
        )
        step = "Use one lens without zooming, and keep the scene still."
        yield ReportWarning("reprojection-error", text, step)


def _training_warnings(training: dict[str, Any]) -> Iterator[ReportWarning]:
    if not isinstance(training.get("held_out"), list):
        return
    count = len(training["held_out"])
    if count == 0:
        text = "No photo was held out: the accuracy of new views was not measured."
        step = "Take more photos, or allow held-out photos."
        yield ReportWarning("no-held-out-photos", text, step)
        return
    if count < FEW_HELD_OUT:
        text = f"Only {plural(count, 'photo')} held out: too few for a reliable mean."
        yield ReportWarning("few-held-out-photos", text, "Take more photos from all around.")
    history = items(training.get("history"))
    reached = measured(part(history[-1]).get("psnr")) if history else None
    new = measured(training.get("held_out_psnr"))
    if reached is not None and new is not None and reached - new > GAP_DB:
        text = (
            f"Held-out photos have more than twice the error of training photos "
            f"({new:.1f} dB against {reached:.1f} dB)."
        )
        step = "Take more photos between the viewpoints; check for motion and changes of exposure."
        yield ReportWarning("new-views-worse", text, step)


def _mesh_warnings(region: dict[str, Any], provenance: dict[str, Any]) -> Iterator[ReportWarning]:
    statistics = part(region, "statistics")
    if statistics.get("closed") is False and provenance.get("boundary") != "open":
        edges = plural(statistics.get("boundary_edges"), "open edge")
        text = f"The mesh is not closed ({edges}); volumes and 3D printing need a closed mesh."
        step = "Fill the holes in Blender; send the job folder's log.txt with a bug report."
        yield ReportWarning("not-closed", text, step)
    residual_p99 = measured(provenance.get("level_error_p99"))
    # Smoothing and decimation move vertices off the surface on request.
    moved = "faces_before_clean_up" in provenance or measured(provenance.get("smooth_steps"))
    if residual_p99 is not None and residual_p99 > MAX_RESIDUAL and not moved:
        text = "1 % of the vertices or more do not lie on the reconstructed surface."
        step = "Mesh with more points, or choose a smaller region."
        yield ReportWarning("off-the-surface", text, step)
    if left := measured(provenance.get("degenerate_faces_left")):
        text = f"{plural(int(left), 'face')} with zero area could not be removed."
        step = "Blender: Mesh > Clean Up > Degenerate Dissolve."
        yield ReportWarning("degenerate-faces", text, step)
    defects = [d for d in items(part(region, "check").get("defects")) if isinstance(d, str)]
    if defects:
        text = f"The check of the final mesh found defects ({'; '.join(defects)})."
        step = (
            "Mesh with another number of points; send the job folder's log.txt with a bug report."
        )
        yield ReportWarning("mesh-defects", text, step)


def _texture_warnings(texture: dict[str, Any]) -> Iterator[ReportWarning]:
    coverage = measured(texture.get("coverage"))
    if coverage == 0.0:
        text = "No photo sees the mesh: its texture is plain grey."
        yield ReportWarning("no-photo-sees-the-mesh", text, "Check the region and the cameras.")
    elif coverage is not None and coverage < LOW_COVERAGE:
        text = (
            f"Only {percent(coverage)} of the texture is seen by photos; the rest is filled in "
            "from its surroundings."
        )
        step = "Choose a tighter region, or photograph the missing sides."
        yield ReportWarning("little-seen", text, step)
    reason = texture.get("unwrap_fallback_reason")
    if isinstance(reason, str) and reason:
        text = f"The mesh was unwrapped by box projection: {reason}"
        step = "Box projection makes more seams; a smaller mesh may unwrap normally."
        yield ReportWarning("unwrapped-simply", text, step)
    lost = measured(texture.get("faces_without_texel"))
    share = measured(texture.get("area_without_texel_share"))
    if lost and (share is None or share > TEXELLESS_SHARE):
        text = f"{plural(int(lost), 'face')} smaller than a texel: no texture colour of their own."
        step = "Choose a larger texture or a coarser mesh."
        yield ReportWarning("faces-without-texel", text, step)
    if overlaps := measured(texture.get("texels_overlapping")):
        text = f"{plural(int(overlaps), 'texel')} belong to two faces."
        yield ReportWarning("texels-overlap", text, "Choose a larger texture.")
