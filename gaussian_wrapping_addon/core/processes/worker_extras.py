# SPDX-License-Identifier: GPL-3.0-or-later
"""Optional packages of the worker: a table of what each is for, and the error where one is missing.

An extra is installed when the user asks for it, by the hashes of its files, without dependencies:
what its packages need must be in ``requirements-worker.txt`` or among its packages.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import MissingExtraError, UsageError
from .worker_requirements import Requirement

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


EXTRAS = (
    Extra(
        "heif", (Requirement("pillow-heif", "==1.8.1"),), "pillow_heif",
        "HEIC Photos", "HEIC and HEIF photos of phones",
    ),
    Extra(
        "raw", (Requirement("rawpy", "==0.28.0"),), "rawpy",
        "Camera RAW", "RAW photos of cameras (DNG, CR2, CR3, NEF, ARW, RAF, ORF, RW2 and others)",
    ),
    Extra(
        "markers", (Requirement("opencv-python-headless", "==4.11.0.86"),), "cv2",
        "Printed Markers", "printed markers in photos",
    ),
    Extra(
        "masks",
        (
            Requirement("flatbuffers", "==25.12.19"), Requirement("onnxruntime", "==1.27.0"),
            Requirement("packaging", "==26.4"), Requirement("protobuf", "==6.33.5"),
        ),
        "onnxruntime", "Mask Models", "segmentation models (ONNX)",
    ),
    Extra(
        "farm",
        (
            Requirement("cffi", "==2.1.1"), Requirement("click", "==8.5.1"),
            Requirement("cloudpickle", "==3.1.3"), Requirement("cryptography", "==50.0.2"),
            Requirement("dask", "==2026.8.0"), Requirement("dask-jobqueue", "==0.9.0"),
            Requirement("distributed", "==2026.8.0"),
            Requirement("importlib-metadata", "==8.9.0"), Requirement("locket", "==1.0.0"),
            Requirement("msgpack", "==1.2.4"), Requirement("packaging", "==26.4"),
            Requirement("partd", "==1.4.2"), Requirement("psutil", "==7.2.2"),
            Requirement("pycparser", "==3.12"), Requirement("pyyaml", "==6.0.4"),
            Requirement("sortedcontainers", "==2.4.0"), Requirement("tblib", "==3.2.2"),
            Requirement("toolz", "==1.2.0"), Requirement("tornado", "==6.6.1"),
            Requirement("urllib3", "==2.8.0"), Requirement("zict", "==3.0.0"),
            Requirement("zipp", "==4.1.2"),
        ),
        "distributed", "Several Computers", "several processes or computers (Dask)",
    ),
)  # fmt: skip


def extra_named(name: str) -> Extra:
    """Return an extra by its name.

    Raises
    ------
    UsageError
        There is none of this name; lists those there are.
    """
    for extra in EXTRAS:
        if extra.name == name:
            return extra
    known = ", ".join(extra.name for extra in EXTRAS)
    raise UsageError(f"There is no extra {name}.", f"Give one or several of: {known}.")


def read_extra_names(text: str) -> tuple[str, ...]:
    """Return the names in a list such as ``heif,raw``, each once, in the order of the table.

    Raises
    ------
    UsageError
        A name is unknown.
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
    """Import the module of an extra.

    Parameters
    ----------
    name : str
        Of the extra.
    needed_by : str
        What needs it, such as the names of files.

    Raises
    ------
    MissingExtraError
        It is not installed, in another version, or broken; says how to install it.
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
    """Import several extras; see :func:`load_extra`.

    Parameters
    ----------
    needed_by : mapping
        What needs each of the extras.

    Raises
    ------
    MissingExtraError
        Names all that are missing.
    """
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
