# SPDX-License-Identifier: GPL-3.0-or-later
"""Records of what was measured: small JSON files from which the page can be written again."""

from __future__ import annotations

import datetime
import math
import os
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.machine import processor_name

from ..speed_error.runs import ROOT, code_state
from ..tables import versions

FOLDER = ROOT / "benchmarks" / "records" / "paper"
PLUG_IN, ATTENUATION, MESHERS = "plug_in", "attenuation", "meshers"
DIGITS = 6


def origin(command: str, threads: int) -> dict[str, Any]:
    """Return where figures come from: command, date, machine, versions, code, load."""
    return {
        "command": f"python -m benchmarks.paper.{command}",
        "date": datetime.date.today().isoformat(),
        "machine": f"{processor_name()}, {threads} thread{'s' if threads > 1 else ''}",
        "versions": versions(),
        "code": code_state(),
        "load_before": round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None,
    }


def rounded(value: Any) -> Any:
    """Return JSON values with floats of :data:`DIGITS` significant digits; NaN becomes null."""
    if isinstance(value, dict):
        return {str(key): rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return value
    if isinstance(value, int):
        return value
    number = float(value)
    return float(f"{number:.{DIGITS}g}") if math.isfinite(number) else None


def write_record(name: str, values: dict[str, Any], folder: Path = FOLDER) -> Path:
    """Write one record and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    write_json(path, rounded(values))
    return path


def read_record(name: str, folder: Path = FOLDER) -> dict[str, Any] | None:
    """Return a record, or ``None`` where there is none."""
    path = folder / f"{name}.json"
    return dict(read_json(path)) if path.is_file() else None
