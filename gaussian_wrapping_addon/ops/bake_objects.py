# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh objects to arrays for a bake; a finished bake to UVs and materials."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bmesh
import bpy
import numpy as np

from ..core.errors import DatasetError, ParseError, UsageError
from ..core.files import read_json, reject_foreign_entries
from ..core.mesh.exchange import FileMesh
from ..core.mesh.surface_mesh import edge_keys, edge_lengths, faces_per_edge, half_edges
from ..core.mesh.textured_mesh import (
    FIRST_UDIM,
    LAST_UDIM,
    POLYGONS_FILE,
    SAME_UV,
    Polygons,
    join_triangles,
    read_polygons,
    udim_uvs,
)
from ..core.texture.file_checks import atlas_file
from . import addon
from .mesh_data import build_mesh, build_polygons, evaluated, mesh_of, values_of
from .placement import placement_of
from .region_objects import matrix_of, transformed
from .result_files import read_mesh_arrays
from .scene_objects import create_material, load_texture, set_shading, shading_of

# -- A mesh object as triangles, with its modifiers, in the world of a job's input ----------------


@dataclass(frozen=True)
class Triangulation:
    """Triangles of an evaluated mesh object."""

    vertices: np.ndarray
    """(v, 3) float64, Blender's world."""
    faces: np.ndarray
    """(f, 3) int32, counter-clockwise seen from outside, also of a mirrored object."""
    loops: np.ndarray
    """(f, 3) int32 loop of each corner."""
    polygons: np.ndarray
    """(f,) int32 polygon of each triangle."""
    corner_uvs: np.ndarray | None
    """(f, 3, 2) float32 of the active UV map; ``None`` without one."""
    is_own: bool
    """Whether these are the loops of the object's own mesh: no modifier has changed its faces."""


def triangulation_of(thing: bpy.types.Object) -> Triangulation:
    """Triangulate a mesh object as it is shown.

    Raises UsageError: it is no mesh, is not evaluated, has no faces, or has vertices that are not
    finite.
    """
    if thing.type != "MESH":
        raise UsageError(f"{thing.name} is no mesh.", "Select a mesh object.")
    mesh_of(thing).update_tag()  # scripts may have changed its layers, which tags nothing
    shown = evaluated(thing)
    mesh = shown.to_mesh()
    try:
        mesh.calc_loop_triangles()
        local = values_of(mesh.vertices, "co", 3, np.float32).reshape(-1, 3)
        triangles: Any = mesh.loop_triangles
        faces = values_of(triangles, "vertices", 3, np.int32).reshape(-1, 3)
        loops = values_of(triangles, "loops", 3, np.int32).reshape(-1, 3)
        polygons = values_of(triangles, "polygon_index", 1, np.int32)
        layer: Any = mesh.uv_layers.active
        uvs = None if layer is None else values_of(layer.uv, "vector", 2, np.float32).reshape(-1, 2)
        is_own = _same_faces(mesh, mesh_of(thing))
    finally:
        shown.to_mesh_clear()
    if len(faces) == 0:
        raise UsageError(f"{thing.name} has no faces.", "Select a mesh with faces.")
    matrix = matrix_of(thing)
    vertices = transformed(matrix, local.astype(np.float64))
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise UsageError(
            f"Vertex {int(bad[0])} of {thing.name} is not finite (as are {len(bad)} in all).",
            "Delete these vertices, or check the object's scale.",
        )
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        faces, loops = faces[:, [0, 2, 1]], loops[:, [0, 2, 1]]
    corner_uvs = None if uvs is None else uvs[loops]
    return Triangulation(vertices, faces, loops, polygons, corner_uvs, is_own)


def _same_faces(evaluated: bpy.types.Mesh, own: bpy.types.Mesh) -> bool:
    if (len(evaluated.loops), len(evaluated.polygons)) != (len(own.loops), len(own.polygons)):
        return False
    corners = [values_of(mesh.loops, "vertex_index", 1, np.int32) for mesh in (evaluated, own)]
    starts = [values_of(mesh.polygons, "loop_start", 1, np.int32) for mesh in (evaluated, own)]
    return bool(np.array_equal(corners[0], corners[1]) and np.array_equal(starts[0], starts[1]))


