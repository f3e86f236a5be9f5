# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that export meshes and pack textures."""

from pathlib import Path
from typing import Any, Final

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ...core.errors import UsageError
from ...core.export_formats import EXPORT_FORMATS, MESH_FORMATS, PACKABLE_FORMATS
from ...core.files import real_path
from ..common import tags
from ..common.error_reporting import NeedsObjectMode, NeedsResult, OperatorResult, ReportsErrors
from ..results.materials import images_of
from .export_objects import ObjectExport, export_objects


class GWRAP_OT_export_meshes(NeedsObjectMode, bpy.types.Operator):
    bl_idname = "gwrap.export_meshes"
    bl_label = "Export Meshes"
    bl_description = "Export meshes of a result to other programs, one file and sidecar each"

    directory: StringProperty(name="Folder", subtype="DIR_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    format: EnumProperty(  # type: ignore[valid-type]
        name="Format",
        items=tuple(
            (name.upper(), EXPORT_FORMATS[name].label, EXPORT_FORMATS[name].help)
            for name in MESH_FORMATS
        ),
    )
    scope: EnumProperty(  # type: ignore[valid-type]
        name="Meshes",
        items=(
            ("SELECTED", "Selected", "The selected meshes, levels of detail included"),
            ("ALL", "All Regions", "The mesh of each region of the result"),
        ),
    )
    levels: BoolProperty(  # type: ignore[valid-type]
        name="Levels of Detail",
        description="Export the levels of detail of each region as separate files",
    )
    placed: BoolProperty(  # type: ignore[valid-type]
        name="As Placed",
        description="Coordinates as in Blender; off: the world coordinates of the photos' cameras",
        default=True,
    )
    pack: BoolProperty(  # type: ignore[valid-type]
        name="Pack Textures", description="Put the textures into the file"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run; Blender calls this."""
        needs_result: Any = NeedsResult.poll
        return bool(needs_result.__func__(cls, context)) and super().poll(context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        if not chosen_meshes(context):
            self.scope = "ALL"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "format")
        layout.prop(self, "scope", expand=True)
        if self.scope == "ALL":
            layout.prop(self, "levels")
        layout.prop(self, "placed")
        if self.format.lower() in PACKABLE_FORMATS:
            layout.prop(self, "pack")

    def work(self, context: bpy.types.Context) -> OperatorResult:
        if not self.directory:
            raise UsageError("No folder was chosen.", "Choose the folder of the exported files.")
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        if self.scope == "SELECTED":
            chosen = chosen_meshes(context)
            if not chosen:
                raise UsageError("No mesh of a result is selected.", "Select some, or export all.")
        else:
            kinds = tags.WITH_TEXTURE if self.levels else ("mesh", "baked")
            children = frame.children_recursive if frame is not None else ()
            chosen = [t for t in children if tags.kind_of(t) in kinds]
        request = ObjectExport(
            self.format.lower(),
            real_path(bpy.path.abspath(self.directory)),
            self.placed,
            self.pack and self.format.lower() in PACKABLE_FORMATS,
        )
        paths = []
        frames = {t: owner for t in chosen if (owner := tags.frame_of(t)) is not None}
        for owner in dict.fromkeys(frames.values()):
            paths += export_objects(owner, [t for t in chosen if frames.get(t) == owner], request)
        self.report({"INFO"}, f"{len(paths)} files written to {request.folder}")
        return {"FINISHED"}


class GWRAP_OT_pack_images(NeedsResult, ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.pack_images"
    bl_label = "Pack Textures"
    bl_description = "Pack the result's textures into the .blend file, or unpack them to files"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    pack: BoolProperty(name="Pack", default=True)  # type: ignore[valid-type]

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        count = 0
        for image in images_of(frame):
            if self.pack and image.packed_file is None:
                if not Path(bpy.path.abspath(image.filepath)).is_file():
                    raise UsageError(
                        f"The texture {image.filepath} does not exist.", "Import the result again."
                    )
                image.pack()
                count += 1
            elif not self.pack and image.packed_file is not None:
                there = Path(bpy.path.abspath(image.filepath)).is_file()
                # A file that is there is the result's own, never written over.
                image.unpack(method="USE_ORIGINAL" if there else "WRITE_ORIGINAL")
                count += 1
        self.report({"INFO"}, f"{count} textures {'packed' if self.pack else 'unpacked'}")
        return {"FINISHED"}


def chosen_meshes(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected meshes of results, with levels and lighter meshes."""
    return [
        t
        for t in context.selected_objects
        if tags.kind_of(t) in tags.WITH_TEXTURE
        and t.type == "MESH"
        and tags.frame_of(t) is not None
    ]


CLASSES: Final = (GWRAP_OT_export_meshes, GWRAP_OT_pack_images)
