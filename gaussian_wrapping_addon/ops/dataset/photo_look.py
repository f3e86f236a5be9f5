# SPDX-License-Identifier: GPL-3.0-or-later
"""Let the worker look at the photos in the background: blur, exposure, duplicates, coverage."""

from __future__ import annotations

import json
from typing import Any

import bpy

from ...core.errors import WrapError
from ...core.jobs.client import worker_python
from ...core.processes.helper_process import child_command
from ..common import estimate_child, tags
from ..common.addon import properties_of
from ..common.background import Lane
from ..common.estimate_child import Child
from ..common.redrawing import redraw
from ..jobs.scene_folders import source_of
from ..worker.preferred_worker import WorkerChoice

MODULE = "jobs.commands.photo_check_command"
DEADLINE_S = 1800.0
MAX_ROWS = 20
MAX_TEXT = 600

_looks = Lane(of_file=True)


def is_busy() -> bool:
    """Return whether the worker is looking at photos."""
    return _looks.busy


def get_ready() -> None:
    """Start the threads of the next look ahead of a timer that starts it."""
    _looks.start()
    estimate_child.get_ready()


def start(scene: bpy.types.Scene, choice: WorkerChoice) -> None:
    """Start to look at a scene's photos; findings are added to those of the check.

    Without a worker nothing is looked at: the panel says that there is none.
    """
    stop()
    try:
        python = worker_python(choice.python)
        request = {"source": str(source_of(scene)), "threads": choice.threads}
    except WrapError:
        return
    command = child_command(MODULE, json.dumps(request), python=python)
    uid, chosen, child = scene.session_uid, properties_of(scene).source, Child()

    def keep(rows: list[dict[str, str]]) -> None:
        scene = tags.scene_of_uid(uid)
        if scene is not None and properties_of(scene).source == chosen:
            for values in rows[:MAX_ROWS]:
                row = properties_of(scene).findings.add()
                for name, text in values.items():
                    setattr(row, name, text[:MAX_TEXT])
        redraw()

    _looks.submit(
        lambda: rows_of(*child.run(command, DEADLINE_S)),
        keep,
        failed=lambda error: keep([_row("warning", f"The photos were not looked at: {error}")]),
        end=child.end,
    )


def rows_of(messages: list[dict[str, Any]], last_words: str = "") -> list[dict[str, str]]:
    """Return the rows for the panel of what the worker wrote.

    Parameters
    ----------
    messages : list of dict
        ``{"finding": {"severity", "message", "hint"}}``, or ``{"error", "hint", "extras"}``.
    last_words : str
        The last line of the worker's standard error, shown if there is nothing else.
    """
    rows = []
    for values in messages:
        finding = values.get("finding")
        if isinstance(finding, dict):
            severity = str(finding.get("severity", "fact"))
            rows.append(_row(severity, str(finding.get("message")), str(finding.get("hint", ""))))
        if values.get("error"):
            extras = values.get("extras")
            names = [str(name) for name in extras] if isinstance(extras, list) else []
            text, hint = str(values["error"]), str(values.get("hint", ""))
            rows.append({**_row("error", text, hint), "extra": ",".join(names)})
    if not messages:
        rows.append(_row("warning", f"The photos were not looked at: {last_words or 'no answer'}."))
    return rows


def _row(severity: str, message: str, hint: str = "") -> dict[str, str]:
    return {"severity": severity, "message": message, "hint": hint}


def stop() -> None:
    """Cancel a look and end its process."""
    _looks.cancel()
