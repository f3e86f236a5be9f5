# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes written by Blender's exporters."""

import contextlib
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..core.errors import ResourceError, UsageError
from ..core.files import real_path
from ..core.jobs.store.job_file import write_sidecar
from ..core.names import EXPORT_FORMATS, MESH_FORMATS, PACKABLE_FORMATS, file_stems
from ..core.scene.frames import FileFrame, file_offset
from ..core.texture.file_checks import (
    validate_for_export,
    vertex_colors,
    write_errors,
    write_mesh_ply,
)
from . import addon
from .addon import NeedsObjectMode, NeedsResult, OperatorResult
from .mesh_data import mesh_of, values_of
from .placement import placement_of
from .region_objects import matrix_of
from .scene_objects import (
    fold_specular,
    images_of,
    import_result,
    materials_of,
    set_occlusion,
    set_shading,
    shading_of,
    show_as_emission,
    start_empty,
    texture_of,
)

# -- Copies of materials for an export, with images beside the file under names of their own ------


_UNSAFE = re.compile(r"[^\w.-]+")


class MaterialCopies:
    """Copies of the materials of one exported mesh; :meth:`remove` takes them out again.

    Parameters
    ----------
    stem : str
        Name of the exported file without its suffix; prefix of the image names.
    folder : Path
        Where images are written to.
    unlit : str
        What becomes of our unlit materials: ``"keep"`` (glTF has them), ``"emission"`` or
        ``"lit"``, for formats without unlit materials, which would drop the texture.
    fold_specular : bool
        Whether the format describes reflectance by the index of refraction alone.
    """

    def __init__(self, stem: str, folder: Path, *, unlit: str, fold_specular: bool = False) -> None:
        self._stem, self._folder, self._unlit = stem, folder, unlit
        self._fold_specular = fold_specular
        self._images: dict[str, bpy.types.Image] = {}
        self._materials: list[tuple[bpy.types.Material, bpy.types.Material]] = []
        self.textures: list[str] = []
        """Names of the images written."""
        self.has_normal_map = False
        """Whether one of them is looked at."""
        self.shading: str | None = None
        """``"lit"``, ``"unlit"`` or ``"emission"``, of the last of our materials as exported."""

    def copy_of(self, material: bpy.types.Material) -> bpy.types.Material:
        """Return a copy whose images lie beside the exported file.

        Raises UsageError: an image is missing, or of a kind that cannot be written as one file.
        """
        copy = material.copy()
        self._materials.append((material, copy))
        lend_name(material, copy)
        shading = shading_of(copy)
        if shading is not None:
            self.shading = shading.lower()
            if shading == "UNLIT" and self._unlit == "lit":
                set_shading(copy, "LIT")
                self.shading = "lit"
            elif shading == "UNLIT" and self._unlit == "emission":
                show_as_emission(copy)
                self.shading = "emission"
            if self._unlit != "keep" or self.shading == "unlit":
                set_occlusion(copy, None)  # no other format, nor an unlit material, has it
            if self._fold_specular:
                fold_specular(copy)
        tree: Any = copy.node_tree
        for node in tree.nodes if tree is not None else ():
            if node.bl_idname == "ShaderNodeNormalMap" and self.shading != "unlit":
                self.has_normal_map = True
            if node.bl_idname == "ShaderNodeTexImage" and node.image is not None:
                node.image = self._image(node.image)
        return copy

    def remove(self) -> None:
        """Remove all copies from the .blend data."""
        for material, copy in reversed(self._materials):
            name = copy.name
            bpy.data.materials.remove(copy)
            if material.library is None:
                material.name = name
        for image in self._images.values():
            bpy.data.images.remove(image)
        self._materials, self._images = [], {}

    def _image(self, image: bpy.types.Image) -> bpy.types.Image:
        known = self._images.get(image.name)
        if known is not None:
            return known
        plain = Path(_UNSAFE.sub("_", image.name)).stem.split(".")[0].strip("_") or "image"
        name, count = f"{self._stem}-{plain}", 1
        while f"{name}.png" in self.textures or f"{name}.jpg" in self.textures:
            count += 1
            name = f"{self._stem}-{plain}-{count}"
        suffix = ".jpg" if _is_file(image) and image.file_format == "JPEG" else ".png"
        path = self._folder / f"{name}{suffix}"
        _write_image(image, path)
        copy = bpy.data.images.load(str(path), check_existing=False)
        copy.name = name
        copy.colorspace_settings.name = image.colorspace_settings.name
        self._images[image.name] = copy
        self.textures.append(path.name)
        return copy


