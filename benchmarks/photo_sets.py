# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos that people took, wrapped as they are: ``python -m benchmarks.photo_sets FOLDER``.

Each folder in FOLDER that has ``images/`` is a set; cameras are read where it has them, or solved.
There is no true surface: photos that were held out judge the Gaussians and the textured mesh.
``--checkout`` runs another version of the program beside. Each run leaves a record in
``benchmarks/records/photo_sets``; one of the same code is not made again. Runs are kept below
``.cache/studies/photo_sets``. At the end, or with ``--document``, ``docs/benchmarks/photo-sets.md``
is written from the records.
"""

from __future__ import annotations

import argparse
import datetime
import logging
import math
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.machine import processor_name

from .provenance import DOCUMENTS, PACKAGE, RECORDS, ROOT, UNKNOWN, git, versions, write_page
from .runs import BATCH, LAST_LINES
from .study import KEPT_RUNS, reading
from .tables import Row, table_of

_logger = logging.getLogger("benchmarks")

STUDY = "photo_sets"
PAGE = "photo-sets.md"
COMMAND = "python -m benchmarks.photo_sets"
PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the runs that have no record, then write the page; return 1 where a run failed."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument(
        "folder", type=lambda word: Path(word).resolve(), metavar="FOLDER", nargs="?",
        help="of the sets",
    )  # fmt: skip
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="sets to wrap")
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--checkout", type=lambda word: Path(word).resolve(), default=ROOT, metavar="DIR",
        help="version of the program to run, without uncommitted changes",
    )  # fmt: skip
    parser.add_argument("--document", action="store_true", help="make no run, write the page")
    options = parser.parse_args(arguments)
    if options.folder is None and not options.document:
        parser.error("say which FOLDER has the sets, or --document")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if not options.document and git("status", "--porcelain", "--", PACKAGE, root=options.checkout):
        parser.error(f"{options.checkout / PACKAGE} has changes: commit them, a record names code")
    failed = 0
    for photos in [] if options.document else _sets(options.folder, options.only):
        path = record_path(
            photos.name, options.preset, _commit(options.checkout, f"HEAD:{PACKAGE}")
        )
        if path.is_file():
            continue
        try:
            record = _run(photos, options.preset, options.checkout, options.threads)
        except WorkerError as error:
            failed += 1
            _logger.error("%s failed: %s", photos.name, error)
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, record)
        _logger.info("%s: %.0f s", path.stem, spent_s(record))
    page = write_document(DOCUMENTS)
    _logger.info("%s", page or "there is no record yet, so no page")
    return int(failed > 0)


def _sets(folder: Path, only: Sequence[str]) -> list[Path]:
    return [
        path
        for path in sorted(folder.iterdir())
        if (path / "images").is_dir() and (not only or path.name in only)
    ]


def record_path(photos: str, preset: str, core: str, root: Path = RECORDS) -> Path:
    """Return where the record of a set, a preset and the short hash of a version's core lies."""
    return root / STUDY / f"{photos}-{preset}-{core}.json"


def _commit(root: Path, what: str = "HEAD") -> str:
    return git("rev-parse", "--short=10", what, root=root) or UNKNOWN


def _run(photos: Path, preset: str, root: Path, threads: int) -> dict[str, Any]:
    """Wrap a set, or go on with a kept job of the same code, and return the record."""
    folder = KEPT_RUNS / STUDY / f"{photos.name}-{preset}-{_commit(root, f'HEAD:{PACKAGE}')}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    command = [
        sys.executable, str(root / BATCH.relative_to(ROOT)), "wrap", str(photos),
        "--out", str(folder), "--preset", preset, "--seed", "0", "--export", "ply", "--no-blend",
        "--threads", str(threads),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    if done.returncode != 0:
        words = "\n".join((done.stdout + done.stderr).splitlines()[-LAST_LINES:])
        raise WorkerError(f"A run failed with exit code {done.returncode}: {words}")
    return {
        "set": photos.name,
        "photos": sum(path.suffix.lower() in PHOTOS for path in (photos / "images").iterdir()),
        "preset": preset,
        "commit": _commit(root),
        "machine": processor_name(),
        "versions": versions(),
        "threads": threads,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
        "load_before": load,
        **kept_of(read_json(folder / "result" / "report.json")),
    }


