# SPDX-License-Identifier: GPL-3.0-or-later
"""What every page of a benchmark rests on: which code ran where and when, and if it is today's.

A record names the commit, machine and date of its run. A page is written from records alone, and
:func:`write_page` puts a warning into its first line where the package's core has changed since.
"""

from __future__ import annotations

import dataclasses
import datetime
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.files import finite_json, read_json, write_bytes, write_json
from gaussian_wrapping_addon.core.jobs.store.stage_folder import STAGE_VERSIONS
from gaussian_wrapping_addon.core.machine import processor_name

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "benchmarks" / "records"
DOCUMENTS = ROOT / "docs" / "benchmarks"
PACKAGE = "gaussian_wrapping_addon/core"
"""The code that decides a result."""
UNKNOWN = "unknown"
_NAMELESS = "**Of unknown code**: records of this page name no commit."


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


def git(*words: str, root: Path = ROOT) -> str | None:
    """Return what git says in a working tree; ``None`` where it fails."""
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *words], capture_output=True, text=True, check=False
        )
    except OSError:  # there is no git
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def code_of_tree(root: Path = ROOT) -> Code:
    """Return the code of a working tree."""
    return Code(
        git("rev-parse", "--short=10", "HEAD", root=root) or UNKNOWN,
        git("rev-parse", "--short=10", f"HEAD:{PACKAGE}", root=root) or UNKNOWN,
        git("status", "--porcelain", "--", PACKAGE, root=root) != "",
        dict(STAGE_VERSIONS),
    )


def versions() -> str:
    """Return the versions of what the figures depend on."""
    packages = ("numpy", "numba", "llvmlite", "torch")
    return ", ".join(
        [f"Python {platform.python_version()}", *(f"{p} {metadata.version(p)}" for p in packages)]
    )


def origin(threads: int, code: Code | None = None) -> dict[str, Any]:
    """Return what every record names: code, machine, versions, threads and the date, UTC."""
    return {
        "code": dataclasses.asdict(code or code_of_tree()),
        "machine": processor_name(),
        "versions": versions(),
        "threads": threads,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
    }


def write_figures(path: Path, figures: Mapping[str, Any], threads: int, code: Code) -> None:
    """Write the record of a measurement with its origin.

    Parameters
    ----------
    code : Code
        As it was when the measurement began.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, dict(finite_json({**origin(threads, code), **figures})))


def read_figures(path: Path) -> dict[str, Any]:
    """Return a record that :func:`write_figures` wrote.

    Raises
    ------
    ParseError
        It does not name its code.
    """
    values = read_json(path)
    if not isinstance(values, dict) or "code" not in values:
        raise ParseError(path, "code", "No record that names its commit.", "Measure again.")
    return dict(values)


def said_origin(command: str, record: Mapping[str, Any]) -> str:
    """Return one paragraph: command, date, machine, versions and commit of a record."""
    code = Code(**record["code"])
    changed = ", with uncommitted changes" if code.changed else ""
    threads = record["threads"]
    return (
        f"`{command}`, {record['date'][:10]}. {record['machine']}, {threads} "
        f"thread{'' if threads == 1 else 's'}; {record['versions']}. Commit {code.commit}{changed}."
    )


def age(commits: Iterable[str | None], root: Path = ROOT) -> str:
    """Return a warning where figures are not of the core as it is now, else an empty string.

    Parameters
    ----------
    commits : iterable of str or None
        Of the records; ``None`` and ``unknown`` where a record does not say.
    """
    named = list(dict.fromkeys(commits))
    nameless = [c for c in named if c in (None, "", UNKNOWN)]
    changed = git("log", "-1", "--format=%h", "HEAD", "--", PACKAGE, root=root)
    if not changed:
        return f"> {_NAMELESS}" if nameless else ""
    old = [
        c
        for c in named
        if c not in nameless
        and git("merge-base", "--is-ancestor", changed, str(c), root=root) is None
    ]
    words = []
    if old:
        words.append(
            f"**Older than the code**: measured at {', '.join(map(str, old))}; the core was "
            "changed since."
        )
    if nameless:
        words.append(_NAMELESS)
    return f"> {' '.join(words)}" if words else ""


def write_page(
    path: Path,
    title: str,
    commits: Iterable[str | None],
    lines: Sequence[str],
    root: Path = ROOT,
) -> Path:
    """Write a page of Markdown, with a warning above its title where its figures are old."""
    warning = age(commits, root)
    text = "\n".join([*([warning, ""] if warning else []), f"# {title}", "", *lines])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, (text.rstrip() + "\n").encode())
    return path
