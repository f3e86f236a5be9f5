# SPDX-License-Identifier: GPL-3.0-or-later
"""Make one run of a study: wrap, judge, record."""

from __future__ import annotations

import datetime
import logging
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.machine import processor_name

from ..scenes import ensure_scene
from ..speed_error.runs import BATCH, LAST_LINES, ROOT, Settings
from ..speed_error.runs import warm_up as run_warm_up
from ..tables import versions
from .case import Case
from .record import Record, code_of_tree, record_path, write_record

_logger = logging.getLogger("benchmarks")

STAGES = ("cameras", "train", "mesh", "texture")
REMADE_STAGES = STAGES[2:]
"""Of a further mesh of a training."""
KEPT_RUNS = ROOT / ".cache" / "studies"
"""Folders of runs, with Gaussians and meshes: not committed, and not needed for a document."""

_SURFACE = (
    "f1", "precision", "recall", "visible_recall", "thin_recall", "accuracy_median",
    "chamfer_mean", "normal_consistency", "truth_count", "visible_count", "thin_count",
)  # fmt: skip
"""What a record keeps of the scores of a surface."""
DIGITS = 6


def rendered_scene(case: Case) -> Path:
    """Return the folder of a case's scene of :mod:`benchmarks.scenes`; render it where missing."""
    photos = case.photos
    return ensure_scene(case.scene, photos=photos.count, width=photos.width, height=photos.height)


SceneFinder = Callable[[Case], Path]
"""Returns the folder of a case's scene."""


class Maker(Protocol):
    """Makes one run and writes its record."""

    def __call__(self, case: Case, *, threads: int, kept: Path = KEPT_RUNS) -> Record: ...


def carry_out(
    cases: Sequence[Case],
    *,
    threads: int,
    again: bool = False,
    runs: int = 0,
    maker: Maker | None = None,
    kept: Path = KEPT_RUNS,
    find_scene: SceneFinder = rendered_scene,
) -> int:
    """Make the runs that have no record yet, in their order; return how many failed.

    It may be ended at any time: the run that it was at is made again the next time.

    Parameters
    ----------
    again : bool
        Make runs that have a record, too.
    runs : int
        Make no more runs than this; 0: there is no limit.
    maker : callable, optional
        Makes one run and writes its record; :func:`make` by default.
    kept : Path
        Folder of the runs themselves.
    find_scene : callable
        Where kernels are compiled on, before the first run.
    """
    failed = made = 0
    for number, case in enumerate(cases):
        if not again and record_path(case).is_file():
            continue
        if runs and made == runs:
            break
        made += 1
        warm_up(find_scene, case, threads, kept)
        try:
            record = (maker or make)(case, threads=threads, kept=kept)
        except WorkerError as error:
            failed += 1
            _logger.error("%s failed: %s", case.identity, error)
            continue
        _logger.info(
            "%d/%d %s: %.0f processor s, F1 %s", number + 1, len(cases), case.identity,
            record.spent_s,
            " ".join(f"{value:.3f}" for value in record.scores["surface"]["uniform"]["f1"]),
        )  # fmt: skip
    return failed


def warm_up(find_scene: SceneFinder, case: Case, threads: int, kept: Path) -> None:
    """Compile all kernels in a job of a minute, once for each version of the code."""
    stamp = kept / f"warm-{code_of_tree().name.replace(', ', '-')}"
    if stamp.is_file():
        return
    everything = ("--multi-view", "on", "--wrapping", "on", "--harmonics", "on", "--exposure", "on")
    run_warm_up(find_scene(case), Settings(kept, threads, False), everything)
    stamp.touch()


