# SPDX-License-Identifier: GPL-3.0-or-later
"""The record of one run: what was given, which code ran where, what it cost and how good it is."""

from __future__ import annotations

import dataclasses
import math
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.files import finite_json, read_json, write_json
from gaussian_wrapping_addon.core.jobs.store.stage_folder import STAGE_VERSIONS

from ..speed_error.runs import ROOT
from .case import Case

RECORDS = ROOT / "benchmarks" / "records"
VERSION = 1
PACKAGE = "gaussian_wrapping_addon/core"
"""The code that decides a result."""


@dataclasses.dataclass(frozen=True)
class Code:
    """Which code made a run."""

    commit: str
    """Short hash of the commit; ``unknown`` outside of a repository."""
    core: str
    """Short hash of the content of :data:`PACKAGE`: equal hashes are equal code, whatever else
    the commits changed."""
    changed: bool
    """Whether files of :data:`PACKAGE` differed from the commit."""
    stages: dict[str, int]
    """``STAGE_VERSIONS``: a stage whose number is the same is meant to compute the same."""

    @property
    def name(self) -> str:
        """What distinguishes versions."""
        return f"{self.core}, changed" if self.changed else self.core


@dataclasses.dataclass(frozen=True)
class Record:
    """One finished run."""

    case: Case
    code: Code
    machine: str
    versions: str
    threads: int
    date: str
    """Of the end of the run, ISO, UTC."""
    load_before: float | None
    wall_s: float
    """Of the whole command, on the clock: other programs may have run beside it."""
    processor_s: dict[str, float | None]
    """By stage, of all threads: as the job measures them, without starting Python; ``None`` where
    the system does not tell."""
    memory_gib: float | None
    mesh: dict[str, Any]
    """``vertices``, ``faces``, ``closed``, ``components``."""
    scores: dict[str, Any]
    """See :mod:`.making`."""
    mbr: dict[str, Any] | None = None
    """Mesh-based rendering: filled in afterwards from the kept mesh."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        values |= {"case": self.case.to_json(), "code": dataclasses.asdict(self.code)}
        return {"version": VERSION, **dict(finite_json(values))}

    @staticmethod
    def from_json(values: dict[str, Any]) -> Record:
        """Return what :meth:`to_json` wrote."""
        rest = {name: value for name, value in values.items() if name != "version"}
        rest |= {"case": Case.from_json(values["case"]), "code": Code(**values["code"])}
        return Record(**rest)

    def f1(self, index: int, protocol: str = "uniform") -> float:
        """Return F1 at a threshold."""
        return float(self.scores["surface"][protocol]["f1"][index])

    @property
    def spent_s(self) -> float:
        """Processor seconds of all its stages; NaN where one is not known."""
        return self.processor(*self.processor_s)

    def processor(self, *stages: str) -> float:
        """Return the processor seconds of some stages together; NaN where one is not known."""
        known = (self.processor_s.get(stage) for stage in stages)
        return math.fsum(math.nan if seconds is None else seconds for seconds in known)


def record_path(case: Case, root: Path = RECORDS) -> Path:
    """Return where the record of a case lies."""
    return root / case.study / f"{case.identity}.json"


def write_record(record: Record, root: Path = RECORDS) -> Path:
    """Write a record where its case belongs."""
    path = record_path(record.case, root)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, record.to_json())
    return path


def read_record(path: Path) -> Record:
    """Read a record.

    Raises
    ------
    ParseError
        It is of another version, or lacks a field.
    """
    values = read_json(path)
    known = isinstance(values, dict) and values.get("version") == VERSION
    try:
        if known:
            return Record.from_json(values)
    except (KeyError, TypeError) as error:
        raise ParseError(path, "record", str(error), "Make the run again with --again.") from error
    raise ParseError(path, "version", f"No record of version {VERSION}.", "Use --again.")


def read_records(cases: Iterable[Case], root: Path = RECORDS) -> dict[str, Record]:
    """Return the records that exist, by identity, in the order of the cases.

    Raises
    ------
    ParseError
        A record was made with other settings than its case has: it is of another plan.
    """
    found = {}
    for case in cases:
        path = record_path(case, root)
        if not path.is_file():
            continue
        record = read_record(path)
        if record.case != case:
            raise ParseError(
                path, "case", "The run was made with other settings than the plan has now.",
                "Delete the record, or make the run again with --again.",
            )  # fmt: skip
        found[case.identity] = record
    return found


def code_of_tree() -> Code:
    """Return the code of the working tree."""

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False
        )
        return done.stdout.strip() if done.returncode == 0 else "unknown"

    return Code(
        git("rev-parse", "--short=10", "HEAD"),
        git("rev-parse", "--short=10", f"HEAD:{PACKAGE}"),
        git("status", "--porcelain", "--", PACKAGE) != "",
        dict(STAGE_VERSIONS),
    )


def said_versions(records: Sequence[Record]) -> str:
    """Return one sentence: which code the runs are of, and whether versions are mixed."""
    names = list(dict.fromkeys(r.code.name for r in records))
    commits = {
        name: list(dict.fromkeys(r.code.commit for r in records if r.code.name == name))
        for name in names
    }
    if len(names) == 1:
        changed = ", with uncommitted changes" if records[0].code.changed else ""
        return f"All runs are of one version of the code (commit {commits[names[0]][0]}{changed})."
    counts = [
        f"{sum(r.code.name == name for r in records)} of {commits[name][0]}"
        + (" with uncommitted changes" if "changed" in name else "")
        for name in names
    ]
    differing = sorted(
        stage
        for stage in set().union(*(r.code.stages for r in records))
        if len({r.code.stages.get(stage) for r in records}) > 1
    )
    words = (
        f"between them the result of {', '.join(differing)} was changed on purpose"
        if differing
        else "the numbers of their stages say that results did not change on purpose"
    )
    return (
        f"**Runs of {len(names)} versions of the code are mixed** ({', '.join(counts)}); {words}."
    )
