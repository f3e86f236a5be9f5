# SPDX-License-Identifier: GPL-3.0-or-later
"""Records of runs with figures that tests invent."""

from __future__ import annotations

import dataclasses
from typing import Any

from benchmarks.provenance import Code
from benchmarks.study import Case, Record

CODE = Code("0123456789", "aaaaaaaaaa", False, {"train": 6, "mesh": 9})


def surface(level: float, thin_count: int = 500) -> dict[str, Any]:
    """Return scores of a surface in which no two figures are equal."""
    names = ("f1", "precision", "recall", "visible_recall", "thin_recall")
    shares = {n: [level + 0.01 * k + 0.001 * i for i in range(3)] for k, n in enumerate(names)}
    return shares | {
        "accuracy_median": 0.002, "chamfer_mean": 0.004, "normal_consistency": level + 0.06,
        "truth_count": 1000, "visible_count": 900, "thin_count": thin_count,
    }  # fmt: skip


def invented(case: Case, level: float = 0.7, code: Code = CODE, **changed: Any) -> Record:
    """Return a record of invented figures."""
    made = Record(
        case=case,
        code=code,
        machine="a processor",
        versions="Python 3",
        threads=1,
        date="2026-01-02T03:04+00:00",
        load_before=0.25,
        wall_s=100.0,
        processor_s={"cameras": 1.0, "train": 60.0, "mesh": 20.0, "texture": 9.0},
        memory_gib=1.25,
        mesh={"vertices": 1000, "faces": 2000, "closed": True, "components": 2},
        scores={
            "surface": {"uniform": surface(level), "scan": surface(level + 0.1)},
            "texture": {"psnr": 24.0, "ssim": 0.8, "coverage": 0.5},
            "gaussians": {"count": 7000, "psnr": 28.0, "ssim": 0.9, "object_psnr": 27.0},
        },
    )
    return dataclasses.replace(made, **changed)
