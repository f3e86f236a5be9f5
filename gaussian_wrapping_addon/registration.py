# SPDX-License-Identifier: GPL-3.0-or-later
"""Register the add-on, unregister it in reverse order, robust against earlier failures."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Final

import bpy

from . import batch
from .ops import (
    background,
    baking,
    cameras,
    cli_command,
    computers,
    dataset,
    export,
    job_timer,
    jobs,
    masks,
    meshing,
    placement,
    presets,
    region_operators,
    results,
    training,
    worker_setup,
)
from .ui import (
    computers_panel,
    dataset_panel,
    job_view,
    mesh_panel,
    preferences,
    properties,
    region_panel,
    result_panel,
    training_panel,
)
from .ui.translations import table

_logger = logging.getLogger(__name__)

CLASSES: Final[tuple[type, ...]] = (
    *training_panel.PROPERTIES, *mesh_panel.PROPERTIES, *computers_panel.PROPERTIES,
    *properties.CLASSES, *region_panel.PROPERTIES, *preferences.CLASSES, *dataset.CLASSES,
    *worker_setup.CLASSES, *jobs.CLASSES, *region_operators.CLASSES, *meshing.CLASSES,
    *masks.CLASSES, *baking.CLASSES, *computers.CLASSES, *results.CLASSES, *export.CLASSES,
    *cameras.CLASSES, *placement.CLASSES, *training.CLASSES, *presets.CLASSES,
    *dataset_panel.CLASSES, *training_panel.CLASSES, *computers_panel.CLASSES,
    *region_panel.CLASSES, *mesh_panel.CLASSES, *result_panel.CLASSES,
)  # fmt: skip

HANDLERS: Final[tuple[tuple[str, Callable[..., None]], ...]] = (
    ("load_pre", background.before_load),
    ("load_post", jobs.after_load),
    ("load_post", placement.after_load),
    ("load_post", region_operators.forget),
    ("undo_post", jobs.after_undo),
    ("redo_post", jobs.after_undo),
    ("undo_post", placement.after_undo),
    ("redo_post", placement.after_undo),
    ("undo_post", region_operators.forget),
    ("redo_post", region_operators.forget),
    ("depsgraph_update_post", region_operators.after_update),
)


def register() -> None:
    """Register everything; remnants of a failed earlier attempt are removed first."""
    unregister()
    try:
        table.use_context(CLASSES)
        for cls in CLASSES:
            bpy.utils.register_class(cls)
        properties.add_pointers()
        for name, handler in HANDLERS:
            getattr(bpy.app.handlers, name).append(handler)
        table.register()
        region_panel.VIEW.start()
        job_view.VIEW.start()
        job_view.start()
        cli_command.register(batch.main)
        # While Blender starts, scripts may not see the open file yet.
        background.watch(jobs.attach_later)
    except Exception:
        unregister()
        raise


def unregister() -> None:
    """Unregister everything that is registered; workers continue and are found again."""
    worker_setup.stop_setup()
    training.forget()
    meshing.stop()
    region_panel.VIEW.stop()
    job_view.VIEW.stop()
    job_view.stop()
    region_panel.stop()
    region_operators.forget()
    job_timer.forget_all_jobs()
    job_timer.stop()
    masks.stop()
    computers.stop()
    background.stop()  # last of these: what they end is ended by its threads
    cli_command.unregister()
    table.unregister()
    for name, handler in HANDLERS:
        handlers: list[Any] = getattr(bpy.app.handlers, name)
        while handler in handlers:
            handlers.remove(handler)
    properties.remove_pointers()
    for cls in reversed(CLASSES):
        if "bl_rna" not in cls.__dict__:  # gizmo groups lack ``is_registered``
            continue
        try:
            bpy.utils.unregister_class(cls)
        except RuntimeError:
            _logger.exception("cannot unregister %s", cls.__name__)
