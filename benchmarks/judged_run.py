# SPDX-License-Identifier: GPL-3.0-or-later
"""Make one run through the command line, judge it, and return what a record keeps of it."""

from __future__ import annotations

import datetime
import tempfile
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.machine import processor_name

from .speed_error.plan import THRESHOLD_SHARES, Run
from .speed_error.runs import Settings, code_state, judged_by, measured, run_wrap

SHARES = tuple(f"{100 * share:g} %" for share in THRESHOLD_SHARES)
"""Thresholds of F1, of the crop volume's diagonal, for headers of tables."""


def judged_run(run: Run, photos: Path, truth: Path, threads: int) -> dict[str, Any]:
    """Wrap photos, judge the result by the test views and the true surface, and keep the figures.

    Parameters
    ----------
    run : Run
    photos : Path
        Scene folder that is wrapped.
    truth : Path
        Scene folder with the true surface and the test views.
    threads : int
    """
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(Path(folder), threads, False)
        done = run_wrap(run, photos, settings)
        values = measured(done)
        path = Path(folder) / "scores.json"
        arguments = [str(truth), str(path), "--mesh", str(done / "mesh")]
        arguments += ["--job", str(done / "out"), "--stages"]
        scores = judged_by("score", arguments, path, settings)
    training, uniform = values["report"]["training"], scores["surface"]["uniform"]
    (stage,) = [s for s in values["report"]["stages"] if s["name"] == "train"]
    return {
        "scene": run.scene,
        "code": code_state(),
        "date": datetime.date.today().isoformat(),
        "machine": processor_name(),
        "threads": threads,
        "command": values["command"],
        "iterations": training["iterations"],
        "gaussians": training["gaussians"],
        "train_processor_s": stage.get("processor_seconds"),
        "wall_s": values["wall_s"],
        "psnr": scores["gaussians"]["psnr"],
        "ssim": scores["gaussians"]["ssim"],
        "f1": dict(zip(SHARES, uniform["f1"], strict=True)),
        "thin_recall": (uniform["thin_recall"] or (None, None, None))[1],
        "normals": uniform["normal_consistency"],
    }
