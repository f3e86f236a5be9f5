# SPDX-License-Identifier: GPL-3.0-or-later
"""The scenes: their things, surroundings and cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera

from .geometry import Part, around_thing, box, cone, icosphere, inside_room, read_obj, scaled_to
from .rendering import Light, union_of

ROOM_LOW = np.array([-2.4, -1.9, 0.0])
ROOM_HIGH = np.array([2.4, 1.9, 2.5])
"""Opposite corners of the room's free space, metres."""

WALL_THICKNESS = 0.2
"""Walls, floor and ceiling of the true solid, metres; their outer side is never seen."""

_BOOKS = ("cloth_red", "cloth_blue", "cloth_ochre", "cloth_green", "plaster")


def _table() -> list[Part]:
    parts = [box("table top", (-0.45, -0.65, 0.71), (1.05, 0.25, 0.75), "oak")]
    for k, (x, y) in enumerate([(-0.38, -0.58), (0.93, -0.58), (-0.38, 0.13), (0.93, 0.13)]):
        parts.append(box(f"table leg {k}", (x, y, -0.02), (x + 0.05, y + 0.05, 0.715), "oak"))
    vertices, faces = icosphere(4)
    ball = vertices * 0.17 + np.array([0.05, -0.2, 0.75 + 0.166])
    parts.append(Part("ball", ball, faces, "marble"))
    parts.append(box("book on table", (0.5, -0.42, 0.745), (0.72, -0.12, 0.79), "cloth_red", 18))
    return parts


def _shelf(random: np.random.Generator) -> list[Part]:
    low_x, wall_x = 2.1, ROOM_HIGH[0] + 0.02
    parts = [
        box("shelf side 0", (low_x, -0.60, -0.02), (wall_x, -0.57, 1.62), "walnut"),
        box("shelf side 1", (low_x, 0.57, -0.02), (wall_x, 0.60, 1.62), "walnut"),
    ]
    for k, z in enumerate((0.08, 0.58, 1.08, 1.57)):
        parts.append(
            box(f"shelf {k}", (low_x + 0.005, -0.58, z), (wall_x, 0.58, z + 0.03), "walnut")
        )
        y = -0.54
        while k < 3 and y < 0.38:
            thick, tall = random.uniform(0.04, 0.09), random.uniform(0.22, 0.36)
            if random.random() < 0.75:
                material = _BOOKS[int(random.integers(len(_BOOKS)))]
                low = (low_x + random.uniform(0.03, 0.07), y, z + 0.027)
                parts.append(
                    box(f"book {k} {y:.2f}", low, (wall_x - 0.06, y + thick, z + tall), material)
                )
            # A gap between books: touching covers would make a degenerate union.
            y += thick + random.uniform(0.006, 0.03)
    return parts


def _lamp() -> list[Part]:
    x, y = -1.9, 1.35
    return [
        cone("lamp foot", (x, y, -0.01), (x, y, 0.03), 0.15, 0.14, "dark_metal", 32),
        cone("lamp rod", (x, y, 0.02), (x, y, 1.50), 0.012, 0.012, "dark_metal", 12),
        cone("lamp shade", (x, y, 1.46), (x, y, 1.74), 0.22, 0.13, "linen", 40),
    ]


def _stool() -> list[Part]:
    x, y = -1.05, -1.0
    parts = [cone("stool seat", (x, y, 0.44), (x, y, 0.48), 0.18, 0.18, "oak", 40)]
    for k in range(3):
        a = 2 * np.pi * k / 3 + 0.4
        top = (x + 0.11 * np.cos(a), y + 0.11 * np.sin(a), 0.45)
        foot = (x + 0.19 * np.cos(a), y + 0.19 * np.sin(a), -0.02)
        parts.append(cone(f"stool leg {k}", foot, top, 0.016, 0.016, "dark_metal", 12))
    return parts


