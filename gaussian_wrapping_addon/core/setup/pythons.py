# SPDX-License-Identifier: GPL-3.0-or-later
"""Find the Python installations that a worker environment can be created from."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ..errors import UsageError
from ..processes.spawn import child_environment

OLDEST = (3, 11)
NEWEST_WITH_WHEELS = (3, 13)
"""Some packages (xatlas) have no wheels for newer versions yet, which are listed last."""
PROBE_DEADLINE_S = 20.0

# Blender's Python on Windows has the module venv, but not the executables that it copies.
_PROBE = (
    "import os, sys, json, pathlib, importlib.util as u;"
    "has = lambda n: u.find_spec(n) is not None;"
    "nt = lambda: any(pathlib.Path(u.find_spec('venv').origin).parent.glob('scripts/nt/*.exe'));"
    "print(json.dumps(dict(version=sys.version_info[:3], is_64_bit=sys.maxsize > 2**32,"
    " base=getattr(sys, '_base_executable', '') or sys.executable, pip=has('pip'),"
    " ensurepip=has('ensurepip'),"
    " venv=has('venv') and has('ensurepip') and (os.name != 'nt' or nt()))))"
)
_BUNDLED_PIP = (
    "import sys, runpy, pathlib, ensurepip;"
    "w = sorted(pathlib.Path(ensurepip.__file__).with_name('_bundled').glob('pip-*.whl'));"
    "sys.path.insert(0, str(w[-1])); sys.argv[0] = 'pip';"
    "runpy.run_module('pip', run_name='__main__')"
)
"""Runs the pip bundled with ensurepip without installing it."""
_MAC_PATTERNS = (
    "/Library/Frameworks/Python.framework/Versions/3.*/bin/python3",
    "/opt/homebrew/bin/python3.[1-9][0-9]",
    "/usr/local/bin/python3.[1-9][0-9]",
)
"""Not in the ``PATH`` of a Blender started from the Finder."""


@dataclass(frozen=True)
class FoundPython:
    """Properties reported by an interpreter."""

    path: str
    version: tuple[int, int, int]
    has_venv: bool = True
    """Whether ``venv`` and all that it needs are present."""
    pip: tuple[str, ...] = ("-m", "pip")
    """Arguments that run pip outside of a venv; empty if there is none."""

    @property
    def version_text(self) -> str:
        """Such as ``3.11.7``."""
        return ".".join(map(str, self.version))

    @property
    def can_install(self) -> bool:
        """Whether packages can be installed with it, in a venv or with pip."""
        return self.has_venv or bool(self.pip)

    @property
    def has_wheels(self) -> bool:
        """Whether all packages are known to have wheels for it."""
        return self.version[:2] <= NEWEST_WITH_WHEELS


def probe(path: str) -> FoundPython:
    """Query the properties of an interpreter.

    Raises
    ------
    UsageError
        It is not a Python, does not respond, is 32-bit or too old.
    """
    other = "Choose another Python 3.11 to 3.13 (python.org, or your system's packages)."
    if _is_blender(path):
        raise UsageError(f"{path} is Blender, not a Python.", other)
    try:
        done = subprocess.run(
            [path, "-I", "-c", _PROBE], stdin=subprocess.DEVNULL, capture_output=True, check=False,
            timeout=PROBE_DEADLINE_S, env=child_environment(),
        )  # fmt: skip
        answers = json.loads(done.stdout.decode("utf-8", "replace"))
        major, minor, micro = (int(n) for n in answers["version"])
    except (OSError, subprocess.TimeoutExpired, ValueError, KeyError, TypeError):
        raise UsageError(f"{path} does not run as a Python.", other) from None
    if (major, minor) < OLDEST or not answers["is_64_bit"]:
        wrong = "which is too old" if (major, minor) < OLDEST else "but a 32-bit one"
        raise UsageError(f"{path} is Python {major}.{minor}.{micro}, {wrong}.", other)
    bundled = ("-c", _BUNDLED_PIP) if answers["ensurepip"] else ()
    return FoundPython(
        # The base interpreter of a venv is permanent; the venv itself may be deleted.
        answers["base"] if Path(answers["base"]).exists() else path,
        (major, minor, micro),
        bool(answers["venv"]),
        ("-m", "pip") if answers["pip"] else bundled,
    )


def candidates(own: str = "") -> list[str]:
    """Return paths that may be a Python, the likely ones first; starts only ``py``."""
    names = [f"python3.{minor}" for minor in range(11, 15)] + ["python3", "python"]
    found = [shutil.which(name) or "" for name in names]
    if sys.platform == "darwin":
        found += [path for pattern in _MAC_PATTERNS for path in sorted(glob.glob(pattern))]
    launcher = shutil.which("py") if sys.platform == "win32" else None
    if launcher:
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            done = subprocess.run(
                [launcher, "-0p"], stdin=subprocess.DEVNULL, capture_output=True, check=False,
                timeout=PROBE_DEADLINE_S,
            )  # fmt: skip
            found += paths_of_launcher(done.stdout.decode(errors="replace"))
    # Neither Blender nor the Microsoft Store's stub (it opens the shop) is a Python.
    usable = (p for p in [*found, own] if p and "WindowsApps" not in p and not _is_blender(p))
    return list(dict.fromkeys(usable))


def _is_blender(path: str) -> bool:
    return Path(path).name.lower().startswith("blender")


def paths_of_launcher(text: str) -> list[str]:
    """Return the paths in the output of ``py -0p``: one version and one path per line."""
    return re.findall(r"[A-Za-z]:\\.*\.exe", text)


def find_pythons(own: str = "", paths: Iterable[str] | None = None) -> list[FoundPython]:
    """Return the usable Pythons, those with wheels first; takes up to several seconds."""
    found: dict[str, FoundPython] = {}
    for path in candidates(own) if paths is None else paths:
        with contextlib.suppress(UsageError):
            python = probe(path)
            found.setdefault(os.path.realpath(python.path), python)
    return sorted(
        found.values(), key=lambda p: (not p.can_install, not p.has_wheels, not p.has_venv)
    )