def world_mesh(
    frame: bpy.types.Object,
    triangles: Triangulation,
    *,
    with_uvs: bool = False,
    with_polygons: bool = False,
) -> FileMesh:
    """Return a mesh in the world of the input, wherever the result and the object stand.

    ``with_uvs``, ``with_polygons``: whether it has the UVs of the triangles, and what these are
    parts of.
    Raises UsageError: the frame has no valid transform, or has lost its world coordinates.
    """
    scene = placement_of(frame).inverse().points(triangles.vertices)
    world = addon.world_from_scene(frame).points(scene)
    polygons = Polygons(triangles.polygons.astype(np.int64), triangles.loops.astype(np.int64))
    return FileMesh(
        world, triangles.faces, triangles.corner_uvs if with_uvs else None,
        polygons if with_polygons else None,
    )  # fmt: skip


# -- Quads along a mesh by Blender's QuadriFlow, on a copy that is gone afterwards ----------------
#
# QuadriFlow runs in Blender's own process and blocks it.


_logger = logging.getLogger(__name__)

MAX_TRIANGLES = 200_000
"""Of larger meshes, QuadriFlow gets a decimated copy: its time grows with the triangles."""
TRIANGLES_PER_QUAD = 4
"""The copy keeps at least so many for each quad that is wanted."""
MEDIAN_EDGE = 10.0
"""Length to which the copy is scaled: Blender takes edges below 1e-4 for none, and refuses."""
SHORTEST_EDGE = 2e-4
"""Vertices that a shorter edge joins, as cuts leave them, become one."""
ROUNDING_SHARE = 5e-7
"""Share of the extent below which 32-bit coordinates do not tell vertices apart."""
SEED = 0
"""The same mesh gives the same quads, and so a bake of them that was made already is found."""
_MEND = (
    "In Edit Mode, recalculate its normals (Shift N) and mend what Select > All by Trait > Non "
    "Manifold shows; or remesh it (Object Data > Remesh > Voxel); or choose Decimate."
)


def quads_of(name: str, triangles: Triangulation, quads: int) -> Triangulation:
    """Return about so many quads along a mesh, as triangles that are parts of them.

    Parameters
    ----------
    name : str
        Of the object, for errors.
    triangles : Triangulation
        Finite.
    quads : int
        QuadriFlow makes up to a quarter fewer, or a few more.

    Raises
    ------
    UsageError
        QuadriFlow refuses the mesh, fails or is cancelled.
    """
    vertices, faces = _joined(triangles)
    edges = edge_lengths(vertices, faces)
    edge = float(np.median(edges)) if len(edges) else 0.0
    if edge == 0.0:
        raise UsageError(f"The faces of {name} have no area.", "Select another mesh.")
    centre, scale = vertices.mean(axis=0), MEDIAN_EDGE / edge
    vertices = (vertices - centre) * scale
    faces = _without_short_edges(vertices, faces)
    is_open = _refuse_unsound(name, vertices, faces)
    most = max(MAX_TRIANGLES, TRIANGLES_PER_QUAD * quads)
    with _lent_object(name, vertices, faces, most) as thing:
        _run(name, thing, quads, is_open=is_open)
        bpy.context.view_layer.update()
        found = triangulation_of(thing)
    return replace(found, vertices=found.vertices / scale + centre)


def _joined(triangles: Triangulation) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh without loose vertices, and those at one place joined, as bakes do."""
    used, corners = np.unique(triangles.faces, return_inverse=True)
    points, place = np.unique(triangles.vertices[used], axis=0, return_inverse=True)
    return points, _without_flat(place.ravel()[corners.reshape(-1, 3)].astype(np.int64))


def _without_flat(faces: np.ndarray) -> np.ndarray:
    """Leave out triangles with a vertex twice."""
    return np.asarray(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])


def _without_short_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    begin, end = half_edges(faces)
    reach = max(SHORTEST_EDGE, ROUNDING_SHARE * float(np.abs(vertices).max()))
    short = (np.abs(vertices[begin] - vertices[end]) <= reach).all(axis=1)
    if not short.any():
        return faces
    begin, end = begin[short], end[short]
    joined = np.arange(len(vertices))
    while (joined[begin] != joined[end]).any():
        least = np.minimum(joined[begin], joined[end])
        np.minimum.at(joined, begin, least)
        np.minimum.at(joined, end, least)
    return _without_flat(joined[faces])


def _refuse_unsound(name: str, vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Refuse with numbers what QuadriFlow refuses without; return whether the mesh is open."""
    begin, end = half_edges(faces)
    per_edge = faces_per_edge(faces, len(vertices))
    directed = begin * len(vertices) + end
    repeated = np.unique(directed, return_counts=True)
    twice = np.isin(directed, repeated[0][repeated[1] > 1]) & (per_edge == 2)
    keys = edge_keys(begin, end, len(vertices))
    problems = (
        ("more than two faces meet", per_edge > 2), ("faces point to opposite sides", twice),
    )  # fmt: skip
    found = [
        f"{text} at {len(np.unique(keys[bad]))} of its edges" for text, bad in problems if bad.any()
    ]
    if found:
        raise UsageError(f"QuadriFlow cannot work on {name}: {', '.join(found)}.", _MEND)
    return bool((per_edge == 1).any())


