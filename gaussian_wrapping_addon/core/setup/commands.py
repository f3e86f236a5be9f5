# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the exact commands of a set-up, for display and for execution.

The torch that a plain ``pip install torch`` installs depends on the system: on Linux the build for
CUDA, on Windows and macOS the one for the CPU. The other build comes from PyTorch's own index.
From an index, all other packages are installed by the hashes of their files, before torch: its
builds have other hashes on each index. A folder of wheels is taken as it is.
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
from ..processes.worker_environment import MARKER, PACKAGES, WorkerEnvironment, venv_python
from ..processes.worker_extras import extra_hashes_file, extra_named
from ..processes.worker_requirements import hashes_file, read_requirements
from .pythons import FoundPython

CPU = "cpu"
CUDA = "cuda"
CUDA_BRINGS = "Training and vacancy on the GPU, for several GiB more on the disk"
"""What the build for CUDA is for, as told where it can be chosen."""
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
CUDA_INDEX = "https://download.pytorch.org/whl/cu130"

TEMPORARY = "tmp"
"""Folder in an environment for a set-up that runs."""

Command = tuple[str, ...]
_INSTALL = ("install", "--disable-pip-version-check", "--no-input", "--only-binary", ":all:")


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
    extras: tuple[str, ...] = ()
    """Names of optional packages (``core/processes/worker_extras.py``)."""
    adds: bool = False
    """Add the extras to the present environment, and leave all else as it is."""

    @property
    def environment(self) -> WorkerEnvironment:
        """The environment to create."""
        return WorkerEnvironment(Path(self.root))

    @property
    def target(self) -> Path:
        """Folder that packages are added from, once pip has ended."""
        return self.environment.root / TEMPORARY / "added"


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
    folder = request.environment.next_folder()
    if request.adds:
        return _additions(request, python)
    if not python.can_install:
        version = f"{python.version[0]}.{python.version[1]}"
        raise UsageError(
            f"{python.path} has neither venv nor pip.",
            f"Install them (Debian and Ubuntu: apt install python{version}-venv) or choose another"
            " Python.",
        )
    installs = _installs(request)
    if not python.has_venv:
        target = ("--target", str(folder))
        return [(python.path, "-I", *python.pip, *words, *target) for words in installs]
    pip = (str(venv_python(folder)), "-I", "-m", "pip")
    venv = (python.path, "-I", "-m", "venv", "--clear", str(folder))
    return [venv, *((*pip, *words) for words in installs), (*pip, "check")]


def _installs(request: SetupRequest) -> list[Command]:
    """Return the arguments of pip, one call after the other."""
    options, extras = _INSTALL, _extra_installs(request)
    index = torch_index(request.torch)
    if request.find_links:
        return [(*_only_wheels(request), "-r", request.requirements), *extras]
    also = ("--extra-index-url", index) if index else ()
    requirements = Path(request.requirements)
    hashes = hashes_file(requirements)
    if hashes is None:
        return [(*options, *also, "-r", request.requirements), *extras]
    (torch,) = (r for r in read_requirements(requirements) if r.name == "torch")
    # What the build for the processor needs is in the list with hashes.
    alone = ("--no-deps",) if request.torch == CPU else ()
    return [
        (*options, "--require-hashes", "-r", str(hashes)),
        (*options, *also, *alone, f"{torch.name}{torch.versions}"),
        *extras,
    ]


def _only_wheels(request: SetupRequest) -> Command:
    """Return the words of pip that install from the folder of wheels and nowhere else."""
    # Isolated: pip's configured indexes and folders are ignored.
    return ("--isolated", *_INSTALL, "--no-index", "--find-links", request.find_links)


def _extra_installs(request: SetupRequest) -> list[Command]:
    """Return the arguments of pip for the extras, without what they need: it is there already."""
    found: list[Command] = []
    for extra in map(extra_named, request.extras):
        hashes = extra_hashes_file(Path(request.requirements), extra)
        if request.find_links:
            found.append((*_only_wheels(request), "--no-deps", *extra.pins))
        elif hashes is None:
            found.append((*_INSTALL, "--no-deps", *extra.pins))
        else:
            found.append((*_INSTALL, "--no-deps", "--require-hashes", "-r", str(hashes)))
    return found


def _additions(request: SetupRequest, python: FoundPython) -> list[Command]:
    """Return the commands that put the extras into a folder, from where they are moved later."""
    check_addition(request)
    environment = request.environment
    pip: Command = (environment.worker(), "-I", "-m", "pip")
    if environment.marker().get("kind") == PACKAGES:
        pip = (python.path, "-I", *python.pip)
    # Compiled when first imported: a folder of compiled files would replace the environment's.
    target = ("--no-compile", "--target", str(request.target))
    return [(*pip, *words, *target) for words in _extra_installs(request)]


def check_addition(request: SetupRequest) -> None:
    """Raise if there is no complete environment to add to, or nothing to add.

    Raises
    ------
    UsageError
        Says which, and the next step.
    """
    if not request.extras:
        raise UsageError("No extra is named.", "Name what to add.")
    if not request.environment.is_ready():
        raise UsageError(
            f"There is no complete worker in {request.root} to add to.", "Set it up first."
        )


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
