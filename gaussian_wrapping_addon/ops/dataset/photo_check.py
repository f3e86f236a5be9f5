# SPDX-License-Identifier: GPL-3.0-or-later
"""Check an input in the background and store the findings in its scene."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import bpy

from ...core.errors import WrapError
from ..common import tags
from ..common.addon import properties_of
from ..common.background import Lane
from ..common.redrawing import redraw
from ..jobs import panel_state
from ..jobs.scene_folders import source_of
from ..training import training_estimate
from ..worker.preferred_worker import WorkerChoice

if TYPE_CHECKING:
    from ...core.dataset.loading.check import Finding

_logger = logging.getLogger(__name__)

_checks = Lane(of_file=True)


def is_busy() -> bool:
    """Return whether a check is running."""
    return _checks.busy


def check_now(scene: bpy.types.Scene) -> None:
    """Check a scene's input and store the findings; blocks Blender.

    Raises
    ------
    UsageError
        No input is chosen.
    """
    from ...core.dataset.loading.check import check_input

    stop()
    _keep(scene, check_input(source_of(scene)))


def start(scene: bpy.types.Scene, choice: WorkerChoice | None = None) -> None:
    """Begin to check a scene's input.

    Parameters
    ----------
    choice : WorkerChoice, optional
        If there are no errors, request an estimate of the training from this worker.

    Raises
    ------
    UsageError
        No input is chosen.
    """
    from ...core.dataset.loading.check import (  # imported here: threads import nothing
        Finding,
        check_input,
    )

    source = source_of(scene)
    stop()
    if choice is not None:
        training_estimate.get_ready()
    uid, chosen = scene.session_uid, properties_of(scene).source

    def keep(found: list[Finding]) -> None:
        scene = tags.scene_of_uid(uid)
        if scene is not None and properties_of(scene).source == chosen:
            _keep(scene, found)
            if choice is not None:
                _estimate(scene, choice)
        redraw()

    def keep_failure(error: Exception) -> None:
        _logger.error("checking %s", source, exc_info=error)
        text = f"{type(error).__name__}: {error}"
        keep([Finding("error", text, "See the system console.")])

    _checks.submit(lambda: check_input(source), keep, failed=keep_failure)


def _keep(scene: bpy.types.Scene, found: list[Finding]) -> None:
    properties = properties_of(scene)
    properties.findings.clear()
    properties.checked_source = properties.source
    properties.checked_text = ", ".join(f.short for f in found if f.short)
    for finding in found:
        row = properties.findings.add()
        row.severity = finding.severity
        row.message = finding.message
        row.hint = finding.hint


def _estimate(scene: bpy.types.Scene, choice: WorkerChoice) -> None:
    if panel_state.has_errors(scene):
        return
    try:
        training_estimate.start(scene, choice)
    except WrapError as error:
        training_estimate.answer_with(scene, error)


def stop() -> None:
    """Cancel a running check."""
    _checks.cancel()
