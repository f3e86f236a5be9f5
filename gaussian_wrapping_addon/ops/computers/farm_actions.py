# SPDX-License-Identifier: GPL-3.0-or-later
"""Actions of the panel "Computers" as plain functions."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ...core.cluster.addresses import Address, scheduler_address
from ...core.errors import UsageError
from ...core.farm.address import parse_address
from ...core.farm.flamenco import job_state
from ...core.farm.flamenco.job_record import read_record, submitted
from ...core.farm.flamenco.job_state import FarmState
from ...core.farm.flamenco.manager import Manager
from ...core.farm.flamenco.submission import Choices, Farm, Submission, ask_farm, submit
from ...core.files import real_path
from ...core.jobs.client import prepare_job
from ...core.jobs.parts.planning import plan_if_missing
from ...core.jobs.store.job_file import make_job
from ...core.settings import with_values
from ..common import known_jobs, tags
from ..common.addon import properties_of
from ..common.translate import tr
from ..jobs.job_actions import refuse_running
from ..jobs.panel_settings import job_settings
from ..jobs.scene_folders import output_of, source_of
from ..jobs.watched_jobs import key_of
from ..worker.preferred_worker import WorkerChoice
from . import dask_doctor, farm_calls, part_watch

_folders: dict[int, str] = {}
"""Job folders submitted in this session, by the session uid of their scene: undo keeps these."""


def shown_folder(scene: bpy.types.Scene) -> str:
    """Return the folder of the job whose parts a scene shows; ``""`` for none."""
    properties = properties_of(scene)
    choices = properties.computers
    submitted_folder = choices.folder if choices.kind == "FLAMENCO" else ""
    return key_of(submitted_folder or properties.job_folder)


def farm_choices(scene: bpy.types.Scene) -> Choices:
    """Return how jobs of a scene are submitted.

    Raises
    ------
    UsageError
        The shared folder is named by its server.
    """
    choices = properties_of(scene).computers
    shared = bpy.path.abspath(choices.shared) if choices.shared else ""
    if shared and known_jobs.is_remote(Path(shared)):  # of a .blend from elsewhere, any server
        raise UsageError(f"{shared} names a server.", "Give the shared folder a drive letter.")
    return Choices(choices.priority, choices.tag.strip(), shared)


def manager_of(scene: bpy.types.Scene) -> Manager:
    """Return the Manager that a scene names.

    Raises
    ------
    UsageError
        It names none, or Blender may not go there.
    """
    address = parse_address(properties_of(scene).computers.flamenco_address)
    _require_access(address)
    return Manager(address)


def test_computers(scene: bpy.types.Scene, choice: WorkerChoice) -> None:
    """Ask in the background whether the chosen computers can be used.

    Raises
    ------
    WrapError
        The address or a folder cannot be used, or no worker is set up on this computer.
    """
    choices = properties_of(scene).computers
    if choices.kind == "DASK":
        address = scheduler_address(choices.dask_address)
        _require_access(address)
        dask_doctor.start(scene, address, choice)
        return
    manager, chosen = manager_of(scene), farm_choices(scene)
    farm_calls.call(choices.flamenco_address, lambda: ask_farm(manager, chosen), _found)


def _found(farm: Farm) -> tuple[str, ...]:
    return (
        tr("Flamenco {version} has the job type.", version=farm.version),
        tr("Shared folder on this computer: {folder}", folder=farm.shared),
        *farm.notes,
    )


def submit_scene(scene: bpy.types.Scene) -> Path:
    """Write and submit the job of a scene's photos in the background; return its folder.

    Raises
    ------
    WrapError
        The source, the output, the address or a setting cannot be used.
    """
    properties = properties_of(scene)
    address = properties.computers.flamenco_address
    manager, chosen = manager_of(scene), farm_choices(scene).validated()
    source = source_of(scene)
    folder = output_of(scene, source)
    refuse_running(folder)
    tiles = properties.computers.tiles
    settings = with_values(
        job_settings(scene, threads=0),  # threads and device are of the computers that run it
        {"meshing.tiles": "off" if tiles == 1 else str(tiles), "computers": "", "processes": 1},
    )
    job = make_job("wrap", source, settings)
    record = read_record(folder) if folder.is_dir() else None
    if record is not None:
        _require_access(record.address)  # it is asked whether that job is over
    uid = scene.session_uid

    def work() -> Submission:
        farm = ask_farm(manager, chosen)  # before anything is written
        target = prepare_job(folder, job)
        plan_if_missing(target)
        return submit(farm, target.root, chosen)

    def tell(done: Submission) -> tuple[str, ...]:
        known_jobs.remember(folder)
        shown = tags.scene_of_uid(uid)
        if shown is not None:
            properties_of(shown).output = properties_of(shown).computers.folder = str(folder)
            _folders[uid] = str(folder)
        farm_calls.keep_state(key_of(str(folder)), None)
        part_watch.refresh(key_of(str(folder)))
        return (tr("Submitted: {count} parts.", count=done.parts), *done.notes)

    farm_calls.call(address, work, tell)
    return folder


def update(scene: bpy.types.Scene) -> None:
    """Ask the Manager in the background how far the shown job is."""
    key, root = _shown(scene)
    record = submitted(root)
    _require_access(record.address)

    def tell(state: FarmState) -> tuple[str, ...]:
        farm_calls.keep_state(key, state)
        part_watch.refresh(key)
        return ()

    farm_calls.call(key, lambda: job_state.read_state(record), tell)


def cancel(scene: bpy.types.Scene) -> None:
    """Cancel the shown job in the background."""
    key, root = _shown(scene)
    record = submitted(root)
    _require_access(record.address)

    def tell(_nothing: None) -> tuple[str, ...]:
        farm_calls.keep_state(key, None)
        part_watch.refresh(key)
        return (tr("Cancelled. Retry continues it."),)

    farm_calls.call(key, lambda: job_state.cancel(root, record), tell)


def retry(scene: bpy.types.Scene) -> None:
    """Let failed and cancelled parts of the shown job run again."""
    key, root = _shown(scene)
    record = submitted(root)
    _require_access(record.address)

    def tell(_nothing: None) -> tuple[str, ...]:
        farm_calls.keep_state(key, None)
        part_watch.refresh(key)
        return (tr("Queued again."),)

    farm_calls.call(key, lambda: job_state.retry(root, record), tell)


@persistent
def after_undo(_scene: object = None, _unused: object = None) -> None:
    """``undo_post``, ``redo_post``: a scene keeps its submitted job; that is no undo step."""
    for uid, folder in _folders.items():
        scene = tags.scene_of_uid(uid)
        if scene is not None and properties_of(scene).computers.folder != folder:
            properties_of(scene).computers.folder = folder


def forget() -> None:
    """Forget which folders were submitted."""
    _folders.clear()


def _shown(scene: bpy.types.Scene) -> tuple[str, Path]:
    folder = shown_folder(scene)
    if not folder or not known_jobs.is_trusted(Path(folder)):
        raise UsageError(
            "The job folder that this file names was not used on this computer.",
            "Choose it with Find Job.",
        )
    return folder, real_path(folder)


def _require_access(address: Address) -> None:
    """Raise unless Blender may go online, or the address is of this computer."""
    if not address.is_this_computer and not bpy.app.online_access:
        raise UsageError(
            "Blender may not go online.", "Turn on Allow Online Access in Preferences, System."
        )
