# SPDX-License-Identifier: GPL-3.0-or-later
"""What is tried: ways of interruption, and the moments drawn for them from a seed."""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import numpy as np

KILL, CANCEL, DISK, MEMORY, CALLER = "kill", "cancel", "disk", "memory", "caller"
WAYS = {
    KILL: "worker ended by SIGKILL",
    CANCEL: "cancelled by the command line",
    DISK: "disk full",
    MEMORY: "address space limited",
    CALLER: "caller ended by SIGKILL within 0.5 s of the worker's start",
}
SHARES = {KILL: 1.0, CANCEL: 0.2, DISK: 0.2, MEMORY: 0.2, CALLER: 0.5}
"""Trials of each way, as shares of ``--n``."""

START = "start"
"""Before the first stage: the worker loads its packages."""
STAGES = (START, "cameras", "train", "mesh", "texture", "export")
CALLER_DELAY_S = 0.5
LEAST_SHARE = 0.02
"""Smallest disk, of the room that the job takes; smallest limit of memory, of what its packages
take to the most that it takes."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """One interruption."""

    way: str
    number: int
    stage: str
    """At which it happens; empty where a limit, not a moment, is drawn."""
    share: float
    """Of the stage's time, of the disk's or memory's limit, or of :data:`CALLER_DELAY_S`."""

    @property
    def identity(self) -> str:
        """Key of its outcome."""
        return f"{self.way}-{self.number:03d}"

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)


def draw(count: int, seed: int, ways: tuple[str, ...] = tuple(WAYS)) -> list[Trial]:
    """Draw the trials of a seed: those of more kills begin with those of fewer.

    Parameters
    ----------
    count : int
        Kills; the other ways are tried as often as :data:`SHARES` says, at least once.
    """
    trials = []
    for way in ways:
        digest = hashlib.sha256(f"{seed} {way}".encode()).digest()
        random = np.random.default_rng(int.from_bytes(digest[:8], "little"))
        timed = way in (KILL, CANCEL)
        for number in range(max(round(SHARES[way] * count), 1)):
            stage = STAGES[number % len(STAGES)] if timed else ""
            trials.append(Trial(way, number, stage, round(float(random.uniform()), 4)))
    return trials
