# SPDX-License-Identifier: GPL-3.0-or-later
"""The figures of a record that tables and plots show, each in one place."""

from __future__ import annotations

from ..speed_error.tables import MIDDLE, thin_recall
from .record import Record

MBR_NOTE = (
    "MBR: PSNR of mesh-based rendering (docs/method.md, section 9.3), photos cut out along the "
    "true outline."
)


def f1_middle(record: Record) -> float:
    """F1 at 0.5 % of the diagonal, whole surface."""
    return record.f1(MIDDLE)


def f1_fine(record: Record) -> float:
    """F1 at 0.25 %."""
    return record.f1(0)


def f1_seen(record: Record) -> float:
    """F1 at 0.5 % of what cameras see of both surfaces."""
    return record.f1(MIDDLE, "scan")


def thin(record: Record) -> float | None:
    """Recall of thin parts at 0.5 %; ``None`` where there are practically none."""
    return thin_recall(record.scores["surface"]["uniform"])


def normal_error(record: Record) -> float:
    """One less the mean size of the cosine between normals of counterparts."""
    return 1.0 - float(record.scores["surface"]["uniform"]["normal_consistency"])


def view_psnr(record: Record) -> float | None:
    """PSNR of the Gaussians at the test views, whole photo, dB; ``None`` without Gaussians."""
    found = record.scores.get("gaussians")
    return None if found is None else float(found["psnr"])


def texture_psnr(record: Record) -> float | None:
    """PSNR of the textured mesh at the test views, where the true surface is seen, dB."""
    value = record.scores.get("texture", {}).get("psnr")
    return None if value is None else float(value)


def mbr_psnr(record: Record) -> float | None:
    """PSNR of mesh-based rendering, dB; ``None`` where it was not measured."""
    return None if record.mbr is None else float(record.mbr["psnr"])


def gaussians(record: Record) -> int | None:
    """Number of Gaussians."""
    found = record.scores.get("gaussians")
    return None if found is None else int(found["count"])
