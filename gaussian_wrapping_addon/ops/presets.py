# SPDX-License-Identifier: GPL-3.0-or-later
"""The user's presets."""

from pathlib import Path
from typing import Final

import bpy
from bpy.props import StringProperty

from ..core.errors import UsageError
from ..core.files import is_link
from ..core.names import file_stem
from ..core.settings.job import read_saved_settings, savable_settings, write_saved_settings
from .addon import OperatorResult, ReportsErrors, properties_of, redraw
from .jobs import why_busy
from .panel_settings import owner_of

# -- Files of the user's presets, in Blender's folder for presets, which outlives the add-on ------


_FOLDER: Final = "presets/gaussian_wrapping"
MOST_PRESETS: Final = 100
"""More do not fit into a menu."""
PANEL_CHOICES: Final = ("resolution", "decimate")
"""Properties of ``Scene.gwrap`` that decide which settings apply."""


def preset_names() -> list[str]:
    """Return the names of the presets, sorted; reads the folder."""
    folder = _folder()
    if folder is None:
        return []
    found = (path for path in folder.glob("*.json") if path.is_file() and not is_link(path))
    return sorted((path.stem for path in found), key=str.casefold)[:MOST_PRESETS]


def shown_name(name: str) -> str:
    """Return the name of a preset as the menu shows it."""
    return name.replace("_", " ")


def save_preset(scene: bpy.types.Scene, wanted: str) -> str:
    """Save the settings of a scene's panels; return the preset's name.

    Raises UsageError: the name is empty, there are too many, or the file cannot be written.
    """
    if not wanted.strip():
        raise UsageError("The preset has no name.", "Type one.")
    name = file_stem(wanted.strip(), 0)
    folder = _folder(create=True)
    if folder is None:
        raise UsageError("Blender has no folder for presets.", "Check its user folder.")
    names = preset_names()
    if name not in names and len(names) >= MOST_PRESETS:
        raise UsageError(f"There are {len(names)} presets already.", "Delete one.")
    properties = properties_of(scene)
    values = {
        d.path: d.from_panel(getattr(owner_of(d, properties), d.property_name))
        for d in savable_settings()
    }
    panel = {name: getattr(properties, name) for name in PANEL_CHOICES}
    try:
        write_saved_settings(folder / f"{name}.json", values, panel)
    except OSError as error:
        raise UsageError(
            f"The preset cannot be written to {folder}: {error.strerror}.", "Check the folder."
        ) from None
    return name


def apply_preset(scene: bpy.types.Scene, name: str) -> tuple[str, ...]:
    """Give a scene's panels the settings of a preset; return notes on what was left out.

    Raises UsageError, ParseError: there is no such preset, or its file cannot be used. Nothing was
    changed.
    """
    path = _existing(name)
    try:
        saved = read_saved_settings(path)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}.", "Check the file.") from None
    properties = properties_of(scene)
    notes = list(saved.notes)
    chosen = [
        (d.path, owner_of(d, properties), d.property_name, d.to_panel, saved.values)
        for d in savable_settings()
    ]
    chosen += [(name, properties, name, lambda value: value, saved.panel) for name in PANEL_CHOICES]
    for called, owner, name, to_panel, values in chosen:
        if called in values:
            try:
                setattr(owner, name, to_panel(values[called]))
            except (TypeError, ValueError, OverflowError):
                notes.append(f"{called} is no choice of the panel, and stays as it is.")
    return tuple(notes)


def delete_preset(name: str) -> None:
    """Delete the file of a preset.

    Raises UsageError: there is no such preset, or it cannot be deleted.
    """
    path = _existing(name)
    try:
        path.unlink()
    except OSError as error:
        raise UsageError(
            f"{path} cannot be deleted: {error.strerror}.", "Check the folder."
        ) from None


def _folder(*, create: bool = False) -> Path | None:
    found = bpy.utils.user_resource("SCRIPTS", path=_FOLDER, create=create)
    return Path(found) if found and Path(found).is_dir() else None


def _existing(name: str) -> Path:
    """Return the file of a preset: by its listed name, so that no other file can be named."""
    folder = _folder()
    if folder is None or name not in preset_names():
        raise UsageError(f"There is no preset {name[:80]!r}.", "Open the menu again.")
    return folder / f"{name}.json"


# -- Operators of the menu of presets: save, apply, delete ----------------------------------------


class GWRAP_OT_save_preset(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.save_preset"
    bl_label = "Save Preset"
    bl_description = (
        "Save the settings of training, mesh and texture under a name; folders, files and regions "
        "are not part of it"
    )

    name: StringProperty(  # type: ignore[valid-type]
        name="Name",
        description="Name of the preset; one of the same name is replaced",
        maxlen=60,
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        return context.window_manager.invoke_props_dialog(self)

    def work(self, context: bpy.types.Context) -> None:
        name = save_preset(context.scene, self.name)
        self.report({"INFO"}, f"Saved preset {shown_name(name)}")


class GWRAP_OT_apply_preset(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.apply_preset"
    bl_label = "Apply Preset"
    bl_description = "Set training, mesh and texture as they were saved"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    name: StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return why_busy(context)

    def work(self, context: bpy.types.Context) -> None:
        notes = apply_preset(context.scene, self.name)
        if notes:
            self.report({"WARNING"}, " ".join(notes))
        redraw()


class GWRAP_OT_delete_preset(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.delete_preset"
    bl_label = "Delete Preset"
    bl_description = "Delete this preset from the user's folder; this cannot be undone"

    name: StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        return context.window_manager.invoke_confirm(self, event)

    def work(self, _context: bpy.types.Context) -> None:
        delete_preset(self.name)
        self.report({"INFO"}, f"Deleted preset {shown_name(self.name)}")


CLASSES: Final = (GWRAP_OT_save_preset, GWRAP_OT_apply_preset, GWRAP_OT_delete_preset)
