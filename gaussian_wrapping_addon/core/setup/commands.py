# SPDX-License-Identifier: GPL-3.0-or-later
"""The exact commands of a set-up: what is shown before is what runs.

Which torch a plain ``pip install torch`` gives depends on the system: on Linux the build for CUDA,
on Windows and macOS the one for the processor. The other one comes from PyTorch's own index.
"""

from __future__ import annotations

import platform
import shlex
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..errors import UsageError
from ..worker_environment import MARKER, PACKAGES, VENV, WorkerEnvironment
from ..worker_requirements import Requirement
from .pythons import FoundPython

CPU = "cpu"
CUDA = "cuda"
INDEX = "index"
"""Whatever pip's own index gives: for people behind a mirror."""
TORCH_CHOICES = (CPU, CUDA, INDEX)
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
CUDA_INDEX = "https://download.pytorch.org/whl/cu130"

_PIP_OPTIONS = ("--disable-pip-version-check", "--no-input", "--only-binary", ":all:")
_BUNDLED_PIP = (
    "import sys, runpy, pathlib, ensurepip;"
    "w = sorted(pathlib.Path(ensurepip.__file__).with_name('_bundled').glob('pip-*.whl'));"
    "sys.path.insert(0, str(w[-1])); sys.argv[0] = 'pip';"
    "runpy.run_module('pip', run_name='__main__')"
)
"""Runs the pip that ensurepip carries without installing it anywhere."""


@dataclass(frozen=True)
class SetupRequest:
    """What a set-up is asked for."""

    root: str
    """Folder of the environment."""
    python: str
    requirements: str
    """Path of the list of packages."""
    torch: str = CPU
    find_links: str = ""
    """Folder of wheels; nothing else is asked then."""
    repair: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)

    @property
    def environment(self) -> WorkerEnvironment:
        """The environment that is to be made."""
        return WorkerEnvironment(Path(self.root))


@dataclass(frozen=True)
class Step:
    """One command and the packages that it brings."""

    command: tuple[str, ...]
    brings: tuple[Requirement, ...] = ()

    @property
    def line(self) -> str:
        """As it would be typed."""
        if sys.platform == "win32":
            return subprocess.list2cmdline(self.command)
        return shlex.join(self.command)


def cuda_present() -> bool:
    """Tell whether an NVIDIA driver is here; looks at files only."""
    if sys.platform == "darwin":
        return False
    return bool(shutil.which("nvidia-smi")) or Path("/proc/driver/nvidia/version").exists()


def torch_index(choice: str, system: str = "", machine: str = "") -> str:
    """Return the extra index that a choice of torch needs on a system; ``""`` for none.

    Raises
    ------
    UsageError
        There is no such build for the system.
    """
    system, machine = system or platform.system(), machine or platform.machine()
    if choice == CUDA and system == "Darwin":
        raise UsageError("There is no CUDA on macOS.", "Choose the processor build of torch.")
    if choice == CPU and system == "Linux":
        return CPU_INDEX
    if choice == CUDA and system == "Windows":
        return CUDA_INDEX
    return ""


def kind_for(python: FoundPython) -> str:
    """Return which kind of environment a Python can have.

    Raises
    ------
    UsageError
        It has neither venv nor any pip.
    """
    if python.has_venv:
        return VENV
    if python.can_install:
        return PACKAGES
    raise UsageError(
        f"{python.path} has neither venv nor pip.",
        f"Install them (Debian and Ubuntu: apt install python{python.version[0]}."
        f"{python.version[1]}-venv) or choose another Python.",
    )


def venv_step(request: SetupRequest) -> Step:
    """Return the command that makes the venv."""
    return Step((request.python, "-I", "-m", "venv", "--clear", str(request.environment.venv)))


def _pip(request: SetupRequest, python: FoundPython, kind: str) -> tuple[str, ...]:
    if kind == VENV:
        return (str(request.environment.venv_python), "-I", "-m", "pip")
    if python.has_pip:
        return (python.path, "-I", "-m", "pip")
    return (python.path, "-I", "-c", _BUNDLED_PIP)


def install_steps(
    request: SetupRequest,
    python: FoundPython,
    kind: str,
    wanted: list[Requirement],
    *,
    force: bool = False,
) -> list[Step]:
    """Return the commands that install packages.

    Parameters
    ----------
    force : bool
        Install them though they seem to be there, and leave alone what they need.
    """
    options = ["install", *_PIP_OPTIONS]
    if request.find_links:
        # Isolated: settings of pip that name an index or other folders do not count.
        options = ["--isolated", *options, "--no-index", "--find-links", request.find_links]
    if kind == PACKAGES:
        options += ["--target", str(request.environment.packages), "--upgrade"]
    if force and kind == VENV:
        options += ["--force-reinstall", "--no-deps"]
    options += ["-c", request.requirements]
    pip = (*_pip(request, python, kind), *options)
    index = "" if request.find_links else torch_index(request.torch)
    torch = [r for r in wanted if r.name == "torch"]
    if not index or not torch:
        return [Step((*pip, *(r.text for r in wanted)), tuple(wanted))] if wanted else []
    extra = ("--extra-index-url", index)
    if kind == PACKAGES:  # pip looks at nothing that a target folder holds: all in one
        return [Step((*pip, *extra, *(r.text for r in wanted)), tuple(wanted))]
    rest = [r for r in wanted if r.name != "torch"]
    steps = [Step((*pip, *extra, *(r.text for r in torch)), tuple(torch))]
    return [*steps, Step((*pip, *(r.text for r in rest)), tuple(rest))] if rest else steps


def check_folders(request: SetupRequest) -> None:
    """Refuse folders that no set-up can work with; writes nothing.

    Raises
    ------
    UsageError
        Names the folder.
    """
    environment, root = request.environment, request.environment.root
    if root.is_symlink() or (root.exists() and not root.is_dir()):
        raise UsageError(f"{root} is no plain folder.", "Choose another folder.")
    if root.is_dir() and not environment.is_ours():
        try:
            strange = [p for p in root.iterdir() if p.name != "lock.json"]
        except OSError as error:
            raise UsageError(
                f"{root} cannot be read: {error.strerror}.", "Choose another folder."
            ) from None
        if strange:
            raise UsageError(
                f"{root} holds other files and no {MARKER}.", "Choose a new or empty folder."
            )
    if request.find_links and not Path(request.find_links).is_dir():
        raise UsageError(
            f"The wheel folder {request.find_links} does not exist.",
            "Choose that with the wheels.",
        )


def all_steps(
    request: SetupRequest, python: FoundPython, requirements: list[Requirement]
) -> list[Step]:
    """Return every command of a set-up from nothing, in order."""
    kind = kind_for(python)
    first = [venv_step(request)] if kind == VENV else []
    return [*first, *install_steps(request, python, kind, requirements)]
