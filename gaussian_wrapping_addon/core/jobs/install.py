# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes and removes the worker's environment (venv, pip)."""

from __future__ import annotations

import contextlib
import glob
import importlib.metadata
import json
import logging
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ..errors import (
    EXIT_DONE,
    Cancelled,
    ResourceError,
    UsageError,
    WorkerError,
    WrapError,
    unwritable_error,
)
from ..files import write_json
from ..worker.environment import (
    FOLDERS,
    MARKER,
    PACKAGES,
    VENV,
    WorkerEnvironment,
    extra_hashes_file,
    extra_named,
    hashes_file,
    installed_extras,
    read_requirements,
    register_environment,
    unregister_environment,
    venv_python,
)
from ..worker.helper_process import child_command
from ..worker.spawn import child_environment, spawn
from .store.job_folder import JobFolder, JobStatus

# -- Find the Python installations that a worker environment can be created from ------------------

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

    Raises UsageError: it is not a Python, does not respond, is 32-bit or too old.
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
    if sys.platform == "win32" and (launcher := shutil.which("py")):
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


# -- Build the exact commands of a set-up, for display and for execution --------------------------
#
# The torch that a plain ``pip install torch`` installs depends on the system: on Linux the build
# for CUDA, on Windows and macOS the one for the CPU. The other build comes from PyTorch's own
# index. From an index, all other packages are installed by the hashes of their files, before
# torch: its builds have other hashes on each index. A folder of wheels is taken as it is.

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
    """Names of optional packages (``core/worker/environment.py``)."""
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
    is_there = shutil.which("nvidia-smi") or Path("/proc/driver/nvidia/version").exists()
    return sys.platform != "darwin" and bool(is_there)


def torch_index(choice: str, system: str = "") -> str:
    """Return the extra package index for a torch build on a system; ``""`` for none.

    Raises UsageError: the system has no such build.
    """
    system = system or platform.system()
    if choice == CUDA and system == "Darwin":
        raise UsageError("There is no CUDA on macOS.", "Choose the processor build of torch.")
    return {(CPU, "Linux"): CPU_INDEX, (CUDA, "Windows"): CUDA_INDEX}.get((choice, system), "")


def all_commands(request: SetupRequest, python: FoundPython) -> list[Command]:
    """Return every command of a set-up, in order.

    Raises UsageError: the Python or the build of torch cannot be used.
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
    extras, index = _extra_installs(request), torch_index(request.torch)
    if request.find_links:
        return [(*_only_wheels(request), "-r", request.requirements), *extras]
    also = ("--extra-index-url", index) if index else ()
    requirements = Path(request.requirements)
    hashes = hashes_file(requirements)
    if hashes is None:
        return [(*_INSTALL, *also, "-r", request.requirements), *extras]
    (torch,) = (r for r in read_requirements(requirements) if r.name == "torch")
    # What the build for the processor needs is in the list with hashes.
    alone = ("--no-deps",) if request.torch == CPU else ()
    return [
        (*_INSTALL, "--require-hashes", "-r", str(hashes)),
        (*_INSTALL, *also, *alone, f"{torch.name}{torch.versions}"),
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
        if request.find_links or hashes is None:
            options = _only_wheels(request) if request.find_links else _INSTALL
            found.append((*options, "--no-deps", *extra.pins))
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

    Raises UsageError: says which, and the next step.
    """
    if not request.extras:
        raise UsageError("No extra is named.", "Name what to add.")
    if not request.environment.is_ready():
        raise UsageError(
            f"There is no complete worker in {request.root} to add to.", "Set it up first."
        )


