# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that jobs run in: where it is, what it must hold, what may be added."""

from __future__ import annotations

import importlib
import importlib.metadata
import operator
import os
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import (
    MemoryShortageError,
    MissingExtraError,
    ParseError,
    UsageError,
    WorkerError,
    WrapError,
)
from ..files import read_json, write_json

# -- Locate the private worker environment, check that it is complete, and find its interpreter
#
# Its folder holds the marker (only a folder with it is ever removed), ``log.txt``, one folder
# with a venv, or with packages if the Python cannot create a venv, and ``ready.json``, without
# which no job uses it. The marker names the folder in use; a set-up builds another one beside it.

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
    is_ours = isinstance(values, dict) and key in values and value in (None, values[key])
    return values if is_ours else {}


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
    named = Path(registered) if isinstance(registered, str) else None
    roots = [installed_root(), named, default_root()]
    return [WorkerEnvironment(root) for root in dict.fromkeys(roots) if root is not None]


def ready_worker() -> str:
    """Return the worker of the first complete environment; ``""`` if there is none."""
    return next((e.worker() for e in known_environments() if e.is_ready()), "")


# -- The pinned packages of ``requirements-worker.txt``, and errors of a worker's Python ----------

FILE_NAME = "requirements-worker.txt"
HASHES_NAME = "requirements-worker-hashes.txt"
"""The same packages and what they need, by the hashes of their files; without torch."""
_LINE = re.compile(r"^([A-Za-z0-9][\w.-]*)[^\S\n]*([^#;\n]*)", re.MULTILINE)
_COMPARE = {
    "==": operator.eq, "!=": operator.ne, ">=": operator.ge, "<=": operator.le,
    ">": operator.gt, "<": operator.lt,
}  # fmt: skip
NO_ROOM = (
    "failed to map segment", "annot allocate memory", "cannot apply additional memory protection",
    "cannot enable executable stack", "paging file is too small",
)  # fmt: skip
"""What the loaders of Linux, macOS and Windows say where a library finds no room in memory."""
_LLVM = "llvmlite.binding"


@dataclass(frozen=True)
class Requirement:
    """One package and its allowed versions."""

    name: str
    versions: str
    """Such as ``==2.13.0`` or ``>=1.26,<3``; empty for any."""

    def allows(self, version: str) -> bool:
        """Tell whether an installed version is allowed; a local part (``+cpu``) is ignored."""
        clauses = re.findall(r"([<>=!]=|[<>])([^,]+)", self.versions)
        return all(_COMPARE[sign](_numbers(version), _numbers(wanted)) for sign, wanted in clauses)


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers of a version without trailing zeros: 2.13.0 equals 2.13."""
    text = re.sub(r"(\.0+)+$", "", re.split(r"[+a-zA-Z]", version)[0])
    return tuple(int(n) for n in re.findall(r"\d+", text))


def requirements_file() -> Path:
    """Return the add-on's requirements file, in the installed package or in the repository.

    Raises UsageError: the file is missing.
    """
    for folder in (_PACKAGE_ROOT, _PACKAGE_ROOT.parent):
        if (folder / FILE_NAME).is_file():
            return folder / FILE_NAME
    raise UsageError(f"{FILE_NAME} is missing.", "Install the add-on's zip again.")


def hashes_file(requirements: Path) -> Path | None:
    """Return the list with hashes that belongs to a list of packages; ``None`` for other lists."""
    beside = requirements.with_name(HASHES_NAME)
    return beside if requirements.name == FILE_NAME and beside.is_file() else None


def read_requirements(path: Path) -> list[Requirement]:
    """Return the packages of a list; its syntax is left to pip.

    Raises UsageError: the file cannot be read or names no package.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read: {error.strerror}.", "Give another list."
        ) from None
    found = [Requirement(m[1], m[2].replace(" ", "")) for m in _LINE.finditer(text)]
    if not found:
        raise UsageError(f"{path} names no package.", "Give a list of packages.")
    return found


def package_error(error: ImportError | OSError) -> WrapError | None:
    """Return the error of a package that does not load, or ``None`` for anything else.

    A library that finds no room in memory is an error of the import system, too; llvmlite reports
    every reason as a file that is not there.
    """
    text = str(error)
    if any(words in text for words in NO_ROOM) or _LLVM in text:
        return MemoryShortageError(
            f"A package of the worker's Python, {sys.executable}, could not be loaded, probably "
            f"for want of memory: {text.strip().splitlines()[-1]}",
            "Close other programs, or allow more memory (ulimit -v, a container's limit), then "
            "resume. If there is enough, batch.py doctor checks the packages.",
        )
    if not isinstance(error, ImportError):
        return None
    if (error.name or "").partition(".")[0] in ("", __name__.partition(".")[0]):
        return None
    return WorkerError(
        f"The worker's Python, {sys.executable}, lacks a package, or has it in another version: "
        f"{error}.",
        "Press Set Up Worker, run batch.py set-up-worker, or install requirements-worker.txt with "
        "its pip. batch.py doctor checks it.",
    )


def not_started(python: str, error: OSError) -> WorkerError:
    """Return the error of a worker's Python that the system does not start."""
    return WorkerError(
        f"The worker's Python, {python}, does not run: {error.strerror or error}.",
        "Press Set Up Worker, run batch.py set-up-worker, or name another Python.",
    )


# -- Optional packages of the worker: a table of what each is for, and the error where one is
#    missing
#
# An extra is installed when the user asks for it, by the hashes of its files, without
# dependencies: what its packages need must be in ``requirements-worker.txt`` or among its
# packages.

