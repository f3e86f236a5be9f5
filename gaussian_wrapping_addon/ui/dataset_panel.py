# SPDX-License-Identifier: GPL-3.0-or-later
"""Sub-panel Dataset, masks and their review."""

from __future__ import annotations

from typing import Any, Final

import bpy

from ..core.loading.source_kind import VIDEO
from ..core.worker.environment import EXTRAS
from ..ops import dataset, job_timer, masks, panel_settings
from ..ops.addon import properties_of, tr
from .panel_base import (
    Readiness,
    TabPanel,
    button,
    characters_of,
    draw_settings,
    plain,
    settings_in,
    wrapped_label,
)
from .worker_setup_view import draw_add_extra, draw_worker_missing

# -- Draws the buttons of masks, and the photo under review with its mask, from memory ------------


_PICTURE_SCALE = 12.0  # of an icon's size
_LONG_LABEL = 0.66  # of the width, for the longer of two labels


def draw_masks(layout: Any, characters: int) -> None:
    """Draw the making of masks, and their review where one is open."""
    row = layout.split(factor=_LONG_LABEL, align=True)
    row.operator("gwrap.masks_from_region", icon="MOD_MASK")
    row.operator("gwrap.review_masks", text="Review", icon="VIEWZOOM")
    if not masks.is_open():
        return
    mask, accepted, icon = masks.shown()
    box = layout.box()
    box.template_icon(icon_value=icon, scale=_PICTURE_SCALE)
    wrapped_label(box, mask.photo, characters - 4, icon="CHECKMARK" if accepted else "CANCEL")
    number, count, rejected = masks.place()
    text = tr(
        "{number} of {count}, {rejected} rejected", number=number, count=count, rejected=rejected
    )
    row = box.row(align=True)
    row.operator("gwrap.step_mask", text="", icon="TRIA_LEFT").by = -1
    row.label(text=text, translate=False)
    row.operator("gwrap.step_mask", text="", icon="TRIA_RIGHT").by = 1
    row = box.row(align=True)
    row.operator("gwrap.decide_mask", text="Accept", icon="CHECKMARK").accepted = True
    row.operator("gwrap.decide_mask", text="Reject", icon="CANCEL").accepted = False
    box.operator("gwrap.end_mask_review", icon="X")


# -- The sub-panel "Dataset": the photos, and what a check of them has found ----------------------


_MAX_FINDINGS: Final = 12
_ICONS: Final = {"error": "CANCEL", "warning": "ERROR"}


class GWRAP_PT_dataset(TabPanel, bpy.types.Panel):
    bl_label = "Dataset"

    def readiness(self, context: bpy.types.Context) -> Readiness:
        scene = context.scene
        if not properties_of(scene).source:
            return Readiness("No photos")
        if dataset.is_checking():
            return Readiness("Checking…", "SORTTIME")
        if not panel_settings.is_checked(scene):
            return Readiness("Not checked")
        if panel_settings.has_errors(scene):
            return Readiness("Cannot be used", "CANCEL")
        warned = any(f.severity == "warning" for f in properties_of(scene).findings)
        text = properties_of(scene).checked_text.partition(",")[0] or "Checked"
        return Readiness(text, "ERROR" if warned else "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        plain(layout)
        characters = characters_of(context)
        draw_worker_missing(layout, characters)
        if not properties.source:
            text = "Photos of one object from all sides, in a folder of their own, or a video."
            wrapped_label(layout, text, characters)
        column = layout.column()
        column.enabled = not job_timer.is_running(properties.job_folder)
        if properties.source:
            row = column.row(align=True)
            row.prop(properties, "source", text="")
            if panel_settings.primary_of(context) != "gwrap.choose_input":
                row.operator("gwrap.choose_input", text="", icon="FILE_FOLDER")
        if panel_settings.primary_of(context) == "gwrap.choose_input":
            text = "Choose Other Photos" if properties.source else "Choose Photos"
            button(column, context, "gwrap.choose_input", text=text, icon="FILE_FOLDER")
        if properties.source and not panel_settings.is_checked(context.scene):
            text = "Checking…" if dataset.is_checking() else "Check Photos"
            layout.operator("gwrap.check_photos", text=text, icon="VIEWZOOM")
        elif properties.source:
            self._findings(layout, context, characters)
            if properties.checked_kind == VIDEO:
                rows = layout.column()
                rows.enabled = column.enabled
                draw_settings(rows, properties, settings_in("dataset"))

    def _findings(self, layout: Any, context: bpy.types.Context, characters: int) -> None:
        properties = properties_of(context.scene)
        row = layout.row()
        row.label(text=properties.checked_text or tr("Checked"), translate=False)
        row.operator("gwrap.check_photos", text="", icon="FILE_REFRESH", emboss=False)
        if dataset.is_busy():
            layout.label(text=tr("Looking at the photos…"), icon="TIME", translate=False)
        told = [f for f in properties.findings if f.severity in _ICONS]
        told.sort(key=lambda finding: finding.severity != "error")
        for finding in told[:_MAX_FINDINGS]:
            box = layout.box()
            words = box.column()
            words.alert = finding.severity == "error"
            wrapped_label(words, finding.message, characters - 4, icon=_ICONS[finding.severity])
            if finding.hint:
                wrapped_label(box, finding.hint, characters - 4, icon="BLANK1")
            for extra in EXTRAS:
                if extra.name in finding.extra.split(","):
                    draw_add_extra(box, extra)
        if len(told) > _MAX_FINDINGS:
            more = tr("and {count} more", count=len(told) - _MAX_FINDINGS)
            layout.label(text=more, translate=False)


class GWRAP_PT_dataset_details(TabPanel, bpy.types.Panel):
    bl_parent_id = "GWRAP_PT_dataset"
    bl_label = "Details"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return panel_settings.is_checked(context.scene)

    def readiness(self, context: bpy.types.Context) -> Readiness:
        count = len([f for f in properties_of(context.scene).findings if f.severity not in _ICONS])
        return Readiness(str(count))

    def draw(self, context: bpy.types.Context) -> None:
        facts = [f for f in properties_of(context.scene).findings if f.severity not in _ICONS]
        for fact in facts[:_MAX_FINDINGS]:
            wrapped_label(self.layout, fact.message, characters_of(context) - 4, icon="DOT")


CLASSES: Final = (GWRAP_PT_dataset, GWRAP_PT_dataset_details)
