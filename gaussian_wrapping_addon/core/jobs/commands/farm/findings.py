# SPDX-License-Identifier: GPL-3.0-or-later
"""What ``farm doctor`` asks of a computer: versions, memory, devices, and the shared folder.

Runs on a Dask worker as the parts of a job do, as a child process of the worker's Python. Its last
line is ``{"answer": {...}}``.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
import secrets
import shutil
import threading
from pathlib import Path
from typing import Any

from ....errors import EXIT_OTHER, WrapError
from ....machine import processor_count, total_memory_bytes
from ....processes.helper_process import emit
from ....processes.parent_death import end_with_parent
from ...parts.code_version import code_version
from ..doctor import Diagnosis, diagnose

MODULE = "jobs.commands.farm.findings"
COMPARED = ("torch", "numpy")
"""Packages that must have the same version on all computers: results depend on them."""
_MAX_TOKEN_BYTES = 100


def main(arguments: list[str]) -> int:
    """Answer for ``arguments = [{"out", "token", "reply", "deadline_s"} as JSON]``.

    ``token`` and ``reply`` are names of files in ``out``, to be read and to be written; empty where
    the shared folder is not seen.
    """
    end_with_parent()
    request = json.loads(arguments[0])
    late = threading.Timer(float(request["deadline_s"]), os._exit, (EXIT_OTHER,))
    late.daemon = True  # nobody waits for the answer any more
    late.start()
    out = Path(request["out"])
    answer = {**_exchanged(out, request), **versions(), **_findings(out)}
    emit(answer=answer)
    return 0


def versions() -> dict[str, str]:
    """Return the version of the program, of Python and of the packages that are compared."""
    found = {"code": code_version(), "python": platform.python_version()}
    for name in COMPARED:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = ""
    return found


def _exchanged(out: Path, request: dict[str, Any]) -> dict[str, str]:
    """Read the token that was written elsewhere, and write one of our own."""
    if not request["token"]:
        return {}
    try:
        with (out / request["token"]).open("rb") as stream:
            token = stream.read(_MAX_TOKEN_BYTES).decode(errors="replace")
        reply = secrets.token_hex(16)
        (out / request["reply"]).write_text(reply, encoding="ascii")
    except OSError as error:
        return {"folder_error": f"{error.strerror or error}: {error.filename or out}"}
    return {"token": token, "reply": reply}


def _findings(out: Path) -> dict[str, Any]:
    try:
        found = diagnose(str(out))
    except (WrapError, OSError) as error:  # the version and the folder are told all the same
        found = [Diagnosis("Worker", False, f"{error}", "Install the add-on there again.")]
    gpus = [f.finding.split(",")[0] for f in found if re.fullmatch(r"GPU \d+", f.subject)]
    return {
        "cores": processor_count(), "memory_bytes": total_memory_bytes(),
        "gpu": gpus[0] if gpus else "", "free_bytes": shutil.disk_usage(out).free,
        "bad": [[f"{f.subject}: {f.finding}", f.hint] for f in found if not f.good],
    }  # fmt: skip