@contextmanager
def _lent_object(
    name: str, vertices: np.ndarray, faces: np.ndarray, most: int
) -> Iterator[bpy.types.Object]:
    """Lend an object of the scene with a mesh of about ``most`` triangles at most."""
    starts = np.arange(0, 3 * len(faces), 3)
    meshes = [build_polygons(f"{name} for QuadriFlow", vertices, faces.ravel(), starts)]
    thing = bpy.data.objects.new(meshes[0].name, meshes[0])
    try:
        bpy.context.scene.collection.objects.link(thing)
        if len(faces) > most:
            _logger.info("decimating %d triangles to %d for QuadriFlow", len(faces), most)
            modifier: Any = thing.modifiers.new("Fewer", "DECIMATE")
            modifier.ratio = most / len(faces)
            bpy.context.view_layer.update()
            meshes.append(bpy.data.meshes.new_from_object(evaluated(thing)))
            thing.modifiers.clear()
            thing.data = meshes[1]
        yield thing
    finally:
        bpy.data.objects.remove(thing)
        for mesh in meshes:
            bpy.data.meshes.remove(mesh)


def _run(name: str, thing: bpy.types.Object, quads: int, *, is_open: bool) -> None:
    before = len(mesh_of(thing).polygons)
    outcome: set[str] = set()
    try:
        with bpy.context.temp_override(active_object=thing, object=thing, selected_objects=[thing]):
            outcome = bpy.ops.object.quadriflow_remesh(
                mode="FACES", target_faces=quads, use_mesh_symmetry=False,
                use_preserve_sharp=False, use_preserve_boundary=is_open, seed=SEED,
            )  # fmt: skip
    except RuntimeError as error:  # what Blender reports as an error
        _logger.warning("QuadriFlow on %s: %s", name, error)
    sides = values_of(mesh_of(thing).polygons, "loop_total", 1, np.int32)
    # Blender only warns where it refuses a mesh, which then stays as it was.
    if outcome != {"FINISHED"} or not len(sides) or (sides != 4).any():
        raise UsageError(
            f"QuadriFlow made no quads of the {before} triangles of {name}.",
            f"Try another number of quads. {_MEND}",
        )
    _logger.info("QuadriFlow: %d quads of %d triangles of %s", len(sides), before, name)


# -- Read the files of a finished bake, ``baked/NAME``, validated before they reach Blender -------


_HINT = "Bake the photos again."


@dataclass(frozen=True)
class BakedFiles:
    """A finished bake."""

    name: str
    vertices: np.ndarray
    """(v, 3) float64, scene frame."""
    faces: np.ndarray
    """(f, 3) int32, in the order of the mesh that was handed over."""
    corner_uvs: np.ndarray
    """(f, 3, 2) float32, in UDIM tiles if there are several."""
    udims: tuple[int, ...]
    """Empty for a single texture."""
    albedo: tuple[Path, ...]
    normal_map: tuple[Path, ...]
    """The same, or empty."""
    occlusion: tuple[Path, ...]
    """The same, or empty."""
    has_own_uvs: bool
    """Whether the UVs are those of the mesh that was handed over."""
    has_own_faces: bool
    """Whether the faces are."""
    polygons: Polygons | None
    """Polygons of faces that were made for the bake; ``None`` where the object has them already."""
    coverage: float
    """Share of the texels that photos see."""
    warnings: tuple[str, ...]


