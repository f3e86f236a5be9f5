# SPDX-License-Identifier: GPL-3.0-or-later
"""Check each worker of a Dask cluster in the background, by a process of the worker's Python."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import bpy

from ...core.cluster.addresses import Address
from ...core.errors import UsageError, WorkerError
from ...core.files import real_path
from ...core.jobs.client import worker_python
from ...core.names import SHARED_VARIABLE
from ...core.processes.helper_process import child_command
from ..common.addon import properties_of
from ..common.estimate_child import Child
from ..common.translate import tr
from ..jobs.panel_settings import certificates_of
from ..jobs.scene_folders import output_of, source_of
from ..worker.preferred_worker import WorkerChoice
from . import farm_calls
from .farm_calls import Outcome

MODULE = "jobs.commands.farm.doctor"
LIMIT_S = 120.0
"""Within which each worker must answer."""
DEADLINE_S = LIMIT_S + 60.0
MAX_ROWS = 12
MAX_TEXT = 600


def start(scene: bpy.types.Scene, address: Address, choice: WorkerChoice) -> None:
    """Ask all workers of a scheduler in the background; the panel shows a row for each.

    Raises
    ------
    UsageError
        There is no folder to test, or the certificates are on another computer.
    WorkerError
        No worker is set up on this computer.
    """
    request = {
        "address": str(address), "certificates": certificates_of(scene),
        "folder": str(folder_of_jobs(scene)), "limit_s": LIMIT_S,
    }  # fmt: skip
    python = worker_python(choice.python)
    command, child = child_command(MODULE, json.dumps(request), python=python), Child()
    late = WorkerError("The test took too long.", "Look at the scheduler, then test again.")
    farm_calls.call(
        properties_of(scene).computers.dask_address,
        lambda: child.run(command, DEADLINE_S, late),
        lambda told: outcome_of(*told),
        end=child.end,
    )


def folder_of_jobs(scene: bpy.types.Scene) -> Path:
    """Return the folder that workers must see: where the scene's job is or will be written.

    Raises
    ------
    UsageError
        Neither photos nor the environment name one.
    """
    if properties_of(scene).source:
        folder = output_of(scene, source_of(scene))
    elif os.environ.get(SHARED_VARIABLE):
        folder = real_path(os.environ[SHARED_VARIABLE])
    else:
        raise UsageError(
            "No folder is known that all computers share.",
            f"Choose photos in it, or set {SHARED_VARIABLE}.",
        )
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    return folder


def outcome_of(messages: list[dict[str, Any]], last_words: str) -> Outcome:
    """Return what the panel shows of what the process has written.

    Parameters
    ----------
    messages : list of dict
        ``{"worker": {...}}`` for each worker, ``{"error", "hint"}``.
    last_words : str
        The last line of its standard error.
    """
    workers = [m["worker"] for m in messages if isinstance(m.get("worker"), dict)]
    errors = [m for m in messages if m.get("error")]
    rows = sorted((bool(w.get("good")), _sentence(w)) for w in workers)  # bad ones first
    if workers:
        good = sum(is_good for is_good, _ in rows)
        lines = [tr("{good} of {count} workers can be used.", good=good, count=len(rows))]
        return Outcome(good == len(rows), tuple(lines), tuple(rows[:MAX_ROWS]))
    if errors:
        texts = (str(errors[-1].get(key, ""))[:MAX_TEXT] for key in ("error", "hint"))
        return Outcome(False, tuple(filter(None, texts)))
    words = last_words[:MAX_TEXT] or "no output"
    return Outcome(False, (f"The test ended without a result: {words}.", "See Check Worker."))


def _sentence(worker: dict[str, Any]) -> str:
    name = str(worker.get("name", ""))[:MAX_TEXT]
    if not worker.get("good"):
        problems = worker.get("problems")
        told = " ".join(map(str, problems)) if isinstance(problems, list) else ""
        return f"{name}: {told}"[:MAX_TEXT]
    return tr(
        "{name}: {cores} cores, {memory} GiB, {gpu}",
        name=name, cores=worker.get("cores", 0), memory=worker.get("memory_gib", 0),
        gpu=str(worker.get("gpu") or tr("no GPU"))[:MAX_TEXT],
    )  # fmt: skip
