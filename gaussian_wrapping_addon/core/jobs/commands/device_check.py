# SPDX-License-Identifier: GPL-3.0-or-later
"""Check in the worker's Python that a job gets the GPU it names, before the job is written.

The child writes one JSON object to stdout: ``{"device"}``, or ``{"error", "hint"}``.
"""

from __future__ import annotations

from ...devices import choose_device, reject_absent_gpu
from ...errors import DeviceError, WorkerError, WrapError
from ...worker.helper_process import child_command, emit
from ..client import worker_python
from .doctor import answers_of


def require_device(setting: str) -> None:
    """Raise where a setting names a GPU that this machine or the worker's Python cannot use.

    The driver is asked first, at once and without a process. Other settings are not looked at.
    Raises DeviceError: says why; WorkerError: the worker's Python does not answer.
    """
    if not setting.startswith("cuda"):
        return
    reject_absent_gpu(setting)
    python = worker_python()
    command = child_command("jobs.commands.device_check", setting, python=python)
    answers, said = answers_of(command, python, "Run batch.py doctor.")
    for values in reversed(answers):
        if "error" in values:
            raise DeviceError(str(values["error"]), str(values.get("hint", "")))
        if "device" in values:
            return
    raise WorkerError(
        f"The check of the device {setting} ended without a result: {said}.",
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
