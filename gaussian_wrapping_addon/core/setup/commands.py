# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the exact commands of a set-up, for display and for execution.

The torch that a plain ``pip install torch`` installs depends on the system: on Linux the build for
CUDA, on Windows and macOS the one for the CPU. The other build comes from PyTorch's own index.
"""

from __future__ import annotations

import platform
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from ..errors import UsageError
from ..processes.worker_environment import MARKER, WorkerEnvironment, venv_python
from .pythons import FoundPython

CPU = "cpu"
CUDA = "cuda"
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
CUDA_INDEX = "https://download.pytorch.org/whl/cu130"

Command = tuple[str, ...]


@dataclass(frozen=True)
class SetupRequest:
    """The options of a set-up."""

    root: str
    """Folder of the environment."""
    python: str
    requirements: str
    """Path of the list of packages."""
    torch: str = CPU
    find_links: str = ""
    """Folder of wheels; if given, no package index is used."""

    @property
    def environment(self) -> WorkerEnvironment:
        """The environment to create."""
        return WorkerEnvironment(Path(self.root))


def as_line(command: Command) -> str:
    """Return a command as a shell line."""
    return subprocess.list2cmdline(command) if sys.platform == "win32" else shlex.join(command)


def cuda_present() -> bool:
    """Tell whether an NVIDIA driver is installed; looks at files only."""
    if sys.platform == "darwin":
        return False
    return bool(shutil.which("nvidia-smi")) or Path("/proc/driver/nvidia/version").exists()


def torch_index(choice: str, system: str = "") -> str:
    """Return the extra package index for a torch build on a system; ``""`` for none.

    Raises
    ------
    UsageError
        The system has no such build.
    """
    system = system or platform.system()
    if choice == CUDA and system == "Darwin":
        raise UsageError("There is no CUDA on macOS.", "Choose the processor build of torch.")
    return {(CPU, "Linux"): CPU_INDEX, (CUDA, "Windows"): CUDA_INDEX}.get((choice, system), "")


def all_commands(request: SetupRequest, python: FoundPython) -> list[Command]:
    """Return every command of a set-up, in order.

    Raises
    ------
    UsageError
        The Python or the build of torch cannot be used.
    """
    options = ["install", "--disable-pip-version-check", "--no-input", "--only-binary", ":all:"]
    index = torch_index(request.torch)
    if request.find_links:
        # Isolated: pip's configured indexes and folders are ignored.
        options = ["--isolated", *options, "--no-index", "--find-links", request.find_links]
    elif index:
        options += ["--extra-index-url", index]
    options += ["-r", request.requirements]
    folder = request.environment.next_folder()
    if not python.can_install:
        version = f"{python.version[0]}.{python.version[1]}"
        raise UsageError(
            f"{python.path} has neither venv nor pip.",
            f"Install them (Debian and Ubuntu: apt install python{version}-venv) or choose another"
            " Python.",
        )
    if not python.has_venv:
        return [(python.path, "-I", *python.pip, *options, "--target", str(folder))]
    pip = (str(venv_python(folder)), "-I", "-m", "pip")
    venv = (python.path, "-I", "-m", "venv", "--clear", str(folder))
    return [venv, (*pip, *options), (*pip, "check")]


def check_folders(request: SetupRequest) -> None:
    """Raise if the folders of a set-up cannot be used; writes nothing.

    Raises
    ------
    UsageError
        A folder cannot be used; names it.
    """
    root, wheels = request.environment.root, request.find_links
    try:
        is_ours = not root.exists() or request.environment.is_ours()
        strange = root.is_symlink() or not (is_ours or next(root.iterdir(), None) is None)
    except OSError:  # a file, or a folder that cannot be read
        strange = True
    if strange:
        raise UsageError(
            f"{root} is not a folder, or holds other files and no {MARKER}.",
            "Choose a new or empty folder.",
        )
    if wheels and not Path(wheels).is_dir():
        raise UsageError(
            f"The wheel folder {wheels} does not exist.", "Choose the folder that holds the wheels."
        )
