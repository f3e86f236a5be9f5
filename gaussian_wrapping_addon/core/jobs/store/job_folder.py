# SPDX-License-Identifier: GPL-3.0-or-later
"""Job folders: layout, status file, lock, cancel request, and the ``scene.blend`` of a result."""

from __future__ import annotations

import contextlib
import logging
import os
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from ... import limits
from ...errors import DISK_FULL_ERRNOS, ParseError, UsageError, known_error, unwritable_error
from ...files import (
    overwrite_json,
    read_bounded,
    read_json,
    reject_foreign_entries,
    seconds_since_written,
    touch_regular,
    write_json,
)
from ...names import JOB_MARKER
from ...worker.spawn import host_and_pid_namespace, is_here, owner_alive, process_start_ticks

# -- Rename the ``scene.blend`` of a result when it no longer matches the result ------------------
#
# It is written outside of the worker, which has no Blender, and only on request.

_logger = logging.getLogger("gaussian_wrapping")

NAME, EARLIER = "scene.blend", "scene.blend1"
"""Its name, and Blender's name for the previous version, which may hold a user's additions."""


def result_state(result: Path) -> dict[str, bytes]:
    """Return the content of each region's figures file, by region: it identifies a result."""
    return {
        path.parent.name: read_bounded(path, limits.MAX_JSON_BYTES)
        for path in sorted(result.glob("*/figures.json"))
    }


def back_up_stale_blend(result: Path, before: dict[str, bytes]) -> bool:
    """Rename ``scene.blend`` if the result has changed; tell whether it was renamed.

    ``before``: :func:`result_state` from when the file was up to date.
    """
    blend = result / NAME
    if not blend.is_file() or result_state(result) == before:
        return False
    os.replace(blend, result / EARLIER)
    _logger.info("%s showed the previous result and was renamed to %s", NAME, EARLIER)
    return True


# -- The job folder: its layout, status file, lock and cancel request -----------------------------
#
# Layout: ``job.json``, ``status.json``, ``log.txt``, ``lock.json``, ``cancel`` (a file asks to
# stop), ``stages/<name>-<hash>/`` (``done.json`` last), ``result/``.

FOREIGN_LOCK_HINT = "If it is no job of this add-on, delete lock.json there."
STATES = ("NEW", "RUNNING", "CANCELLING", "CANCELLED", "FAILED", "DONE", "LOST")
ACTIVE_STATES = ("NEW", "RUNNING", "CANCELLING")


@dataclass(frozen=True)
class JobStatus:
    """What ``status.json`` says; ``fraction`` and ``seconds_left`` are of the whole job."""

    state: str = "NEW"
    stage: str = ""
    fraction: float = 0.0
    message: str = ""
    """For people only."""
    seconds_left: float | None = None
    error: str = ""
    """Why the job failed; after a rollback, why it could not be meshed again."""
    hint: str = ""
    exit_code: int | None = None
    pid: int = 0
    pid_started: int = 0
    """Start time of the process in system ticks: detects a re-used pid."""
    place: str = ""
    """Where the pid is one: host, boot and namespace; empty for this computer."""
    heartbeat_s: float = 0.0
    """Unix time of the last heartbeat."""
    result: str = ""
    """Absolute path of the result folder, once there is one."""
    figures: dict[str, float] = field(default_factory=dict)
    """Live figures of the running stage, such as ``iteration``, ``gaussians`` and ``psnr``."""
    phase: str = ""
    """For programs: a special phase of the stage, such as ``progress.COMPILING``."""
    put_back: bool = False
    """Whether the job was rolled back to its finished state after a failed mesh."""

    @property
    def active(self) -> bool:
        """Whether a worker is (or should be) running."""
        return self.state in ACTIVE_STATES

    @classmethod
    def from_json(cls, values: Any) -> JobStatus:
        """Build from JSON values, ignoring unknown entries.

        Raises TypeError, ValueError: an entry is wrong: the file is not ours, or is being written.
        """
        given = dict(values)
        known = {f.name: given[f.name] for f in fields(cls) if f.name in given}
        for f in fields(cls):
            if f.name in known and not has_type(str(f.type), known[f.name]):
                raise TypeError(f"{f.name} is {type(known[f.name]).__name__}")
        if known.get("state", "NEW") not in STATES:
            raise ValueError("state is none")
        # Version 0.1.0 marked a rolled-back job only by its error.
        old = known.get("state") == "DONE" and bool(known.get("error"))
        return cls(**{"put_back": old, **known})


