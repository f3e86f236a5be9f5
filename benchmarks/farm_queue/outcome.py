# SPDX-License-Identifier: GPL-3.0-or-later
"""What became of the queue: kept in one file, from which the page is written."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import EXIT_DONE
from gaussian_wrapping_addon.core.files import read_json, write_json

from ..study.record import RECORDS
from .strikes import Struck

PATH = RECORDS / "farm_queue" / "outcome.json"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One queue from its first command to the comparisons."""

    seed: int
    rows: tuple[dict[str, Any], ...]
    """Of the queue's own table."""
    strikes: tuple[Struck, ...]
    first_code: int
    first_s: float
    end_s: float
    second_code: int
    second_s: float
    processes_left: tuple[str, ...]
    left_behind: tuple[str, ...]
    incomplete: tuple[str, ...]
    """Jobs whose result lacks files that others have."""
    compared: tuple[str, ...]
    """Jobs that were made alone as well."""
    items: int
    """Compared in each of them."""
    differences: tuple[str, ...]
    traceback: bool
    code_name: str
    machine: str
    date: str

    @property
    def faults(self) -> list[str]:
        """What is not as it should be, in words."""
        found = [
            f"{row['name']} is {row['state']}: {row['error']}"
            for row in self.rows
            if row["state"] != "done"
        ]
        if self.first_code == EXIT_DONE:
            found.append("the first command ended with code 0 though it was killed")
        if self.second_code != EXIT_DONE:
            found.append(f"the second command ended with code {self.second_code}")
        found += [f"left running: {line[:120]}" for line in self.processes_left]
        found += [f"left behind: {place}" for place in self.left_behind]
        found += [f"not whole: {name}" for name in self.incomplete]
        found += [f"another result: {line}" for line in self.differences]
        return found + ["a traceback was shown"] * self.traceback


def read_outcome(path: Path = PATH) -> Outcome:
    """Return the outcome of the last run."""
    values = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in read_json(path).items()
    }
    strikes = tuple(Struck(**strike) for strike in values["strikes"])
    return Outcome(**{**values, "strikes": strikes})


def write_outcome(outcome: Outcome, path: Path = PATH) -> None:
    """Write an outcome."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, dataclasses.asdict(outcome))
