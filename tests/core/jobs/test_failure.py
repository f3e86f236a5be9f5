# SPDX-License-Identifier: GPL-3.0-or-later
"""What a failed job tells of each kind of exception: exit code, what is wrong, what to do."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import (
    EXIT_BAD_DATA,
    EXIT_OTHER,
    EXIT_RESOURCES,
    DatasetError,
    ResourceError,
)
from gaussian_wrapping_addon.core.jobs.worker import failure_of

ROOT = Path("/jobs/a")
LLVMLITE = (
    "Could not find/load shared object file 'libllvmlite.so' from resource location: "
    "'llvmlite.binding'. This could mean that the library literally cannot be found, but may also"
    " mean that the permissions are incorrect or that a dependency of/a symbol in the library could"
    " not be resolved."
)
NUMPY = (
    "\n\nIMPORTANT: PLEASE READ THIS FOR ADVICE ON HOW TO SOLVE THIS ISSUE!\n\n"
    "Original error was: libscipy_openblas64_.so: failed to map segment from shared object\n"
)


@pytest.mark.parametrize(
    "error",
    [
        ImportError("libtorch_cpu.so: failed to map segment from shared object", name="torch._C"),
        ImportError("x.so: cannot allocate memory in static TLS block", name="x"),
        ImportError("DLL load failed: The paging file is too small for this operation", name="x"),
        ImportError(NUMPY),
        OSError(LLVMLITE),
    ],
    ids=["torch", "tls", "windows", "numpy", "llvmlite"],
)
def test_a_package_without_room_in_memory_is_no_missing_package(error: Exception) -> None:
    told = failure_of(error, ROOT)
    assert (told.code, told.is_known) == (EXIT_RESOURCES, True)
    assert "memory" in told.error
    assert "resume" in told.hint
    assert "Set Up Worker" not in told.hint
    assert "\n" not in told.error


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError(), EXIT_RESOURCES, "Not enough memory."),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), EXIT_RESOURCES, "Not enough memory."),
        (RuntimeError("can't start new thread"), EXIT_RESOURCES, "no further thread"),
        (OSError(errno.ENOSPC, "full", "/jobs/a/x.npz"), EXIT_RESOURCES, "/jobs/a/x.npz"),
        (OSError(errno.ENOSPC, "full"), EXIT_RESOURCES, "/jobs/a"),
        (ImportError("No module named 'xatlas'", name="xatlas"), EXIT_OTHER, "lacks a package"),
        (DatasetError("p.png is no photo.", "Remove it."), EXIT_BAD_DATA, "p.png is no photo."),
    ],
)
def test_what_users_can_mend_is_said(error: Exception, code: int, words: str) -> None:
    told = failure_of(error, ROOT)
    assert (told.code, told.is_known) == (code, True)
    assert words in told.error
    assert told.hint
    assert "bug" not in told.hint
    # What it has caused is not told as something else.
    other = ResourceError("No room is left.", "Make room there.")
    other.__cause__ = error
    is_full = isinstance(error, OSError) and error.errno == errno.ENOSPC
    assert ("checkpoint is intact" in failure_of(other, ROOT).hint) == is_full


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("a fault of ours"),
        ValueError("x"),
        OSError(errno.EIO, "Input/output error"),
        ImportError("no runner", name="gaussian_wrapping_addon.core.jobs.runner"),
    ],
)
def test_anything_else_asks_for_a_bug_report(error: Exception) -> None:
    told = failure_of(error, ROOT)
    assert (told.code, told.is_known) == (EXIT_OTHER, False)
    assert told.error.startswith(f"Unexpected {type(error).__name__}: ")
    assert "bug report" in told.hint
