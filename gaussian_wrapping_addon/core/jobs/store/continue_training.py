# SPDX-License-Identifier: GPL-3.0-or-later
"""Continue the training of a finished job from its last checkpoint."""

from __future__ import annotations

import logging
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...errors import DatasetError, UsageError
from .job_file import JobFile
from .job_folder import JobFolder
from .stage_folder import read_done

_logger = logging.getLogger(__name__)

_CHECKPOINT = re.compile(r"checkpoint-(\d{1,9})\.json")
_INSTEAD = "Train anew instead: run wrap with the total number of --iterations."


def continue_training_job(folder: JobFolder, job: JobFile, iterations: int) -> JobFile:
    """Return the job that trains ``job`` for more iterations, then meshes again.

    Raises
    ------
    UsageError
        The number is not positive.
    DatasetError
        The folder holds no finished training, or no checkpoint to continue from.
    """
    if iterations < 1:
        raise UsageError(f"--iterations {iterations} adds nothing.", "Give a positive number.")
    finished = [path for path in folder.stages.glob("train-*") if read_done(path) is not None]
    if not finished:
        raise no_finished_training(folder.root)
    if not any(checkpoints(path) for path in finished):
        raise DatasetError(
            f"The training in {folder.root} has no checkpoint to continue from.", _INSTEAD
        )
    training = job.settings.training
    longer = replace(training, extra_iterations=training.extra_iterations + iterations)
    settings = replace(job.settings, training=longer).validated()
    return replace(job, command="more", settings=settings, bake=None)


def checkpoints(folder: Path) -> list[Path]:
    """Return the JSON files of a stage's checkpoints, newest first."""
    found = [p for p in folder.glob("checkpoint-*.json") if _CHECKPOINT.fullmatch(p.name)]
    return sorted(found, key=lambda path: path.name, reverse=True)


def lineage(base_key: str, extra_iterations: int) -> dict[str, Any]:
    """Return the entry of ``done.json`` by which longer trainings find a finished one.

    Parameters
    ----------
    base_key : str
        Hash of everything that the stage's key depends on except the extra iterations.
    """
    return {"base": base_key, "extra_iterations": extra_iterations}


def shorter_training(stages: Path, base_key: str, extra_iterations: int) -> Path | None:
    """Return the longest finished training with a checkpoint that this one can continue, if any."""
    best: tuple[int, str, Path] | None = None
    for folder in stages.glob("train-*"):
        values = (read_done(folder) or {}).get("lineage")
        if not isinstance(values, dict) or values.get("base") != base_key:
            continue
        reached = values.get("extra_iterations")
        if not isinstance(reached, int) or reached >= extra_iterations or not checkpoints(folder):
            continue
        best = max(best or (-1, "", folder), (reached, folder.name, folder))
    return None if best is None else best[2]


def link_checkpoints(source: Path, target: Path, others: tuple[str, ...] = ()) -> None:
    """Link the checkpoints of a finished stage into a new one; copy them if links are unsupported.

    Files of a stage are replaced, never modified, so that a link cannot change its source.

    Parameters
    ----------
    others : tuple of str
        Further files to link, if they exist.
    """
    for path in reversed(checkpoints(source)):
        # The JSON file last: without it, the arrays are ignored.
        for one in (path.with_suffix(".npz"), path):
            _link(one, target / one.name)
    for name in others:
        if (source / name).is_file():
            _link(source / name, target / name)
    _logger.info("training continues from %s", source.name)


def _link(source: Path, target: Path) -> None:
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def no_finished_training(root: Path) -> DatasetError:
    """Return the error of a command that needs a finished training."""
    return DatasetError(f"{root} holds no finished training.", "Run wrap, or resume it, first.")


def nothing_to_continue(folder: JobFolder) -> DatasetError:
    """Return the error of a ``more`` job without a matching training."""
    return DatasetError(
        f"No finished training in {folder.root} fits this job's photos and settings and has a "
        "checkpoint.",
        _INSTEAD,
    )
