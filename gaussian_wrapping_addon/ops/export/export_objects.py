# SPDX-License-Identifier: GPL-3.0-or-later
"""Export meshes as they are in Blender: with modifiers, edits, materials and placement.

Each mesh is copied, transformed in double precision to the coordinates of the file, checked, and
passed to Blender's exporter of the format (PLY to our own, which keeps doubles). The scene is not
changed.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.dataset.frames.file_frame import FileFrame, file_offset
from ...core.errors import ResourceError, UsageError
from ...core.export_formats import EXPORT_FORMATS, MESH_FORMATS
from ...core.jobs.store.sidecar import write_sidecar
from ...core.names import file_stems
from ...core.texture.files.file_checks import validate_for_export, write_errors
from ...core.texture.files.mesh_ply import vertex_colors, write_mesh_ply
from ..common import tags
from ..common.mesh_data import mesh_of, values_of
from ..placement.placement import placement_of
from ..regions.region_objects import matrix_of
from ..results.materials import texture_of
from .export_materials import MaterialCopies, lend_name, pixels_of

_OPERATORS = {
    "glb": "export_scene.gltf",
    "obj": "wm.obj_export",
    "usd": "wm.usd_export",
    "fbx": "export_scene.fbx",
}
_SAME_PLACE = 1e-6
"""Object matrices are single precision: a mesh this near its parent's place has not been moved."""


@dataclass(frozen=True)
class ObjectExport:
    """Format, folder and options of an export."""

    format: str
    """One of :data:`MESH_FORMATS`."""
    folder: Path
    """Created if missing; files of the same names are replaced."""
    placed: bool = True
    """Whether coordinates are those in Blender, else those of the input's world."""
    pack: bool = False
    """Whether images go into the file, where the format can: GLB always does, OBJ and PLY never."""


def export_objects(
    frame: bpy.types.Object, things: list[bpy.types.Object], request: ObjectExport
) -> list[Path]:
    """Write one file for each mesh, its sidecar beside it.

    Parameters
    ----------
    frame : Object
        The parent empty of the result.
    things : list of Object
        Meshes and levels of detail of that result.

    Raises
    ------
    UsageError
        Nothing to write, an unknown format, an exporter that is missing or fails, a missing image,
        or a frame with non-uniform scale.
    MeshingError
        A mesh has no faces or values that are not finite; it is not written.
    ResourceError
        The folder cannot be written.
    """
    if request.format not in MESH_FORMATS:
        raise UsageError(
            f"{request.format!r} is not an export format.", f"Use {', '.join(MESH_FORMATS)}."
        )
    if not things:
        raise UsageError("There is no mesh to export.", "Select meshes of a result.")
    operator = _operator(request.format) if request.format in _OPERATORS else None
    world_from_scene = tags.world_from_scene(frame)
    blender_from_scene = placement_of(frame)
    target_from_scene = blender_from_scene if request.placed else world_from_scene
    with write_errors(request.folder):
        request.folder.mkdir(parents=True, exist_ok=True)
    paths = []
    stems = _stems(frame, things)
    for thing in things:
        with _copy_of(thing, frame) as (data, vertices):
            offset = np.zeros(3)
            if not request.placed and not EXPORT_FORMATS[request.format].doubles:
                offset = file_offset(target_from_scene.points(vertices))
            place = FileFrame(request.format, target_from_scene, offset)
            path, contents = _write(
                thing, stems[thing.name], data, place.local(vertices), request, operator
            )
            write_sidecar(
                path, place, world_from_scene, blender_from_scene, placed=request.placed,
                result=tags.result_folder(frame), contents=contents,
            )  # fmt: skip
            paths.append(path)
    return paths


def _stems(frame: bpy.types.Object, things: list[bpy.types.Object]) -> dict[str, str]:
    """Return the stem of each object's files, by the name of the object.

    A duplicate of an object has the tags of the original: the one of the first name keeps them.
    """
    owners: dict[tuple[str, int], str] = {}
    around = {thing.name: thing for thing in (*frame.children, *things)}
    for name, thing in sorted(around.items()):
        if thing.type != "MESH":
            continue
        region, level = str(thing.get(tags.REGION, name)), int(thing.get(tags.LEVEL, 0))
        if (region, level) in owners:
            region = f"{region} {name}"
        owners[region, level] = name
    return {owners[mesh]: stem for mesh, stem in file_stems(owners).items()}


