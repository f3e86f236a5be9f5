# SPDX-License-Identifier: GPL-3.0-or-later
"""The eight scenes: what stands where, who looks at it, and which are for tests only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.regions.convex_region import Region

from . import furniture
from .geometry import Part, read_obj, scaled_to
from .rendering import Light, union_of
from .surroundings import ceiling_lamps, room_shell, studio
from .viewpoints import around_thing, inside_room

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
        vertices, faces = furniture.gourd()
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
    low, high = furniture.ROOM_LOW, furniture.ROOM_HIGH
    things = furniture.furniture(random)
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
        union_of([furniture.wall_solid(), *things]),
        _grown("region", low, high, furniture.WALL_THICKNESS),
        _grown("crop", low, high, 0.35 * furniture.WALL_THICKNESS),
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
