# SPDX-License-Identifier: GPL-3.0-or-later
"""The pinned packages of ``requirements-worker.txt``, and errors of a worker's Python."""

from __future__ import annotations

import operator
import re
import sys
from dataclasses import dataclass
from pathlib import Path

from ..errors import MemoryShortageError, UsageError, WorkerError, WrapError

FILE_NAME = "requirements-worker.txt"
HASHES_NAME = "requirements-worker-hashes.txt"
"""The same packages and what they need, by the hashes of their files; without torch."""
_LINE = re.compile(r"^([A-Za-z0-9][\w.-]*)[^\S\n]*([^#;\n]*)", re.MULTILINE)
_COMPARE = {
    "==": operator.eq, "!=": operator.ne, ">=": operator.ge, "<=": operator.le,
    ">": operator.gt, "<": operator.lt,
}  # fmt: skip
NO_ROOM = (
    "failed to map segment",
    "annot allocate memory",
    "cannot apply additional memory protection",
    "cannot enable executable stack",
    "paging file is too small",
)
"""What the loaders of Linux, macOS and Windows say where a library finds no room in memory."""
_LLVM = "llvmlite.binding"
_PACKAGE_ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Requirement:
    """One package and its allowed versions."""

    name: str
    versions: str
    """Such as ``==2.13.0`` or ``>=1.26,<3``; empty for any."""

    def allows(self, version: str) -> bool:
        """Tell whether an installed version is allowed; a local part (``+cpu``) is ignored."""
        clauses = re.findall(r"([<>=!]=|[<>])([^,]+)", self.versions)
        return all(_COMPARE[sign](_numbers(version), _numbers(wanted)) for sign, wanted in clauses)


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers of a version without trailing zeros: 2.13.0 equals 2.13."""
    text = re.sub(r"(\.0+)+$", "", re.split(r"[+a-zA-Z]", version)[0])
    return tuple(int(n) for n in re.findall(r"\d+", text))


def requirements_file() -> Path:
    """Return the add-on's requirements file, in the installed package or in the repository.

    Raises
    ------
    UsageError
        The file is missing.
    """
    for folder in (_PACKAGE_ROOT, _PACKAGE_ROOT.parent):
        if (folder / FILE_NAME).is_file():
            return folder / FILE_NAME
    raise UsageError(f"{FILE_NAME} is missing.", "Install the add-on's zip again.")


def hashes_file(requirements: Path) -> Path | None:
    """Return the list with hashes that belongs to a list of packages; ``None`` for other lists."""
    beside = requirements.with_name(HASHES_NAME)
    return beside if requirements.name == FILE_NAME and beside.is_file() else None


def read_requirements(path: Path) -> list[Requirement]:
    """Return the packages of a list; its syntax is left to pip.

    Raises
    ------
    UsageError
        The file cannot be read or names no package.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read: {error.strerror}.", "Give another list."
        ) from None
    found = [Requirement(m[1], m[2].replace(" ", "")) for m in _LINE.finditer(text)]
    if not found:
        raise UsageError(f"{path} names no package.", "Give a list of packages.")
    return found


def package_error(error: ImportError | OSError) -> WrapError | None:
    """Return the error of a package that does not load, or ``None`` for anything else.

    A library that finds no room in memory is an error of the import system, too; llvmlite reports
    every reason as a file that is not there.
    """
    text = str(error)
    if any(words in text for words in NO_ROOM) or _LLVM in text:
        return MemoryShortageError(
            f"A package of the worker's Python, {sys.executable}, could not be loaded, probably "
            f"for want of memory: {text.strip().splitlines()[-1]}",
            "Close other programs, or allow more memory (ulimit -v, a container's limit), then "
            "resume. If there is enough, batch.py doctor checks the packages.",
        )
    if not isinstance(error, ImportError):
        return None
    if (error.name or "").partition(".")[0] in ("", __name__.partition(".")[0]):
        return None
    return WorkerError(
        f"The worker's Python, {sys.executable}, lacks a package, or has it in another version: "
        f"{error}.",
        "Press Set Up Worker, run batch.py set-up-worker, or install requirements-worker.txt with "
        "its pip. batch.py doctor checks it.",
    )


def not_started(python: str, error: OSError) -> WorkerError:
    """Return the error of a worker's Python that the system does not start."""
    return WorkerError(
        f"The worker's Python, {python}, does not run: {error.strerror or error}.",
        "Press Set Up Worker, run batch.py set-up-worker, or name another Python.",
    )
