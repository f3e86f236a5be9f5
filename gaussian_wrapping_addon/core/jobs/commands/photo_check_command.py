# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of ``check`` that decodes photos, in the worker's Python.

The line of a finding has it as ``"finding"``, too.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from ...loading.photo_quality import photo_findings
from ...progress import Progress
from ...worker.helper_process import emit, emit_progress
from .run_in_worker import run_command


def main(arguments: list[str]) -> int:
    """Look at the photos of ``arguments = [request as JSON]``; return the exit code."""
    request = json.loads(arguments[0])
    return run_command(lambda: _look(Path(request["source"]), int(request["threads"])))


def _look(source: Path, threads: int) -> Iterator[str]:
    for finding in photo_findings(source, Progress("check", emit_progress), threads=threads):
        emit(finding=asdict(finding))
        yield f"{finding.severity}: {finding.message} {finding.hint}".rstrip()
    yield "fact: All photos were looked at."