def _operator(format: str) -> Any:
    module, name = _OPERATORS[format].split(".")
    operator = getattr(getattr(bpy.ops, module), name)
    try:
        operator.get_rna_type()
    except (KeyError, AttributeError):
        raise UsageError(
            f"This Blender has no {format.upper()} exporter.",
            "Turn its add-on on in the preferences, or choose another format.",
        ) from None
    return operator


@contextlib.contextmanager
def _copy_of(
    thing: bpy.types.Object, frame: bpy.types.Object
) -> Iterator[tuple[bpy.types.Mesh, np.ndarray]]:
    """Yield the mesh with modifiers applied, and its (v, 3) float64 vertices in the scene frame."""
    hidden = thing.hide_viewport
    thing.hide_viewport = False  # Blender does not evaluate objects that are disabled in viewports
    mesh_of(thing).update_tag()  # scripts may have changed it without tagging it
    bpy.context.view_layer.update()
    try:
        depsgraph = bpy.context.evaluated_depsgraph_get()
        data = bpy.data.meshes.new_from_object(
            thing.evaluated_get(depsgraph), preserve_all_data_layers=True, depsgraph=depsgraph
        )
        relative = np.linalg.inv(matrix_of(frame)) @ matrix_of(thing)
    finally:
        thing.hide_viewport = hidden
    try:
        vertices = values_of(data.vertices, "co", 3, np.float32)
        scene = vertices.reshape(-1, 3).astype(np.float64)
        if np.abs(relative - np.eye(4)).max() > _SAME_PLACE:
            scene = scene @ relative[:3, :3].T + relative[:3, 3]
            if np.linalg.det(relative[:3, :3]) < 0.0:
                data.flip_normals()
        yield data, scene
    finally:
        bpy.data.meshes.remove(data)


def _write(
    thing: bpy.types.Object,
    stem: str,
    data: bpy.types.Mesh,
    local: np.ndarray,
    request: ObjectExport,
    operator: Any,
) -> tuple[Path, dict[str, Any]]:
    """Write one checked mesh; return its file and the contents listed in the sidecar."""
    region, level = str(thing.get(tags.REGION, thing.name)), int(thing.get(tags.LEVEL, 0))
    data.calc_loop_triangles()
    count = len(data.loop_triangles)
    faces = values_of(data.loop_triangles, "vertices", 3, np.int32).reshape(-1, 3)
    corners = values_of(data.loop_triangles, "loops", 3, np.int32)
    uvs = _corner_uvs(data, corners)
    validate_for_export(local, faces, uvs, name=f"mesh {thing.name}")
    vertices: Any = data.vertices
    vertices.foreach_set("co", local.astype(np.float32).ravel())
    data.update()
    contents = {
        "region": region, "level": level, "vertices": len(local), "faces": count,
        "shading": "lit", "textures": [],
    }  # fmt: skip
    kind = EXPORT_FORMATS[request.format]
    path = request.folder / f"{stem}{kind.file_suffix(pack=request.pack)}"
    if operator is None:
        write_mesh_ply(path, local, faces, _colors(thing, data, len(local), faces, uvs))
        return path, contents
    inside = kind.textures == "inside" or (request.pack and kind.textures == "either")
    with contextlib.ExitStack() as stack:
        images = request.folder
        if inside:
            images = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gwrap-")))
        copies = MaterialCopies(
            stem, images,
            unlit=kind.unlit, fold_specular=request.format == "usd",
        )  # fmt: skip
        stack.callback(copies.remove)
        for index, material in enumerate(data.materials):
            if material is not None:
                data.materials[index] = copies.copy_of(material)
        stack.enter_context(_alone(thing, data))
        _run(operator, path, _options(request, tangents=copies.has_normal_map))
    if copies.shading is not None:
        contents["shading"] = copies.shading
    contents["textures"] = [] if inside else copies.textures
    return path, contents


def _corner_uvs(data: bpy.types.Mesh, corners: np.ndarray) -> np.ndarray | None:
    layer = data.uv_layers.active
    if layer is None:
        return None
    uvs = values_of(layer.uv, "vector", 2, np.float32)
    return uvs.reshape(-1, 2)[corners].reshape(-1, 3, 2)


