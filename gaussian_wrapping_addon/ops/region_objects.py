# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions as Blender objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..core.errors import UsageError
from ..core.regions.box import CUBE_CORNERS, CUBE_TRIANGLES, box_matrix, check_volume
from ..core.regions.files import region_to_json, write_region_file
from . import addon
from .mesh_data import evaluated, values_of

# -- Convex hull of any mesh in bounded time: points that cannot be corners are dropped first -----


# Points whose hull takes about a second.
MOST_CANDIDATES = 40_000
# After the first round: of more, too many would be left after the second one too.
MOST_HIDDEN = 10 * MOST_CANDIDATES
# Hulls of fewer points are computed directly.
FEW = 4_000
# Directions, one number a round, whose furthest points span the solid that hides the others.
ROUNDS = (64, 400)
# Share of the extent by which a point left out may lie outside that solid; float32 knows no better.
INSIDE_SHARE = 1e-6
_CHUNK = 8_192

Triangles = list[tuple[int, int, int]]


def convex_hull(points: np.ndarray, name: str) -> tuple[np.ndarray, Triangles]:
    """Return the convex hull of points.

    Parameters
    ----------
    points : (n, 3) float64
    name : str
        Of the object, for messages.

    Returns
    -------
    vertices : (k, 3) float64
    triangles : list of index triples

    Raises
    ------
    UsageError
        The points enclose no volume, are not finite, or too many of them may be corners.
    """
    if len(points) < 4:
        raise UsageError(f"Region {name} has {len(points)} vertices.", "Use a box or a solid.")
    if not np.isfinite(points).all():
        raise UsageError(f"Region {name} has a position that is not finite.", "Remove it.")
    middle = 0.5 * (points.min(0) + points.max(0))
    candidates = (points - middle).astype(np.float32)  # as they come from a mesh
    for count in ROUNDS:
        # The second round is for shapes that it can bring below the limit.
        if not FEW < len(candidates) <= (MOST_HIDDEN if count == ROUNDS[-1] else np.inf):
            break
        candidates = _without_hidden(candidates, count)
    if len(candidates) > MOST_CANDIDATES:
        raise UsageError(
            f"The shape of {name} is too fine for a region: {len(candidates):,} of its "
            f"{len(points):,} vertices lie on its hull or nearly so.",
            "Add a Decimate modifier, or use a box: Add Region Box > Around Selected.",
        )
    vertices, triangles = _hull(candidates)
    if not triangles:
        raise UsageError(f"Region {name} is flat.", "Give it a thickness.")
    return vertices + middle, triangles


def _without_hidden(points: np.ndarray, count: int) -> np.ndarray:
    """Return the points without those in the hull of the furthest ones in many directions."""
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(3, count)).astype(np.float32)  # lengths do not matter
    best = np.full(count, -np.inf, np.float32)
    furthest = np.zeros(count, np.int64)
    for begin in range(0, len(points), _CHUNK):
        reach = points[begin : begin + _CHUNK] @ directions  # (chunk, count)
        first = reach.argmax(0)
        top = reach[first, np.arange(count)]
        furthest = np.where(top > best, first + begin, furthest)
        best = np.maximum(top, best)
    furthest = np.unique(furthest)
    corners, triangles = _hull(points[furthest])
    if not triangles:
        return points
    sides = corners[np.array(triangles)]  # (m, 3, 3)
    normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])  # (m, 3)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    good = lengths[:, 0] > 0.0
    normals, sides = normals[good] / lengths[good], sides[good]
    inwards = ((corners.mean(0) - sides[:, 0]) * normals).sum(1) > 0.0  # either winding comes
    normals[inwards] *= -1.0
    levels = (normals * sides[:, 0]).sum(1) + INSIDE_SHARE * float(np.ptp(corners, 0).max())
    normals, levels = normals.T.astype(np.float32), levels.astype(np.float32)
    kept = np.zeros(len(points), bool)
    for begin in range(0, len(points), _CHUNK):
        part = points[begin : begin + _CHUNK]
        kept[begin : begin + _CHUNK] = (part @ normals > levels).any(1)
    kept[furthest] = True
    return points[kept]


