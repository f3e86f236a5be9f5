# SPDX-License-Identifier: GPL-3.0-or-later
"""Typed errors: every one says what is wrong, where, and what to do next."""

from __future__ import annotations

import errno
from pathlib import Path

EXIT_DONE = 0
EXIT_OTHER = 1
EXIT_USAGE = 2
EXIT_BAD_DATA = 3
EXIT_RESOURCES = 4
EXIT_CANCELLED = 5

DISK_FULL_ERRNOS = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EFBIG)
"""What systems say of a disk or a quota that is full."""


class WrapError(Exception):
    """Base of every error that a user is shown.

    Parameters
    ----------
    message : str
        One sentence: what is wrong and where.
    hint : str
        The next step a person can take.
    """

    exit_code = EXIT_OTHER

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message} {self.hint}".strip()


class UsageError(WrapError):
    """A command line, setting or job file that asks for something impossible."""

    exit_code = EXIT_USAGE


class SettingError(UsageError):
    """A setting out of range; who knows by which option it was given may name that instead.

    Parameters
    ----------
    setting : str
        Path in the job's settings, such as ``"meshing.tiles"``.
    wanted : str
        What may be given.
    """

    def __init__(self, setting: str, wanted: str, *, called: str = "") -> None:
        super().__init__(f"{called or f'Setting {setting}'} is out of range.", f"Give {wanted}.")
        self.setting = setting
        self.wanted = wanted


class DatasetError(WrapError):
    """The photos or camera poses cannot be used as they are."""

    exit_code = EXIT_BAD_DATA


class ParseError(DatasetError):
    """A file does not hold what its format promises.

    Parameters
    ----------
    path : path-like
        The file.
    place : str
        Where in it, such as ``"byte 120"``, ``"line 7"`` or ``"frames[3].file_path"``.
    """

    def __init__(self, path: str | Path, location: str, message: str, hint: str = "") -> None:
        super().__init__(f"{Path(path).name}, {location}: {message}", hint)
        self.path = Path(path)
        self.location = location


class ResourceError(WrapError):
    """Not enough memory, disk or time, or a limit of ``limits.py`` was reached."""

    exit_code = EXIT_RESOURCES


class Cancelled(WrapError):  # noqa: N818 - a request that was obeyed, not an error
    """The user asked to stop."""

    exit_code = EXIT_CANCELLED

    def __init__(self, message: str = "Cancelled.", hint: str = "") -> None:
        super().__init__(message, hint)


class WorkerError(WrapError):
    """A worker or helper process failed; the message carries its last words."""


class MeshingError(WrapError):
    """The field holds no surface in the region, or a mesh cannot be made of it."""

    exit_code = EXIT_BAD_DATA


def unwritable_error(path: str | Path, error: OSError) -> ResourceError:
    """Return the error of a place that cannot be written, whatever command meets it."""
    if error.errno in DISK_FULL_ERRNOS:
        return ResourceError(
            f"No room is left on the disk: {path} could not be written.", "Make room there."
        )
    return ResourceError(
        f"{path} cannot be written: {error.strerror or error}.",
        "Check that the folder exists, is not read-only, and that the disk has room.",
    )


class DeviceError(WrapError):
    """The GPU, its driver or the compiler for it cannot do what was asked."""

    exit_code = EXIT_RESOURCES