def kept_of(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a record keeps of the report of a job with one region."""
    processor_s: dict[str, float] = {}
    clock_s: dict[str, float] = {}
    for entry in report["stages"]:
        stage = entry["name"].partition("-")[0]
        for seconds, name in ((processor_s, "processor_seconds"), (clock_s, "seconds")):
            seconds[stage] = round(seconds.get(stage, 0.0) + (entry[name] or 0.0), 1)
    (region,) = report["regions"].values()
    training, rendered = report["training"], region["mesh_rendering"]
    statistics, facts = region["statistics"], report["cameras"]["facts"]
    return {
        "processor_s": processor_s,
        "clock_s": clock_s,
        "placed": report["cameras"]["views"],
        "reprojection_px": facts.get("mean_reprojection_error_px"),
        "held_out_psnr": training.get("held_out_psnr"),
        "held_out_ssim": training.get("held_out_ssim"),
        "gaussians": training["gaussians"],
        "decisions": {d["name"]: d["chosen"] for d in training["decisions"]},
        "mesh_psnr": rendered.get("psnr"),
        "mesh_exposed_psnr": rendered.get("exposed_psnr"),
        "mesh_ssim": rendered.get("ssim"),
        "covered": rendered.get("covered"),
        "faces": statistics["faces"],
        "closed": statistics["closed"],
        "components": statistics["components"],
        "coverage": region["texture"]["coverage"],
        "warnings": [warning["code"] for warning in report["warnings"]],
    }


def spent_s(record: Mapping[str, Any]) -> float:
    """Return the processor seconds of all stages but the cameras, whose solver's are not known."""
    return math.fsum(s for stage, s in record["processor_s"].items() if stage != "cameras")


def read_runs(root: Path = RECORDS) -> list[dict[str, Any]]:
    """Return all records by set, preset and date."""
    found = [read_json(path) for path in (root / STUDY).glob("*.json")]
    return sorted(found, key=lambda r: (r["set"], r["preset"], r["date"]))


def _row(record: Mapping[str, Any]) -> Row:
    def shown(value: float | None, digits: int) -> str | None:
        return None if value is None else f"{value:.{digits}f}"

    return {
        "set": record["set"],
        "preset": record["preset"],
        "commit": record["commit"],
        "placed": f"{record['placed']} of {record['photos']}",
        "reprojection px": shown(record["reprojection_px"], 2),
        "held out dB": shown(record["held_out_psnr"], 2),
        "SSIM": shown(record["held_out_ssim"], 3),
        "textured mesh dB": shown(record["mesh_psnr"], 2),
        "in their exposures": shown(record.get("mesh_exposed_psnr"), 2),
        "SSIM, mesh": shown(record["mesh_ssim"], 3),
        "of the photo, %": shown(100.0 * (record["covered"] or 0.0), 0),
        "texels seen, %": shown(100.0 * record["coverage"], 0),
        "parts": record["components"],
        "closed": "yes" if record["closed"] else "no",
        "cameras, s on the clock": shown(record["clock_s"]["cameras"], 0),
        "the rest, processor s": shown(spent_s(record), 0),
    }


def write_document(folder: Path, root: Path = RECORDS) -> Path | None:
    """Write the page and return its path; ``None`` if there is no record."""
    records = read_runs(root)
    if not records:
        return None
    days = sorted({record["date"][:10] for record in records})
    loads = [r["load_before"] for r in records if r["load_before"] is not None]
    origin = (
        f"`{COMMAND} FOLDER`, {' to '.join(dict.fromkeys((days[0], days[-1])))}; "
        f"{'; '.join(sorted({r['machine'] for r in records}))}; "
        f"{'; '.join(sorted({r['versions'] for r in records}))}. Load average before a run: "
        f"{min(loads, default=0.0):.1f} to {max(loads, default=0.0):.1f}. Automatic region and "
        "settings, seed 0. Held out: every eighth photo, whole, rendered from the Gaussians. "
        "Textured mesh: what of these photos it covers, baked without them; where exposures are "
        "modelled, in that of each photo as well, as the Gaussians are measured."
    )
    table = table_of("Photo sets", [_row(record) for record in records])
    lines = [origin, "", *reading("photo-sets"), table.markdown()]
    commits = [record["commit"] for record in records]
    return write_page(folder / PAGE, "Photos that people took", commits, lines)


if __name__ == "__main__":
    raise SystemExit(main())