def make(
    case: Case,
    *,
    threads: int,
    kept: Path = KEPT_RUNS,
    find_scene: SceneFinder = rendered_scene,
) -> Record:
    """Make a run, judge it, and write its record.

    Raises
    ------
    WorkerError
        With the last lines of the job's output.
    """
    scene = find_scene(case)
    folder = run_folder(case, kept)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    job = folder / "out"
    if case.base:
        base = run_folder(case, kept).with_name(case.base) / "out"
        if not base.is_dir():
            raise WorkerError(f"{case.base} is not kept on this machine, so nothing to mesh.")
        # A copy: the mesh of the base stays as its record says.
        shutil.copytree(base, job)
        words = ["mesh", "--out", str(job)]
    else:
        words = [
            "wrap", str(scene), "--out", str(job), "--preset", case.preset,
            "--seed", str(case.seed),
        ]  # fmt: skip
    words += ["--region", str(scene / "region.json"), *case.arguments]
    words += ["--export", "ply", "--no-blend", "--threads", str(threads)]
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    code = code_of_tree()
    wall_s = _child([sys.executable, str(BATCH), *words], f"See {job}.")
    scores_file = folder / "scores.json"
    _judge(scene, job, folder, scores_file, threads)
    report = read_json(job / "result" / "report.json")
    region = _region_name(job)
    peaks = report["peak_memory_bytes"]
    # The report of a further mesh repeats what its training took.
    own = REMADE_STAGES if case.base else STAGES
    stages = {name: _processor_s(report, name) for name in own}
    statistics = report["regions"][region]["statistics"]
    record = Record(
        case=case,
        code=code,
        machine=processor_name(),
        versions=versions(),
        threads=threads,
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
        load_before=load,
        wall_s=round(wall_s, 1),
        processor_s=stages,
        memory_gib=round(max(peaks.values()) / 2**30, 2) if peaks else None,
        mesh={
            "vertices": statistics["vertices"],
            "faces": statistics["faces"],
            "closed": statistics["closed"],
            "components": statistics["components"],
        },
        scores=kept_scores(read_json(scores_file)),
    )
    write_record(record)
    write_json(folder / "record.json", record.to_json())
    return record


def run_folder(case: Case, kept: Path = KEPT_RUNS) -> Path:
    """Return where a run is kept: ``out/`` is the job, ``mesh/`` its textured mesh."""
    return kept / case.study / case.identity


def kept_scores(scores: dict[str, Any]) -> dict[str, Any]:
    """Return what a record keeps of the scores, lengths as shares of the diagonal."""
    texture = {name: scores["texture"].get(name) for name in ("psnr", "ssim", "coverage")}
    kept = {"surface": kept_surface(scores["surface"], scores["diagonal"]), "texture": texture}
    kept |= {name: scores[name] for name in ("gaussians", "depth", "vacancy") if name in scores}
    return dict(rounded(kept))


def kept_surface(surface: dict[str, Any], diagonal: float) -> dict[str, Any]:
    """Return what a record keeps of the scores of a surface, by protocol."""
    found: dict[str, Any] = {}
    for protocol in ("uniform", "scan"):
        found[protocol] = {name: surface[protocol][name] for name in _SURFACE}
        for name in ("accuracy_median", "chamfer_mean"):
            length = found[protocol][name]
            found[protocol][name] = None if length is None else length / diagonal
    return dict(rounded(found))


def rounded(values: Any) -> Any:
    """Return values with :data:`DIGITS` significant digits: no figure is known better."""
    if isinstance(values, dict):
        return {name: rounded(value) for name, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [rounded(value) for value in values]
    if isinstance(values, float) and math.isfinite(values):
        return float(f"{values:.{DIGITS}g}")
    return values


def _judge(scene: Path, job: Path, folder: Path, path: Path, threads: int) -> None:
    mesh = folder / "mesh"
    shutil.copytree(job / "result" / _region_name(job), mesh)
    _child(
        [
            sys.executable, "-m", "benchmarks.speed_error.score", str(scene), str(path),
            "--mesh", str(mesh), "--job", str(job), "--stages", "--threads", str(threads),
        ],
        f"See {folder}.",
    )  # fmt: skip


def _child(command: list[str], hint: str) -> float:
    """Run a command; return its seconds on the clock."""
    begun_s = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode != 0:
        words = "\n".join((done.stdout + done.stderr).splitlines()[-LAST_LINES:])
        raise WorkerError(f"A run failed with exit code {done.returncode}: {words}", hint)
    return time.monotonic() - begun_s


def _processor_s(report: dict[str, Any], stage: str) -> float | None:
    found = [
        entry.get("processor_seconds")
        for entry in report["stages"]
        if entry["name"].startswith(stage)
    ]
    return round(math.fsum(found), 1) if found and None not in found else None


def _region_name(job: Path) -> str:
    (name,) = sorted(path.parent.name for path in (job / "result").glob("*/mesh.npz"))
    return name
