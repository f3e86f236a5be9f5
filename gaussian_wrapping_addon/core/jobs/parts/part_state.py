# SPDX-License-Identifier: GPL-3.0-or-later
"""The state of each part of a job: ``parts/NAME.json``, written by the process that runs it."""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Collection
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from ... import limits
from ...errors import ParseError
from ...files import overwrite_json, read_json, resolve_inside, write_json
from ...processes.process_identity import host_and_pid_namespace, process_start_ticks

STATES_FOLDER = "parts"
STATES = ("RUNNING", "DONE", "FAILED")


@dataclass(frozen=True)
class PartState:
    """What is known of a part that was begun."""

    state: str
    plan: str
    """Hash of the plan that it was run for."""
    place: str = ""
    """Where the pid is one: host, boot and namespace."""
    pid: int = 0
    pid_started: int = 0
    token: str = ""
    """Differs between two runs of the same part."""
    begun_s: float = 0.0
    """Unix time, by the clock of that computer."""
    heartbeat_s: float = 0.0
    """Unix time of the last sign of life, by the same clock."""
    fraction: float = 0.0
    message: str = ""
    attempts: int = 1
    error: str = ""
    hint: str = ""
    exit_code: int | None = None
    seconds: float = 0.0
    """How long it took, in this attempt."""
    peak_memory_bytes: int = 0
    figures: dict[str, float] = field(default_factory=dict)
    """Live figures, such as ``iteration`` and ``psnr`` of a training."""
    outputs: tuple[str, ...] = ()
    """Files and folders, relative to the job folder; of a stage first its own folder."""

    @property
    def host(self) -> str:
        """The computer, for people."""
        return self.place.split(" ")[0]

    def done_in(self, root: Path, plan: str) -> bool:
        """Return whether the part is done for a plan, and what it has made is still there."""
        return (
            self.state == "DONE"
            and self.plan == plan
            and all(
                (path := resolve_inside(root, output)) is not None and path.exists()
                for output in self.outputs
            )
        )


def states_folder(root: Path) -> Path:
    """Return the folder of the states in a job folder."""
    return root / STATES_FOLDER


def state_path(root: Path, name: str) -> Path:
    """Return the state file of a part."""
    return root / STATES_FOLDER / f"{name}.json"


def write_state(root: Path, name: str, state: PartState) -> None:
    """Write the state of a part, atomically."""
    states_folder(root).mkdir(exist_ok=True)
    write_json(state_path(root, name), _values_of(state))


def overwrite_state(root: Path, name: str, state: PartState) -> None:
    """Write the state of a part over the earlier one, where there is no room for another file."""
    overwrite_json(state_path(root, name), _values_of(state))


def _values_of(state: PartState) -> dict[str, Any]:
    return {**asdict(state), "outputs": list(state.outputs)}


def read_state(root: Path, name: str) -> PartState | None:
    """Return the state of a part; ``None`` where there is none, or it is damaged."""
    try:
        values = read_json(state_path(root, name), most_bytes=limits.MAX_PART_STATE_BYTES)
        return _state_of(values)
    except (OSError, ParseError, TypeError, ValueError, KeyError, OverflowError):
        return None


_TEXTS = ("state", "plan", "place", "token", "message", "error", "hint")
_NUMBERS = ("begun_s", "heartbeat_s", "fraction", "seconds")
_WHOLE = ("pid", "pid_started", "attempts", "peak_memory_bytes")


def _state_of(values: Any) -> PartState:
    known: dict[str, Any] = {f.name: values[f.name] for f in fields(PartState)}
    code, outputs = known["exit_code"], known["outputs"]
    good = (
        all(isinstance(known[name], str) for name in _TEXTS)
        and all(_is_number(known[name], int | float) for name in _NUMBERS)
        and all(_is_number(known[name], int) for name in _WHOLE)
        and (code is None or _is_number(code, int))
        and isinstance(outputs, list)
        and all(isinstance(output, str) for output in outputs)
        and known["state"] in STATES
        and isinstance(known["figures"], dict)
        and all(_is_number(figure, int | float) for figure in known["figures"].values())
    )
    if not good:
        raise TypeError("a value has the wrong type")
    numbers = {name: float(known[name]) for name in _NUMBERS}
    return PartState(**{**known, **numbers, "outputs": tuple(outputs)})


def _is_number(value: Any, kinds: Any) -> bool:
    return isinstance(value, kinds) and not isinstance(value, bool)


def new_state(plan: str, attempt: int) -> PartState:
    """Return the state of a part that begins in this process."""
    pid, now_s = os.getpid(), time.time()
    return PartState(
        "RUNNING", plan, host_and_pid_namespace(), pid, process_start_ticks(pid),
        uuid.uuid4().hex, now_s, now_s, attempts=attempt,
    )  # fmt: skip


def keep_states(root: Path, names: Collection[str]) -> None:
    """Remove the states of all parts of a job but some."""
    folder = states_folder(root)
    for path in folder.glob("*.json") if folder.is_dir() else ():
        if path.stem not in names:
            path.unlink(missing_ok=True)
