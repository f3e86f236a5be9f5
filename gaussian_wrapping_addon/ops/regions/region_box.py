# SPDX-License-Identifier: GPL-3.0-or-later
"""A region box as a cage: its matrix for a gizmo, and the object's transform from a changed one."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..common import tags
from .region_objects import matrix_of

LEAST_HALF = 1e-3
"""Least half side of a dragged cage, scene units; smaller boxes are left as they are."""
LEAST_TOUCH = 0.25
"""Share of a side's distance from the middle at which the mouse may seem to be when it is touched;
below it, the side follows the mouse at the mouse's own pace."""


def is_editable_box(thing: bpy.types.Object | None) -> bool:
    """Return whether a cage can edit an object: a box with an unconstrained transform."""
    return (
        thing is not None
        and tags.kind_of(thing) == "region"
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

    Parameters
    ----------
    origin : (3,) float64
        Along the axes, as the translation of :func:`cage_matrix`. It must stay while a cage is
        dragged, and lie at its depth: the mouse is followed in the view's plane through it.
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

    Parameters
    ----------
    cage : (4, 4) float64
        As :func:`cage_matrix`: a scale along the axes and a translation.
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

    Parameters
    ----------
    cage, first, before : (4, 4) float64
        The cage as Blender wants it now, as it first wanted it in this drag, and as it was.
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


def is_moved_only(cage: np.ndarray, before: np.ndarray) -> bool:
    """Return whether a cage has kept its size."""
    return bool(np.allclose(cage.diagonal(), before.diagonal(), rtol=1e-6))


def as_columns(matrix: np.ndarray) -> list[float]:
    """Return the 16 numbers of a matrix in the order of gizmos."""
    return [float(value) for value in matrix.T.ravel()]


def from_columns(values: object) -> np.ndarray:
    """Return the (4, 4) matrix of a gizmo's 16 numbers."""
    return np.array(values, np.float64).reshape(4, 4).T


def same_place(a: Matrix, b: Matrix) -> bool:
    """Return whether two matrices are equal up to rounding."""
    return bool(np.allclose(np.array(a), np.array(b), rtol=1e-6, atol=1e-9))
