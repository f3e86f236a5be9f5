# SPDX-License-Identifier: GPL-3.0-or-later
"""Carry out a plan of training runs: render scenes, run, judge, within the time that is given."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import WorkerError

from ..scenes import ensure_scene
from ..speed_error.results import Result
from ..speed_error.runs import Settings, judged_by, measured, run_wrap, warm_up
from .plan import EVERYTHING_ON, WRAPPING, Case, Plan

_logger = logging.getLogger("benchmarks")


@dataclasses.dataclass(frozen=True)
class Measured:
    """A run with its case."""

    case: Case
    result: Result
    folder: Path
    """Of the run."""
    scene: Path
    """Of the photos."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Everything that a plan gave."""

    runs: list[Measured]
    pivots: dict[str, dict[str, Any]]
    """By scene; see :mod:`.pivots`."""
    missing: list[tuple[str, str]]
    """Runs that were not made, or failed, each with the reason."""
    failed: bool
    """Whether a run failed."""


def carry_out(
    plan: Plan, settings: Settings, data: Path | None, only: Sequence[str] = ()
) -> Outcome:
    """Make the runs in their order until the plan's time is over.

    Parameters
    ----------
    settings : Settings
        Their folder gets one folder for each size of photos.
    data : Path or None
        Folder with the real sets; runs on a set that it lacks are left out, with the reason.
    only : sequence of str
        Runs that none of these words names are not made; finished ones are shown where the
        settings allow it.
    """
    begun_s = time.monotonic()
    outcome = Outcome([], {}, [], False)
    warm = False
    for case in plan.cases:
        name = f"{case.run.identity} ({case.folder})"
        own = dataclasses.replace(settings, folder=settings.folder / case.folder)
        finished = settings.reuse and (own.folder / case.run.identity / "measured.json").is_file()
        late = plan.minutes and time.monotonic() - begun_s > 60 * plan.minutes
        if not finished and only and not case.words & set(only):
            outcome.missing.append((name, "left out by --only"))
            continue
        if not finished and late:
            outcome.missing.append((name, f"not begun within {plan.minutes:g} minutes"))
            continue
        scene = _scene(case, data)
        if isinstance(scene, str):
            outcome.missing.append((name, scene))
            continue
        try:
            if not finished and not warm:
                warm_up(scene, own, EVERYTHING_ON)
                warm = True
            found = _measure(case, scene, own)
        except WorkerError as error:
            _logger.warning("%s failed: %s", name, error)
            outcome.missing.append((name, f"failed: {first_line(str(error))}"))
            outcome = dataclasses.replace(outcome, failed=True)
            continue
        outcome.runs.append(found)
        _log(name, found.result)
    for found in outcome.runs:
        run = found.case.run
        if run.scene in plan.pivot_scenes and run.name == WRAPPING:
            path = found.folder / "pivots.json"
            arguments = [str(found.scene), str(found.folder / "out"), str(path)]
            module = f"{__package__}.pivots"
            outcome.pivots[run.scene] = judged_by(module, arguments, path, settings)
            _logger.info("pivots of %s", run.scene)
    return outcome


def _scene(case: Case, data: Path | None) -> Path | str:
    """Return the folder of the photos, or why there is none."""
    if case.photos is not None:
        photos = case.photos
        return ensure_scene(
            case.run.scene, photos=photos.count, width=photos.width, height=photos.height
        )
    if data is None:
        return "real photos lie outside of this repository: name their folder with --data"
    folder = data / case.run.scene
    if not (folder / "images").is_dir():
        return f"the folder of --data holds no {case.run.scene}/images"
    return folder


def _measure(case: Case, scene: Path, settings: Settings) -> Measured:
    folder = run_wrap(case.run, scene, settings)
    values = measured(folder)
    if case.photos is None:
        scores = held_out_scores(values["report"])
    else:
        path = folder / "scores.json"
        job = str(folder / "out")
        arguments = [str(scene), str(path), "--mesh", str(folder / "mesh"), "--job", job]
        scores = judged_by("score", [*arguments, "--stages"], path, settings)
    return Measured(case, Result(case.run, None, values, scores), folder, scene)


def held_out_scores(report: dict[str, Any]) -> dict[str, Any]:
    """Return what is known without a true surface: the job's own held-out photos."""
    training = report["training"]
    return {
        "gaussians": {
            "count": training["gaussians"],
            "psnr": training.get("held_out_psnr"),
            "ssim": training.get("held_out_ssim"),
        }
    }


def first_line(text: str) -> str:
    """Return the line of a job's output that names the error, or the last one."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    named = [line for line in lines if "error" in line.lower()]
    return (named or lines or ["no words"])[-1]


def _log(name: str, result: Result) -> None:
    psnr = result.scores["gaussians"]["psnr"]
    words = "" if psnr is None else f", {psnr:.2f} dB"
    if "surface" in result.scores:
        shown = " ".join(f"{value:.3f}" for value in result.surface("uniform", "f1"))
        words += f", F1 {shown}"
    _logger.info("%s: %.0f s%s", name, result.wall_s, words)
