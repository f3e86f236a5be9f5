# SPDX-License-Identifier: GPL-3.0-or-later
"""What runs parts: the interface, and the engine that runs them in this process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from ...errors import EXIT_DONE
from ...progress import Progress
from .graph import Part
from .lease import PartLease
from .part_runner import BegunAgain, PartRunner


@dataclass(frozen=True)
class Outcome:
    """How a part ended."""

    part: Part
    code: int
    """0 done; else one of the exit codes of ``run-part``, or negative: a signal."""
    reused: bool = False
    error: str = ""
    hint: str = ""
    place: str = ""
    begun_again: bool = False
    """Whether the region of the part is to be planned anew."""


class Engine(Protocol):
    """Runs parts, one or several at a time."""

    @property
    def slots(self) -> int:
        """Parts that it runs at a time."""

    @property
    def trusts_states(self) -> bool:
        """Whether finished parts of an interrupted job are not asked again."""

    def start(self, part: Part, plan: str, attempt: int) -> None:
        """Begin a part, or queue it."""

    def wait(self, seconds: float) -> list[Outcome]:
        """Return what has ended; wait at most so long for the first."""

    def close(self, *, cancelled: bool) -> None:
        """End what still runs and give everything back."""


@dataclass
class InProcess:
    """The engine of this process: one part after the other.

    Its errors are raised as they are: they end the job.

    Parameters
    ----------
    root : Path
        The job folder.
    progress_of : callable
        Makes the progress of a part.
    """

    root: Path
    runner: PartRunner
    progress_of: Callable[[Part], Progress]
    slots: int = 1
    trusts_states: bool = False
    _queue: list[tuple[Part, str, int]] = field(default_factory=list)

    def start(self, part: Part, plan: str, attempt: int) -> None:
        """Queue a part."""
        self._queue.append((part, plan, attempt))

    def wait(self, seconds: float) -> list[Outcome]:
        """Run the next part, however long it takes; there must be one."""
        part, plan, attempt = self._queue.pop(0)
        lease = PartLease(self.root, part.name, plan, attempt)
        lease.take()
        try:
            result = self.runner.run(part, self.progress_of(part))
        except BegunAgain:
            lease.finish("FAILED", error="It is begun again on the processor.")
            return [Outcome(part, EXIT_DONE, begun_again=True)]
        except Exception as error:
            lease.finish(
                "FAILED", error=str(getattr(error, "message", error)),
                hint=getattr(error, "hint", ""), exit_code=getattr(error, "exit_code", None),
            )  # fmt: skip
            raise
        state = lease.finish("DONE", fraction=1.0, exit_code=EXIT_DONE, outputs=result.outputs)
        return [Outcome(part, EXIT_DONE, reused=result.reused, place=state.host)]

    def close(self, *, cancelled: bool) -> None:
        """Forget what is queued."""
        self._queue.clear()
