# SPDX-License-Identifier: GPL-3.0-or-later
"""The pinned packages of ``requirements-worker.txt``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from .errors import UsageError

FILE_NAME = "requirements-worker.txt"
MAX_FILE_BYTES = 100_000

_LINE = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]*)\s*((?:[<>=!~]=?=?[^,;\s]+(?:\s*,\s*)?)*)$")
_PACKAGE_ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Requirement:
    """One package and the versions of it that do."""

    name: str
    versions: str
    """Such as ``==2.13.0`` or ``>=1.26,<3``; empty for any."""

    @property
    def text(self) -> str:
        """As pip wants it."""
        return f"{self.name}{self.versions}"

    def allows(self, version: str) -> bool:
        """Tell whether an installed version does; a local part (``+cpu``) does not count."""
        return all(
            _allows(clause.strip(), version) for clause in self.versions.split(",") if clause
        )


def plain_name(name: str) -> str:
    """Return a package's name as package indexes compare names."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _numbers(version: str) -> tuple[int, ...]:
    numbers = [int(n) for n in re.findall(r"\d+", re.split(r"[+a-zA-Z]", version)[0])]
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def _allows(clause: str, version: str) -> bool:
    match = re.match(r"(==|>=|<=|!=|~=|<|>)(.*)", clause)
    if match is None:
        return True
    wanted, has = _numbers(match[2]), _numbers(version)
    answers = {
        "==": has == wanted, "!=": has != wanted, ">=": has >= wanted, "<=": has <= wanted,
        ">": has > wanted, "<": has < wanted,
        "~=": has >= wanted and has[: max(len(wanted) - 1, 1)] == wanted[: max(len(wanted) - 1, 1)],
    }  # fmt: skip
    return answers[match[1]]


def requirements_file() -> Path:
    """Return the add-on's list: beside the package's files in the zip, or in the repository.

    Raises
    ------
    UsageError
        It is missing.
    """
    for folder in (_PACKAGE_ROOT, _PACKAGE_ROOT.parent):
        if (folder / FILE_NAME).is_file():
            return folder / FILE_NAME
    raise UsageError(f"{FILE_NAME} is missing.", "Install the add-on's zip again.")


def read_requirements(path: Path) -> list[Requirement]:
    """Return the packages of a list.

    Raises
    ------
    UsageError
        It cannot be read, is empty, or a line is no plain ``name==version``.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read: {error.strerror}.", "Give another list."
        ) from None
    if len(data) > MAX_FILE_BYTES:
        raise UsageError(f"{path} is too large.", "Give a list of packages.")
    found = []
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        text = line.split("#")[0].strip()
        match = _LINE.match(text)
        if text and match is None:
            raise UsageError(
                f"{path.name}, line {number}: {text} is no package.", "Write name==version."
            )
        if match is not None:
            found.append(Requirement(match[1], match[2].replace(" ", "")))
    if not found:
        raise UsageError(f"{path} names no package.", "Give a list of packages.")
    return found
