# SPDX-License-Identifier: GPL-3.0-or-later
"""Register the add-on, unregister it in reverse order, robust against earlier failures."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Final

import bpy

from . import batch
from .ops import cli_command
from .ops.cameras import camera_operators
from .ops.common import background
from .ops.computers import computers_operators, farm_calls, part_watch
from .ops.dataset import input_operators
from .ops.export import export_operators
from .ops.jobs import job_attach, job_operators, job_timer, live_points, live_preview
from .ops.masks import mask_operators, mask_review
from .ops.meshing import bake_operators, region_estimate, region_list_operators
from .ops.placement import placement, placement_operators
from .ops.presets import preset_operators
from .ops.regions import region_operators, region_watch
from .ops.results import import_operators, report_operators
from .ops.training import training_estimate, training_operators
from .ops.worker import worker_check_operators, worker_setup, worker_setup_operators
from .ui import preferences, properties
from .ui.baking import bake_panel, bake_properties
from .ui.computers import computers_panel, computers_properties
from .ui.dataset import dataset_panel
from .ui.jobs import points_drawing, status_bar
from .ui.meshing import mesh_panel, texture_panel
from .ui.placement import scene_panel
from .ui.presets import preset_menu
from .ui.regions import region_drawing, region_gizmo, region_panel, region_properties
from .ui.results import report_panel, result_panel
from .ui.training import train_advanced_panel, train_panel, training_properties
from .ui.translations import table

_logger = logging.getLogger(__name__)

CLASSES: Final[tuple[type, ...]] = (
    *training_properties.CLASSES,
    *bake_properties.CLASSES,
    *computers_properties.CLASSES,
    *properties.CLASSES,
    *region_properties.CLASSES,
    *preferences.CLASSES,
    *input_operators.CLASSES,
    *worker_setup_operators.CLASSES,
    *job_operators.CLASSES,
    *worker_check_operators.CLASSES,
    *region_operators.CLASSES,
    *region_list_operators.CLASSES,
    *mask_operators.CLASSES,
    *bake_operators.CLASSES,
    *computers_operators.CLASSES,
    *import_operators.CLASSES,
    *export_operators.CLASSES,
    *camera_operators.CLASSES,
    *placement_operators.CLASSES,
    *report_operators.CLASSES,
    *training_operators.CLASSES,
    *preset_operators.CLASSES,
    *preset_menu.CLASSES,
    *dataset_panel.CLASSES,
    *train_panel.CLASSES,
    *train_advanced_panel.CLASSES,
    *computers_panel.CLASSES,
    *region_panel.CLASSES,
    *mesh_panel.CLASSES,
    *texture_panel.CLASSES,
    *bake_panel.CLASSES,
    *result_panel.CLASSES,
    *region_gizmo.CLASSES,
    *report_panel.CLASSES,
    *scene_panel.CLASSES,
)

HANDLERS: Final[tuple[tuple[str, Callable[..., None]], ...]] = (
    ("load_pre", background.before_load),
    ("load_post", job_attach.after_load),
    ("load_post", placement.after_load),
    ("load_post", region_watch.after_load),
    ("undo_post", job_attach.after_undo),
    ("redo_post", job_attach.after_undo),
    ("undo_post", placement.after_undo),
    ("redo_post", placement.after_undo),
    ("undo_post", region_watch.after_load),
    ("redo_post", region_watch.after_load),
    ("depsgraph_update_post", region_watch.after_update),
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
        region_drawing.VIEW.start()
        points_drawing.VIEW.start()
        status_bar.start()
        cli_command.register(batch.main)
        # While Blender starts, scripts may not see the open file yet.
        background.watch(job_attach.attach_later)
    except Exception:
        unregister()
        raise


def unregister() -> None:
    """Unregister everything that is registered; workers continue and are found again."""
    worker_setup.stop()
    training_estimate.forget()
    region_estimate.stop()
    region_drawing.VIEW.stop()
    points_drawing.VIEW.stop()
    status_bar.stop()
    region_gizmo.stop()
    region_watch.forget()
    job_timer.forget_all()
    live_preview.stop()
    mask_review.stop()
    live_points.stop()
    part_watch.stop()
    farm_calls.stop()
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
