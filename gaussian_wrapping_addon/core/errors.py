# SPDX-License-Identifier: GPL-3.0-or-later
"""Exception types: each states what is wrong, where, and the next step."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from pathlib import Path

EXIT_DONE = 0
EXIT_OTHER = 1
EXIT_USAGE = 2
EXIT_BAD_DATA = 3
EXIT_RESOURCES = 4
EXIT_CANCELLED = 5

DISK_FULL_ERRNOS = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EFBIG)
"""Error numbers of a full disk or an exhausted quota."""

SHOWN_PATH = 80  # characters of an over-long path that a message shows


class WrapError(Exception):
    """Base of all errors that are shown to users.

    The message is one sentence: what is wrong and where; the hint is the next step for the user.
    """

    exit_code = EXIT_OTHER
    can_resume = False
    """Whether a mesh that ends so keeps what it has begun, as a cancelled one does."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message, self.hint = message, hint

    def __str__(self) -> str:
        return f"{self.message} {self.hint}".strip()


class UsageError(WrapError):
    """An invalid command line, setting or job file."""

    exit_code = EXIT_USAGE


class SettingError(UsageError):
    """A setting out of range; ``called`` names the option that set it, if known.

    ``setting`` is its path in the job's settings, such as ``"meshing.tiles"``; ``wanted`` tells the
    allowed values.
    """

    def __init__(self, setting: str, wanted: str, *, called: str = "") -> None:
        super().__init__(f"{called or f'Setting {setting}'} is out of range.", f"Give {wanted}.")
        self.setting, self.wanted = setting, wanted


class DatasetError(WrapError):
    """The photos or camera poses cannot be used as they are."""

    exit_code = EXIT_BAD_DATA


class ParseError(DatasetError):
    """A file violates its format.

    The location in it is such as ``"byte 120"``, ``"line 7"`` or ``"frames[3].file_path"``.
    """

    def __init__(self, path: str | Path, location: str, message: str, hint: str = "") -> None:
        super().__init__(f"{Path(path).name}, {location}: {message}", hint)
        self.path, self.location = Path(path), location


class ResourceError(WrapError):
    """Not enough memory, disk or time, or a limit of ``limits.py`` was reached."""

    exit_code = EXIT_RESOURCES


class MemoryShortageError(ResourceError):
    """The system or the user allows less memory than is needed, not a limit of this program."""


class Cancelled(WrapError):  # noqa: N818 - a request, not an error
    """The user cancelled."""

    exit_code = EXIT_CANCELLED

    def __init__(self, message: str = "Cancelled.", hint: str = "") -> None:
        super().__init__(message, hint)


class WorkerError(WrapError):
    """A worker or helper process failed; the message contains its last output."""


class MissingExtraError(WorkerError):
    """The worker lacks optional packages that the input needs.

    ``extras`` are their names, as ``set-up-worker --add`` takes them.
    """

    exit_code = EXIT_BAD_DATA

    def __init__(self, message: str, hint: str = "", extras: Sequence[str] = ()) -> None:
        super().__init__(message, hint)
        self.extras = tuple(extras)


class MeshingError(WrapError):
    """The field has no surface in the region, or no mesh can be extracted."""

    exit_code = EXIT_BAD_DATA


def unwritable_error(path: str | Path, error: OSError) -> ResourceError:
    """Return the error for a path that cannot be written; the same for all commands."""
    if error.errno in DISK_FULL_ERRNOS:
        return ResourceError(
            f"No room is left on the disk: {path} could not be written.", "Make room there."
        )
    return ResourceError(
        f"{path} cannot be written: {error.strerror or error}.",
        "Check that the folder exists, is not read-only, and that the disk has room.",
    )


def known_error(error: OSError, path: str | Path = "") -> WrapError | None:
    """Return what users are told where the system refuses a path or is full; ``None`` otherwise.

    ``path`` is used where the error names none.
    """
    named = str(error.filename or path)
    if error.errno in DISK_FULL_ERRNOS:
        return unwritable_error(named or "A file", error)
    if error.errno == errno.ENAMETOOLONG:
        return UsageError(
            f"The path {named[:SHOWN_PATH]}... is longer than this system stores.",
            "Use shorter names.",
        )
    return None


class FarmError(WrapError):
    """A farm's manager cannot be reached, answers as none does, or refuses what it is asked."""


class DeviceError(WrapError):
    """The GPU, its driver or its compiler failed or lacks a required feature."""

    exit_code = EXIT_BAD_DATA
