# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake Photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import bpy

from ..core.errors import UsageError, unwritable_error
from ..core.jobs.store.job_file import BakeRequest, make_bake_job
from ..core.jobs.store.job_folder import JobFolder
from ..core.jobs.store.rollback import finished_job, no_finished_training
from ..core.jobs.store.stage_folder import read_done
from ..core.mesh.exchange import FileMesh, write_handed_over
from ..core.names import file_stem
from ..core.settings import TextureSettings
from . import addon
from .addon import properties_of, waiting
from .bake_objects import SUFFIXES, Triangulation, quads_of, triangulation_of, world_mesh
from .jobs import ConfirmsFolder, launch, refuse_running, why_no_start
from .panel_settings import job_folder_of, texture_choices
from .worker_setup import WorkerChoice, worker_choice

# -- Start a bake: hand a mesh of the scene over to the worker ------------------------------------


FOLDER = "handed-over"
"""Folder of a job with the meshes that Blender has handed over."""


def bake_target(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the active object if photos can be baked onto it."""
    thing = context.view_layer.objects.active
    if thing is None or thing.type != "MESH" or addon.kind_of(thing) == "region":
        return None
    return thing if thing.select_get() else None


def start_bake(
    scene: bpy.types.Scene, frame: bpy.types.Object, thing: bpy.types.Object, choice: WorkerChoice
) -> None:
    """Bake the photos of a result onto a mesh object.

    ``thing`` is any mesh, which need not belong to the result. Quads are made here, in Blender,
    which waits for them. They become an object when the bake is done: until then, and where it
    fails, the scene stays as it is.

    Raises WrapError: the mesh cannot be baked onto or made of quads, or the job has no finished
    training.
    """
    folder = JobFolder(job_folder_of(frame))
    refuse_running(folder.root)
    earlier = finished_job(folder)
    if not any(read_done(path) for path in folder.stages.glob("train-*")):
        raise no_finished_training(folder.root)
    chosen = properties_of(scene).bake
    keeps = chosen.retopology == "KEEP"
    triangles = triangulation_of(thing)
    dense = None
    if keeps:
        _refuse_unusable(thing, triangles, chosen.uvs)
        if chosen.dense not in (None, thing):
            dense = triangulation_of(chosen.dense)
    elif chosen.retopology == "QUADS":
        dense, triangles = triangles, quads_of(thing.name, triangles, chosen.quads)
    name = _name(thing, folder, SUFFIXES[chosen.retopology])
    makes_uvs = not keeps or chosen.uvs == "NEW" or triangles.corner_uvs is None
    mesh = world_mesh(
        frame, triangles, with_uvs=not makes_uvs,
        with_polygons=makes_uvs and chosen.retopology != "DECIMATE",
    )  # fmt: skip
    mesh = replace(mesh, is_new=chosen.retopology == "QUADS")
    request = BakeRequest(
        mesh=str(_hand_over(folder, name, mesh)), name=name,
        uvs=chosen.uvs.lower() if keeps else "auto",
        faces=chosen.faces if chosen.retopology == "DECIMATE" else 0,
        dense=str(_hand_over(folder, f"{name}-dense", world_mesh(frame, dense))) if dense else "",
        texture=_texture(scene, has_dense=dense is not None),
    )  # fmt: skip
    job = make_bake_job(earlier, request)
    job = replace(job, settings=replace(job.settings, threads=choice.threads))
    launch(scene, folder.root, job, choice, "BAKE", thing.session_uid)
    if keeps:
        thing[addon.BAKE] = name


def _refuse_unusable(thing: bpy.types.Object, triangles: Triangulation, uvs: str) -> None:
    """Refuse before the start what could not be brought back."""
    if not thing.is_editable or (thing.data is not None and not thing.data.is_editable):
        raise UsageError(
            f"{thing.name} is linked from a library.",
            "Make it local (Object > Relations > Make Local).",
        )
    if uvs == "OWN" and triangles.corner_uvs is None:
        raise UsageError(f"{thing.name} has no UV map.", "Unwrap it (U), or choose New UVs.")
    if (uvs == "NEW" or triangles.corner_uvs is None) and not triangles.is_own:
        raise UsageError(
            f"Modifiers of {thing.name} change its faces, and it needs new UVs.",
            "Unwrap it (U), choose New UVs without modifiers, or apply the modifiers.",
        )


def _name(thing: bpy.types.Object, folder: JobFolder, suffix: str) -> str:
    """Return the folder of an object's bake: its earlier one, or one that nothing uses."""
    own = thing.get(addon.BAKE, "")
    others = {t.get(addon.BAKE) for t in bpy.data.objects if t != thing}
    stem = file_stem(f"{thing.name}{suffix}", 0)
    if suffix and addon.kind_of(thing) != "baked":
        made = [t for t in bpy.data.objects if addon.kind_of(t) == "baked"]
        if any(t.get(addon.BAKE) == stem for t in made):
            return stem  # made anew from the same object
    elif not suffix and isinstance(own, str) and own and own not in others:
        return own
    count, name = 1, stem
    while name in others or (folder.baked / name).exists():
        count += 1
        name = f"{stem}-{count}"
    return name


def _hand_over(folder: JobFolder, name: str, mesh: FileMesh) -> Path:
    path = folder.root / FOLDER / f"{name}.npz"
    try:
        path.parent.mkdir(exist_ok=True)
        write_handed_over(path, mesh)
    except OSError as error:
        raise unwritable_error(path, error) from None
    return path


def _texture(scene: bpy.types.Scene, *, has_dense: bool) -> TextureSettings:
    """Return the settings of the panel Texture, without levels of detail."""
    chosen = {path.rpartition(".")[2]: value for path, value in texture_choices(scene).items()}
    texture = TextureSettings(**{**chosen, "lods": 0})
    if has_dense and texture.normal_map == "auto":
        return replace(texture, normal_map="on")
    return texture


# -- The operator **Bake Photos**; it changes no data of the open file until the bake is done -----


class GWRAP_OT_bake_photos(ConfirmsFolder, bpy.types.Operator):
    bl_idname = "gwrap.bake_photos"
    bl_label = "Bake Photos"
    bl_description = (
        "Bake the photos onto the selected mesh, edited, retopologised or of your own, in a "
        "background process"
    )

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if addon.current_frame(context) is None:
            return "Needs a finished job: press Wrap Scene or Import Result first"
        if context.mode != "OBJECT":
            return "Change to Object Mode first"
        if bake_target(context) is None:
            return "Select a mesh to bake the photos onto"
        return why_no_start(context)

    def work(self, context: bpy.types.Context) -> None:
        frame = addon.current_frame(context)
        thing = bake_target(context)
        if frame is None or thing is None:
            raise UsageError("No mesh is selected.", "Select a mesh, and wrap the scene before.")
        with waiting(context):
            start_bake(context.scene, frame, thing, worker_choice(context))
        self.report({"INFO"}, f"Baking photos onto {thing.name}")


CLASSES: Final = (GWRAP_OT_bake_photos,)