def read_baked(folder: Path) -> BakedFiles:
    """Read and check a folder of a bake.

    Raises DatasetError, ParseError: a file is missing or invalid, or the folder holds links.
    """
    reject_foreign_entries(folder)
    path = folder / "mesh.npz"
    if not path.is_file():
        raise DatasetError(f"{folder} holds no mesh.npz.", _HINT)
    vertices, faces, corner_uvs, face_atlas = read_mesh_arrays(path, repair=False)
    made = folder / POLYGONS_FILE
    polygons = read_polygons(made, len(faces)) if made.is_file() else None
    figures_path = folder / "bake.json"
    values = read_json(figures_path)
    try:
        udims = tuple(int(number) for number in values["udims"])
        texture = values["texture"]
        has_own_faces = int(values["faces_given"]) == len(faces)
        has_own_uvs = texture["unwrap"] == "own"
        coverage = float(texture["coverage"])
        warnings = tuple(str(warning["text"]) for warning in texture["warnings"])
        if not all(FIRST_UDIM <= number <= LAST_UDIM for number in udims):
            raise ValueError("a UDIM number is out of range")
        atlases = 1 if face_atlas is None else int(face_atlas.max()) + 1
        if udims and len(udims) < atlases:
            raise ValueError("there are fewer tiles than textures")
    except (KeyError, TypeError, ValueError) as error:
        raise ParseError(figures_path, "whole file", f"not of a bake ({error}).", _HINT) from None
    albedo, normal_map, occlusion = (
        tuple(folder / atlas_file(name, number, udims) for number in range(max(len(udims), 1)))
        for name in ("albedo", "normal", "occlusion")
    )
    normal_map = normal_map if normal_map[0].is_file() else ()
    occlusion = occlusion if occlusion[0].is_file() else ()
    for image in (*albedo, *normal_map, *occlusion):
        if not image.is_file():
            raise DatasetError(f"{folder} holds no {image.name}.", _HINT)
    if udims:
        corner_uvs = udim_uvs(corner_uvs, face_atlas, udims)
    return BakedFiles(
        folder.name, vertices, faces, corner_uvs, udims, albedo, normal_map, occlusion, has_own_uvs,
        has_own_faces, polygons, coverage, warnings,
    )  # fmt: skip


# -- Bring a finished bake into the scene: material and UVs of the object, or an object of its own


UV_NAME = "Photos"
"""UV map made for a bake."""
MOVED_SHARE = 1e-4
"""Share of the mesh's extent by which corners may have moved since they were handed over."""
SUFFIXES = {"KEEP": "", "DECIMATE": " light", "QUADS": " quads"}
"""What the names of objects that bakes make end with, by the choice *Faces*."""


def apply_bake(
    scene: bpy.types.Scene, frame: bpy.types.Object, baked: BakedFiles, target_uid: int = 0
) -> bpy.types.Object:
    """Show a bake in a scene; return the object that shows it.

    The object gets the baked material in place of its own, and new UVs as a UV map of their own.
    Polygons that new UVs cut are divided; all others stay. A bake with fewer faces or with quads
    becomes a new object under the frame, and the dense one is hidden.

    Parameters
    ----------
    scene : Scene
    frame : Object
        Frame of the result whose photos were baked.
    baked : BakedFiles
    target_uid : int, optional
        Session uid of the object that was handed over; otherwise it is found by its tag.

    Raises
    ------
    UsageError
        The object is gone, or its faces have changed since; nothing has been changed.
    """
    thing = _target(scene, baked.name, target_uid)
    if not baked.has_own_faces or baked.polygons is not None:
        thing = _new_object(scene, frame, thing, baked)
    else:
        if thing is None:
            raise UsageError(
                f"The object that {baked.name} was baked for is not in the scene.",
                "Undo its removal and press Bake Photos again: what is baked already is used.",
            )
        if not baked.has_own_uvs:
            _set_uvs(thing, frame, baked)
        _set_material(thing, frame, baked)
        layer = mesh_of(thing).uv_layers.active
        if layer is not None:
            layer.active_render = True  # render with the UV map that photos were baked for
    thing[addon.BAKE] = baked.name
    note = f"{100 * baked.coverage:.1f} % seen by photos"
    thing[addon.BAKE_NOTE] = " ".join([f"{note}.", *baked.warnings])
    return thing


