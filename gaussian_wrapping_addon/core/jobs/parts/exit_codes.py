# SPDX-License-Identifier: GPL-3.0-or-later
"""Exit codes of ``run-part``: what an engine may do with a part that is not done."""

from __future__ import annotations

from ...cluster import child
from ...errors import EXIT_CANCELLED, EXIT_DONE, EXIT_RESOURCES, DeviceError, WorkerError, WrapError

DONE = EXIT_DONE
NEVER = 1
"""Bad data: it fails wherever it is run."""
MAY_WORK_ELSEWHERE = 2
"""Memory, disk, a device, a killed helper: elsewhere or later it may work."""
OTHER_CODE = child.OTHER_CODE
"""This computer has another version of the program than the one that planned."""
CANCELLED = EXIT_CANCELLED


def part_exit_code(error: WrapError) -> int:
    """Return the exit code of a part that ended with an error."""
    if error.exit_code == EXIT_CANCELLED:
        return CANCELLED
    elsewhere = error.exit_code == EXIT_RESOURCES or isinstance(error, WorkerError | DeviceError)
    return MAY_WORK_ELSEWHERE if elsewhere else NEVER
