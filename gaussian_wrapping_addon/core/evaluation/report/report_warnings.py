# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings of a report: those of the stages, and those derived from its figures."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from ...report_warning import ReportWarning, read_warnings
from .text import escaped, items, measured, number, part, percent, plural

FEW_HELD_OUT = 3
"""The mean over fewer photos is not reliable."""

LOW_COVERAGE = 0.5
"""Below half, most of the texture is filled in and not photographed."""

GAP_DB = 20.0 * math.log10(2.0)
"""Held-out photos have more than twice the error of training photos."""

TEXELLESS_SHARE = 0.005
"""Share of the area in faces smaller than a texel that is worth a warning: scattered slivers take
the colour of their neighbours."""

MAX_RESIDUAL = 0.25
"""``|v - 0.5|`` beyond which a vertex is nearer to "empty" or "solid" than to the surface."""

REPROJECTION_PX = 2.0
"""Half of the 4 px at which structure from motion rejects a point."""


@dataclass(frozen=True)
class StageWarning:
    """One warning of one stage."""

    stage: str
    """``cameras``, ``training``, ``mesh NAME`` or ``texture NAME``."""
    code: str
    """Stable identifier; empty for texts of version 0.1.0."""
    text: str
    hint: str = ""
    """What the user can do; empty if no remedy is known."""

    def to_json(self) -> dict[str, str]:
        """Return plain JSON values."""
        return asdict(self)


def collect_warnings(report: dict[str, Any]) -> list[StageWarning]:
    """Return the warnings of every stage, in the order of the stages.

    Parameters
    ----------
    report : dict
        Content of ``report.json`` of any version; entries may be missing.
    """
    cameras, training = part(report, "cameras"), part(report, "training")
    found = _of_stage(
        "cameras",
        read_warnings(cameras.get("warnings")),
        _camera_warnings(part(cameras, "facts")),
    )
    found += _of_stage(
        "training", read_warnings(training.get("warnings")), _training_warnings(training)
    )
    for name, region in part(report, "regions").items():
        provenance, texture = part(region, "provenance"), part(region, "texture")
        found += _of_stage(
            f"mesh {name}",
            read_warnings(provenance.get("warnings")),
            read_warnings(provenance.get("notes")),
            _mesh_warnings(part(region, "statistics"), provenance),
            _check_warnings(part(region, "check")),
        )
        found += _of_stage(
            f"texture {name}",
            read_warnings(texture.get("warnings")),
            read_warnings(part(region).get("warnings")),
            _texture_warnings(texture),
        )
    return list(dict.fromkeys(found))


def warning_lines(report: dict[str, Any]) -> list[str]:
    """Return the section "Warnings" as Markdown list entries."""
    lines = []
    for warning in collect_warnings(report):
        step = f" *Next step:* {escaped(warning.hint)}" if warning.hint else ""
        lines.append(f"- **{escaped(warning.stage)}**: {escaped(warning.text)}{step}")
    return lines or ["No stage reported a warning."]


def _of_stage(stage: str, *lists: Iterable[ReportWarning]) -> list[StageWarning]:
    return [StageWarning(stage, w.code, w.text, w.hint) for each in lists for w in each]


def _camera_warnings(facts: dict[str, Any]) -> list[ReportWarning]:
    error_px = measured(facts.get("mean_reprojection_error_px"))
    if error_px is None or error_px <= REPROJECTION_PX:
        return []
    text = (
        f"The mean reprojection error of the cameras is {number(error_px, 'px', digits=2)}; "
        f"above {REPROJECTION_PX:g} px details blur."
    )
    return [
        ReportWarning(
            "reprojection-error", text, "Use one lens without zooming, and keep the scene still."
        )
    ]


