# SPDX-License-Identifier: GPL-3.0-or-later
"""What a hostile case is: bad input, a command line, and how it has to end."""

from __future__ import annotations

import enum
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Build = Callable[[Path], None]
"""Makes the bad input in an empty folder, the same every time."""


class Way(enum.Enum):
    """How the command line of a variant is run."""

    HERE = "here"
    """``batch.main`` in this process; commands that need a worker run in this process as well."""
    LOADING = "loading"
    """The first stage of ``wrap`` alone, in this process: poses, photos, masks and points."""
    PROCESS = "process"
    """``python batch.py`` in a process of its own."""
    TERMINAL = "terminal"
    """As ``PROCESS``, with a terminal as its output."""


class Needs(enum.Enum):
    """What a variant cannot do without; the text tells why it is skipped elsewhere."""

    POSIX = "links, pipes and devices are those of POSIX"
    LINUX = "/proc and /dev/full are those of Linux"
    USER = "root may read everything"
    CLOSED_FOLDER = "this user may write into read-only folders, and cannot mount any"

    def met(self) -> bool:
        """Tell whether this machine and user have it; closed folders are seen when tried."""
        if self is Needs.LINUX:
            return sys.platform.startswith("linux")
        if self is Needs.USER:
            return os.name != "nt" and os.geteuid() != 0
        return os.name != "nt"


@dataclass(frozen=True)
class Variant:
    """One row of the suite's table."""

    name: str
    build: Build
    code: int
    """Exit code."""
    says: str
    """Regular expression of one line of the output: names file, place and next step."""
    words: tuple[str, ...] = ("check", "set")
    """The command line, run in the folder of the input."""
    way: Way = Way.HERE
    writes: tuple[str, ...] = ()
    """Entries of the folder of the input that the command may make, change or remove."""
    encoding: str = "utf-8"
    """Of the output, in a process of its own."""
    closed: str = ""
    """Folder that nobody may write into while the command runs."""
    environment: tuple[tuple[str, str], ...] = ()
    needs: Needs | None = None
    only_loading: bool = False
    """Whether loading may refuse what ``check``, which decodes no photos, lets pass."""
    reads_beside: bool = False
    """Whether the command may open the files that a link of the input leads to."""
    starts: bool = False
    """Whether the command may start other programs."""


@dataclass(frozen=True)
class Case:
    """One number of the suite."""

    number: int
    title: str
    variants: tuple[Variant, ...] = ()
    tests: tuple[str, ...] = ()
    """Node ids of tests elsewhere that hold what no command line shows, or the rest of the case."""


@dataclass(frozen=True)
class Group:
    """Cases of one subject, in one module of ``tests/hostile/cases``."""

    title: str
    cases: tuple[Case, ...]


def row_id(case: Case, variant: Variant) -> str:
    """Return the name of a row, such as ``07 focal length of 0``."""
    return f"{case.number:02d} {variant.name}"