def _colors(
    thing: bpy.types.Object,
    data: bpy.types.Mesh,
    count: int,
    faces: np.ndarray,
    uvs: np.ndarray | None,
) -> np.ndarray | None:
    images = [texture_of(slot.material) for slot in thing.material_slots]
    used = [image for image in images if image is not None]
    if not used or uvs is None:
        return None
    slots = values_of(data.polygons, "material_index", 1, np.int32)
    polygons = values_of(data.loop_triangles, "polygon_index", 1, np.int32)
    # A slot without our texture takes the first texture, as with one atlas.
    numbers = [used.index(image if image is not None else used[0]) for image in images]
    owner = np.array(numbers)[slots[polygons].clip(0, len(numbers) - 1)]
    return vertex_colors(count, faces, uvs, [pixels_of(image) for image in used], owner)


@contextlib.contextmanager
def _alone(thing: bpy.types.Object, data: bpy.types.Mesh) -> Iterator[None]:
    """Put the mesh into the scene under the object's name, selected alone; then undo that."""
    layer = bpy.context.view_layer
    chosen, active = [o for o in layer.objects if o.select_get()], layer.objects.active
    copy = bpy.data.objects.new("exported", data)
    name, data_name = lend_name(thing, copy), lend_name(mesh_of(thing), data)
    try:
        bpy.context.scene.collection.objects.link(copy)
        for other in chosen:
            other.select_set(False)
        layer.update()
        copy.select_set(True)
        layer.objects.active = copy
        yield
    finally:
        bpy.data.objects.remove(copy)
        data.name = "exported"
        for original, own in ((thing, name), (mesh_of(thing), data_name)):
            if original.library is None:
                original.name = own
        for other in chosen:
            other.select_set(True)
        layer.objects.active = active


def _options(request: ObjectExport, *, tangents: bool) -> dict[str, Any]:
    """Return the exporter's options; :func:`_run` drops those unknown to this Blender."""
    if request.format == "glb":
        return {
            "export_format": "GLB", "use_selection": True, "export_yup": True,
            "export_apply": False, "export_animations": False, "export_materials": "EXPORT",
            "export_image_format": "AUTO", "export_tangents": tangents, "export_extras": False,
            "export_vertex_color": "NONE", "will_save_settings": False,
        }  # fmt: skip
    if request.format == "obj":
        return {
            "export_selected_objects": True, "forward_axis": "NEGATIVE_Z", "up_axis": "Y",
            "apply_modifiers": False, "export_materials": True, "export_uv": True,
            "export_normals": True, "path_mode": "STRIP",
        }  # fmt: skip
    if request.format == "usd":
        return {
            "selected_objects_only": True, "export_animation": False, "export_materials": True,
            "generate_preview_surface": True, "relative_paths": True,
            "export_textures": request.pack,  # before Blender 4.4
            "export_textures_mode": "NEW" if request.pack else "KEEP",  # since
            "convert_orientation": False, "convert_world_material": False,
            "export_custom_properties": False, "author_blender_name": False,
        }  # fmt: skip
    return {
        "use_selection": True, "object_types": {"MESH"}, "axis_forward": "-Z", "axis_up": "Y",
        "apply_scale_options": "FBX_SCALE_ALL", "bake_space_transform": True,
        "use_mesh_modifiers": False, "bake_anim": False, "add_leaf_bones": False,
        "path_mode": "COPY" if request.pack else "STRIP", "embed_textures": request.pack,
    }  # fmt: skip


def _run(operator: Any, path: Path, options: dict[str, Any]) -> None:
    known = operator.get_rna_type().properties.keys()
    path.unlink(missing_ok=True)  # so that a file there is a new one
    try:
        result = operator(filepath=str(path), **{k: v for k, v in options.items() if k in known})
    except RuntimeError as error:
        raise UsageError(
            f"{path.name} cannot be written: {str(error).strip()}", "Choose another folder."
        ) from None
    if "FINISHED" not in result or not path.is_file():
        raise ResourceError(f"{path} cannot be written.", "Check the folder's permissions.")