def lend_name(original: bpy.types.ID, copy: bpy.types.ID) -> str:
    """Give the copy the name of the original, so that the file has it; return the name.

    After removing the copy, the caller restores the original's name.
    """
    name = original.name
    if original.library is None:  # others cannot be renamed, and do not stand in the way
        original.name = f"exported {name}"
    copy.name = name
    return name


def _is_file(image: bpy.types.Image) -> bool:
    return image.source == "FILE" and not image.is_dirty


def _write_image(image: bpy.types.Image, path: Path) -> None:
    """Write the image's own bytes if it is a file of this format, else Blender's pixels."""
    if image.source not in ("FILE", "GENERATED"):
        raise UsageError(f"Image {image.name} is not a single image.", "Use a single image file.")
    source = Path(bpy.path.abspath(image.filepath, library=image.library))
    if _is_file(image) and image.packed_file is None and not source.is_file():
        raise UsageError(
            f"The texture {source} does not exist.", "Restore it, or import the result again."
        )
    if not image.has_data and not _loads(image):
        raise UsageError(
            f"The texture {source} cannot be read.", "Restore it, or import the result again."
        )
    try:
        if not _is_file(image) or image.file_format not in ("PNG", "JPEG"):
            _save_as_png(image, path)
        elif image.packed_file is not None:
            path.write_bytes(cast(bytes, image.packed_file.data))
        elif source.resolve() != path.resolve():
            shutil.copyfile(source, path)
    except (OSError, RuntimeError) as error:
        raise ResourceError(
            f"{path} cannot be written: {error}.", "Choose another folder."
        ) from None


def _loads(image: bpy.types.Image) -> bool:
    """Return whether the image has pixels; Blender reads files on first access."""
    pixels: Any = image.pixels
    return bool(image.size[0] * image.size[1] and len(pixels) and image.has_data)


def _save_as_png(image: bpy.types.Image, path: Path) -> None:
    copy = image.copy()
    try:
        copy.file_format = "PNG"
        copy.save(filepath=str(path))
    finally:
        bpy.data.images.remove(copy)


def pixels_of(image: bpy.types.Image) -> np.ndarray:
    """Return (h, w, 3) uint8 of an sRGB image, the first row on top.

    Raises UsageError: the image cannot be read.
    """
    width, height = image.size
    if width * height == 0:
        raise UsageError(
            f"The texture {image.filepath} cannot be read.",
            "Restore it, or import the result again.",
        )
    values = np.empty(width * height * image.channels, np.float32)
    pixels: Any = image.pixels
    pixels.foreach_get(values)
    grid = values.reshape(height, width, image.channels)[::-1]
    colors = grid[..., :3] if image.channels >= 3 else np.repeat(grid[..., :1], 3, axis=2)
    return np.rint(255.0 * np.nan_to_num(colors).clip(0.0, 1.0)).astype(np.uint8)


# -- Export meshes as they are in Blender: with modifiers, edits, materials and placement ---------
#
# Each mesh is copied, transformed in double precision to the coordinates of the file, checked,
# and passed to Blender's exporter of the format (PLY to our own, which keeps doubles). The scene
# is not changed.