def _sofa() -> list[Part]:
    return [
        box("sofa seat", (-0.9, 1.1, 0.1), (0.9, 1.80, 0.42), "cloth_green"),
        box("sofa back", (-0.9, 1.62, 0.3), (0.9, 1.82, 0.85), "cloth_green"),
        box("sofa arm 0", (-1.08, 1.08, 0.1), (-0.88, 1.81, 0.6), "cloth_green"),
        box("sofa arm 1", (0.88, 1.08, 0.1), (1.08, 1.81, 0.6), "cloth_green"),
        box("cushion", (0.3, 1.35, 0.41), (0.75, 1.63, 0.72), "cloth_ochre"),
        *(
            box(f"sofa foot {k}", (x, y, -0.02), (x + 0.06, y + 0.06, 0.11), "walnut")
            for k, (x, y) in enumerate([(-1.0, 1.15), (0.94, 1.15), (-1.0, 1.7), (0.94, 1.7)])
        ),
    ]


def furniture(random: np.random.Generator) -> list[Part]:
    """Return all furniture as closed solids; metres, floor at z = 0."""
    return [
        *_table(),
        *_shelf(random),
        *_lamp(),
        *_stool(),
        *_sofa(),
        box("crate", (-2.1, -1.55, -0.02), (-1.6, -1.05, 0.5), "crate", 24),
        box("skirting", (0.9, -1.92, -0.02), (2.0, -1.86, 0.12), "plaster"),
    ]


def wall_solid() -> Part:
    """Return the room's walls: a closed shell, its inner side facing the free space."""
    inner = box("inner", ROOM_LOW, ROOM_HIGH, "plaster")
    outer = box("outer", ROOM_LOW - WALL_THICKNESS, ROOM_HIGH + WALL_THICKNESS, "plaster")
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)])
    vertices = np.concatenate([outer.vertices, inner.vertices])
    return Part("walls", vertices, faces, "plaster", smooth=False)


def gourd() -> tuple[np.ndarray, np.ndarray]:
    """Return a smooth ribbed closed body with a neck and a dimple: vertices (v, 3), faces."""
    directions, faces = icosphere(5)
    x, y, z = directions.T
    around = np.arctan2(y, x)
    equator = 1.0 - z**2  # 0 at the poles, so that the ribs end smoothly there
    radius = 0.78 + 0.06 * np.cos(7 * around) * equator**2
    radius += 0.55 * np.exp((z - 1.0) / 0.12) * (1 + 0.15 * np.cos(around))  # neck
    radius -= 0.16 * np.exp(-(z + 1.0) / 0.10)  # dimple below
    radius += 0.05 * np.sin(3 * z + 2 * x) * equator
    return directions * radius[:, None], faces


_PICTURES = {
    "west": (0.18, 0.42, 0.36, 0.80),
    "east": (0.55, 0.86, 0.40, 0.78),
    "south": (0.30, 0.68, 0.42, 0.84),
    "north": (0.12, 0.40, 0.34, 0.76),
}
"""Shares of a wall's width and height that its picture covers: left, right, bottom, top."""


def _sheet(name: str, corner: np.ndarray, right: np.ndarray, up: np.ndarray, material: str) -> Part:
    """Return one rectangle, seen from the side that ``right x up`` points to."""
    vertices = np.stack([corner, corner + right, corner + right + up, corner + up])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uvs = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float64)
    return Part(name, vertices, faces, material, uvs, surrounding=True, smooth=False)


def _wall(
    name: str, corner: np.ndarray, right: np.ndarray, up: np.ndarray, material: str, picture: str
) -> list[Part]:
    """Return a wall in nine rectangles whose middle one is the picture."""
    if not picture:
        return [_sheet(name, corner, right, up, material)]
    left, end, bottom, top = _PICTURES[name]
    across, along = (0.0, left, end, 1.0), (0.0, bottom, top, 1.0)
    return [
        _sheet(
            f"{name} {i}{j}",
            corner + across[i] * right + along[j] * up,
            (across[i + 1] - across[i]) * right,
            (along[j + 1] - along[j]) * up,
            picture if i == j == 1 else material,
        )
        for i in range(3)
        for j in range(3)
    ]


