# SPDX-License-Identifier: GPL-3.0-or-later
"""Actions of the panel "Computers" as plain functions."""

from __future__ import annotations

import bpy

from ...core.cluster.addresses import scheduler_address
from ...core.errors import UsageError
from ..common.addon import properties_of
from ..jobs.watched_jobs import key_of
from ..worker.preferred_worker import WorkerChoice
from . import dask_doctor


def shown_folder(scene: bpy.types.Scene) -> str:
    """Return the folder of the job whose parts a scene shows; ``""`` for none."""
    return key_of(properties_of(scene).job_folder)


def test_computers(scene: bpy.types.Scene, choice: WorkerChoice) -> None:
    """Ask in the background whether the chosen computers can be used.

    Raises
    ------
    WrapError
        The address or a folder cannot be used, or no worker is set up on this computer.
    """
    address = scheduler_address(properties_of(scene).computers.dask_address)
    if not address.is_this_computer and not bpy.app.online_access:
        raise UsageError(
            "Blender may not go online.", "Turn on Allow Online Access in Preferences, System."
        )
    dask_doctor.start(scene, address, choice)