EXTRA_HASHES_NAME = "requirements-worker-{}-hashes.txt"
"""Files of an extra by their hashes, written by ``tools.worker_hashes``."""


@dataclass(frozen=True)
class Extra:
    """Optional packages of the worker."""

    name: str
    """As on the command line."""
    packages: tuple[Requirement, ...]
    """Pinned, without what ``requirements-worker.txt`` lists."""
    module: str
    """Imported to tell whether the extra is installed."""
    title: str
    """Of its check box and button."""
    purpose: str
    """What it reads, in the plural: fits into "... cannot be read"."""

    @property
    def pins(self) -> tuple[str, ...]:
        """The packages as pip takes them."""
        return tuple(f"{p.name}{p.versions}" for p in self.packages)


def _pinned(pins: str) -> tuple[Requirement, ...]:
    named = (pin.partition("==") for pin in pins.split())
    return tuple(Requirement(name, f"=={version}") for name, _, version in named)


EXTRAS = (
    Extra(
        "heif", _pinned("pillow-heif==1.8.1"), "pillow_heif",
        "HEIC Photos", "HEIC and HEIF photos of phones",
    ),
    Extra(
        "raw", _pinned("rawpy==0.28.0"), "rawpy",
        "Camera RAW", "RAW photos of cameras (DNG, CR2, CR3, NEF, ARW, RAF, ORF, RW2 and others)",
    ),
    Extra(
        "markers", _pinned("opencv-python-headless==4.11.0.86"), "cv2",
        "Printed Markers", "printed markers in photos",
    ),
    Extra(
        "masks",
        _pinned("flatbuffers==25.12.19 onnxruntime==1.27.0 packaging==26.4 protobuf==6.33.5"),
        "onnxruntime", "Mask Models", "segmentation models (ONNX)",
    ),
    Extra(
        "farm",
        _pinned(
            "cffi==2.1.1 click==8.5.1 cloudpickle==3.1.3 cryptography==50.0.2 dask==2026.8.0"
            " dask-jobqueue==0.9.0 distributed==2026.8.0 importlib-metadata==8.9.0 locket==1.0.0"
            " msgpack==1.2.4 packaging==26.4 partd==1.4.2 psutil==7.2.2 pycparser==3.12"
            " pyyaml==6.0.4 sortedcontainers==2.4.0 tblib==3.2.2 toolz==1.2.0 tornado==6.6.1"
            " urllib3==2.8.0 zict==3.0.0 zipp==4.1.2"
        ),
        "distributed", "Several Computers", "several processes or computers (Dask)",
    ),
)  # fmt: skip


def extra_named(name: str) -> Extra:
    """Return an extra by its name.

    Raises UsageError: there is none of this name; lists those there are.
    """
    if found := [extra for extra in EXTRAS if extra.name == name]:
        return found[0]
    known = ", ".join(extra.name for extra in EXTRAS)
    raise UsageError(f"There is no extra {name}.", f"Give one or several of: {known}.")


def read_extra_names(text: str) -> tuple[str, ...]:
    """Return the names in a list such as ``heif,raw``, each once, in the order of the table.

    Raises UsageError: a name is unknown.
    """
    given = {extra_named(word.strip()).name for word in text.split(",") if word.strip()}
    return tuple(extra.name for extra in EXTRAS if extra.name in given)


def installed_extras(versions: Iterable[str]) -> tuple[str, ...]:
    """Return the extras whose packages are all among the names of installed packages."""
    there = {_normal(name) for name in versions}
    return tuple(e.name for e in EXTRAS if all(_normal(p.name) in there for p in e.packages))


def extra_hashes_file(requirements: Path, extra: Extra) -> Path | None:
    """Return the list with hashes of an extra beside our list of packages; ``None`` if missing."""
    beside = requirements.with_name(EXTRA_HASHES_NAME.format(extra.name))
    return beside if beside.is_file() else None


def load_extra(name: str, needed_by: str) -> Any:
    """Import the module of an extra; ``needed_by``: what needs it, such as the names of files.

    Raises MissingExtraError: it is missing, of another version, or broken; says how to install it.
    """
    extra = extra_named(name)
    try:
        module = importlib.import_module(extra.module)
        for package in extra.packages:
            version = importlib.metadata.version(package.name)
            if not package.allows(version):
                raise ImportError(f"{package.name} is {version}, not {package.versions[2:]}")
    except Exception as error:  # a broken binary package can raise anything
        is_missing = isinstance(error, ModuleNotFoundError) and error.name == extra.module
        reason = "" if is_missing else f" ({error})"
        raise MissingExtraError(
            f"{needed_by}: the worker has no package for {extra.purpose} yet{reason}.",
            f"Press Add {extra.title} in the add-on's preferences, or run: batch.py set-up-worker "
            f"--add {extra.name}. In a Python of your own: pip install {' '.join(extra.pins)}.",
            (extra.name,),
        ) from None
    return module


def load_extras(needed_by: Mapping[str, str]) -> None:
    """Import several extras, by what needs each. Raises MissingExtraError: names all missing."""
    missing: list[MissingExtraError] = []
    for name, files in needed_by.items():
        try:
            load_extra(name, files)
        except MissingExtraError as error:
            missing.append(error)
    if missing:
        raise MissingExtraError(
            " ".join(error.message for error in missing),
            " ".join(error.hint for error in missing),
            [name for error in missing for name in error.extras],
        )


def _normal(name: str) -> str:
    """Return a package's name as pip compares it."""
    return name.lower().replace("_", "-").replace(".", "-")
