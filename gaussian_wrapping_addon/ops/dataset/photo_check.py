# SPDX-License-Identifier: GPL-3.0-or-later
"""Check an input in the background and store the findings in its scene."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import bpy

from ...core.dataset.loading.source_kind import WITHOUT_PHOTOS
from ...core.errors import WrapError
from ...core.jobs.client import worker_if_any
from ..common import tags
from ..common.addon import properties_of
from ..common.background import Lane
from ..common.redrawing import redraw
from ..jobs import panel_state
from ..jobs.scene_folders import source_of
from ..training import training_estimate
from ..worker.preferred_worker import WorkerChoice, worker_choice
from . import photo_look

if TYPE_CHECKING:
    from ...core.dataset.loading.check import Finding

_logger = logging.getLogger(__name__)

_checks = Lane(of_file=True)


def is_busy() -> bool:
    """Return whether a check is running."""
    return _checks.busy


def check_now(scene: bpy.types.Scene, python: str = "") -> None:
    """Check a scene's input and store the findings; blocks Blender.

    Parameters
    ----------
    python : str
        The worker's Python in the preferences, which opens videos.

    Raises
    ------
    UsageError
        No input is chosen.
    """
    from ...core.dataset.loading.check import check_input

    stop()
    found = check_input(source_of(scene), worker=worker_if_any(python), panoramas=_panoramas(scene))
    _keep(scene, found)


def start(scene: bpy.types.Scene, choice: WorkerChoice | None = None, *, python: str = "") -> None:
    """Begin to check a scene's input.

    Parameters
    ----------
    choice : WorkerChoice, optional
        If there are no errors, request an estimate of the training from this worker.
    python : str
        As for :func:`check_now`.

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
    photo_look.get_ready()
    if choice is not None:
        training_estimate.get_ready()
    looks_with = choice or worker_choice(bpy.context)
    panoramas = _panoramas(scene)
    uid, chosen = scene.session_uid, properties_of(scene).source

    def keep(found: list[Finding]) -> None:
        scene = tags.scene_of_uid(uid)
        if scene is not None and properties_of(scene).source == chosen:
            _keep(scene, found)
            has_photos = properties_of(scene).checked_kind not in WITHOUT_PHOTOS
            if has_photos and not panel_state.has_errors(scene):
                photo_look.start(scene, looks_with)
            if choice is not None:
                _estimate(scene, choice)
        redraw()

    def keep_failure(error: Exception) -> None:
        _logger.error("checking %s", source, exc_info=error)
        text = f"{type(error).__name__}: {error}"
        keep([Finding("error", text, "See the system console.")])

    def check() -> list[Finding]:
        return check_input(source, worker=worker_if_any(python), panoramas=panoramas)

    _checks.submit(check, keep, failed=keep_failure)


def _panoramas(scene: bpy.types.Scene) -> str:
    return str(properties_of(scene).training.equirectangular).lower()


def _keep(scene: bpy.types.Scene, found: list[Finding]) -> None:
    properties = properties_of(scene)
    properties.findings.clear()
    properties.checked_source = properties.source
    properties.checked_text = ", ".join(f.short for f in found if f.short)
    properties.checked_kind = next((f.kind for f in found if f.kind), "")
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
    photo_look.stop()
