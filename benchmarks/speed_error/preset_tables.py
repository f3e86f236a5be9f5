# SPDX-License-Identifier: GPL-3.0-or-later
"""The tables of the report: what a preset costs and how exact it is; meshers on one training."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..study.figures import (
    MBR_NOTE,
    f1_fine,
    f1_middle,
    f1_seen,
    gaussians,
    mbr_psnr,
    normal_error,
    texture_psnr,
    thin,
    view_psnr,
)
from ..study.record import Record
from ..tables import Table
from .cases import (
    ADAPTIVE,
    ALPHA,
    LABELS,
    MESHED_PRESETS,
    MESHERS,
    SCENES,
    alpha_case,
    mesher_case,
    preset_case,
)
from .plan import PRESETS
from .tables import AT, SHARES, Row, table_of, three, two

Records = Mapping[str, Record]
"""By identity."""


def preset_table(records: Records) -> Table:
    """Return processor time and error of the presets, after the trivial surface of each scene."""
    rows: list[Row] = []
    knows_mbr = any(mbr_psnr(r) is not None for r in records.values())
    for scene in SCENES:
        for case in (alpha_case(scene), *(preset_case(scene, p) for p in PRESETS)):
            r = records.get(case.identity)
            if r is None:
                continue
            trivial = case.name == ALPHA
            rows.append(
                {
                    "scene": scene,
                    "preset": "alpha shape" if trivial else case.preset,
                    "processor s": _seconds(r.spent_s),
                    "training": None if trivial else _seconds(r.processor("train")),
                    "mesh": None if trivial else _seconds(r.processor("mesh")),
                    "texture": None if trivial else _seconds(r.processor("texture")),
                    "peak GiB": None if r.memory_gib is None else f"{r.memory_gib:.2f}",
                    "Gaussians": gaussians(r),
                    "vertices": r.mesh["vertices"],
                    **_errors(r),
                    f"seen F1 {AT}": three(f1_seen(r)),
                    "test views dB": two(view_psnr(r)),
                    "textured mesh dB": two(texture_psnr(r)),
                    **({"MBR dB": two(mbr_psnr(r))} if knows_mbr else {}),
                    "closed": _closed(r),
                }
            )
    return table_of(
        "Presets",
        rows,
        "Processor s: seconds of all threads, of all stages of the job together and of three of "
        "them; starting Python is not among them, and kernels were compiled before.",
        "F1 at shares of the crop volume's diagonal, whole surface, hidden sides included; seen "
        "F1: what the cameras see of both surfaces. Thin recall: true samples on parts thinner "
        "than 1.5 % of the diagonal that at least two cameras see, where at least 1 % of the "
        "samples are thin. Normal error: one less the mean size of the cosine between normals of "
        "counterparts, both directions.",
        "Test views: PSNR of the Gaussians at eight views that the job was never given, whole "
        "photo. Textured mesh: PSNR on the pixels that show the true surface; a hole is an error "
        "there." + (f" {MBR_NOTE}" if knows_mbr else ""),
        "Alpha shape: of the sparse points that training starts from, with the best alpha of six "
        "by the truth; its time is that of the triangulation alone. What is not above it was not "
        "worth training for.",
    )


def mesher_table(records: Records) -> Table:
    """Return every mesh of a training, the preset's own first."""
    rows: list[Row] = []
    knows_mbr = any(mbr_psnr(r) is not None for r in records.values())
    for scene in SCENES:
        for preset in MESHED_PRESETS:
            others = {m: mesher_case(scene, preset, m).identity for m in MESHERS}
            if not any(identity in records for identity in others.values()):
                continue
            for mesher, identity in {
                ADAPTIVE: preset_case(scene, preset).identity,
                **others,
            }.items():
                r = records.get(identity)
                if r is None:
                    continue
                rows.append(
                    {
                        "scene": scene,
                        "training": preset,
                        "mesher": LABELS[mesher],
                        "mesh, processor s": _seconds(r.processor("mesh")),
                        "vertices": r.mesh["vertices"],
                        "faces": r.mesh["faces"],
                        **_errors(r),
                        **({"MBR dB": two(mbr_psnr(r))} if knows_mbr else {}),
                        "components": r.mesh["components"],
                        "closed": _closed(r),
                    }
                )
    return table_of(
        "Meshers on the same training",
        rows,
        "Marching tetrahedra from the pivots alone, as in the paper, without samples of depth "
        "maps (`--pivot-samples none`).",
    )


def spent_s(record: Record, records: Records) -> float:
    """Return the processor seconds from photos to mesh; of a further mesh with its training."""
    own = record.processor("mesh")
    if record.case.name == ALPHA:
        return own
    trained = records.get(record.case.base) if record.case.base else record
    return math.nan if trained is None else own + trained.processor("cameras", "train")


def _errors(record: Record) -> Row:
    return {
        f"F1 {SHARES[0]}": three(f1_fine(record)),
        f"F1 {AT}": three(f1_middle(record)),
        f"F1 {SHARES[2]}": three(record.f1(2)),
        f"thin recall {AT}": three(thin(record)),
        "normal error": three(normal_error(record)),
    }


def _seconds(value: float) -> str | None:
    if not math.isfinite(value):
        return None
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}"


def _closed(record: Record) -> str | None:
    closed = record.mesh["closed"]
    return None if closed is None else ("yes" if closed else "NO")
