# SPDX-License-Identifier: GPL-3.0-or-later
"""What a farm's scheduler and workers can do, asked on the spot."""

from __future__ import annotations

import asyncio
import importlib.metadata
import json
import logging
import os
import platform
import re
import secrets
import shutil
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import EXIT_OTHER, UsageError, WrapError, unwritable_error
from ...farm.dask import Answer, request_of
from ...files import real_path
from ...machine import processor_count, total_memory_bytes
from ...worker.helper_process import emit
from ...worker.spawn import end_with_parent
from ..parts.graph import code_version
from .doctor import Diagnosis, diagnose

# -- What ``farm doctor`` asks of a computer: versions, memory, devices, and the shared folder ----
#
# Runs on a Dask worker as the parts of a job do, as a child process of the worker's Python. Its
# last line is ``{"answer": {...}}``.

MODULE = "jobs.commands.farm_findings"
COMPARED = ("torch", "numpy")
"""Packages that must have the same version on all computers: results depend on them."""
_MAX_TOKEN_BYTES = 100


def main(arguments: list[str]) -> int:
    """Answer for ``arguments = [{"out", "token", "reply", "deadline_s"} as JSON]``.

    ``token`` and ``reply`` are names of files in ``out``, to be read and to be written; empty where
    the shared folder is not seen.
    """
    end_with_parent()
    request = json.loads(arguments[0])
    late = threading.Timer(float(request["deadline_s"]), os._exit, (EXIT_OTHER,))
    late.daemon = True  # nobody waits for the answer any more
    late.start()
    out = Path(request["out"])
    emit(answer={**_exchanged(out, request), **versions(), **_findings(out)})
    return 0


def versions() -> dict[str, str]:
    """Return the version of the program, of Python and of the packages that are compared."""
    found = {"code": code_version(), "python": platform.python_version()}
    for name in COMPARED:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = ""
    return found


def _exchanged(out: Path, request: dict[str, Any]) -> dict[str, str]:
    """Read the token that was written elsewhere, and write one of our own."""
    if not request["token"]:
        return {}
    try:
        with (out / request["token"]).open("rb") as stream:
            token = stream.read(_MAX_TOKEN_BYTES).decode(errors="replace")
        reply = secrets.token_hex(16)
        (out / request["reply"]).write_text(reply, encoding="ascii")
    except OSError as error:
        return {"folder_error": f"{error.strerror or error}: {error.filename or out}"}
    return {"token": token, "reply": reply}


def _findings(out: Path) -> dict[str, Any]:
    try:
        found = diagnose(str(out))
    except (WrapError, OSError) as error:  # the version and the folder are told all the same
        found = [Diagnosis("Worker", False, f"{error}", "Install the add-on there again.")]
    gpus = [f.finding.split(",")[0] for f in found if re.fullmatch(r"GPU \d+", f.subject)]
    return {
        "cores": processor_count(), "memory_bytes": total_memory_bytes(),
        "gpu": gpus[0] if gpus else "", "free_bytes": shutil.disk_usage(out).free,
        "bad": [[f"{f.subject}: {f.finding}", f.hint] for f in found if not f.good],
    }  # fmt: skip


# -- A folder in the shared folder in which this computer and workers leave each other a file -----
#
# All files of the check lie in it, so that nothing is left once it is removed: a worker that
# comes too late has no place to write to.

_logger = logging.getLogger(__name__)

SEEN_S = 10.0
"""Longest time until a file that a worker has written is seen here."""
FROM_HERE_NAME = "here.txt"
_POLL_S = 0.2
_MAX_BYTES = 100
_REMOVALS = 5
"""Network file systems keep the name of a file that another computer has open for a moment."""


