# SPDX-License-Identifier: GPL-3.0-or-later
"""Rooms and streets of the zoo, and the paths that cameras take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gaussian_wrapping_addon.core.scene.camera import Camera

from ..scenes.geometry import PRINCIPAL_POINT, Part, box, cone, icosphere, inside_room, look_at
from . import shapes
from .looks import WEAK, Look, Photography, Subject, draw_look
from .shapes import part

THING_RADIUS = 1.0
"""Half the diagonal of every thing."""
ORBIT, DOME, CLOSE_UP, FORWARD, INSIDE, WALK = (
    "orbit", "dome", "close-up", "forward", "inside", "walk",
)  # fmt: skip
_GOLDEN = 0.618034
_ABOVE_GROUND = 0.15
"""No camera is nearer to the ground of a thing."""
_FOCAL_SHARE = 0.92
"""Of the long side, for things."""

Volume = tuple[np.ndarray, np.ndarray]
"""Opposite corners (3,): of a thing's box, of the free space of a room or street."""

Directions = Callable[[int, float, np.random.Generator], np.ndarray]


def _unit(azimuth: np.ndarray, elevation_degrees: np.ndarray) -> np.ndarray:
    lift = np.radians(elevation_degrees)
    flat = np.cos(lift)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(lift)], 1)


def _orbit(count: int, phase: float, random: np.random.Generator) -> np.ndarray:
    """Two rings, taken in turn."""
    k = np.arange(count)
    azimuth = 2 * np.pi * (k + phase + random.uniform(-0.15, 0.15, count)) / count
    lift = np.where(k % 2 == 0, 10.0, 32.0) if phase == 0 else random.uniform(5.0, 35.0, count)
    return _unit(azimuth, lift + random.uniform(-4, 4, count))


def _dome(count: int, phase: float, random: np.random.Generator) -> np.ndarray:
    """A spiral that rises from the horizon almost to the zenith, evenly over the sphere."""
    share = (np.arange(count) + 0.5) / count
    rise = np.sin(np.radians(4.0)) + share * (np.sin(np.radians(72.0)) - np.sin(np.radians(4.0)))
    azimuth = 2 * np.pi * (_GOLDEN * np.arange(count) + 0.5 * phase)
    azimuth += random.uniform(-0.1, 0.1, count)
    return _unit(azimuth, np.degrees(np.arcsin(rise)) + random.uniform(-2, 2, count))