def room_shell(
    low: np.ndarray,
    high: np.ndarray,
    *,
    floor: str,
    ceiling: str,
    walls: dict[str, tuple[str, str]],
) -> list[Part]:
    """Return the inner surfaces of a room, seen from inside.

    Parameters
    ----------
    low, high : (3,) float64
        Opposite corners of the free space.
    floor, ceiling : str
        Material names.
    walls : dict
        ``west east south north`` -> (material of the wall, material of its picture or "").
    """
    x, y, z = np.diag(np.asarray(high, np.float64) - low)  # edges of the room
    lo, hi = np.array(low, np.float64), np.array(high, np.float64)
    parts = [
        _sheet("floor", lo, x, y, floor),
        _sheet("ceiling", lo + z, y, x, ceiling),
    ]
    parts += _wall("west", lo, y, z, *walls["west"])
    parts += _wall("east", hi - z, -y, z, *walls["east"])
    parts += _wall("south", lo + x, -x, z, *walls["south"])
    parts += _wall("north", lo + y, x, z, *walls["north"])
    return parts


def studio(half_width: float, floor_z: float, height: float) -> list[Part]:
    """Return the room in which single things are photographed, centred at x = y = 0."""
    low = np.array([-half_width, -half_width, floor_z])
    high = np.array([half_width, half_width, floor_z + height])
    return room_shell(
        low,
        high,
        floor="planks",
        ceiling="plaster",
        walls={
            "west": ("wallpaper_yz", "poster_a"),
            "east": ("bricks_yz", "poster_b"),
            "south": ("panels_xz", "poster_c"),
            "north": ("wallpaper_xz", "poster_d"),
        },
    )


def ceiling_lamps(ceiling_z: float) -> list[Part]:
    """Return bright panels just below a ceiling: what shiny things reflect."""
    places = {"lamp 0": (1.3, -1.0, 1.1, 0.5), "lamp 1": (-1.7, 1.4, 0.6, 0.6)}
    return [
        _sheet(
            name,
            np.array([x, y, ceiling_z - 0.03]),
            np.array([0.0, width, 0.0]),
            np.array([depth, 0.0, 0.0]),
            "lamp_panel",
        )
        for name, (x, y, width, depth) in places.items()
    ]


MESHES = Path(__file__).parents[1] / "meshes"

THING_DIAGONAL = 2.0
"""Every single thing is scaled to this diagonal of its box."""

THIN_SHARE = 0.015
"""Walls thinner than this share of the crop's diagonal count as thin."""

STUDIO_FLOOR, STUDIO_HEIGHT = -1.45, 4.2
"""Of the room around single things, whose middle is at 0."""

