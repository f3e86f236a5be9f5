# SPDX-License-Identifier: GPL-3.0-or-later
"""Sub-panels Mesh, Texture and Bake."""

from typing import Final

import bpy
from bpy.props import EnumProperty, IntProperty, PointerProperty

from ..ops import addon
from ..ops.addon import properties_of, tr
from ..ops.bake_objects import MAX_TRIANGLES
from ..ops.baking import bake_target
from ..ops.jobs import selected_regions
from .job_view import draw_job, job_readiness
from .panel_base import (
    InTab,
    Readiness,
    TabPanel,
    button,
    characters_of,
    column_of_choices,
    count_of_regions,
    draw_settings,
    settings_in,
    wrapped_label,
)

# -- Choices of **Bake Photos**: ``Scene.gwrap.bake`` ---------------------------------------------


_UVS: Final = (
    ("AUTO", "Automatic", "The active UV map of the mesh if it has one, else a new one"),
    ("OWN", "Active UV Map", "The active UV map of the mesh, with its UDIM tiles"),
    ("NEW", "New", "Unwrap the mesh into a UV map of its own"),
)
_FACES: Final = (
    ("KEEP", "As They Are", "Bake onto the selected mesh itself"),
    ("DECIMATE", "Decimate", "Make a lighter mesh of triangles; its lost detail is a normal map"),
    ("QUADS", "Quads",
     ("Make a new mesh of quads with QuadriFlow; the detail of this one is a normal map. "
      "Blender waits for QuadriFlow, for seconds or a few minutes; meshes of more than "
      f"{MAX_TRIANGLES:,} triangles are decimated for it")),
)  # fmt: skip


class GWRAP_PG_bake(bpy.types.PropertyGroup):
    """How photos are baked onto the active mesh."""

    uvs: EnumProperty(name="UVs", description="UV map to bake for", items=_UVS)  # type: ignore[valid-type]
    retopology: EnumProperty(  # type: ignore[valid-type]
        name="Faces", description="Which faces the photos are baked onto", items=_FACES
    )
    faces: IntProperty(  # type: ignore[valid-type]
        name="Target", description="Faces of the lighter mesh", default=5000,
        min=4, soft_min=100, soft_max=100_000, max=100_000_000,
    )  # fmt: skip
    quads: IntProperty(  # type: ignore[valid-type]
        name="Target", description="Quads of the new mesh; QuadriFlow makes up to a quarter fewer",
        default=5000, min=4, soft_min=100, soft_max=50_000, max=100_000,
    )  # fmt: skip
    dense: PointerProperty(  # type: ignore[valid-type]
        name="Detail From",
        description="Dense mesh at the same place, whose detail is baked into a normal map",
        type=bpy.types.Object,
    )


PROPERTIES: Final = (GWRAP_PG_bake,)


# -- The sub-panel "Mesh": resolution of the selected regions, and the meshing job ----------------


class GWRAP_PT_mesh(TabPanel, bpy.types.Panel):
    bl_label = "Mesh"

    def readiness(self, context: bpy.types.Context) -> Readiness:
        job = job_readiness(context, "MESH")
        if job is not None:
            return job
        if addon.current_frame(context) is None:
            return Readiness("Needs a training")
        count = len(selected_regions(context))
        if not count:
            return Readiness("No region selected")
        return Readiness(count_of_regions(count), "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        selected = selected_regions(context)
        column = column_of_choices(layout, properties)
        column.prop(properties, "resolution")
        draw_settings(column, properties, settings_in("mesh"))
        if draw_job(layout, context, "MESH"):
            return
        characters = characters_of(context)
        if addon.current_frame(context) is None:
            wrapped_label(layout, "Needs a finished training.", characters, icon="INFO")
        elif selected:
            names = ", ".join(region.name for region in selected)
            text = "Region: {names}" if len(selected) == 1 else "Regions: {names}"
            wrapped_label(layout, tr(text, names=names), characters)
        else:
            text = "Select a region above, or add a region box."
            wrapped_label(layout, text, characters, icon="INFO")
        count = len(selected)
        text = "Mesh Region" if count < 2 else tr("Mesh {count} Regions", count=count)
        button(layout, context, "gwrap.mesh_region", text=text, icon="MESH_DATA")


class GWRAP_PT_mesh_advanced(InTab, bpy.types.Panel):
    bl_parent_id = "GWRAP_PT_mesh"
    bl_label = "Advanced"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def draw(self, context: bpy.types.Context) -> None:
        properties = properties_of(context.scene)
        column = column_of_choices(self.layout, properties)
        column.prop(properties, "decimate")
        draw_settings(column, properties, settings_in("mesh_advanced"))


# -- The sub-panel "Texture": size, source of the colours, further maps, coarser meshes -----------


class GWRAP_PT_texture(TabPanel, bpy.types.Panel):
    bl_label = "Texture"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def readiness(self, context: bpy.types.Context) -> Readiness:
        properties = properties_of(context.scene)
        size = f"{properties.texture_size} px" if properties.texture_size != "0" else "Automatic"
        photos = properties.texture_source == "PHOTOS"
        text = "{size}, photos" if photos else "{size}, gaussians"
        return Readiness(tr(text, size=tr(size)), "TEXTURE")

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        column = column_of_choices(layout, properties)
        draw_settings(column, properties, settings_in("texture"))
        text = "Applies to the next Wrap Scene, Mesh Region or Bake Photos."
        wrapped_label(layout, text, characters_of(context), icon="INFO")


# -- The sub-panel "Bake": photos onto the active mesh, whatever made it --------------------------


class GWRAP_PT_bake(TabPanel, bpy.types.Panel):
    bl_label = "Bake"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - Blender's convention

    def readiness(self, context: bpy.types.Context) -> Readiness:
        job = job_readiness(context, "BAKE")
        if job is not None:
            return job
        if addon.current_frame(context) is None:
            return Readiness("Needs a result")
        thing = bake_target(context)
        if thing is None:
            return Readiness("No mesh selected")
        return Readiness(thing.name, "MESH_DATA")

    def draw(self, context: bpy.types.Context) -> None:
        layout, properties = self.layout, properties_of(context.scene)
        column = column_of_choices(layout, properties)
        bake = properties.bake
        column.prop(bake, "retopology")
        if bake.retopology == "KEEP":
            column.prop(bake, "uvs")
            column.prop(bake, "dense")
        else:
            column.prop(bake, "faces" if bake.retopology == "DECIMATE" else "quads")
        if draw_job(layout, context, "BAKE"):
            return
        characters = characters_of(context)
        thing = bake_target(context)
        if addon.current_frame(context) is None:
            wrapped_label(layout, "Needs a finished job.", characters, icon="INFO")
        elif thing is None:
            text = "Select a mesh: edited, retopologised, or of your own."
            wrapped_label(layout, text, characters, icon="INFO")
        else:
            note = thing.get(addon.BAKE_NOTE, "")
            text = f"{thing.name}: {note}" if isinstance(note, str) and note else thing.name
            wrapped_label(layout, text, characters)
        button(layout, context, "gwrap.bake_photos", icon="RENDER_STILL")
        text = "Size, maps and colours are those of Texture."
        wrapped_label(layout, text, characters, icon="INFO")


CLASSES: Final = (GWRAP_PT_mesh, GWRAP_PT_mesh_advanced, GWRAP_PT_texture, GWRAP_PT_bake)