def _training_warnings(training: dict[str, Any]) -> list[ReportWarning]:
    if not isinstance(training.get("held_out"), list):
        return []
    count = len(training["held_out"])
    if count == 0:
        text = "No photo was held out: the accuracy of new views was not measured."
        return [
            ReportWarning("no-held-out-photos", text, "Take more photos, or allow held-out photos.")
        ]
    found = []
    if count < FEW_HELD_OUT:
        text = f"Only {plural(count, 'photo')} held out: too few for a reliable mean."
        found.append(
            ReportWarning("few-held-out-photos", text, "Take more photos from all around.")
        )
    history = items(training.get("history"))
    reached = measured(part(history[-1]).get("psnr")) if history else None
    new = measured(training.get("held_out_psnr"))
    if reached is not None and new is not None and reached - new > GAP_DB:
        text = (
            f"Held-out photos have more than twice the error of training photos "
            f"({new:.1f} dB against {reached:.1f} dB)."
        )
        step = "Take more photos between the viewpoints; check for motion and changes of exposure."
        found.append(ReportWarning("new-views-worse", text, step))
    return found


def _mesh_warnings(statistics: dict[str, Any], provenance: dict[str, Any]) -> list[ReportWarning]:
    found = []
    is_open_by_request = provenance.get("boundary") == "open"
    if statistics.get("closed") is False and not is_open_by_request:
        edges = plural(statistics.get("boundary_edges"), "open edge")
        text = f"The mesh is not closed ({edges}); volumes and 3D printing need a closed mesh."
        step = "Fill the holes in Blender; send the job folder's log.txt with a bug report."
        found.append(ReportWarning("not-closed", text, step))
    residual_p99 = measured(provenance.get("level_error_p99"))
    # Smoothing and decimation move vertices off the surface on request.
    moved = "faces_before_clean_up" in provenance or measured(provenance.get("smooth_steps"))
    if residual_p99 is not None and residual_p99 > MAX_RESIDUAL and not moved:
        text = "1 % of the vertices or more do not lie on the reconstructed surface."
        found.append(
            ReportWarning(
                "off-the-surface", text, "Mesh with more points, or choose a smaller region."
            )
        )
    left = measured(provenance.get("degenerate_faces_left"))
    if left:
        text = f"{plural(int(left), 'face')} with zero area could not be removed."
        found.append(
            ReportWarning(
                "degenerate-faces", text, "Blender: Mesh > Clean Up > Degenerate Dissolve."
            )
        )
    return found


def _check_warnings(check: dict[str, Any]) -> list[ReportWarning]:
    defects = [defect for defect in items(check.get("defects")) if isinstance(defect, str)]
    if not defects:
        return []
    text = f"The check of the final mesh found defects ({'; '.join(defects)})."
    step = "Mesh with another number of points; send the job folder's log.txt with a bug report."
    return [ReportWarning("mesh-defects", text, step)]


def _texture_warnings(texture: dict[str, Any]) -> list[ReportWarning]:
    found = []
    coverage = measured(texture.get("coverage"))
    if coverage == 0.0:
        text = "No photo sees the mesh: its texture is plain grey."
        found.append(
            ReportWarning("no-photo-sees-the-mesh", text, "Check the region and the cameras.")
        )
    elif coverage is not None and coverage < LOW_COVERAGE:
        text = (
            f"Only {percent(coverage)} of the texture is seen by photos; the rest is filled in "
            "from its surroundings."
        )
        step = "Choose a tighter region, or photograph the missing sides."
        found.append(ReportWarning("little-seen", text, step))
    reason = texture.get("unwrap_fallback_reason")
    if isinstance(reason, str) and reason:
        text = f"The mesh was unwrapped by box projection: {reason}"
        found.append(
            ReportWarning(
                "unwrapped-simply",
                text,
                "Box projection makes more seams; a smaller mesh may unwrap normally.",
            )
        )
    lost = measured(texture.get("faces_without_texel"))
    share = measured(texture.get("area_without_texel_share"))
    if lost and (share is None or share > TEXELLESS_SHARE):
        text = f"{plural(int(lost), 'face')} smaller than a texel: no texture colour of their own."
        found.append(
            ReportWarning("faces-without-texel", text, "Choose a larger texture or a coarser mesh.")
        )
    overlaps = measured(texture.get("texels_overlapping"))
    if overlaps:
        text = f"{plural(int(overlaps), 'texel')} belong to two faces."
        found.append(ReportWarning("texels-overlap", text, "Choose a larger texture."))
    return found