_TYPES: dict[str, Any] = {"str": str, "int": int, "float": int | float, "bool": bool}


def has_type(annotation: str, value: Any) -> bool:
    """Tell whether a JSON value has the type of a dataclass's field, as that is written."""
    if annotation.endswith(" | None"):
        return value is None or has_type(annotation.removesuffix(" | None"), value)
    if annotation == "dict[str, float]":
        return isinstance(value, dict) and all(has_type("float", x) for x in value.values())
    if annotation == "tuple[str, ...]":
        return isinstance(value, list) and all(isinstance(x, str) for x in value)
    is_flag = isinstance(value, bool)  # an int for Python
    return isinstance(value, _TYPES[annotation]) and is_flag == (annotation == "bool")


def _read_small(path: Path) -> Any:
    return read_json(path, most_bytes=limits.MAX_STATUS_BYTES)


class JobFolder:
    """Paths of a job folder; access to its status and lock."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.job_path = root / "job.json"
        self.status_path = root / "status.json"
        self.log_path = root / "log.txt"
        self.output_path = root / "worker-output.txt"  # what the worker wrote to stdout and stderr
        self.cancel_path = root / "cancel"  # the worker stops if it exists
        self.lock_path = root / "lock.json"  # names the process that holds the folder
        self.stages = root / "stages"
        self.baked = root / "baked"  # meshes from elsewhere that photos were baked onto
        self.result = root / "result"

    def create(self) -> None:
        """Create the folder, or accept an existing job folder or an empty folder.

        Raises UsageError: it is a file, holds other content, or its path is too long; DatasetError:
        see :meth:`check_entries`; ResourceError: it cannot be written.
        """
        try:
            if self.root.exists() and not self.root.is_dir():
                raise UsageError(f"{self.root} is a file.", "Choose a folder for the results.")
            self.root.mkdir(parents=True, exist_ok=True)
            if not os.path.lexists(self.root / JOB_MARKER) and any(self.root.iterdir()):
                raise UsageError(
                    f"{self.root} holds other files.", "Choose a new or empty folder for results."
                )
            touch_regular(self.root / JOB_MARKER)
            self.stages.mkdir(exist_ok=True)
        except OSError as error:
            raise known_error(error, self.root) or unwritable_error(self.root, error) from None
        self.check_entries()

    def check_entries(self, *, but: frozenset[str] = frozenset()) -> None:
        """Raise unless everything in the folder is a regular file or a folder, at any depth.

        Before any command reads or writes more than the status: the folder may come from elsewhere,
        and a link in it would lead writes and deletions out of it. The folder itself may be reached
        through links. ``but``: names of folders that are not looked into. Raises DatasetError:
        names the entry.
        """
        reject_foreign_entries(self.root, but=but)

    def is_job(self) -> bool:
        """Whether a job was started here."""
        return (self.root / JOB_MARKER).exists() and self.job_path.exists()

    def read_status(self) -> JobStatus:
        """Return the status; a running job whose process is gone is reported as LOST."""
        for _ in range(2):  # it may have written its final status and ended after the first read
            status = self._read_file()
            if not self._gone(status):
                return status
        return replace(
            status, state="LOST", error="The worker process ended without reporting an error.",
            hint="Resume the job; it continues from the last checkpoint.",
        )  # fmt: skip

    def _read_file(self) -> JobStatus:
        try:
            return JobStatus.from_json(_read_small(self.status_path))
        except (OSError, ParseError, TypeError, ValueError):
            return JobStatus()

    def _gone(self, status: JobStatus) -> bool:
        return status.state in ("RUNNING", "CANCELLING") and not _lives(
            status.pid, status.pid_started, status.place, self.status_path
        )

    def write_status(self, status: JobStatus) -> None:
        """Write the status atomically."""
        try:
            write_json(self.status_path, asdict(status))
        except OSError as error:
            if error.errno not in DISK_FULL_ERRNOS or status.active:
                raise
            # The final status of a worker on a full disk: overwrite in place.
            overwrite_json(self.status_path, asdict(status))

    def lock(self) -> None:
        """Lock the folder for this process.

        The lock of a dead process, or an unreadable one, is taken over: a lock of a living process
        is written atomically. Raises UsageError: another process holds the folder.
        """
        pid = os.getpid()
        started, place = process_start_ticks(pid), host_and_pid_namespace()
        mine = {"pid": pid, "started": started, "place": place}
        if self._lock_owner() == tuple(mine.values()):
            return
        self._drop_stale_lock()
        # A hard link to a complete file is atomic and succeeds for one process only.
        ready = self.lock_path.with_name(f"lock.{pid}.json")
        write_json(ready, mine)
        try:
            os.link(ready, self.lock_path)
        except FileExistsError:
            pid, _, place = self._lock_owner() or (0, 0, "")
            where = "" if is_here(place) else f" of {place.split(' ')[0]}"
            raise UsageError(
                f"Process {pid}{where} is working in {self.root}.",
                f"Wait for it, cancel it, or choose another folder. {FOREIGN_LOCK_HINT}",
            ) from None
        except OSError:
            # A file system without hard links (exFAT): renaming is the best available.
            os.replace(ready, self.lock_path)
        finally:
            ready.unlink(missing_ok=True)

    def _drop_stale_lock(self) -> None:
        try:
            content: bytes | None = read_bounded(self.lock_path, limits.MAX_STATUS_BYTES)
        except ParseError:
            if self.lock_path.is_dir():
                return
            content = None  # a link or a pipe: no process of ours holds it
        except OSError:
            return
        owner = self._lock_owner()
        if owner is not None and _lives(*owner, self.lock_path):
            return
        aside = self.lock_path.with_name(f"lock.{os.getpid()}.stale")
        try:
            os.replace(self.lock_path, aside)
        except FileNotFoundError:
            return
        try:
            if content is not None and aside.read_bytes() != content:
                # Another process has taken the lock over meanwhile: restore it.
                os.link(aside, self.lock_path)
        except FileExistsError:
            pass
        except OSError:  # no hard links
            os.replace(aside, self.lock_path)
        finally:
            aside.unlink(missing_ok=True)

    def _lock_owner(self) -> tuple[int, int, str] | None:
        """Return pid, start time and place of the process that holds the folder."""
        try:
            owner = _read_small(self.lock_path)
            return int(owner["pid"]), int(owner["started"]), str(owner.get("place", ""))
        except (OSError, ParseError, KeyError, TypeError, ValueError, AttributeError):
            return None

    def locked(self) -> bool:
        """Whether a living process holds the folder; on another computer, one that shows it."""
        owner = self._lock_owner()
        return owner is not None and _lives(*owner, self.lock_path)

    def show_life(self) -> None:
        """Show other computers that the process that holds the folder lives."""
        with contextlib.suppress(OSError):
            os.utime(self.lock_path)

    def unlock(self) -> None:
        """Release the folder."""
        self.lock_path.unlink(missing_ok=True)


def _lives(pid: int, started: int, place: str, record: Path) -> bool:
    """Tell whether the process that a file names lives, by the file's age if it is elsewhere."""
    if is_here(place):
        return owner_alive(pid, started)
    try:
        return seconds_since_written(record) < limits.SILENT_S
    except OSError:
        return False
