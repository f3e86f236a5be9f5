# SPDX-License-Identifier: GPL-3.0-or-later
"""What became of each trial, kept in one file so that a study may take several sittings."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import EXIT_CANCELLED, EXIT_DONE, EXIT_RESOURCES
from gaussian_wrapping_addon.core.files import read_json, write_json

from ..study.record import RECORDS
from .trials import CALLER, CANCEL, DISK, KILL, MEMORY, Trial

LONGEST_END_S = 12.0
"""After a moment that was chosen, no process of a job is left after this long."""
CODES: dict[str, tuple[int | None, ...]] = {
    KILL: (EXIT_DONE, EXIT_RESOURCES),
    CANCEL: (EXIT_DONE, EXIT_CANCELLED),
    DISK: (EXIT_DONE, EXIT_RESOURCES),
    MEMORY: (EXIT_DONE, EXIT_RESOURCES),
    CALLER: (None,),
}
"""With which exit codes the interrupted command may end; done, where it ended before."""
PATH = RECORDS / "kills" / "outcomes.json"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One interruption and what came after it."""

    trial: Trial
    hit: str
    """Stage at which it struck; empty: the job had ended, or fitted its limit."""
    code: int | None
    """Exit code of the command that was interrupted; ``None`` where it was the one that was
    killed."""
    message: str
    """Last line of what it said."""
    end_s: float
    """From the interruption until no process of the job was left."""
    left: int
    """Processes that were left at the end."""
    traceback: bool
    """Whether the command or the job's output showed one."""
    resumed: int
    """Exit code of the resume."""
    compared: int
    """Arrays, images, entries of reports and files of the result that were compared."""
    differences: tuple[str, ...]
    """Between its result and that of the job without interruption."""
    code_name: str
    """Version of the program."""
    date: str

    @property
    def faults(self) -> list[str]:
        """What is not as it should be, in words."""
        found = []
        if self.code not in CODES[self.trial.way]:
            found.append(f"ended with code {self.code}: {self.message}")
        if self.traceback:
            found.append("showed a traceback")
        if self.left:
            found.append(f"left {self.left} processes")
        if self.end_s > LONGEST_END_S:
            found.append(f"ended after {self.end_s:.1f} s")
        if self.resumed:
            found.append(f"resumed with code {self.resumed}")
        if self.differences:
            found.append(f"another result: {'; '.join(self.differences)}")
        return found

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> Outcome:
        """Return what :meth:`to_json` wrote."""
        trial = Trial(**values["trial"])
        return Outcome(**{**values, "trial": trial, "differences": tuple(values["differences"])})


def read_outcomes(path: Path = PATH) -> dict[str, Outcome]:
    """Return the outcomes so far by the identity of their trials."""
    if not path.is_file():
        return {}
    known = (Outcome.from_json(values) for values in read_json(path)["outcomes"])
    return {outcome.trial.identity: outcome for outcome in known}


def write_outcomes(outcomes: dict[str, Outcome], path: Path = PATH) -> None:
    """Write all outcomes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ordered = [outcomes[name].to_json() for name in sorted(outcomes)]
    write_json(path, {"version": 1, "outcomes": ordered})
