# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras of hundreds of photos: ``python -m benchmarks.camera_solving``.

``town`` is 400 rendered photos of streets with exact cameras, ``hall`` a room whose four walls
look the same, ``odm_caliterra`` and ``odm_brighton_beach`` are photos of drones, ``fox`` is by hand
(``--data DIR`` names the folder that has them). What has a record in
``benchmarks/records/camera_solving`` is not run again. The page is
``docs/benchmarks/camera-solving.md``.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.files import read_json, write_json

from ..speed_error.runs import ROOT
from .cases import CASES, run
from .document import page
from .repeating import repeating_record
from .retrieval import recall_record

_logger = logging.getLogger("benchmarks")
RECORDS = ROOT / "benchmarks" / "records" / "camera_solving"
PAGE = ROOT / "docs" / "benchmarks" / "camera-solving.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Make missing runs and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", help="cases; none: write the page alone")
    parser.add_argument("--data", type=Path, help="folder of the real photo sets")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="make runs that have a record, too")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    RECORDS.mkdir(parents=True, exist_ok=True)

    def wanted(name: str) -> bool:
        is_new = options.again or not (RECORDS / f"{name}.json").is_file()
        return is_new and (options.only is None or name in options.only)

    for case in CASES:
        if wanted(case.identity) and (case.count or options.data is not None):
            record = run(case, options.data, options.threads, _logger.info)
            write_json(RECORDS / f"{case.identity}.json", record)
            _logger.info("%s: %s", case.identity, record)
    if wanted("repeating"):
        write_json(RECORDS / "repeating.json", repeating_record(_logger.info))
    for name in ("fox", "odm_caliterra", "conch_turntable"):
        if options.data is not None and wanted(f"recall-{name}"):
            photos = options.data / name / "images"
            write_json(RECORDS / f"recall-{name}.json", recall_record(photos, options.threads))
    records = {path.stem: read_json(path) for path in sorted(RECORDS.glob("*.json"))}
    PAGE.write_text(page(records), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