class MeetingFolder:
    """Made with ``with``, which removes it again.

    ``shared``: the shared folder or one in it, which a job could lie in.
    """

    def __init__(self, shared: Path) -> None:
        self.shared = real_path(shared)
        self.root = self.shared / f"gwrap-doctor-{secrets.token_hex(6)}"
        self.token = secrets.token_hex(16)

    def __enter__(self) -> MeetingFolder:
        if not self.shared.is_dir():
            raise UsageError(
                f"{self.shared} is not a folder.", "Mount the shared folder, or name it."
            )
        try:
            self.root.mkdir()
            (self.root / FROM_HERE_NAME).write_text(self.token, encoding="ascii")
        except OSError as error:
            self.remove()
            raise unwritable_error(self.shared, error) from None
        return self

    def __exit__(self, *_error: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the folder with what lies in it."""
        for _ in range(_REMOVALS):
            shutil.rmtree(self.root, ignore_errors=True)
            if not self.root.exists():
                return
            time.sleep(_POLL_S)
        _logger.warning("%s could not be removed", self.root)

    def requests(self, number: int, deadline_s: float) -> list[dict[str, Any]]:
        """Return what the worker of a number is asked: as a job asks, then without the folder."""
        reply = f"worker-{number}.txt"
        arguments = {"token": FROM_HERE_NAME, "reply": reply, "deadline_s": deadline_s}
        seen = request_of(self.root, MODULE, arguments, None)
        unseen = {**seen, "arguments": {**arguments, "token": ""}, "folder": ".",
                  "is_shared": False}  # fmt: skip
        return [seen, unseen]

    def unnamed(self, text: str) -> str:
        """Return a text of a worker with the shared folder in place of this one."""
        for separator in "/\\":
            text = text.replace(f"{separator}{self.root.name}", "")
        return text

    async def sees(self, reply: str) -> bool:
        """Return whether a worker's file is here with this text, waiting for it a while."""
        until_s = time.monotonic() + SEEN_S
        while True:
            if any(_text(path) == reply for path in self.root.glob("worker-*.txt")):
                return True
            if time.monotonic() >= until_s:
                return False
            await asyncio.sleep(_POLL_S)


def _text(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return stream.read(_MAX_BYTES).decode(errors="replace")
    except OSError:
        return ""


# -- What is found about one worker of a Dask cluster, and what is wrong with it ------------------

MAX_CLOCK_S = 60.0
"""States of parts have the time of their computer; one of three minutes ago counts as left."""
MAX_CHARACTERS = 300
"""Of a text from a worker."""
_GIB = 2**30
_SAME_VERSION = "Install the same version of the add-on on all computers."
_SAME_PACKAGES = "Set up its worker again, on both computers from the same version of the add-on."
_START = "Start it with batch.py farm worker, of the same version as here."
_MOUNT = (
    "Mount the shared folder there and start its worker with --shared; set GW_SHARED here where "
    "the paths differ."
)


@dataclass(frozen=True)
class WorkerFinding:
    """Findings about one worker."""

    name: str
    """Host, and the address where the scheduler reaches it."""
    facts: tuple[str, ...]
    problems: tuple[str, ...]
    """Sentences: what is wrong and the next step; none if it can be used."""
    cores: int = 0
    memory_bytes: int = 0
    gpu: str = ""

    @property
    def good(self) -> bool:
        """Whether it can run parts."""
        return not self.problems

    def line(self) -> str:
        """Return all of it as a line."""
        facts = ", ".join(self.facts)
        if self.good:
            return f"{self.name}: ok; {facts}"
        return f"{self.name}: {' '.join(self.problems)}" + (f" ({facts})" if facts else "")

    def to_json(self) -> dict[str, Any]:
        """Return what the panel shows."""
        return {
            "name": self.name, "good": self.good, "problems": list(self.problems),
            "cores": self.cores, "memory_gib": round(self.memory_bytes / _GIB, 1), "gpu": self.gpu,
        }  # fmt: skip


async def finding_of(
    answer: Answer, meeting: MeetingFolder, here: Mapping[str, str]
) -> WorkerFinding:
    """Judge the answer of a worker.

    ``here``: the versions of this computer, see :func:`.farm_findings.versions`.
    """
    values = _values(answer)
    problems = [
        *_not_asked(answer), *_no_answer(answer, values, meeting),
        *await _shared(values, meeting), *_of_versions(values, here), *_of_clock(answer),
        *values.get("bad", ()),
    ]  # fmt: skip
    host = short(str(answer.results[-1].get("host", ""))) if answer.results else ""
    place = answer.worker.partition("://")[2] or answer.worker
    return WorkerFinding(
        f"{host} ({place})" if host else place, tuple(_facts(answer, values)),
        tuple(short(f"{what} {hint}") for what, hint in problems),
        values.get("cores", 0), values.get("memory_bytes", 0), values.get("gpu", ""),
    )  # fmt: skip


def _values(answer: Answer) -> dict[str, Any]:
    """Return what a worker has found, complete: another version may tell less, or other things."""
    told = answer.results[-1].get("answer") if answer.results else None
    if not isinstance(told, dict):
        return {}
    rows = told.get("bad")
    rows = rows if isinstance(rows, list) else []
    return {
        **{name: short(str(text)) for name, text in told.items() if isinstance(text, str)},
        **{name: short(str(told.get(name, ""))) for name in ("code", "python", "gpu", *COMPARED)},
        **{name: _whole(told.get(name)) for name in ("cores", "memory_bytes", "free_bytes")},
        "bad": [(str(r[0]), str(r[1])) for r in rows if isinstance(r, list) and len(r) == 2],
    }


def _whole(value: Any) -> int:
    return value if isinstance(value, int) else 0


def _not_asked(answer: Answer) -> Iterator[tuple[str, str]]:
    if answer.error:
        yield answer.error, "Look at that computer; end its worker and start it again."
    elif not answer.has_our_python:
        yield (
            f"It has Python {answer.python}, this computer {platform.python_version()}.",
            "Set up the workers with the same Python: batch.py set-up-worker --python.",
        )


def _no_answer(
    answer: Answer, values: Mapping[str, Any], meeting: MeetingFolder
) -> Iterator[tuple[str, str]]:
    """Tell why the shared folder is not seen, or nothing could be started at all."""
    for number, result in enumerate(answer.results):
        if isinstance(result.get("answer"), dict):
            continue
        if number == 0 and values:
            yield meeting.unnamed(str(result.get("error", ""))), _MOUNT
        elif number == len(answer.results) - 1:
            yield str(result.get("error") or "It has answered nothing."), _START


async def _shared(values: Mapping[str, Any], meeting: MeetingFolder) -> list[tuple[str, str]]:
    if "folder_error" in values:
        error = meeting.unnamed(values["folder_error"])
        return [(f"It cannot use the shared folder: {error}.", "Check its permissions there.")]
    if "token" not in values:
        return []
    if values["token"] != meeting.token:
        return [("Its shared folder is not the one of this computer.", _MOUNT)]
    if not await meeting.sees(values.get("reply", "")):
        hint = "Use a folder of a file server (NFS, SMB), not one that is copied to and fro."
        return [("What it writes into the shared folder is not seen here.", hint)]
    return []


def _of_versions(values: Mapping[str, Any], here: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    if not values:
        return
    if values["code"] != here["code"]:
        yield (
            f"It has version {values['code']} of the program, this computer {here['code']}.",
            _SAME_VERSION,
        )
    for name in COMPARED:
        there = values[name]
        if there and _public(there) != _public(here[name]):  # a missing one is told otherwise
            yield f"It has {name} {there}, this computer {here[name]}.", _SAME_PACKAGES


def _of_clock(answer: Answer) -> Iterator[tuple[str, str]]:
    if abs(answer.clock_s) > MAX_CLOCK_S:
        side = "ahead of" if answer.clock_s > 0 else "behind"
        yield (
            f"Its clock is {abs(answer.clock_s):.0f} s {side} that of this computer.",
            "Let both set their clocks by the network (NTP).",
        )


def _facts(answer: Answer, values: Mapping[str, Any]) -> Iterator[str]:
    if not values:
        return
    yield f"version {values['code']}"
    yield f"Python {values['python']}"
    yield from (f"{name} {values[name] or 'missing'}" for name in COMPARED)
    yield f"{values['cores']} cores"
    yield f"{values['memory_bytes'] / _GIB:.1f} GiB memory"
    yield values["gpu"] or "no GPU"
    if "token" in values:
        yield f"{values['free_bytes'] / _GIB:.1f} GiB free in the shared folder"
    yield f"clock {answer.clock_s:+.1f} s"


def _public(version: str) -> str:
    """Return a version without the build, such as ``+cu126``."""
    return version.partition("+")[0]


def short(text: str) -> str:
    """Return a text from elsewhere as one short line without control characters."""
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words if len(words) <= MAX_CHARACTERS else words[: MAX_CHARACTERS - 1] + "…"
