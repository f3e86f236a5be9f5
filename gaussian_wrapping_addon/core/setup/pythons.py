# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Pythons this machine has that a worker's environment can be made from."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import UsageError
from ..processes.spawn import child_environment

OLDEST = (3, 11)
NEWEST_WITH_WHEELS = (3, 13)
"""Of newer ones, some packages have no wheels yet (xatlas): they are listed last."""
PROBE_DEADLINE_S = 20.0
MAX_CANDIDATES = 40

_PROBE = (
    "import sys, json, platform, importlib.util as u;"
    "has = lambda n: u.find_spec(n) is not None;"
    "print(json.dumps(dict(version=list(sys.version_info[:3]), executable=sys.executable,"
    " base=getattr(sys, '_base_executable', '') or sys.executable, bits=64 if sys.maxsize > 2**32"
    " else 32, venv=has('venv') and has('ensurepip'), pip=has('pip'), ensurepip=has('ensurepip'),"
    " machine=platform.machine())))"
)


@dataclass(frozen=True)
class FoundPython:
    """What an interpreter has said of itself."""

    path: str
    version: tuple[int, int, int]
    has_venv: bool = True
    """``venv`` with ``ensurepip``."""
    has_pip: bool = True
    has_ensurepip: bool = True
    is_own: bool = False
    """Whether it is the one that Blender (or this command) runs on."""

    @property
    def version_text(self) -> str:
        """Such as ``3.11.7``."""
        return ".".join(map(str, self.version))

    @property
    def can_install(self) -> bool:
        """Whether packages can be installed with it in any way."""
        return self.has_venv or self.has_pip or self.has_ensurepip

    @property
    def has_wheels(self) -> bool:
        """Whether all packages are known to have wheels for it."""
        return self.version[:2] <= NEWEST_WITH_WHEELS


def is_blender(path: str) -> bool:
    """Tell whether a path is the Blender program, which is no Python."""
    return Path(path).name.lower().startswith("blender")


def probe(path: str, own: str = "") -> FoundPython:
    """Ask an interpreter what it is.

    Raises
    ------
    UsageError
        It is none, does not answer, is 32-bit or too old.
    """
    other = "Choose another Python 3.11 to 3.13 (python.org, or your system's packages)."
    if is_blender(path):
        raise UsageError(f"{path} is Blender, not a Python.", other)
    try:
        done = subprocess.run(
            [path, "-I", "-c", _PROBE],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=PROBE_DEADLINE_S,
            env=child_environment(),
            check=False,
        )
        said: dict[str, Any] = json.loads(done.stdout.decode("utf-8", "replace"))
        version = tuple(int(n) for n in said["version"])
    except (OSError, subprocess.TimeoutExpired, ValueError, KeyError, TypeError):
        raise UsageError(f"{path} is no Python that runs.", other) from None
    text = ".".join(map(str, version))
    if version[:2] < OLDEST:
        raise UsageError(f"{path} is Python {text}, which is too old.", other)
    if said["bits"] != 64:
        raise UsageError(f"{path} is a 32-bit Python.", other)
    # What a venv was made from stays where it is; the venv may be thrown away.
    base = str(said["base"])
    chosen = base if Path(base).exists() and not is_blender(base) else path
    return FoundPython(
        chosen,
        (version[0], version[1], version[2]),
        bool(said["venv"]),
        bool(said["pip"]),
        bool(said["ensurepip"]),
        bool(own) and os.path.realpath(path) == os.path.realpath(own),
    )


def candidates(own: str = "") -> list[str]:
    """Return paths that may be a Python, the likely ones first; nothing is started but ``py``."""
    found = [own] if own and not is_blender(own) else []
    names = [f"python3.{minor}" for minor in (11, 12, 13, 14)] + ["python3", "python"]
    found += [path for name in names if (path := shutil.which(name))]
    if sys.platform == "win32":
        found += _windows()
    elif sys.platform == "darwin":
        found += _globbed(
            "/Library/Frameworks/Python.framework/Versions/3.*/bin/python3",
            "/opt/homebrew/bin/python3.[0-9]*",
            "/usr/local/bin/python3.[0-9]*",
        )
    else:
        found += _globbed("/usr/bin/python3.[0-9]*", "/usr/local/bin/python3.[0-9]*")
    return list(dict.fromkeys(found))[:MAX_CANDIDATES]


def _globbed(*patterns: str) -> list[str]:
    found = [path for pattern in patterns for path in sorted(Path("/").glob(pattern[1:]))]
    return [str(p) for p in found if re.fullmatch(r"python3(\.\d+)?", p.name)]


def _windows() -> list[str]:
    found = []
    launcher = shutil.which("py")
    if launcher:
        try:
            done = subprocess.run(
                [launcher, "-0p"], stdin=subprocess.DEVNULL, capture_output=True, check=False,
                timeout=PROBE_DEADLINE_S,
            )  # fmt: skip
            found += paths_of_launcher(done.stdout.decode(errors="replace"))
        except (OSError, subprocess.TimeoutExpired):
            pass
    for variable, below in (("LOCALAPPDATA", "Programs/Python"), ("PROGRAMFILES", "")):
        folder = os.environ.get(variable)
        if folder:
            found += [str(p) for p in sorted((Path(folder) / below).glob("Python3*/python.exe"))]
    # The Microsoft Store puts a program there that opens the shop.
    return [path for path in found if "WindowsApps" not in path]


def paths_of_launcher(text: str) -> list[str]:
    """Return the paths in the words of ``py -0p``: one version and one path a line."""
    found = [re.search(r"([A-Za-z]:\\.*\.exe)\s*$", line.strip()) for line in text.splitlines()]
    return [match[1] for match in found if match]


def find_pythons(own: str = "", paths: Iterable[str] | None = None) -> list[FoundPython]:
    """Return the Pythons that can be used, those with wheels first; takes up to seconds."""
    found: dict[str, FoundPython] = {}
    for path in candidates(own) if paths is None else paths:
        try:
            python = probe(path, own)
        except UsageError:
            continue
        key = os.path.realpath(python.path)
        if key not in found or python.is_own:
            found[key] = python
    return sorted(
        found.values(),
        key=lambda p: (not p.can_install, not p.has_wheels, not p.has_venv, p.is_own),
    )
