# SPDX-License-Identifier: GPL-3.0-or-later
"""Locate the private worker environment, check that it is complete, and find its interpreter.

Its folder holds the marker (only a folder with it is ever removed), ``log.txt``, one folder with a
venv, or with packages if the Python cannot create a venv, and ``ready.json``, without which no job
uses it. The marker names the folder in use; a set-up builds another one beside it.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import ParseError
from ..files import read_json, write_json

MARKER = "gaussian-wrapping-worker.json"
READY = "ready.json"
VENV = "venv"
PACKAGES = "packages"
"""The two kinds of environment."""
FOLDERS = ("env", "env-2", "packages")
"""Possible names of the folder in use; the last one was used by 0.1.0."""

DATA_VARIABLE = "GAUSSIAN_WRAPPING_DATA"
"""Environment variable: folder for user data outside of Blender."""
PACKAGES_OPTION = "gwrap_packages"
"""``-X gwrap_packages=DIR`` gives a child process the folder of its packages."""

_POINTER = "worker-location.json"
_ADDON = "gaussian_wrapping_addon"
_PACKAGE_ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class WorkerEnvironment:
    """Paths of one environment; reading them starts no process."""

    root: Path

    @property
    def marker_path(self) -> Path:
        """Marker file: states that we made this folder, its Python, kind and folder in use."""
        return self.root / MARKER

    @property
    def ready_path(self) -> Path:
        """Names the installed packages and their versions."""
        return self.root / READY

    @property
    def folder(self) -> Path:
        """The folder in use, with the venv or the packages."""
        marker = self.marker()
        name = marker.get("folder")
        if name not in FOLDERS:  # made by 0.1.0
            name = "packages" if marker.get("kind") == PACKAGES else "env"
        return self.root / str(name)

    def next_folder(self) -> Path:
        """Return the folder that the next set-up builds in; never the one in use."""
        in_use = self.is_ready() and self.folder.name == FOLDERS[0]
        return self.root / FOLDERS[1 if in_use else 0]

    def is_ours(self) -> bool:
        """Tell whether the folder carries our marker."""
        return bool(self.marker())

    def is_ready(self) -> bool:
        """Tell whether it is complete and its interpreter exists."""
        return bool(self.ready_path.is_file() and self.is_ours() and self.worker())

    def marker(self) -> dict[str, Any]:
        """Return the content of the marker; empty if there is none."""
        return _read_object(self.marker_path, "made_by", _ADDON)

    def extras(self) -> tuple[str, ...]:
        """Return the names of the extras that were installed."""
        names = self.marker().get("extras")
        return tuple(map(str, names)) if isinstance(names, list) else ()

    def worker(self) -> str:
        """Return the ``python`` for :func:`~.helper_process.child_command`; ``""`` if missing.

        It is the venv's interpreter, or this folder if a plain Python uses its packages.
        """
        marker, python = self.marker(), venv_python(self.folder)
        if marker.get("kind") == PACKAGES:
            present = self.folder.is_dir() and Path(str(marker["python"])).exists()
            return str(self.root) if present else ""
        return str(python) if python.exists() else ""


def venv_python(folder: Path) -> Path:
    """Return the interpreter of a venv."""
    windows = sys.platform == "win32"
    return folder / "Scripts" / "python.exe" if windows else folder / "bin" / "python"


def _read_object(path: Path, key: str, value: str | None = None) -> dict[str, Any]:
    try:
        values = read_json(path, follow_links=True)
    except (OSError, ParseError):
        return {}
    if not isinstance(values, dict) or key not in values:
        return {}
    return values if value is None or values[key] == value else {}


def interpreter_of(worker: str) -> tuple[str, str]:
    """Return the interpreter of a worker path, and the folder of its packages or ``""``."""
    environment = WorkerEnvironment(Path(worker))
    if environment.root.is_dir():
        marker = environment.marker()
        if marker.get("kind") == PACKAGES:
            return str(marker["python"]), str(environment.folder)
        return str(venv_python(environment.folder)), ""
    return worker, ""


def user_data() -> Path:
    """Return the folder for user data outside of Blender; it need not exist."""
    chosen = os.environ.get(DATA_VARIABLE)
    if chosen:
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / _ADDON
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Application Support" / _ADDON
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / _ADDON


def installed_root() -> Path | None:
    """Return the environment folder of the Blender extension that contains this file, if any.

    It is the folder returned by ``bpy.utils.extension_path_user``, so that the command line of an
    installed extension finds it without Blender.
    """
    repository = _PACKAGE_ROOT.parent
    user = repository.parent / ".user"
    if not (_PACKAGE_ROOT / "blender_manifest.toml").is_file() or not user.is_dir():
        return None
    return user / repository.name / _PACKAGE_ROOT.name / "worker"


def default_root() -> Path:
    """Return the default folder of a new environment."""
    return installed_root() or user_data() / "worker"


def register_environment(root: Path) -> None:
    """Record the folder of an environment, so that later processes find it."""
    pointer = user_data() / _POINTER
    pointer.parent.mkdir(parents=True, exist_ok=True)
    write_json(pointer, {"root": str(root)})


def unregister_environment(root: Path) -> None:
    """Delete the record of an environment that is being removed."""
    pointer = user_data() / _POINTER
    if _read_object(pointer, "root", str(root)):
        pointer.unlink(missing_ok=True)


def known_environments() -> list[WorkerEnvironment]:
    """Return the environments that may exist, in order of preference."""
    registered = _read_object(user_data() / _POINTER, "root").get("root")
    roots = [
        installed_root(),
        Path(registered) if isinstance(registered, str) else None,
        default_root(),
    ]
    return [WorkerEnvironment(root) for root in dict.fromkeys(roots) if root is not None]


def ready_worker() -> str:
    """Return the worker of the first complete environment; ``""`` if there is none."""
    return next((e.worker() for e in known_environments() if e.is_ready()), "")
