# SPDX-License-Identifier: GPL-3.0-or-later
"""Check the worker's Python in the background."""

from __future__ import annotations

from pathlib import Path

from ...core.jobs.commands.doctor import Diagnosis, find_and_diagnose
from ..common.background import Lane
from ..common.redrawing import redraw

_checks = Lane()
_findings: list[Diagnosis] = []


def findings() -> tuple[Diagnosis, ...]:
    """Return the findings of the last check."""
    return tuple(_findings)


def is_busy() -> bool:
    """Return whether a check is running."""
    return _checks.busy


def as_text() -> str:
    """Return the findings for a bug report, with the home folder masked."""
    lines = [
        f"good {f.subject}: {f.finding}" if f.good else f"BAD  {f.subject}: {f.finding} {f.hint}"
        for f in _findings
    ]
    return "\n".join(lines).replace(str(Path.home()), "~")


def start(preference: str) -> None:
    """Start a check of the interpreter that jobs would use."""
    stop()
    _findings.clear()
    _checks.submit(lambda: find_and_diagnose(preference), _keep, failed=_keep_failure)


def _keep(found: list[Diagnosis]) -> None:
    _findings[:] = found
    redraw("PREFERENCES")


def _keep_failure(error: Exception) -> None:
    _keep([Diagnosis("Python", False, f"{type(error).__name__}: {error}", "")])


def stop() -> None:
    """Cancel a running check."""
    _checks.cancel()
