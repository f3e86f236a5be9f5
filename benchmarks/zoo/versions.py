# SPDX-License-Identifier: GPL-3.0-or-later
"""Versions and presets of the program beside each other on scenes of the zoo.

``python -m benchmarks.zoo.versions --earlier CHECKOUT --only SCENE ...`` runs the command line of
this checkout (presets standard and draft) and that of another one (standard) on the same scenes,
one after the other, each run judged by this checkout's judge. What has a record is not made again;
``--document`` writes the page.
"""

from __future__ import annotations

import argparse
import datetime
import logging
import math
import os
import shutil
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import WorkerError, WrapError
from gaussian_wrapping_addon.core.files import read_json, write_bytes, write_json
from gaussian_wrapping_addon.core.machine import processor_name

from ..speed_error.runs import BATCH, LAST_LINES, ROOT
from ..speed_error.tables import SHARES, Row, table_of, three
from ..study.command import DOCUMENTS
from ..study.making import KEPT_RUNS
from ..study.origin import reading
from ..study.record import RECORDS
from ..tables import versions
from .cache import ensure_zoo_scene
from .catalogue import SCENES

_logger = logging.getLogger("benchmarks")

STUDY = "zoo-versions"
PAGE, READING = "zoo-versions.md", "zoo-versions-reading.md"
EARLIER, STANDARD, DRAFT = "earlier, standard", "standard", "draft"
COLUMNS = (EARLIER, STANDARD, DRAFT)
"""What is compared on each scene, in the order in which it is made."""


def main(given: Sequence[str] | None = None) -> int:
    """Run the command line, return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.zoo.versions", description=__doc__)
    parser.add_argument("--earlier", type=Path, metavar="CHECKOUT", help="root of another checkout")
    parser.add_argument("--only", nargs="+", default=[], metavar="SCENE", choices=tuple(SCENES))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--document", action="store_true", help="write the page, make no run")
    options = parser.parse_args(given)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    try:
        if not options.document:
            for scene in options.only:
                _make_runs(scene, options.earlier, options.threads)
        path = write_document(DOCUMENTS)
        _logger.info("%s", path or "there is no record yet, so no page")
    except WrapError as error:
        _logger.error("%s", error)
        return error.exit_code
    return 0


def _make_runs(name: str, earlier: Path | None, threads: int) -> None:
    """Make the missing runs on a scene."""
    scene = ensure_zoo_scene(name)
    for column in COLUMNS:
        root = earlier if column == EARLIER else ROOT
        path = record_path(name, column)
        if root is None or path.is_file():
            continue
        record = _run(name, scene, root, column.rpartition(" ")[2], threads)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, record)
        seen = " ".join(f"{value:.3f}" for value in record["seen_f1"])
        _logger.info("%s, %s: %.0f s, F1 %s", name, column, spent_s(record), seen)


def record_path(scene: str, column: str, root: Path = RECORDS) -> Path:
    """Return where a run's record lies."""
    return root / STUDY / f"{scene}-{column.replace(', ', '-')}.json"


def _run(name: str, scene: Path, root: Path, preset: str, threads: int) -> dict[str, Any]:
    folder = KEPT_RUNS / STUDY / f"{name}-{_commit(root)}-{preset}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    job, scores = folder / "out", folder / "scores.json"
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    _child(
        [
            sys.executable, str(root / BATCH.relative_to(ROOT)), "wrap", str(scene),
            "--out", str(job), "--preset", preset, "--seed", "0", "--export", "ply", "--no-blend",
            "--region", str(scene / "region.json"), "--threads", str(threads),
        ],
        root,
    )  # fmt: skip
    (mesh,) = (path.parent for path in (job / "result").glob("*/mesh.npz"))
    judge = [sys.executable, "-m", "benchmarks.speed_error.score", str(scene), str(scores)]
    _child([*judge, "--mesh", str(mesh), "--job", str(job), "--threads", str(threads)], ROOT)
    stages: dict[str, float] = {}
    for entry in read_json(job / "result" / "report.json")["stages"]:
        stage = entry["name"].partition("-")[0]
        stages[stage] = round(stages.get(stage, 0.0) + entry["processor_seconds"], 1)
    judged = read_json(scores)
    return {
        "scene": scene.name,
        "commit": _commit(root),
        "preset": preset,
        "machine": processor_name(),
        "versions": versions(),
        "threads": threads,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
        "load_before": load,
        "processor_s": stages,
        "seen_f1": [round(v, 4) for v in judged["surface"]["scan"]["f1"]],
        "psnr": round(judged["texture"]["psnr"], 3),
    }