def _forward(count: int, phase: float, random: np.random.Generator) -> np.ndarray:
    """Rows on one side, towards -y."""
    rows = 3
    k = np.arange(count)
    columns = -(-count // rows)
    across = (k // rows + 0.5 + 0.5 * phase) / columns - 0.5
    azimuth = -np.pi / 2 + np.radians(100.0) * across + random.uniform(-0.03, 0.03, count)
    lift = np.array([4.0, 18.0, 34.0])[k % rows] + random.uniform(-3, 3, count)
    return _unit(azimuth, lift)


_DIRECTIONS: dict[str, Directions] = {
    ORBIT: _orbit, DOME: _dome, CLOSE_UP: _orbit, FORWARD: _forward,
}  # fmt: skip


def _camera(name: str, pose: np.ndarray, shot: Photography, focal_share: float) -> Camera:
    focal = focal_share * max(shot.width, shot.height)
    cx, cy = PRINCIPAL_POINT[0] * shot.width, PRINCIPAL_POINT[1] * shot.height
    return Camera(name, shot.width, shot.height, focal, focal, cx, cy, pose)


def thing_distance(shot: Photography) -> float:
    """Return the distance at which a thing fills the short side of the photo."""
    share = min(shot.width, shot.height) / max(shot.width, shot.height)
    return THING_RADIUS * 0.92 * _FOCAL_SHARE / (share / 2)


def pixel_at_thing(shot: Photography) -> float:
    """Return the length at a thing's middle that one pixel covers."""
    return thing_distance(shot) / (_FOCAL_SHARE * max(shot.width, shot.height))


def _of_thing(
    shot: Photography, count: int, floor_z: float, phase: float, random: np.random.Generator,
    prefix: str,
) -> list[Camera]:  # fmt: skip
    distance = thing_distance(shot)
    cameras = []
    for k, direction in enumerate(_DIRECTIONS[shot.path](count, phase, random)):
        near = shot.path == CLOSE_UP and k % 3 > 0
        away = distance * random.uniform(0.92, 1.08) * (0.6 if near else 1.0)
        target = random.normal(size=3) * (0.25 if near else 0.05)
        center = away * direction + (0.5 * target if near else 0.0)
        center[2] = max(center[2], floor_z + _ABOVE_GROUND)
        pose = look_at(center, target, random.uniform(-3, 3))
        cameras.append(_camera(f"{prefix}_{k:03d}.png", pose, shot, _FOCAL_SHARE))
    return cameras


def _on_walk(
    shot: Photography, count: int, free: Volume, phase: float, random: np.random.Generator,
    prefix: str,
) -> list[Camera]:  # fmt: skip
    """Along a street: the façade is towards +y; there and back, looking across, ahead and back."""
    low, high = free
    cameras = []
    for k in range(count):
        share = (k + 0.5 + 0.5 * phase) / count
        x = 0.85 * (low[0] + share * (high[0] - low[0])) + random.uniform(-0.15, 0.15)
        y = low[1] + (high[1] - low[1]) * (0.15, 0.40, 0.0)[k % 3] + random.uniform(-0.2, 0.2)
        center = np.array([x, y, random.uniform(1.4, 2.0)])
        turn = (0.0, -32.0, 32.0)[k % 3]  # to the right below 0, where x grows
        outward = (share < 0.5) == (turn > 0)
        turn *= 1.0 - abs(2 * share - 1) if outward else 1.0  # nothing stands beyond the ends
        yaw = np.radians(90.0 + turn + random.uniform(-8, 8))
        pitch = np.radians((4.0, 14.0, 0.0, 9.0)[k % 4] + random.uniform(-4, 4))
        gaze = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
        pose = look_at(center, center + np.array(gaze), random.uniform(-3, 3))
        cameras.append(_camera(f"{prefix}_{k:03d}.png", pose, shot, 0.72))
    return cameras


def make_cameras(
    shot: Photography, count: int, free: Volume, random: np.random.Generator, *, tests: bool
) -> tuple[Camera, ...]:
    """Return photos, or test views that stand between them.

    Parameters
    ----------
    free : (low, high)
        Of a thing only ``low[2]`` counts, the height of the ground.
    """
    prefix, phase = ("test", 0.5) if tests else ("photo", 0.0)
    if shot.path == INSIDE:
        size = (shot.width, shot.height)
        return tuple(inside_room(count, *size, *free, random, prefix))
    make = _on_walk if shot.path == WALK else None
    if make is not None:
        return tuple(make(shot, count, free, phase, random, prefix))
    return tuple(_of_thing(shot, count, float(free[0][2]), phase, random, prefix))


WALL = 0.2
"""Thickness of walls and ground; their outer side is never seen."""
_JUDGED = 0.35
"""Share of the walls that is judged."""
_SINK = 0.012
"""So far things that touch sink into each other."""

_OBJECTS = (2.0, 5.0)
"""Scales of patterns on furniture."""


def _volume(free: Volume) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    low, high = free[0] - _JUDGED * WALL, free[1] + _JUDGED * WALL
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def rooms(random: np.random.Generator) -> tuple[Subject, Volume]:
    """Return a furnished room with plain walls and the free space in it."""
    half_x, half_y, height = random.uniform([1.9, 1.6, 2.3], [2.8, 2.2, 2.8])
    low, high = np.array([-half_x, -half_y, 0.0]), np.array([half_x, half_y, height])
    looks = {
        "walls": draw_look(random, (0.8, 1.6), patterns=(WEAK,), weak=True),
        "floor": draw_look(random, (1.0, 2.5), patterns=("grain", "bricks_xy", "speckles")),
        **{f"thing{k}": draw_look(random, _OBJECTS) for k in range(6)},
        "plain": draw_look(random, (1.0, 2.0), patterns=(WEAK,), weak=True),
    }
    xs, ys, zs = (np.array([a - WALL, a, b, b + WALL]) for a, b in zip(low, high, strict=True))
    filled = np.ones((3, 3, 3), bool)
    filled[1, 1, 1] = False
    parts = [
        # Light passes through the walls, so that the closed room is lit.
        replace(
            part("walls", shapes.blocks(xs, ys, zs, filled), "walls", smooth=False),
            surrounding=True,
        ),
        # The floor's own look lies on the shell as a board that nearly reaches the walls.
        box(
            "floor",
            (low[0] + 0.03, low[1] + 0.03, -_SINK),
            (high[0] - 0.03, high[1] - 0.03, 0.015),
            "floor",
        ),
    ]
    makers = [_table, _cupboard, _sofa, _lamp, _crates]
    places = [(-0.55, 0.62), (0.6, 0.6), (0.62, -0.55), (-0.62, -0.6), (0.0, -0.72)]
    order = random.permutation(len(makers))
    for (x, y), which in zip(places, order, strict=True):
        parts += makers[which](x * half_x, y * half_y, random)
    parts += _pictures(low, high, random)
    return Subject(tuple(parts), looks, place=True, inner=_volume((low, high))), (low, high)


def _thing(random: np.random.Generator) -> str:
    return f"thing{int(random.integers(6))}"


def _table(x: float, y: float, random: np.random.Generator) -> list[Part]:
    w, d, h = random.uniform([0.35, 0.25, 0.5], [0.6, 0.4, 0.78])
    look = _thing(random)
    parts = [box("table top", (x - w, y - d, h - 0.04), (x + w, y + d, h), look)]
    for k, (i, j) in enumerate([(-1, -1), (1, -1), (-1, 1), (1, 1)]):
        at = (x + i * (w - 0.05), y + j * (d - 0.05))
        parts.append(cone(f"table leg {k}", (*at, 0.0), (*at, h - 0.02), 0.022, 0.03, look, 12))
    vertices, faces = icosphere(3)
    radius = random.uniform(0.09, 0.16)
    ball = radius * vertices + [x - 0.4 * w, y, h + radius - _SINK]
    parts.append(part("ball", (ball, faces), _thing(random)))
    parts.append(
        box(
            "book",
            (x + 0.1 * w, y - 0.4 * d, h - _SINK),
            (x + 0.6 * w, y + 0.4 * d, h + 0.05),
            _thing(random),
            20,
        )
    )
    return parts


def _cupboard(x: float, y: float, random: np.random.Generator) -> list[Part]:
    w, d, h = random.uniform([0.35, 0.2, 0.7], [0.55, 0.3, 1.05])
    rows = int(random.integers(2, 4))
    xs = np.array([-w, -w + 0.03, w - 0.03, w]) + x
    ys = np.array([-d, d - 0.02, d]) + y
    levels = np.linspace(0.06, h, rows + 1)
    zs = np.unique(np.concatenate([[0.0], levels, levels[1:] - 0.03]))
    filled = np.ones((3, 2, len(zs) - 1), bool)
    hollow = [z in np.arange(1, len(zs) - 1, 2) for z in range(len(zs) - 1)]
    side = 0
    if y < 0:
        ys = 2 * y - ys[::-1]
        side = 1
    filled[1, side, hollow] = False
    return [
        part("cupboard", shapes.blocks(xs, ys, zs, filled), _thing(random), smooth=False),
        box(
            "on cupboard",
            (x - 0.2, y - 0.12, h - _SINK),
            (x + 0.1, y + 0.12, h + 0.15),
            _thing(random),
            25,
        ),
    ]


def _sofa(x: float, y: float, random: np.random.Generator) -> list[Part]:
    w, d = random.uniform(0.5, 0.8), 0.33
    back = np.sign(y) or -1.0
    look = _thing(random)
    b0, b1 = sorted((y + back * d, y + back * (d - 0.14)))
    return [
        box("seat", (x - w, y - d, 0.0), (x + w, y + d, random.uniform(0.36, 0.44)), look),
        box("back", (x - w + 0.01, b0 - 0.007, 0.1), (x + w - 0.01, b1 + 0.007, 0.82), look),
        box("arm", (x - w - 0.1, y - d - 0.01, 0.0), (x - w + 0.05, y + d + 0.01, 0.6), look),
        box("cushion", (x + 0.05, y - 0.15, 0.33), (x + 0.4, y + 0.12, 0.6), _thing(random), 15),
    ]


def _lamp(x: float, y: float, random: np.random.Generator) -> list[Part]:
    height = random.uniform(1.2, 1.6)
    look = _thing(random)
    return [
        cone("lamp foot", (x, y, 0.0), (x, y, 0.05), 0.16, 0.13, look, 32),
        cone("lamp rod", (x, y, 0.03), (x, y, height), 0.015, 0.015, look, 12),
        cone(
            "lamp shade",
            (x, y, height - 0.03),
            (x, y, height + 0.26),
            0.22,
            0.13,
            _thing(random),
            40,
        ),
    ]


def _crates(x: float, y: float, random: np.random.Generator) -> list[Part]:
    size = random.uniform(0.2, 0.3)
    top = 2 * size
    return [
        box("crate", (x - size, y - size, 0.0), (x + size, y + size, top), _thing(random), 15),
        box(
            "upper crate",
            (x - 0.6 * size, y - 0.5 * size, top - _SINK),
            (x + 0.5 * size, y + 0.5 * size, 1.5 * top),
            "plain",
            40,
        ),
    ]


def _pictures(low: np.ndarray, high: np.ndarray, random: np.random.Generator) -> list[Part]:
    """Return boards on two or three of the walls."""
    parts = []
    for k in range(int(random.integers(2, 4))):
        axis, sign = divmod(k, 2)
        wall = (high if sign else low)[axis]
        other = 1 - axis
        middle = random.uniform(0.45 * low[other], 0.45 * high[other])
        wide, tall = random.uniform(0.25, 0.5), random.uniform(0.2, 0.35)
        a, b = np.zeros(3), np.zeros(3)
        a[axis], b[axis] = wall - (0.03 if sign else _SINK), wall + (_SINK if sign else 0.03)
        a[other], b[other] = middle - wide, middle + wide
        a[2], b[2] = 1.45 - tall, 1.45 + tall
        parts.append(box(f"picture {k}", a.tolist(), b.tolist(), _thing(random)))
    return parts


def streets(random: np.random.Generator) -> tuple[Subject, Volume]:
    """Return facades along y = 0 with windows, ground before them, and the space of the walk."""
    long, depth = random.uniform(5.5, 7.5), random.uniform(4.5, 5.5)
    low, high = np.array([-long, -depth, 0.0]), np.array([long, 0.0, 0.0])
    houses = int(random.integers(2, 4))
    looks: dict[str, Look] = {
        "ground": draw_look(random, (1.2, 2.4), patterns=("bricks_xy", "speckles", "patches")),
        "kerb": draw_look(random, (1.0, 2.0), patterns=(WEAK,), weak=True),
        **{f"thing{k}": draw_look(random, _OBJECTS) for k in range(6)},
    }
    edges = np.linspace(-long, long, houses + 1)
    edges[1:-1] += random.uniform(-0.6, 0.6, houses - 1)
    parts = [
        box("ground", (-long - WALL, -depth - WALL, -WALL), (long + WALL, 0.3, 0.0), "ground"),
        box("kerb", (-long - 0.5 * WALL, -1.1, -0.05), (long + 0.5 * WALL, 0.25, 0.12), "kerb"),
    ]
    tops = []
    for k in range(houses):
        plain = random.random() < 0.3
        patterns = (WEAK,) if plain else ("bricks_xz", "bricks_xz", "cells", "speckles")
        looks[f"facade{k}"] = draw_look(random, (1.2, 2.4), patterns=patterns, weak=plain)
        top = random.uniform(3.4, 5.0)
        # Neighbours differ in depth, so that no two fronts lie in one plane.
        front = 0.02 + 0.12 * (k % 2)
        parts += _facade(k, edges[k] - 0.02 * k, edges[k + 1] + 0.021, front, top, random)
        tops.append(top)
    for k in range(int(random.integers(2, 5))):
        x, y = random.uniform(-0.8 * long, 0.8 * long), random.uniform(-0.9, -0.35)
        if random.random() < 0.5:
            h = random.uniform(0.5, 1.1)
            parts.append(
                box(
                    f"bin {k}",
                    (x - 0.25, y - 0.2, 0.05),
                    (x + 0.25, y + 0.2, h),
                    _thing(random),
                    20,
                )
            )
        else:
            h = random.uniform(2.2, 3.0)
            parts.append(
                cone(f"post {k}", (x, y, 0.05), (x, y, h), 0.05, 0.035, _thing(random), 16)
            )
            parts.append(
                cone(f"head {k}", (x, y, h - 0.03), (x, y, h + 0.2), 0.07, 0.15, _thing(random), 20)
            )
    high[2] = max(tops)
    inner = (
        (float(low[0]), float(-0.75 * depth), -_JUDGED * WALL),
        (float(high[0]), 0.5, float(high[2]) + 0.05),
    )
    return Subject(tuple(parts), looks, place=True, inner=inner), (low, high)


def _facade(
    number: int, left: float, right: float, front: float, top: float, random: np.random.Generator
) -> list[Part]:
    """Return a house's front with windows and a door set back, and a ledge."""
    columns, floors = max(2, round((right - left) / 1.5)), max(2, round(top / 1.7))
    step, rise = (right - left) / columns, top / floors
    wide, tall = step * random.uniform(0.4, 0.6), rise * random.uniform(0.4, 0.6)
    xs = [left, right]
    for c in range(columns):
        middle = left + (c + 0.5) * step
        xs += [middle - wide / 2, middle + wide / 2]
    zs = [-0.1, top]
    for f in range(floors):
        base = f * rise + 0.3 * (rise - tall) + 0.25
        zs += [base, base + tall * 0.9]
    planes_x, planes_z = np.array(sorted(xs)), np.array(sorted(zs))
    ys = np.array([front, front + random.uniform(0.12, 0.22), front + 0.5])
    filled = np.ones((len(planes_x) - 1, 2, len(planes_z) - 1), bool)
    filled[1::2, 0, 1::2] = False  # windows lie between the odd planes
    mesh = shapes.blocks(planes_x, ys, planes_z, filled)
    ledge = rise * 0.99
    return [
        part(f"facade {number}", mesh, f"facade{number}", smooth=False),
        box(
            f"ledge {number}",
            (left + 0.03, front - 0.09, ledge - 0.06),
            (right - 0.03, front + 0.05, ledge + 0.02),
            f"thing{number}",
        ),
    ]
