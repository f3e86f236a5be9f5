# SPDX-License-Identifier: GPL-3.0-or-later
"""A failed job puts back what was there; results are swapped whole."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from ...errors import DatasetError, ParseError, UsageError
from ...files import is_real_folder, read_json, write_json
from .job_file import JobFile, read_job, write_job
from .job_folder import JobFolder, JobStatus
from .stage_folder import read_done

# -- Replace a job's result all at once, or not at all --------------------------------------------
#
# A new result is written to a subfolder of the result folder until it is complete: on the same
# disk, so that replacing takes renames only. Region names contain no dot.

_logger = logging.getLogger(__name__)

NEW = ".new"
"""Subfolder of the result folder in which a new result is written."""
EARLIER = ".earlier"
"""Subfolder of the result folder that holds the replaced files during the swap."""


@contextmanager
def new_result(result: Path, last: tuple[str, ...] = ()) -> Iterator[Path]:
    """Yield an empty folder for the new result; move its content into place when the block ends.

    Each entry of the folder replaces the one of its name in ``result``, those in ``last`` after the
    others, which they describe. If the block or the swap raises, the result is unchanged.
    """
    begun = not result.exists()
    result.mkdir(exist_ok=True)
    recover(result)
    new = result / NEW
    new.mkdir()
    try:
        yield new
        _swap(new, result, last)
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if begun:
            with contextlib.suppress(OSError):  # not empty: it is the result
                result.rmdir()


def recover(result: Path) -> None:
    """Undo an interrupted swap: restore the earlier files and remove the new ones."""
    earlier = result / EARLIER
    if is_real_folder(earlier):
        _logger.warning("an earlier export was interrupted; the previous result is restored")
        for path in sorted(earlier.iterdir()):
            _remove(result / path.name)
            os.replace(path, result / path.name)
        earlier.rmdir()
    elif os.path.lexists(earlier):
        _remove(earlier)  # not ours: its content is not a result
    _remove(result / NEW)


def _swap(new: Path, result: Path, last: tuple[str, ...]) -> None:
    """Rename all entries of ``new`` into ``result``; after an error, rename them back."""
    earlier = result / EARLIER
    earlier.mkdir()
    names = sorted((path.name for path in new.iterdir()), key=lambda name: (name in last, name))
    moved: list[tuple[Path, Path]] = []

    def move(source: Path, target: Path) -> None:
        os.replace(source, target)
        moved.append((source, target))

    try:
        for name in names:
            if os.path.lexists(result / name):
                move(result / name, earlier / name)
            move(new / name, result / name)
    except BaseException:
        for source, target in reversed(moved):
            os.replace(target, source)
        earlier.rmdir()
        raise
    # Swap complete: rename the old files before deleting, so that recover() ignores leftovers.
    old = result / f"{NEW}{EARLIER}"
    _remove(old)
    os.replace(earlier, old)
    shutil.rmtree(old, ignore_errors=True)


def _remove(path: Path) -> None:
    if is_real_folder(path):
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# -- Roll a job folder back to its finished job when meshing it again, or a bake, fails -----------
#
# A file beside ``job.json`` keeps the finished job while ``mesh`` or ``bake`` runs, and is
# removed when that is done. If it fails, job and status of the finished job are restored and the
# stages it began are removed. A cancelled one can be resumed, as any job.

NAME = "job-finished.json"


def save_rollback(folder: JobFolder, job: JobFile) -> None:
    """Save the state of a folder before ``job`` is written there.

    Of several meshes in a row that did not finish, the state before the first is kept: if the last
    one fails, the stages begun by the others are removed as well. Commands that train change the
    result itself: nothing is saved.
    """
    path = folder.root / NAME
    if job.command not in ("mesh", "bake"):
        path.unlink(missing_ok=True)
        return
    status = folder.read_status()
    if status.state != "DONE":
        return  # an earlier rollback file, with its list of stages, stays valid
    try:
        finished = read_job(folder.job_path)
    except (UsageError, ParseError):
        path.unlink(missing_ok=True)
        return  # nothing to restore
    without_error = replace(status, error="", hint="", exit_code=0, put_back=False)
    stages = sorted(p.name for p in folder.stages.iterdir())
    write_json(path, {"job": finished.to_json(), "status": asdict(without_error), "stages": stages})


def finished_job(folder: JobFolder) -> JobFile:
    """Return the job that produced a folder's result, not one whose mesh is unfinished.

    Raises UsageError, ParseError: there is no job.
    """
    saved = _read(folder.root / NAME)
    if saved is None or folder.read_status().state == "DONE":
        return read_job(folder.job_path)
    return JobFile.from_json(saved["job"])


def discard_rollback(folder: JobFolder) -> None:
    """Delete the saved state: the current job is the finished one."""
    (folder.root / NAME).unlink(missing_ok=True)


def roll_back(folder: JobFolder) -> JobStatus | None:
    """Restore a folder to its state before a failed mesh; return its status at that time.

    Returns ``None`` if there was no finished job, or if another command failed.
    """
    saved = _read(folder.root / NAME)
    if saved is None:
        return None
    try:
        job = JobFile.from_json(saved["job"])
        status = JobStatus.from_json(saved["status"])
    except (UsageError, TypeError, ValueError):
        return None
    known = set(saved["stages"])
    for kind in ("mesh", "texture", "bake") if is_real_folder(folder.stages) else ():
        for stage in folder.stages.glob(f"{kind}-*"):
            if is_real_folder(stage) and stage.name not in known and read_done(stage) is None:
                shutil.rmtree(stage, ignore_errors=True)
    for files in (folder.result, folder.baked):
        if is_real_folder(files):
            recover(files)
    write_job(folder.job_path, job)
    discard_rollback(folder)
    _logger.info("the job was restored to its state before this mesh")
    # The folder may be a copy whose status names the original's path.
    return replace(status, result=str(folder.result) if status.result else "")


def _read(path: Path) -> dict[str, Any] | None:
    try:
        values = read_json(path)
    except (OSError, ParseError):
        return None
    wanted = {"job": dict, "status": dict, "stages": list}
    if not isinstance(values, dict) or set(values) != set(wanted):
        return None
    if not all(isinstance(values[name], kind) for name, kind in wanted.items()):
        return None
    return values if all(isinstance(stage, str) for stage in values["stages"]) else None


# -- Continue the training of a finished job from its last checkpoint -----------------------------

_CHECKPOINT = re.compile(r"checkpoint-(\d{1,9})\.json")
_INSTEAD = "Train anew instead: run wrap with the total number of --iterations."


def continue_training_job(folder: JobFolder, job: JobFile, iterations: int) -> JobFile:
    """Return the job that trains ``job`` for more iterations, then meshes again.

    Raises UsageError: not a positive number; DatasetError: no finished training, or no checkpoint.
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

    ``base_key``: hash of everything that the stage's key depends on except the extra iterations.
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
    """Link checkpoints of a finished stage into a new one, and ``others`` that exist; else copy.

    Files of a stage are replaced, never modified, so that a link cannot change its source.
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
