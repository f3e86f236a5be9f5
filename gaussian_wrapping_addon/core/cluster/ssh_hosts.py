# SPDX-License-Identifier: GPL-3.0-or-later
"""Computers that the system's ``ssh`` reaches, and how a worker is started on one.

The client of the system knows the user's keys, agents, jump hosts and names of computers. It never
asks: a computer that wants a password fails at once.
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import ParseError, UsageError
from ..regular_files import read_bounded
from ..settings.choices import MAX_PROCESSES

MAX_HOSTS = 1000
MAX_FILE_BYTES = 1 << 20
_CONNECT_S = 15
_ALIVE_EVERY_S = 15
_ALIVE_COUNT = 4
_NAME = re.compile(
    r"(ssh://)?([A-Za-z0-9_.][A-Za-z0-9_.-]*@)?"
    r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.][A-Za-z0-9_.-]*)(:[0-9]{1,5})?"
)
"""``[user@]computer``, or ``ssh://[user@]computer[:port]``."""


@dataclass(frozen=True)
class Host:
    """A computer, with its own paths."""

    name: str
    shared: str
    certificates: str
    python: str
    batch: str
    slots: int = 1


def read_hosts(path: Path, usual: Host) -> list[Host]:
    """Read computers from a file: a line has a name, and ``KEY=VALUE`` where one differs.

    Parameters
    ----------
    usual : Host
        What applies where a line says nothing: ``shared``, ``certificates``, ``python``, ``batch``,
        ``slots``.

    Raises
    ------
    ParseError
        A line is none of these, or the file is too large or no file.
    OSError
        It cannot be read.
    """
    data = read_bounded(path, MAX_FILE_BYTES, follow_links=True)
    try:
        text = data.decode("utf-8")
    except ValueError:
        raise ParseError(
            path, "whole file", "it is not text.", "Name a list of computers."
        ) from None
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            words = shlex.split(line, comments=True)
            if words:
                found.append(_host(words, usual))
        except (ValueError, UsageError) as error:
            told = error.message if isinstance(error, UsageError) else f"{error}."
            raise ParseError(
                path, f"line {number}", told, "Write: COMPUTER [shared=DIR] [slots=N] ..."
            ) from None
    return found


def hosts_named(names: Iterable[str], usual: Host) -> list[Host]:
    """Return computers by their names.

    Raises
    ------
    UsageError
        A name is none.
    """
    return [_host([name], usual) for name in names]


def checked_hosts(hosts: list[Host]) -> list[Host]:
    """Return computers of which there are some, each once.

    Raises
    ------
    UsageError
        There is none, one is named twice, or they are too many.
    """
    names = [host.name for host in hosts]
    twice = [name for name in names if names.count(name) > 1] if len(names) <= MAX_HOSTS else []
    if not names:
        raise UsageError("No computer is named.", "Give their names, or --hosts FILE.")
    if len(names) > MAX_HOSTS:
        raise UsageError(f"{len(names)} computers are too many.", f"Give up to {MAX_HOSTS}.")
    if twice:
        raise UsageError(f"{twice[0]} is named twice.", "Give slots=2 for two parts side by side.")
    return hosts


def ssh_command(host: Host, address: str) -> list[str]:
    """Return the command that runs a worker on a computer until its input ends.

    Raises
    ------
    UsageError
        There is no ``ssh`` here.
    """
    program = shutil.which("ssh")
    if program is None:
        raise UsageError("There is no ssh on this computer.", "Install OpenSSH's client.")
    there = worker_command(host, address, "--end-with-input")
    return [
        program, "-T", "-a", "-x", "-o", "BatchMode=yes", "-o", f"ConnectTimeout={_CONNECT_S}",
        "-o", f"ServerAliveInterval={_ALIVE_EVERY_S}", "-o", f"ServerAliveCountMax={_ALIVE_COUNT}",
        "--", host.name, f"exec {there}",
    ]  # fmt: skip


def worker_command(host: Host, address: str, *more: str) -> str:
    """Return the line for a POSIX shell that runs a worker."""
    words = [host.python, host.batch, "farm", "worker", address, "--slots", str(host.slots), *more]
    if address.startswith("tls://"):
        words += ["--certificates", host.certificates]
    if host.shared:
        words += ["--shared", host.shared]
    return shlex.join(words)


def _host(words: list[str], usual: Host) -> Host:
    name, *pairs = words
    if not _NAME.fullmatch(name):
        raise UsageError(f"{name!r} is no name of a computer.", "Give it as ssh takes it.")
    changes: dict[str, Any] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key not in ("shared", "certificates", "python", "batch", "slots"):
            raise UsageError(f"{pair!r} is unknown.", "Give shared=DIR, python=PATH and the like.")
        if key != "slots":
            changes[key] = value
        elif value.isdecimal() and 1 <= int(value) <= MAX_PROCESSES:
            changes[key] = int(value)
        else:
            raise UsageError(f"slots is not from 1 to {MAX_PROCESSES}.", "")
    return replace(usual, name=name, **changes)
