# SPDX-License-Identifier: GPL-3.0-or-later
"""Quads along a mesh by Blender's QuadriFlow, on a copy that is gone afterwards.

QuadriFlow runs in Blender's own process and blocks it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import bpy
import numpy as np

from ...core.errors import UsageError
from ...core.mesh.topology import edge_keys, edge_lengths, faces_per_edge, half_edges
from ..common.mesh_data import build_polygons, evaluated, mesh_of, values_of
from .triangulation import Triangulation, triangulation_of

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
    counts = [len(np.unique(keys[bad])) for bad in (per_edge > 2, twice)]
    texts = (
        "more than two faces meet at {} of its edges",
        "faces point to opposite sides at {} of its edges",
    )
    found = [text.format(count) for text, count in zip(texts, counts, strict=True) if count]
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
                mode="FACES",
                target_faces=quads,
                use_mesh_symmetry=False,
                use_preserve_sharp=False,
                use_preserve_boundary=is_open,
                seed=SEED,
            )
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
