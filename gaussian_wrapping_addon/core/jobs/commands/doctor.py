# SPDX-License-Identifier: GPL-3.0-or-later
"""Diagnose a Python environment: whether it can run a worker, and what is missing."""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import platform
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from typing import Any

from ...errors import EXIT_BAD_DATA, EXIT_DONE, WorkerError, WrapError
from ...machine import total_memory_bytes
from ...worker.environment import EXTRAS, not_started, read_requirements, requirements_file
from ...worker.helper_process import child_command, emit, json_object, last_line
from ...worker.spawn import run_to_end

MIN_PYTHON = (3, 11)
MIN_MEMORY_BYTES = 4 * 2**30
MIN_DISK_BYTES = 2 * 2**30
DEADLINE_S = 120.0

REQUIRED = {
    "numpy": "numpy", "torch": "torch", "numba": "numba", "scipy": "scipy", "shull": "shull",
    "pycolmap": "pycolmap", "xatlas": "xatlas",
    "PIL": "pillow", "trimesh": "trimesh", "igl": "libigl", "av": "av",
}  # fmt: skip


@dataclass(frozen=True)
class Diagnosis:
    """One finding; ``good`` is false if it prevents jobs from running."""

    subject: str
    good: bool
    finding: str
    hint: str = ""


def diagnose(folder: str = ".") -> list[Diagnosis]:
    """Diagnose the running interpreter."""
    good, python = sys.version_info[:2] >= MIN_PYTHON, platform.python_version()
    free_bytes = shutil.disk_usage(folder).free
    free = f"{free_bytes / 2**30:.1f} GiB free"
    return [
        Diagnosis("Python", good, f"{python} at {sys.executable}", "Use Python 3.11 or newer."),
        *_packages(), *_extras(), *_devices(), _memory(),
        Diagnosis("Disk", free_bytes > MIN_DISK_BYTES, free, "Free at least 2 GiB."),
    ]  # fmt: skip


def _packages() -> list[Diagnosis]:
    """Import every pinned package and compare its version with the list."""
    modules = {package: module for module, package in REQUIRED.items()}
    found = []
    for requirement in read_requirements(requirements_file()):
        name = requirement.name
        hint = f"Press Set Up Worker, or: pip install {name}{requirement.versions}"
        try:
            module = importlib.import_module(modules.get(name, name))
            version = importlib.metadata.version(name)
        except Exception as error:  # a broken binary package can raise anything
            found.append(Diagnosis(name, False, f"cannot be imported: {error}", hint))
            continue
        good = requirement.allows(version)
        wanted = "" if good else f", but {requirement.versions} is required"
        found.append(Diagnosis(name, good, f"{version}{_build(module)}{wanted}", hint))
    return found


def _extras() -> list[Diagnosis]:
    """Return which extras are installed; one that is not prevents no job, a broken one does."""
    found = []
    for extra in EXTRAS:
        hint = f"Press Add {extra.title}, or: pip install {' '.join(extra.pins)}"
        try:
            versions = [importlib.metadata.version(p.name) for p in extra.packages]
        except importlib.metadata.PackageNotFoundError:
            found.append(Diagnosis(extra.title, True, "not installed (optional)"))
            continue
        try:
            importlib.import_module(extra.module)
        except Exception as error:  # a broken binary package can raise anything
            found.append(Diagnosis(extra.title, False, f"cannot be imported: {error}", hint))
            continue
        good = all(p.allows(v) for p, v in zip(extra.packages, versions, strict=True))
        wanted = "" if good else f", but {' '.join(extra.pins)} is required"
        found.append(Diagnosis(extra.title, good, ", ".join(versions) + wanted, hint))
    return found


def _build(module: Any) -> str:
    """Return the device that torch was built for; empty for other packages."""
    if getattr(module, "__name__", "") != "torch":
        return ""
    cuda = getattr(module.version, "cuda", None)
    return f", built for CUDA {cuda}" if cuda else ", built for the processor"


def _devices() -> list[Diagnosis]:
    """Return where jobs compute, and the GPUs; a GPU that cannot be used prevents no job."""
    try:
        from ...devices.choice import gpu_findings

        found = gpu_findings()
    except ImportError:  # reported by the findings about the packages
        return [Diagnosis("Device", False, "a package is missing", "Press Set Up Worker.")]
    except Exception as error:  # a broken torch or driver can raise anything
        return [Diagnosis("Device", True, f"jobs run on the processor: {error}")]
    return [Diagnosis(subject, True, finding) for subject, finding in found]


def _memory() -> Diagnosis:
    total_bytes = total_memory_bytes()
    if not total_bytes:
        return Diagnosis("Memory", True, "unknown")
    found, good = f"{total_bytes / 2**30:.1f} GiB", total_bytes >= MIN_MEMORY_BYTES
    return Diagnosis("Memory", good, found, "At least 4 GiB are needed.")


def main(arguments: list[str]) -> int:
    """Write the findings about this interpreter to stdout, one JSON object per line."""
    findings = diagnose(arguments[0] if arguments else ".")
    for finding in findings:
        emit(**asdict(finding))
    return EXIT_DONE if all(f.good for f in findings) else EXIT_BAD_DATA


def answers_of(command: list[str], python: str, hint: str) -> tuple[list[dict[str, Any]], str]:
    """Return the JSON objects that a child of the worker's Python writes, and its last error line.

    Raises WorkerError: it does not start or, with the hint, does not end in time.
    """
    try:
        _, output, error_output = run_to_end(command, DEADLINE_S)
    except OSError as error:
        raise not_started(python, error) from None
    except subprocess.TimeoutExpired:
        raise WorkerError(f"{python} does not answer.", hint) from None
    answers = [values for line in output.splitlines() if (values := json_object(line))]
    return answers, last_line(error_output)


def diagnose_worker(python: str) -> list[Diagnosis]:
    """Diagnose another interpreter, in a child process.

    Raises WorkerError: the interpreter does not start or reports nothing.
    """
    hint = "Press Set Up Worker, or choose another Python."
    answers, said = answers_of(child_command("jobs.commands.doctor", python=python), python, hint)
    findings: list[Diagnosis] = []
    for values in answers:
        if "error" in values:
            raise WorkerError(str(values["error"]), str(values.get("hint", "")))
        with contextlib.suppress(TypeError):
            findings.append(Diagnosis(**values))
    if not findings:
        raise WorkerError(
            f"{python} reported nothing: {said}.",
            "Press Set Up Worker, or choose a Python 3.11 or newer with the worker's packages.",
        )
    return findings


def find_and_diagnose(preference: str = "") -> list[Diagnosis]:
    """Diagnose the interpreter that jobs would use; without one, return the next step."""
    from ..client import worker_python

    try:
        return diagnose_worker(worker_python(preference))
    except WrapError as error:
        return [Diagnosis("Worker", False, error.message, error.hint)]
