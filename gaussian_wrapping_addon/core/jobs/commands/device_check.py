# SPDX-License-Identifier: GPL-3.0-or-later
"""Check in the worker's Python that a job gets the GPU it names, before the job is written.

The child writes one JSON object to stdout: ``{"device"}``, or ``{"error", "hint"}``.
"""

from __future__ import annotations

import subprocess

from ...devices import choose_device, reject_absent_gpu
from ...errors import DeviceError, WorkerError, WrapError
from ...worker.environment import not_started
from ...worker.helper_process import child_command, emit, json_object, last_line
from ...worker.spawn import run_to_end
from ..client import worker_python

CHECK_DEADLINE_S = 120.0


def require_device(setting: str) -> None:
    """Raise where a setting names a GPU that this machine or the worker's Python cannot use.

    The driver is asked first, at once and without a process. Other settings are not looked at.
    Raises DeviceError: says why; WorkerError: the worker's Python does not answer.
    """
    if not setting.startswith("cuda"):
        return
    reject_absent_gpu(setting)
    python = worker_python()
    try:
        command = child_command("jobs.commands.device_check", setting, python=python)
        _, output, error_output = run_to_end(command, CHECK_DEADLINE_S)
    except OSError as error:
        raise not_started(python, error) from None
    except subprocess.TimeoutExpired:
        raise WorkerError(f"{python} does not answer.", "Run batch.py doctor.") from None
    for line in reversed(output.splitlines()):
        values = json_object(line) or {}
        if "error" in values:
            raise DeviceError(str(values["error"]), str(values.get("hint", "")))
        if "device" in values:
            return
    raise WorkerError(
        f"The check of the device {setting} ended without a result: {last_line(error_output)}.",
        "Run batch.py doctor to check the worker's Python.",
    )


def main(arguments: list[str]) -> int:
    """Choose the device of ``arguments = [setting]`` as a job does; return the exit code."""
    try:
        emit(device=choose_device(arguments[0]).device)
    except WrapError as error:
        emit(error=error.message, hint=error.hint)
        return error.exit_code
    return 0
