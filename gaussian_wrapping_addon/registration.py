# SPDX-License-Identifier: GPL-3.0-or-later
"""Register and unregister everything, in order and back, whatever has failed before."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Final

import bpy

from .ops import (
    camera_operators,
    doctor,
    export_operators,
    import_operators,
    job_operators,
    job_timer,
    live_preview,
    placement,
    placement_operators,
    region_operators,
    report_operators,
    training_estimate,
    training_operators,
)
from .ui import (
    panels,
    preferences,
    properties,
    report_panel,
    scene_panel,
    training_panel,
    training_properties,
)

_logger = logging.getLogger(__name__)

CLASSES: Final[tuple[type, ...]] = (
    *training_properties.CLASSES,
    *properties.CLASSES,
    *preferences.CLASSES,
    *job_operators.CLASSES,
    *region_operators.CLASSES,
    *import_operators.CLASSES,
    *export_operators.CLASSES,
    *camera_operators.CLASSES,
    *placement_operators.CLASSES,
    *report_operators.CLASSES,
    *training_operators.CLASSES,
    *panels.CLASSES,
    *training_panel.CLASSES,
    *report_panel.CLASSES,
    *scene_panel.CLASSES,
)

HANDLERS: Final[tuple[tuple[str, Callable[..., None]], ...]] = (
    ("load_post", job_timer.after_load),
    ("load_post", placement.after_load),
    ("undo_post", job_timer.after_undo),
    ("redo_post", job_timer.after_undo),
    ("undo_post", placement.after_undo),
    ("redo_post", placement.after_undo),
)


def register() -> None:
    """Add everything; what an earlier, failed attempt left behind is taken out first."""
    unregister()
    try:
        for cls in CLASSES:
            bpy.utils.register_class(cls)
        properties.add_pointers()
        for name, handler in HANDLERS:
            getattr(bpy.app.handlers, name).append(handler)
        # While Blender starts, scripts may not see the open file yet.
        bpy.app.timers.register(job_timer.attach_later, first_interval=0.1, persistent=True)
    except Exception:
        unregister()
        raise


def unregister() -> None:
    """Take everything out, as far as it is there; workers go on and are found again."""
    job_timer.stop_timer()
    if bpy.app.timers.is_registered(job_timer.attach_later):
        bpy.app.timers.unregister(job_timer.attach_later)
    doctor.stop()
    training_estimate.stop()
    job_timer.forget_all()
    live_preview.stop()
    for name, handler in HANDLERS:
        handlers: list[Any] = getattr(bpy.app.handlers, name)
        while handler in handlers:
            handlers.remove(handler)
    properties.remove_pointers()
    for cls in reversed(CLASSES):
        if not getattr(cls, "is_registered", False):
            continue
        try:
            bpy.utils.unregister_class(cls)
        except RuntimeError:
            _logger.exception("cannot unregister %s", cls.__name__)
