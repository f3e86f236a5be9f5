# SPDX-License-Identifier: GPL-3.0-or-later
"""Sub-panel Computers."""

from typing import Any, Final

import bpy
from bpy.props import EnumProperty, StringProperty

from ..core.jobs.parts.states import PartBoard
from ..ops import computers
from ..ops.addon import properties_of, tr
from ..ops.job_timer import key_of
from .panel_base import (
    Readiness,
    TabPanel,
    characters_of,
    column_of_choices,
    draw_settings,
    settings_in,
    table,
    wrapped_label,
)

# -- Where the jobs of a scene run: ``Scene.gwrap.computers``; no property has a callback ---------


_KINDS: Final = (
    ("THIS", "Local", "Jobs run on this computer"),
    ("DASK", "Dask", "Parts of jobs run on the computers of a Dask cluster"),
)


class GWRAP_PG_computers(bpy.types.PropertyGroup):
    """Which computers run the jobs of a scene."""

    kind: EnumProperty(  # type: ignore[valid-type]
        name="Computers", description="Computers that run the jobs of this scene", items=_KINDS
    )
    dask_address: StringProperty(  # type: ignore[valid-type]
        name="Scheduler",
        description="Address of the Dask scheduler, such as tls://computer:8786",
        default="tls://localhost:8786",
    )
    certificates: StringProperty(  # type: ignore[valid-type]
        name="Certificates",
        description=(
            "Folder of the farm's certificates, for tls:// addresses; empty uses GW_CERTIFICATES"
        ),
        subtype="DIR_PATH",
    )


PROPERTIES: Final = (GWRAP_PG_computers,)


# -- The sub-panel "Computers": the choice, its address, the parts of the job by state ------------


_KIND_NAMES: Final = {"THIS": "Local", "DASK": "Dask"}
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
_MAX_NAME: Final = 40
"""Characters of a name from elsewhere."""


class GWRAP_PT_computers(TabPanel, bpy.types.Panel):
    bl_label = "Computers"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def readiness(self, context: bpy.types.Context) -> Readiness:
        board = computers.look_at(key_of(properties_of(context.scene).job_folder))
        if board is not None and board.counts:
            done, _, failed, _ = board.totals
            total = sum(board.totals)
            icon = "ERROR" if failed else "CHECKMARK" if done == total else "SORTTIME"
            return Readiness(tr("{done} of {total}", done=done, total=total), icon)
        return Readiness(_KIND_NAMES[properties_of(context.scene).computers.kind])

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        choices = properties.computers
        column = column_of_choices(layout, properties)
        row = column.row()
        row.use_property_split = False  # the names need the whole width
        row.prop(choices, "kind", expand=True)
        if choices.kind == "THIS":
            draw_settings(column, properties, settings_in("computers"))
        else:
            column.prop(choices, "dask_address")
            column.prop(choices, "certificates")
            layout.operator("gwrap.test_computers", icon="VIEWZOOM")
            _draw_outcome(layout, context, choices.dask_address)
        self._parts(layout, context)

    def _parts(self, layout: Any, context: bpy.types.Context) -> None:
        board = computers.look_at(key_of(properties_of(context.scene).job_folder))
        if board is None:
            return
        characters = characters_of(context)
        if board.problem:
            wrapped_label(layout, board.problem, characters, icon="ERROR")
        else:
            table(layout.box(), part_rows(board))
        for part in board.failed[:_MAX_FAILED]:
            box = layout.box()
            place = f" · {part.place[:_MAX_NAME]}" if part.place else ""
            wrapped_label(box, part.name[:_MAX_NAME] + place, characters - 4, icon="ERROR")
            if part.error:
                wrapped_label(box, part.error, characters - 4, icon="BLANK1")
        row = layout.row(align=True)
        row.operator("gwrap.resume_job", text="Retry", icon="FILE_REFRESH")
        row.operator("gwrap.cancel_job", icon="X")


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
    if computers.asks_about(about):
        layout.label(text=tr("Asking…"), icon="SORTTIME", translate=False)
    outcome = computers.outcome(about)
    if outcome is None:
        return
    icon = _ICONS[outcome.good]
    for line in outcome.lines:
        wrapped_label(layout, line, characters, icon=icon)
        icon = "BLANK1"
    for is_good, line in outcome.rows:
        wrapped_label(layout, line, characters, icon=_ICONS[is_good])


CLASSES: Final = (GWRAP_PT_computers,)