def _target(scene: bpy.types.Scene, name: str, uid: int) -> bpy.types.Object | None:
    objects = [thing for thing in scene.objects if thing.type == "MESH"]
    found = [thing for thing in objects if uid and thing.session_uid == uid]
    tagged = [t for t in objects if t.get(addon.BAKE) == name and addon.kind_of(t) != "baked"]
    return next(iter((*found, *tagged)), None)


def _new_object(
    scene: bpy.types.Scene,
    frame: bpy.types.Object,
    dense: bpy.types.Object | None,
    baked: BakedFiles,
) -> bpy.types.Object:
    known = (t for t in scene.objects if addon.kind_of(t) == "baked")
    thing = next((t for t in known if t.get(addon.BAKE) == baked.name), None)
    retopology = "DECIMATE" if baked.polygons is None else "QUADS"
    name = f"{dense.name}{SUFFIXES[retopology]}" if dense else baked.name
    if baked.polygons is None:
        mesh = build_mesh(name, baked.vertices, baked.faces, baked.corner_uvs)
    else:
        joined = join_triangles(baked.faces, baked.corner_uvs, baked.polygons)
        mesh = build_polygons(name, baked.vertices, joined.corners, joined.starts, joined.uvs)
        mesh.validate()
    if thing is None:
        thing = bpy.data.objects.new(name, mesh)
        thing[addon.KIND] = "baked"
        thing.parent = frame
        collection = frame.users_collection[0] if frame.users_collection else scene.collection
        if dense is not None and dense.users_collection:
            collection = dense.users_collection[0]
        collection.objects.link(thing)
    else:
        old, thing.data = mesh_of(thing), mesh
        if old.users == 0:
            bpy.data.meshes.remove(old)
    _set_material(thing, frame, baked)
    if dense is not None:
        _stand_in(thing, dense)
    return thing


def _stand_in(thing: bpy.types.Object, dense: bpy.types.Object) -> None:
    """Show an object and hide its dense mesh; where that was active, it is instead, selected."""
    layer = bpy.context.view_layer
    layer.update()  # or it does not have an object that was linked just now
    is_there = thing.name in layer.objects
    if is_there:
        thing.hide_set(False)
    was_active = layer.objects.active == dense and dense.mode == "OBJECT"
    dense.hide_set(True)
    dense.hide_render = True
    if was_active and is_there:
        thing.select_set(True)
        layer.objects.active = thing


def _set_uvs(thing: bpy.types.Object, frame: bpy.types.Object, baked: BakedFiles) -> None:
    triangles = triangulation_of(thing)
    _refuse_changed(thing, frame, triangles, baked)
    if mesh_of(thing).users > 1:
        thing.data = mesh_of(thing).copy()  # its other users are somewhere else
    mesh = mesh_of(thing)
    corners = triangles.loops.ravel()
    uvs = baked.corner_uvs.reshape(-1, 2)
    of_loops = np.zeros((len(mesh.loops), 2), np.float32)
    of_loops[corners] = uvs
    apart = (np.abs(of_loops[corners] - uvs) > SAME_UV).any(axis=1).reshape(-1, 3).any(axis=1)
    layer: Any = mesh.uv_layers.get(UV_NAME) or mesh.uv_layers.new(name=UV_NAME, do_init=False)
    if layer is None:
        raise UsageError(
            f"{thing.name} has as many UV maps as Blender allows.", "Remove one of them."
        )
    mesh.uv_layers.active = layer
    layer.uv.foreach_set("vector", of_loops.ravel())
    cut = np.unique(triangles.polygons[apart])
    if len(cut):
        _divide(mesh, triangles, baked.corner_uvs, cut)
    mesh.update()


def _refuse_changed(
    thing: bpy.types.Object, frame: bpy.types.Object, triangles: Triangulation, baked: BakedFiles
) -> None:
    same = triangles.is_own and triangles.faces.shape == baked.faces.shape
    if same:
        now = placement_of(frame).inverse().points(triangles.vertices)[triangles.faces]
        before = baked.vertices[baked.faces]
        extent = float(np.ptp(before.reshape(-1, 3), axis=0).max())
        # Moved, turned or scaled as a whole, it is the same mesh.
        same = _shape_differs(now, before) <= MOVED_SHARE * extent
    if not same:
        raise UsageError(
            f"{thing.name} has changed since its photos were baked.", "Press Bake Photos again."
        )


