# SPDX-License-Identifier: GPL-3.0-or-later
"""Which pinned packages the interpreter that runs this has whole.

Versions and lists of files are read without importing anything; a package of which a file has
gone is broken, whatever it says of itself.
"""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from ..errors import EXIT_DONE, WorkerError
from ..helper_process import child_command, emit
from ..processes.spawn import child_environment
from ..worker_requirements import Requirement, read_requirements

EXAMINE_DEADLINE_S = 180.0
MISSING = "missing"
WRONG_VERSION = "wrong version"
BROKEN = "broken"
GOOD = "good"


@dataclass(frozen=True)
class PackageState:
    """What is known of one package."""

    name: str
    state: str
    version: str = ""
    detail: str = ""


def examine(requirement: Requirement, folder: str | None = None) -> PackageState:
    """Look at one package of this interpreter.

    Parameters
    ----------
    folder : str or None
        Where it must lie; None for anywhere on the path.
    """
    path = [folder] if folder else sys.path
    found = list(importlib.metadata.distributions(name=requirement.name, path=path))
    if not found:
        return PackageState(requirement.name, MISSING)
    package = found[0]
    version = package.version or ""
    if not requirement.allows(version):
        return PackageState(
            requirement.name,
            WRONG_VERSION,
            version,
            f"{version} is there, {requirement.text} wanted",
        )
    for file in package.files or []:
        # Compiled files come and go; scripts lie elsewhere where pip was given a target.
        if file.suffix == ".pyc" or file.parts[0] == "..":
            continue
        if not Path(str(package.locate_file(file))).exists():
            return PackageState(requirement.name, BROKEN, version, f"{file} has gone")
    return PackageState(requirement.name, GOOD, version)


def main(arguments: list[str]) -> int:
    """Write the state of each package of the list ``arguments[0]``, one JSON object a line."""
    from ..worker_environment import PACKAGES_OPTION

    folder = sys._xoptions.get(PACKAGES_OPTION)
    for requirement in read_requirements(Path(arguments[0])):
        state = examine(requirement, str(folder) if folder else None)
        emit(**asdict(state))
    return EXIT_DONE


def examine_worker(worker: str, requirements: Path) -> list[PackageState]:
    """Look at the packages of another interpreter.

    Raises
    ------
    WorkerError
        It does not run.
    """
    try:
        done = subprocess.run(
            child_command("setup.examine", str(requirements), python=worker),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=child_environment(),
            timeout=EXAMINE_DEADLINE_S,
            check=False,
        )
        lines = done.stdout.decode("utf-8", "replace").splitlines()
        found = [PackageState(**json.loads(line)) for line in lines]
    except (OSError, subprocess.TimeoutExpired, ValueError, TypeError) as error:
        raise WorkerError(f"{worker} does not run: {error}.", "Press Repair.") from None
    if done.returncode != 0 or not found:
        words = done.stderr.decode("utf-8", "replace").strip().splitlines()
        raise WorkerError(
            f"{worker} does not run: {words[-1] if words else 'no answer'}.", "Press Repair."
        )
    return found