_STUDIO_LIGHT = Light(sun=1.15)
_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""Turns a mesh whose y axis points up so that z does."""


@dataclass(frozen=True)
class SceneKind:
    """What is known of a scene without rendering it."""

    name: str
    role: str
    """"test": reported, nothing may be tuned on it; "development"."""
    description: str
    seed: int
    samples: int = 5
    distance: float = 2.35
    """Of the cameras from the middle of a single thing."""
    derived_from: str = ""
    """Name of the scene whose photos are used, where it has none of its own."""
    exposure: bool = False
    far: bool = False


@dataclass(frozen=True)
class SceneContent:
    """Everything of a scene before it is rendered."""

    parts: tuple[Part, ...]
    truth: tuple[np.ndarray, np.ndarray]
    """Vertices (v, 3) and faces (f, 3) of the true surface, closed, outward."""
    region: Region
    crop: Region
    light: Light
    cameras: tuple[Camera, ...]
    test_cameras: tuple[Camera, ...]


KINDS = {
    kind.name: kind
    for kind in (
        SceneKind("spot", "development", "A painted cow, matte, in a studio room.", 101),
        SceneKind("wheel", "test", "A wheel with 28 thin crossing spokes, matte.", 102, 5, 2.3),
        SceneKind("cup", "test", "A thin-walled cup with a handle, matte ceramic.", 103),
        SceneKind("fence", "development", "A panel of crossing wires, matte.", 104, distance=2.15),
        SceneKind("room", "test", "A furnished room seen from inside.", 105),
        SceneKind("glossy", "test", "A glazed gourd that reflects its room.", 106, 6, 2.2),
        SceneKind(
            "spot_exposure", "development", "spot; exposure and white balance change from photo to"
            " photo.", 107, derived_from="spot", exposure=True,
        ),
        SceneKind(
            "spot_far", "development", "spot, 20 times larger, far away from the origin.", 108,
            derived_from="spot", far=True,
        ),
    )
}  # fmt: skip


def scene_kind(name: str) -> SceneKind:
    """Return the scene of this name.

    Raises
    ------
    UsageError
        There is none.
    """
    if name not in KINDS:
        raise UsageError(f"There is no scene {name!r}.", f"Choose one of {', '.join(KINDS)}.")
    return KINDS[name]


def _thing(name: str) -> Part:
    if name == "glossy":
        vertices, faces = gourd()
        return Part(name, scaled_to(vertices, THING_DIAGONAL), faces, "glaze")
    file, material = {
        "spot": ("spot.obj", "spot"),
        "wheel": ("spoked_wheel.obj", "painted_metal"),
        "cup": ("thin_cup.obj", "ceramic"),
        "fence": ("wire_fence.obj", "rusty_wire"),
    }[name]
    vertices, faces, uvs = read_obj(MESHES / file)
    if name == "spot":
        vertices = vertices @ _Y_UP.T
    if name == "wheel":
        vertices = vertices @ _Y_UP.T  # stands upright instead of lying
    return Part(name, scaled_to(vertices, THING_DIAGONAL), faces, material, uvs)


def _grown(name: str, low: np.ndarray, high: np.ndarray, margin: float) -> Region:
    return Region.box(name, low - margin, high + margin)


def _thing_content(kind: SceneKind, photos: int, tests: int, size: tuple[int, int]) -> SceneContent:
    random = np.random.default_rng(kind.seed)
    thing = _thing(kind.name)
    low, high = thing.vertices.min(0), thing.vertices.max(0)
    parts = [thing, *studio(3.6, STUDIO_FLOOR, STUDIO_HEIGHT)]
    if kind.name == "glossy":
        parts += ceiling_lamps(STUDIO_FLOOR + STUDIO_HEIGHT)
    around: Callable[[int, str], list[Camera]] = lambda count, prefix: around_thing(  # noqa: E731
        count, *size, kind.distance, random, prefix
    )
    return SceneContent(
        tuple(parts),
        (thing.vertices, thing.faces),
        _grown("region", low, high, 0.05 * THING_DIAGONAL),
        _grown("crop", low, high, 0.03 * THING_DIAGONAL),
        _STUDIO_LIGHT,
        tuple(around(photos, "photo")),
        tuple(around(tests, "test")),
    )


def _room_content(kind: SceneKind, photos: int, tests: int, size: tuple[int, int]) -> SceneContent:
    random = np.random.default_rng(kind.seed)
    low, high = ROOM_LOW, ROOM_HIGH
    things = furniture(random)
    shell = room_shell(
        low,
        high,
        floor="planks",
        ceiling="plaster",
        walls={
            "west": ("wallpaper_yz", "poster_a"),
            "east": ("limewash", ""),
            "south": ("bricks_xz", "poster_c"),
            "north": ("limewash", "poster_d"),
        },
    )
    cameras = inside_room(photos, *size, low, high, random, "photo")
    test_cameras = inside_room(tests, *size, low, high, random, "test")
    return SceneContent(
        (*things, *shell),
        union_of([wall_solid(), *things]),
        _grown("region", low, high, WALL_THICKNESS),
        _grown("crop", low, high, 0.35 * WALL_THICKNESS),
        Light(sun=1.7, direction=(0.5, 0.35, -0.8)),
        tuple(cameras),
        tuple(test_cameras),
    )


def scene_content(kind: SceneKind, photos: int, tests: int, size: tuple[int, int]) -> SceneContent:
    """Return geometry, light and cameras of a scene that has photos of its own.

    Parameters
    ----------
    size : (int, int)
        Width and height of the photos in pixels.

    Raises
    ------
    ResourceError
        The room needs bpy to unite its solids, and bpy is missing.
    """
    build = _room_content if kind.name == "room" else _thing_content
    return build(kind, photos, tests, size)