def _shape_differs(now: np.ndarray, before: np.ndarray) -> float:
    """Return how far the lengths of edges differ, in the unit of ``before``."""
    edges = [np.linalg.norm(c - np.roll(c, -1, axis=1), axis=2).ravel() for c in (now, before)]
    scale = float(edges[1].sum() / max(edges[0].sum(), 1e-300))
    return float(np.abs(scale * edges[0] - edges[1]).max())


def _divide(
    mesh: bpy.types.Mesh, triangles: Triangulation, corner_uvs: np.ndarray, cut: np.ndarray
) -> None:
    """Divide polygons into their triangles, whose corners have UVs of their own."""
    work = bmesh.new()
    try:
        work.from_mesh(mesh)
        work.faces.ensure_lookup_table()
        layers: Any = work.loops.layers.uv
        layer = layers[UV_NAME]
        rows = np.flatnonzero(np.isin(triangles.polygons, cut))
        first = {int(p): int(mesh.polygons[int(p)].loop_start) for p in cut}
        old = {int(p): work.faces[int(p)] for p in cut}
        for row in rows.tolist():
            polygon = int(triangles.polygons[row])
            face = old[polygon]
            loops = [face.loops[int(k) - first[polygon]] for k in triangles.loops[row]]
            try:
                new = work.faces.new([loop.vert for loop in loops], face)
            except ValueError:
                continue  # Blender has this triangle already: a face folded onto itself
            for loop, before, uv in zip(new.loops, loops, corner_uvs[row], strict=True):
                _copy_layers(work.loops.layers, before, loop)
                loop[layer].uv = uv.tolist()
        bmesh.ops.delete(work, geom=list(old.values()), context="FACES_ONLY")
        work.to_mesh(mesh)
    finally:
        work.free()


def _copy_layers(layers: Any, source: Any, target: Any) -> None:
    """Copy a corner's UVs, colours and attributes; ``BMLoop.copy_from`` breaks in Blender 4.3."""
    for layer in layers.uv.values():
        target[layer].uv = source[layer].uv
    for kind in ("color", "float_color", "float", "float_vector", "int", "bool", "string"):
        for layer in getattr(layers, kind).values() if hasattr(layers, kind) else ():
            target[layer] = source[layer]


def _set_material(thing: bpy.types.Object, frame: bpy.types.Object, baked: BakedFiles) -> None:
    image = _load(baked.albedo, baked.udims, "sRGB")
    normal = _load(baked.normal_map, baked.udims, "Non-Color") if baked.normal_map else None
    dark = _load(baked.occlusion, baked.udims, "Non-Color") if baked.occlusion else None
    mesh = mesh_of(thing)
    if mesh.users > 1:
        thing.data = mesh = mesh.copy()
    material = create_material(f"{thing.name} photos", image, normal, dark)
    set_shading(material, _shading(frame))
    mesh.materials.clear()
    mesh.materials.append(material)
    polygons: Any = mesh.polygons
    polygons.foreach_set("material_index", np.zeros(len(mesh.polygons), np.int32))
    for slot in thing.material_slots:
        slot.link = "DATA"


def _shading(frame: bpy.types.Object) -> str:
    """Return how the result's own meshes are shaded, so that both look alike."""
    for child in frame.children:
        for slot in child.material_slots if addon.kind_of(child) == "mesh" else ():
            shading = shading_of(slot.material)
            if shading is not None:
                return shading
    return "LIT"


def _load(paths: Sequence[Path], udims: Sequence[int], colorspace: str) -> bpy.types.Image:
    if not udims:
        return load_texture(paths[0], colorspace)
    pattern = str(paths[0]).replace(f".{udims[0]}.", ".<UDIM>.")
    known = (i for i in bpy.data.images if i.source == "TILED" and i.filepath == pattern)
    image = next(known, None) or bpy.data.images.load(str(paths[0]), check_existing=False)
    image.source = "TILED"
    image.filepath = pattern
    image.name = Path(pattern).name
    tiles: Any = image.tiles
    tiles[0].number = udims[0]
    there = {tile.number for tile in tiles}
    for number in udims:
        if number not in there:
            tiles.new(tile_number=number)
    for tile in list(tiles):
        if tile.number not in udims:
            tiles.remove(tile)
    image.reload()
    settings: Any = image.colorspace_settings
    settings.name = colorspace
    return image
