# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Computers": the choice, its address, the parts of the job by state."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import bpy

from ...core.farm.part_states import PartBoard
from ...ops.common.addon import properties_of
from ...ops.common.translate import tr
from ...ops.computers import farm_calls, part_watch
from ...ops.computers.farm_actions import shown_folder
from ...ops.computers.part_watch import Look
from ...ops.jobs import watched_jobs
from ..common.panel_base import Readiness, TabPanel, plain, table
from ..common.setting_properties import draw_settings, settings_in
from ..common.text import characters_of, wrapped_label

_KINDS: Final = {"THIS": "Local", "DASK": "Dask", "FLAMENCO": "Flamenco"}
_PARTS: Final = {
    "frames": "Frames", "cameras": "Cameras", "masks": "Masks", "coarse": "Coarse Training",
    "block": "Blocks", "train": "Train", "plan": "Plan", "points": "Points", "gather": "Gather",
    "faces": "Faces", "mesh": "Mesh", "texture": "Texture", "export": "Export", "bake": "Bake",
}  # fmt: skip
"""Names of the kinds of parts."""
_NOW: Final = ("{count} running", "{count} failed")
_ICONS: Final = {True: "CHECKMARK", False: "ERROR"}
_MAX_FAILED: Final = 4
"""Failed parts that are drawn; the others are counted above."""
_MAX_LINES: Final = 3
"""Last lines of a failed part that are drawn."""
_MAX_NAME: Final = 40
"""Characters of a name from elsewhere."""


class GWRAP_PT_computers(TabPanel, bpy.types.Panel):
    bl_label = "Computers"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def readiness(self, context: bpy.types.Context) -> Readiness:
        look = part_watch.look_at(shown_folder(context.scene))
        if look is not None and look.board.counts:
            done, _, failed, _ = look.board.totals
            total = sum(look.board.totals)
            icon = "ERROR" if failed else "CHECKMARK" if done == total else "SORTTIME"
            return Readiness(tr("{done} of {total}", done=done, total=total), icon)
        return Readiness(_KINDS[properties_of(context.scene).computers.kind])

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        plain(layout)
        choices = properties.computers
        column = layout.column()
        column.enabled = not watched_jobs.is_running(properties.job_folder)
        row = column.row()
        row.use_property_split = False  # the names need the whole width
        row.prop(choices, "kind", expand=True)
        if choices.kind == "THIS":
            draw_settings(column, properties, settings_in("computers"))
        elif choices.kind == "DASK":
            column.prop(choices, "dask_address")
            column.prop(choices, "certificates")
            self._test(layout, context, choices.dask_address)
        else:
            for name in ("flamenco_address", "shared", "tiles", "priority", "tag"):
                column.prop(choices, name)
            self._test(layout, context, choices.flamenco_address)
            layout.operator("gwrap.submit_farm", icon="EXPORT")
            layout.operator("gwrap.save_job_type", icon="FILE_SCRIPT")
        self._parts(layout, context)

    def _test(self, layout: Any, context: bpy.types.Context, address: str) -> None:
        layout.operator("gwrap.test_computers", icon="VIEWZOOM")
        _draw_outcome(layout, context, address)

    def _parts(self, layout: Any, context: bpy.types.Context) -> None:
        folder = shown_folder(context.scene)
        look = part_watch.look_at(folder)
        if look is None:
            return
        characters = characters_of(context)
        if look.board.problem:
            wrapped_label(layout, look.board.problem, characters, icon="ERROR")
        else:
            table(layout.box(), part_rows(look.board))
        _draw_failed(layout, context, look, folder)
        self._buttons(layout, context, look, folder)
        _draw_outcome(layout, context, folder)

    def _buttons(self, layout: Any, context: bpy.types.Context, look: Look, folder: str) -> None:
        row = layout.row(align=True)
        if look.submitted:
            row.operator("gwrap.retry_farm", icon="FILE_REFRESH")
            row.operator("gwrap.cancel_farm", icon="X")
            layout.operator("gwrap.update_farm", icon="VIEWZOOM")
        else:
            row.operator("gwrap.resume_job", text="Retry", icon="FILE_REFRESH")
            row.operator("gwrap.cancel_job", icon="X")
        finished = look.submitted and look.board.finished
        if finished and not watched_jobs.result_to_import(context.scene):
            operator: Any = layout.operator(
                "gwrap.import_result", text="Import Finished Result", icon="IMPORT"
            )
            operator.directory = str(Path(folder) / "result")


def part_rows(board: PartBoard) -> tuple[tuple[str, str], ...]:
    """Return rows for each kind of parts: how many are done, then what runs and has failed."""
    rows: list[tuple[str, str]] = []
    for kind, (done, running, failed, left) in board.counts:
        total = done + running + failed + left
        rows.append((_PARTS.get(kind, kind), tr("{done} of {total}", done=done, total=total)))
        rows += [("", tr(t, count=c)) for t, c in zip(_NOW, (running, failed), strict=True) if c]
    return tuple(rows)


def _draw_outcome(layout: Any, context: bpy.types.Context, about: str) -> None:
    """Draw how the last request ended, if it was about this address or folder."""
    characters = characters_of(context)
    if farm_calls.asks_about(about):
        layout.label(text=tr("Asking…"), icon="SORTTIME", translate=False)
    outcome = farm_calls.outcome(about)
    if outcome is None:
        return
    icon = _ICONS[outcome.good]
    for line in outcome.lines:
        wrapped_label(layout, line, characters, icon=icon)
        icon = "BLANK1"
    for is_good, line in outcome.rows:
        wrapped_label(layout, line, characters, icon=_ICONS[is_good])


def _draw_failed(layout: Any, context: bpy.types.Context, look: Look, folder: str) -> None:
    """Draw failed parts with their computer and last lines."""
    characters = characters_of(context)
    state = farm_calls.state_of(folder)
    if state is not None:
        text = tr("State in Flamenco: {status}", status=state.status)
        wrapped_label(layout, text, characters, icon="INFO")
    last = {task.name: task for task in state.failed} if state is not None else {}
    rows = [
        (part.name, last[part.name].worker if part.name in last else part.place, part.error)
        for part in look.board.failed
    ]
    told = {name for name, _, _ in rows}
    rows += [(task.name, task.worker, "") for task in last.values() if task.name not in told]
    for name, place, error in rows[:_MAX_FAILED]:
        box = layout.box()
        head = f"{name[:_MAX_NAME]} · {place[:_MAX_NAME]}" if place else name[:_MAX_NAME]
        wrapped_label(box, head, characters - 4, icon="ERROR")
        if error:
            wrapped_label(box, error, characters - 4, icon="BLANK1")
        for line in last[name].lines[-_MAX_LINES:] if name in last else ():
            wrapped_label(box, line, characters - 4, icon="BLANK1")


CLASSES: Final = (GWRAP_PT_computers,)