def _hull(points: np.ndarray) -> tuple[np.ndarray, Triangles]:
    """Return Blender's convex hull, without triangles where the points are flat."""
    work = bmesh.new()
    try:
        for point in points.tolist():
            work.verts.new(point)
        bmesh.ops.convex_hull(work, input=work.verts[:], use_existing_faces=False)
        used = {vertex for face in work.faces for vertex in face.verts}
        bmesh.ops.delete(work, geom=[v for v in work.verts if v not in used], context="VERTS")
        bmesh.ops.triangulate(work, faces=work.faces[:])
        work.verts.index_update()
        vertices = np.array([v.co[:] for v in work.verts], np.float64).reshape(-1, 3)
        triangles = [tuple(v.index for v in face.verts) for face in work.faces]
    finally:
        work.free()
    return vertices, triangles  # type: ignore[return-value]


# -- Regions as Blender objects: an Empty cube for a box, a wire mesh for any other convex solid


# Share of the hull's volume by which that of a convex mesh may be off (float32 coordinates).
CONVEX_TOLERANCE = 1e-3


def matrix_of(thing: bpy.types.Object) -> np.ndarray:
    """Return the current (4, 4) float64 world matrix of an object, hidden or not."""
    evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if evaluated.is_evaluated:
        return np.array(evaluated.matrix_world, np.float64)
    # Blender does not update what is disabled in viewports: its matrix_world may be an old one.
    matrix = np.array(thing.matrix_basis, np.float64)
    if thing.parent is not None:
        matrix = matrix_of(thing.parent) @ np.array(thing.matrix_parent_inverse) @ matrix
    return matrix