def _commit(root: Path) -> str:
    git = ["git", "-C", str(root), "rev-parse", "--short=10", "HEAD"]
    return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()


def _child(command: list[str], root: Path) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    if done.returncode != 0:
        words = "\n".join((done.stdout + done.stderr).splitlines()[-LAST_LINES:])
        raise WorkerError(f"A run failed with exit code {done.returncode}: {words}")


def spent_s(record: Mapping[str, Any]) -> float:
    """Return the processor seconds of all stages."""
    return math.fsum(record["processor_s"].values())


def read_runs(root: Path = RECORDS) -> dict[str, dict[str, dict[str, Any]]]:
    """Return all records by scene, in the order of the catalogue, and column."""
    paths = {
        name: {column: record_path(name, column, root) for column in COLUMNS} for name in SCENES
    }
    found = {
        name: {column: read_json(path) for column, path in mine.items() if path.is_file()}
        for name, mine in paths.items()
    }
    return {name: mine for name, mine in found.items() if mine}


def ratio(mine: Mapping[str, Mapping[str, Any]], column: str, of: str) -> float | None:
    """Return a column's processor seconds as a share of another's; ``None`` if one is missing."""
    if column not in mine or of not in mine:
        return None
    return spent_s(mine[column]) / spent_s(mine[of])


def _row(scene: str, mine: Mapping[str, Mapping[str, Any]]) -> Row:
    row: Row = {"scene": scene}
    for column in COLUMNS:
        spent = f"{spent_s(mine[column]):.0f}" if column in mine else None
        row[f"{column}: processor s"] = spent
        seen = mine[column]["seen_f1"] if column in mine else None
        shares = f"seen F1 {' / '.join(SHARES)}"
        row[f"{column}: {shares}"] = seen and " / ".join(f"{value:.3f}" for value in seen)
    row["standard / earlier"] = three(ratio(mine, STANDARD, EARLIER))
    row["draft / standard"] = three(ratio(mine, DRAFT, STANDARD))
    return row


def write_document(folder: Path, root: Path = RECORDS) -> Path | None:
    """Write the page and return its path; ``None`` if there is no record."""
    runs = read_runs(root)
    if not runs:
        return None
    records = [record for mine in runs.values() for record in mine.values()]
    medians = []
    for column, of in ((STANDARD, EARLIER), (DRAFT, STANDARD)):
        shares = [r for mine in runs.values() if (r := ratio(mine, column, of)) is not None]
        if shares:
            medians.append(
                f"{column} takes {statistics.median(shares):.2f} of the processor seconds of "
                f"{of} in the median of {len(shares)} scenes, {max(shares):.2f} at most"
            )
    commits = {
        column: sorted({mine[column]["commit"] for mine in runs.values() if column in mine})
        for column in COLUMNS
    }
    loads = [r["load_before"] for r in records if r["load_before"] is not None]
    code = "; ".join(f"{column}: {', '.join(found)}" for column, found in commits.items() if found)
    origin = (
        f"`python -m benchmarks.zoo.versions`, {max(r['date'] for r in records)[:10]}; "
        f"{records[0]['machine']}, {records[0]['threads']} thread; {records[0]['versions']}. "
        f"Commits: {code}. Load average before a run: {min(loads, default=0.0):.1f} to "
        f"{max(loads, default=0.0):.1f}. Processor seconds are of all stages, as the jobs measure "
        "them; the scenes' regions are given, cameras are as the zoo gives them."
    )
    table = table_of("Scenes of the zoo", [_row(name, mine) for name, mine in runs.items()])
    lines = ["# Versions beside each other", "", *reading(folder / READING), table.markdown()]
    lines += ["; ".join(medians) + "." if medians else "", "", origin]
    path = folder / PAGE
    write_bytes(path, ("\n".join(lines).rstrip() + "\n").encode())
    return path


if __name__ == "__main__":
    sys.exit(main())