def check_folders(request: SetupRequest) -> None:
    """Raise if the folders of a set-up cannot be used; writes nothing.

    Raises UsageError: a folder cannot be used; names it.
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


# -- Create and remove the worker environment in a thread that runs its commands as processes -----
#
# A set-up builds in a folder that is not in use and switches to it at the end: if it is stopped,
# the previous environment, or none, remains.

_logger = logging.getLogger(__name__)

NEEDED_GIB = 3
"""Disk space for download and installation with torch for the CPU (1.5 GB remain used)."""
NEEDED_CUDA_GIB = 12
_SEE_LOG = "See log.txt in the worker's folder, then press Set Up Worker."

# Settings of pip that would install packages outside of the environment.
_IGNORED_VARIABLES = (
    "PIP_USER", "PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_REQUIREMENT", "PIP_LOG",
    "PIP_REQUIRE_VIRTUALENV", "PIP_NO_DEPS", "PIP_DRY_RUN",
)  # fmt: skip
# Pattern in pip's output, error message and next step; the first match is reported.
_FAILURES = (
    (r"Got\s+[0-9a-f]{64}", "A downloaded package is not the published one.",
     "Do not use it. Look at network, proxy and mirror; log.txt in the worker's folder names it."),
    (r"No space left|not enough space|quota exceeded", "The disk is full.",
     "Free several GiB, then press Set Up Worker."),
    (r"NewConnection|[Nn]ame ?[Rr]esolution|Proxy|Timeout|timed out|SSLError|Max retries|No route",
     "The package index cannot be reached.",
     "Check the network and proxy, or give a folder with wheels."),
    (r"No matching distribution found for (\S+)", "No wheel of {} for this Python was found.",
     "Put it into the wheel folder, if you use one; or choose another Python 3.11 to 3.13."),
)  # fmt: skip


class SetupTask(threading.Thread):
    """Thread that sets up or removes an environment; ``status`` holds its progress."""

    def __init__(self, request: SetupRequest, *, removes: bool = False) -> None:
        super().__init__(daemon=True)
        self.request = request
        self.removes = removes
        self.is_cancelling = False
        self.status = JobStatus("RUNNING", "remove" if removes else "environment")
        self._process: subprocess.Popen[bytes] | None = None
        self._package_count = 0
        """Number of packages that pip has named so far."""

    def run(self) -> None:
        """Run to the end; ``status`` then holds the outcome."""
        try:
            if self.removes:
                remove(self.request.environment)
            elif self.request.adds:
                self._add()
            else:
                self._set_up()
            self.status = JobStatus("DONE", self.status.stage, 1.0, exit_code=EXIT_DONE)
        except WrapError as error:
            self._end("CANCELLED" if isinstance(error, Cancelled) else "FAILED", error)
        except OSError as error:
            self._end("FAILED", unwritable_error(error.filename or self.request.root, error))
        except Exception as error:  # without a final status, the user would wait forever
            _logger.exception("set-up")
            self._end("FAILED", WorkerError(f"{type(error).__name__}: {error}.", _SEE_LOG))

    def _end(self, state: str, failure: WrapError) -> None:
        self.status = JobStatus(
            state, error=failure.message, hint=failure.hint, exit_code=failure.exit_code
        )

    def cancel(self) -> None:
        """Request a stop; unfinished files are deleted."""
        self.is_cancelling = True
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    def _set_up(self) -> None:
        """Create the environment; an existing one is replaced at the end."""
        request, environment = self.request, self.request.environment
        names = [r.name for r in read_requirements(Path(request.requirements))]
        python = probe(request.python)
        commands = all_commands(request, python)
        folder = environment.next_folder()
        marker = {
            "made_by": "gaussian_wrapping_addon", "kind": VENV if python.has_venv else PACKAGES,
            "python": python.path, "version": python.version_text, "torch": request.torch,
            "folder": folder.name, "extras": list(request.extras),
        }  # fmt: skip
        check_folders(request)
        environment.root.mkdir(parents=True, exist_ok=True)
        if "torch" in names:
            _check_disk(environment.root, NEEDED_CUDA_GIB if request.torch == CUDA else NEEDED_GIB)
        if not environment.is_ours():
            write_json(environment.marker_path, marker)
        lock = JobFolder(environment.root)
        lock.lock()
        replaced = environment.folder if environment.is_ready() else None
        try:
            _delete_unused(environment)
            (environment.root / TEMPORARY).mkdir()
            self._run_all(commands, python.path, 2 * len(names))
            write_json(environment.marker_path, marker)
            write_json(environment.ready_path, installed_versions(folder))
            register_environment(environment.root)
        finally:
            with contextlib.suppress(OSError):  # the next set-up deletes the rest
                # Jobs that run may still load packages from the replaced environment.
                _delete_unused(environment, keep=replaced)
            lock.unlock()
            if self.is_cancelling and not environment.is_ready():
                with contextlib.suppress(OSError):
                    remove(environment)

    def _add(self) -> None:
        """Add the extras to the environment in use; stopped before the end, it stays as it is."""
        request, environment = self.request, self.request.environment
        check_folders(request)
        check_addition(request)
        python = probe(str(environment.marker().get("python", "")))
        commands = all_commands(request, python)
        lock = JobFolder(environment.root)
        lock.lock()
        temporary = environment.root / TEMPORARY
        try:
            shutil.rmtree(temporary, ignore_errors=True)
            temporary.mkdir()
            self._run_all(commands, python.path, 1 + len(commands))
            place_packages(request.target, site_folder(environment.folder))
            versions = installed_versions(environment.folder)
            extras = list(installed_extras(versions))
            write_json(environment.marker_path, {**environment.marker(), "extras": extras})
            write_json(environment.ready_path, versions)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
            lock.unlock()

    def _run_all(self, commands: list[Command], python: str, expected: int) -> None:
        """Run commands one after the other; their output goes to ``log.txt``."""
        with (self.request.environment.root / "log.txt").open("a", encoding="utf-8") as log:
            log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} {platform.platform()}\n")
            for command in commands:
                self._run_command(command, python, log, expected)

    def _run_command(self, command: Command, python: str, log: IO[str], expected: int) -> None:
        """Run a command to its end; the progress is the share of ``expected`` packages named."""
        log.write(f"$ {as_line(command)}\n")
        last: deque[str] = deque(maxlen=40)
        self._process = process = _start_process(
            child_command("jobs.install", *command, python=python),
            self.request.environment.root / TEMPORARY,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        if self.is_cancelling:  # cancelled before the process started
            process.stdin.close()
        try:
            for raw in process.stdout:
                line = raw.decode("utf-8", "replace").rstrip()
                log.write(line + "\n")
                log.flush()
                last.append(line)
                self._package_count += line.startswith(("Collecting ", "Processing "))
                stage = "install" if self._package_count else "environment"
                self.status = JobStatus(
                    "RUNNING", stage, min(self._package_count / expected, 0.9), line.strip()[:160]
                )
        finally:
            process.stdin.close()
            process.wait()
            process.stdout.close()
        if self.is_cancelling:
            raise Cancelled("The set-up was cancelled.", "Press Set Up Worker to start again.")
        if process.returncode != 0:
            raise error_from_output(process.returncode, list(last))


def site_folder(folder: Path) -> Path:
    """Return where packages are in an environment's folder: a venv, or packages alone."""
    sites = [*folder.glob("lib/python3*/site-packages"), *folder.glob("Lib/site-packages")]
    return sites[0] if sites else folder