def transformed(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a (4, 4) affine matrix to (n, 3) points."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def scene_from_blender(frame: bpy.types.Object | None) -> np.ndarray:
    """Return the (4, 4) matrix from Blender's world to the scene frame.

    Raises UsageError: the scale of the frame is zero.
    """
    if frame is None:
        return np.eye(4)
    try:
        inverse = np.linalg.inv(matrix_of(frame))
    except np.linalg.LinAlgError:
        inverse = np.full((4, 4), np.nan)
    if not np.isfinite(inverse).all():
        raise UsageError(f"{frame.name} has zero scale.", "Clear its scale (Alt S).")
    return inverse


def hull_in_blender(thing: bpy.types.Object) -> tuple[np.ndarray, Triangles]:
    """Return the convex hull of a region object in Blender's world.

    ``thing``: an Empty displayed as a cube, or a mesh (with its modifiers).
    Returns ``vertices``, (n, 3) float64; ``triangles``.
    Raises UsageError, MeshingError: the object is of another type, or encloses no volume.
    """
    local, triangles = local_hull(thing)
    vertices = transformed(matrix_of(thing), local)
    check_volume(vertices, thing.name)
    return vertices, triangles


def local_hull(thing: bpy.types.Object) -> tuple[np.ndarray, Triangles]:
    """Return the convex hull of a region object in its own coordinates.

    As :func:`hull_in_blender`, which also checks that it encloses a volume.
    """
    if thing.type == "EMPTY":
        if thing.empty_display_type != "CUBE":
            raise UsageError(
                f"Empty {thing.name} is not displayed as a cube.", "Set Display As to Cube."
            )
        return CUBE_CORNERS * thing.empty_display_size, list(CUBE_TRIANGLES)
    if thing.type == "MESH":
        return _mesh_hull(thing)
    raise UsageError(
        f"{thing.name} is a {thing.type.lower()}, not a region.", "Use a region box or a mesh."
    )


def _mesh_hull(thing: bpy.types.Object) -> tuple[np.ndarray, Triangles]:
    shown = evaluated(thing)
    mesh = shown.to_mesh()
    points = values_of(mesh.vertices, "co", 3, np.float32)
    shown.to_mesh_clear()
    return convex_hull(points.reshape(-1, 3).astype(np.float64), thing.name)


def is_convex(thing: bpy.types.Object) -> bool:
    """Return whether a mesh, with its modifiers, is closed and convex."""
    hull, triangles = _mesh_hull(thing)
    center = hull.mean(0)
    shown = evaluated(thing)
    mesh = shown.to_mesh()
    mesh.calc_loop_triangles()
    vertices = values_of(mesh.vertices, "co", 3, np.float32)
    corners = values_of(mesh.loop_triangles, "vertices", 3, np.int32)
    shown.to_mesh_clear()
    own = vertices.reshape(-1, 3).astype(np.float64)[corners.reshape(-1, 3)] - center  # (m, 3, 3)
    volume = abs(float(np.linalg.det(own).sum()))
    # The hull's triangles may wind either way; seen from inside, all of them count.
    whole = float(np.abs(np.linalg.det(hull[np.array(triangles)] - center)).sum())
    return abs(volume - whole) <= CONVEX_TOLERANCE * whole


def region_body(thing: bpy.types.Object, name: str = "") -> dict[str, Any]:
    """Return the bounding-volume JSON of a region object, named as the object by default.

    Its hull is in the world of the input. The way is Blender -> scene frame (the parent empty's
    matrix) -> world (its ``world_from_scene``); an object outside a result is taken to be in world
    coordinates. Raises UsageError, MeshingError: the object cannot be a region, or its frame has
    lost its coordinates.
    """
    frame = addon.frame_of(thing)
    vertices, triangles = hull_in_blender(thing)
    if frame is not None:
        vertices = transformed(scene_from_blender(frame), vertices)
        vertices = addon.world_from_scene(frame).points(vertices)
    return region_to_json(name or thing.name, vertices, triangles)


def export_region(thing: bpy.types.Object, path: Path, name: str = "") -> None:
    """Write a region object in world coordinates, in the format that the suffix names."""
    body = region_body(thing, name)
    try:
        write_region_file(
            path, body["blender_object_name"], body["vertices"], body["hull_simplices"]
        )
    except OSError as error:
        raise UsageError(
            f"{path} cannot be written: {error.strerror}.", "Choose another."
        ) from None


def create_region(
    name: str,
    vertices: np.ndarray,
    frame: bpy.types.Object | None,
    collection: bpy.types.Collection,
) -> bpy.types.Object:
    """Create a region object from (n, 3) vertices in the scene frame (of ``frame``).

    A box becomes an Empty cube, which can be moved, turned and scaled; any other solid becomes
    a mesh of its convex hull.
    """
    matrix = box_matrix(vertices)
    if matrix is not None:
        thing = bpy.data.objects.new(name, None)
        thing.empty_display_type = "CUBE"
        thing.empty_display_size = 1.0
        thing.matrix_basis = Matrix(matrix.tolist())
    else:
        center = vertices.mean(0)
        mesh = bpy.data.meshes.new(name)
        work = bmesh.new()
        try:
            for vertex in vertices - center:
                work.verts.new(vertex.tolist())
            bmesh.ops.convex_hull(work, input=work.verts[:])
            work.to_mesh(mesh)
        finally:
            work.free()
        thing = bpy.data.objects.new(name, mesh)
        thing.display_type = "WIRE"
        thing.hide_render = True
        thing.location = center.tolist()
    thing.show_in_front = True
    thing[addon.KIND] = "region"
    if frame is not None:
        thing.parent = frame
    collection.objects.link(thing)
    return thing


def box_around(things: list[bpy.types.Object], frame: bpy.types.Object | None) -> np.ndarray:
    """Return the (8, 3) corners, in the scene frame, of the box around objects.

    Raises UsageError: none of the objects has an extent.
    """
    corners = [
        transformed(matrix_of(thing), np.array(thing.bound_box, np.float64))
        for thing in things
        if thing.type in ("MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "POINTCLOUD")
    ]
    if not corners:
        raise UsageError("The selected objects have no extent.", "Select a mesh object.")
    points = transformed(scene_from_blender(frame), np.concatenate(corners))
    low, high = points.min(0), points.max(0)
    # A flat object still gets a box that encloses a volume.
    half = np.maximum(0.5 * (high - low), 0.01 * float((high - low).max()) + 1e-6)
    return 0.5 * (low + high) + half * CUBE_CORNERS


# -- A region box as a cage: its matrix for a gizmo, and the object's transform from a changed one


LEAST_HALF = 1e-3
"""Least half side of a dragged cage, scene units; smaller boxes are left as they are."""
LEAST_TOUCH = 0.25
"""Share of a side's distance from the middle at which the mouse may seem to be when it is touched;
below it, the side follows the mouse at the mouse's own pace."""


def is_editable_box(thing: bpy.types.Object | None) -> bool:
    """Return whether a cage can edit an object: a box with an unconstrained transform."""
    return (
        thing is not None
        and addon.kind_of(thing) == "region"
        and thing.type == "EMPTY"
        and thing.empty_display_type == "CUBE"
        and thing.empty_display_size > 0.0
        and thing.is_editable
        and not thing.constraints
        and not any((*thing.lock_location, *thing.lock_scale))
        and (thing.parent is None or thing.parent_type == "OBJECT")
        and _parent_matrix(thing) is not None
        and all(abs(value) > 0.0 for value in thing.scale[:])
    )


def _parent_matrix(thing: bpy.types.Object) -> np.ndarray | None:
    """Return the (4, 4) matrix from the object's parent space to Blender's world, or None."""
    matrix: np.ndarray = np.eye(4)
    if thing.parent is not None:
        matrix = matrix_of(thing.parent) @ np.array(thing.matrix_parent_inverse, np.float64)
    good = np.isfinite(matrix).all() and abs(np.linalg.det(matrix[:3, :3])) > 0.0
    return matrix if good else None


def _axes(thing: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Return the box's axes, a column each, in parent space, and half its sides: (3, 3), (3,)."""
    sides = np.array(thing.matrix_basis, np.float64)[:3, :3] * thing.empty_display_size
    halves = np.linalg.norm(sides, axis=0)
    return sides / halves, halves


def cage_frame(thing: bpy.types.Object, origin: np.ndarray) -> np.ndarray:
    """Return the (4, 4) matrix from a space along the box's axes to Blender's world.

    ``origin``: (3,) float64. Along the axes, as the translation of :func:`cage_matrix`. It must
    stay while a cage is dragged, and lie at its depth: the mouse is followed in the view's plane
    through it.
    """
    parent = _parent_matrix(thing)
    assert parent is not None  # is_editable_box
    turned = np.eye(4)
    turned[:3, :3] = _axes(thing)[0]
    turned[:3, 3] = turned[:3, :3] @ origin
    return parent @ turned


def cage_matrix(thing: bpy.types.Object) -> np.ndarray:
    """Return the (4, 4) matrix from the cube with corners at +-1 to the box along its axes."""
    axes, halves = _axes(thing)
    matrix = np.diag([*halves, 1.0])
    matrix[:3, 3] = np.linalg.solve(axes, np.array(thing.matrix_basis, np.float64)[:3, 3])
    return matrix


def set_cage_matrix(thing: bpy.types.Object, cage: np.ndarray) -> None:
    """Give a box the location and scale of a cage; its rotation and display size stay.

    A side that would come closer than ``2 * LEAST_HALF`` to the opposite one, or pass it, stops
    there.

    ``cage``: (4, 4) float64. As :func:`cage_matrix`: a scale along the axes and a translation.
    """
    if not np.isfinite(cage).all():
        return
    axes, halves = _axes(thing)
    center = cage_matrix(thing)[:3, 3]
    wanted, moved = cage.diagonal()[:3].copy(), cage[:3, 3].copy()
    least = np.minimum(LEAST_HALF, halves)
    for axis in range(3):
        if wanted[axis] >= least[axis]:
            continue
        # The side that stands still keeps its place; with neither, the middle does.
        high = abs(moved[axis] + wanted[axis] - center[axis] - halves[axis])
        low = abs(moved[axis] - wanted[axis] - center[axis] + halves[axis])
        if abs(high - low) > 1e-6 * halves[axis]:
            sign = 1.0 if high < low else -1.0
            moved[axis] = center[axis] + sign * (halves[axis] - least[axis])
        wanted[axis] = least[axis]
    thing.location = Vector(axes @ moved) - thing.delta_location
    thing.scale = np.array(thing.scale) * wanted / halves


def steadied(cage: np.ndarray, first: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return a dragged cage whose sides follow the mouse from where they were.

    Blender puts a side where the mouse is in the view's plane through the middle of the cage,
    which is not where the side is seen: at the first touch it would jump.

    ``cage``, ``first``, ``before``: (4, 4) float64. The cage as Blender wants it now, as it first
    wanted it in this drag, and as it was.
    """
    result = cage.copy()
    for axis in range(3):
        half, center = before[axis, axis], before[axis, 3]
        for sign in (-1.0, 1.0):
            was = sign * half
            touched = first[axis, 3] + sign * first[axis, axis] - center
            now = cage[axis, 3] + sign * cage[axis, axis] - center
            share = touched / was
            if LEAST_TOUCH < share < 1.0 / LEAST_TOUCH:
                now /= share
            else:  # the axis points at the eye, or nearly so
                now += was - touched
            if sign < 0.0:
                low = now
        result[axis, axis], result[axis, 3] = 0.5 * (now - low), center + 0.5 * (now + low)
    return result
