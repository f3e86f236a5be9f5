# SPDX-License-Identifier: GPL-3.0-or-later
"""What is found about one worker of a Dask cluster, and what is wrong with it."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ....cluster.worker_questions import Answer
from .findings import COMPARED
from .meeting_folder import MeetingFolder

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

    Parameters
    ----------
    here : mapping
        The versions of this computer, see :func:`.findings.versions`.
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
    return {
        **{name: short(str(text)) for name, text in told.items() if isinstance(text, str)},
        **{name: short(str(told.get(name, ""))) for name in ("code", "python", "gpu", *COMPARED)},
        **{name: _whole(told.get(name)) for name in ("cores", "memory_bytes", "free_bytes")},
        "bad": [
            (str(row[0]), str(row[1]))
            for row in (rows if isinstance(rows, list) else [])
            if isinstance(row, list) and len(row) == 2
        ],
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
        return [
            (
                "What it writes into the shared folder is not seen here.",
                "Use a folder of a file server (NFS, SMB), not one that is copied to and fro.",
            )
        ]
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