def installed_versions(folder: Path) -> dict[str, str]:
    """Return the packages in an environment's folder: the version of each name."""
    found = importlib.metadata.distributions(path=[str(site_folder(folder))])
    return {d.metadata["Name"]: d.version for d in found}


def place_packages(added: Path, site: Path) -> None:
    """Move installed packages into an environment on the same disk, in place of other versions."""
    for info in added.glob("*.dist-info"):
        for other in site.glob(f"{info.name.split('-')[0]}-*.dist-info"):
            shutil.rmtree(other)
    # The metadata last: what they list is there by then.
    for entry in sorted(added.iterdir(), key=lambda p: p.name.endswith(".dist-info")):
        if entry.name in ("bin", "Scripts"):  # no program of an extra is called
            continue
        target = site / entry.name
        if target.is_dir():
            shutil.rmtree(target)
        os.replace(entry, target)


def _check_disk(root: Path, needed_gib: int) -> None:
    free_gib = shutil.disk_usage(root).free / 2**30
    if free_gib < needed_gib:
        raise ResourceError(
            f"{free_gib:.1f} GiB are free, {needed_gib} GiB are needed.",
            "Free some, or choose another folder.",
        )


def _start_process(command: list[str], temporary: Path) -> subprocess.Popen[bytes]:
    """Start :func:`main` in a process group of its own, with temporary files in ``temporary``."""
    variables = {
        k: v for k, v in child_environment().items() if k.upper() not in _IGNORED_VARIABLES
    }
    variables |= {**dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(temporary)), "PIP_USER": "0"}
    try:
        return spawn(
            command, stdin=subprocess.PIPE, stderr=subprocess.STDOUT, environment=variables,
            folder=temporary,
        )  # fmt: skip
    except OSError as error:
        raise WorkerError(
            f"{command[0]} does not start: {error.strerror}.", "Choose another Python."
        ) from None


def main(arguments: list[str]) -> int:
    """Run a command and kill it when standard input is closed, as when the parent ends."""
    process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL)

    def watch() -> None:
        os.read(0, 1)
        process.kill()
        if hasattr(os, "killpg"):
            os.killpg(0, signal.SIGKILL)  # the whole group, this process included

    threading.Thread(target=watch, daemon=True).start()
    return process.wait()


def error_from_output(code: int, last: list[str]) -> WrapError:
    """Return the typed error for the last output lines of a failed command."""
    for pattern, message, hint in _FAILURES:
        match = re.search(pattern, "\n".join(last))
        if match:
            return ResourceError(message.format(*match.groups()), hint)
    errors = [line for line in last if line.lower().startswith("error")] or last or ["no output"]
    return WorkerError(f"A command of the set-up ended with code {code}: {errors[-1]}.", _SEE_LOG)


def _delete_unused(environment: WorkerEnvironment, keep: Path | None = None) -> None:
    """Delete the files of an environment except the folder in use and ``keep``."""
    in_use = environment.folder if environment.is_ready() else None
    if in_use is None:
        environment.ready_path.unlink(missing_ok=True)
    for folder in (environment.root / name for name in (*FOLDERS, TEMPORARY)):
        if folder.is_symlink():
            folder.unlink()
        elif folder.exists() and folder not in (in_use, keep):
            shutil.rmtree(folder)


def remove(environment: WorkerEnvironment) -> None:
    """Delete an environment made by the add-on, and nothing else.

    Raises UsageError: it has no marker of ours, or a set-up runs there; OSError: a file stays.
    """
    root = environment.root
    if root.is_symlink() or not environment.is_ours():
        raise UsageError(
            f"{root} was not made by this add-on: it holds no {MARKER}.",
            "Delete it by hand if you are sure.",
        )
    if JobFolder(root).locked():
        raise UsageError(f"A set-up is running in {root}.", "Cancel it or wait for it.")
    environment.ready_path.unlink(missing_ok=True)
    unregister_environment(root)
    _delete_unused(environment)
    for name in ("status.json", "log.txt", "output.txt", "cancel", "lock.json", MARKER):
        (root / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # other files in the folder stay
        root.rmdir()