_OPERATORS = {
    "glb": "export_scene.gltf", "obj": "wm.obj_export", "usd": "wm.usd_export",
    "fbx": "export_scene.fbx",
}  # fmt: skip
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

    ``frame``: the parent empty of the result that ``things``, meshes and levels, belong to.
    Raises UsageError: nothing to write, an unknown format, an exporter that is missing or fails, a
    missing image, or a frame with non-uniform scale; MeshingError: a mesh has no faces or values
    that are not finite; it is not written; ResourceError: the folder cannot be written.
    """
    if request.format not in MESH_FORMATS:
        raise UsageError(
            f"{request.format!r} is not an export format.", f"Use {', '.join(MESH_FORMATS)}."
        )
    if not things:
        raise UsageError("There is no mesh to export.", "Select meshes of a result.")
    operator = _operator(request.format) if request.format in _OPERATORS else None
    world_from_scene = addon.world_from_scene(frame)
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
                result=addon.result_folder(frame), contents=contents,
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
        region, level = str(thing.get(addon.REGION, name)), int(thing.get(addon.LEVEL, 0))
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
    region, level = str(thing.get(addon.REGION, thing.name)), int(thing.get(addon.LEVEL, 0))
    data.calc_loop_triangles()
    count = len(data.loop_triangles)
    faces = values_of(data.loop_triangles, "vertices", 3, np.int32).reshape(-1, 3)
    corners = values_of(data.loop_triangles, "loops", 3, np.int32)
    layer = data.uv_layers.active
    uvs: np.ndarray | None = None
    if layer is not None:
        of_loops = values_of(layer.uv, "vector", 2, np.float32).reshape(-1, 2)
        uvs = of_loops[corners].reshape(-1, 3, 2)
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
        folded = request.format == "usd"
        copies = MaterialCopies(stem, images, unlit=kind.unlit, fold_specular=folded)
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


# -- Export a result folder as USD and FBX from an empty file, in background Blender --------------


def export_result(
    result: Path,
    requests: list[ObjectExport],
    *,
    regions: tuple[str, ...] = (),
    levels: bool = False,
    shading: str = "auto",
) -> list[Path]:
    """Write meshes of a result; the open file is closed without saving.

    Parameters
    ----------
    result : Path
        The result folder.
    requests : list of ObjectExport
        One for each format.
    regions : tuple of str
        Names; empty for all.
    levels : bool
        Whether levels of detail are written too.
    shading : str
        ``"unlit"``, or lit.

    Raises
    ------
    UsageError
        Blender has a window, or there is no such region; what :func:`export_objects` raises.
    DatasetError, ParseError
        The folder contains no valid result.
    """
    start_empty("Exporting a result")
    imported = import_result(result, bpy.context.scene)
    known = {thing[addon.REGION] for thing in imported.meshes}
    missing = sorted(set(regions) - known)
    if missing:
        raise UsageError(
            f"{result} holds no mesh {missing[0]}.", f"Use {', '.join(sorted(known))}."
        )
    for material in materials_of(imported.frame):
        set_shading(material, "UNLIT" if shading == "unlit" else "LIT")
    kinds = ("mesh", "lod") if levels else ("mesh",)
    meshes = (t for t in imported.frame.children if addon.kind_of(t) in kinds)
    things = [t for t in meshes if not regions or t[addon.REGION] in regions]
    paths = (export_objects(imported.frame, things, request) for request in requests)
    return [path for written in paths for path in written]


# -- Operators that export meshes and pack textures -----------------------------------------------


class GWRAP_OT_export_meshes(NeedsResult, NeedsObjectMode, bpy.types.Operator):
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

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        if not chosen_meshes(context):
            self.scope = "ALL"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(self, "format")
        layout.prop(self, "scope", expand=True)
        if self.scope == "ALL":
            layout.prop(self, "levels")
        layout.prop(self, "placed")
        if self.format.lower() in PACKABLE_FORMATS:
            layout.prop(self, "pack")

    def work(self, context: bpy.types.Context) -> None:
        if not self.directory:
            raise UsageError("No folder was chosen.", "Choose the folder of the exported files.")
        frame = addon.current_frame(context)
        if self.scope == "SELECTED":
            chosen = chosen_meshes(context)
            if not chosen:
                raise UsageError("No mesh of a result is selected.", "Select some, or export all.")
        else:
            kinds = addon.WITH_TEXTURE if self.levels else ("mesh", "baked")
            children = frame.children_recursive if frame is not None else ()
            chosen = [t for t in children if addon.kind_of(t) in kinds]
        chosen_format, folder = self.format.lower(), real_path(bpy.path.abspath(self.directory))
        packs = self.pack and chosen_format in PACKABLE_FORMATS
        request = ObjectExport(chosen_format, folder, self.placed, packs)
        paths = []
        frames = {t: owner for t in chosen if (owner := addon.frame_of(t)) is not None}
        for owner in dict.fromkeys(frames.values()):
            paths += export_objects(owner, [t for t in chosen if frames.get(t) == owner], request)
        self.report({"INFO"}, f"{len(paths)} files written to {request.folder}")


class GWRAP_OT_pack_images(NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.pack_images"
    bl_label = "Pack Textures"
    bl_description = "Pack the result's textures into the .blend file, or unpack them to files"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    pack: BoolProperty(name="Pack", default=True)  # type: ignore[valid-type]

    def work(self, context: bpy.types.Context) -> None:
        count = 0
        for image in images_of(addon.current_frame(context)):
            if self.pack == (image.packed_file is not None):
                continue
            there = Path(bpy.path.abspath(image.filepath)).is_file()
            if not self.pack:
                # A file that is there is the result's own, never written over.
                image.unpack(method="USE_ORIGINAL" if there else "WRITE_ORIGINAL")
            elif there:
                image.pack()
            else:
                raise UsageError(
                    f"The texture {image.filepath} does not exist.", "Import the result again."
                )
            count += 1
        self.report({"INFO"}, f"{count} textures {'packed' if self.pack else 'unpacked'}")


def chosen_meshes(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected meshes of results, with levels and lighter meshes."""
    meshes = (t for t in context.selected_objects if t.type == "MESH")
    ours = (t for t in meshes if addon.kind_of(t) in addon.WITH_TEXTURE)
    return [t for t in ours if addon.frame_of(t) is not None]


CLASSES: Final = (GWRAP_OT_export_meshes, GWRAP_OT_pack_images)
