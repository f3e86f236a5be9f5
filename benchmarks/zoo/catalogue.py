# SPDX-License-Identifier: GPL-3.0-or-later
"""The scenes of the zoo by name, and what the seed of a name draws."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.regions.shapes import Region

from ..scenes.rendering import Light
from . import places, things
from .looks import FAR, NEAR, OPEN, Content, Photography, Subject, around, sky
from .places import (
    CLOSE_UP,
    DOME,
    FORWARD,
    INSIDE,
    ORBIT,
    WALK,
    Volume,
    make_cameras,
    pixel_at_thing,
)

DEVELOPMENT, TEST = "development", "test"
PARTS = (DEVELOPMENT, TEST)
TEST_VIEWS = 6

FEW = 12
"""Photos of the scenes that have few."""

_Maker = Callable[[np.random.Generator, float, int], Subject]
_THINGS: dict[str, _Maker] = {
    "smooth": things.smooth,
    "thin": things.thin,
    "holed": things.holed,
    "vessels": things.vessels,
    "plates": things.plates,
    "foliage": things.foliage,
    "gloss": things.gloss,
}
_PLACES: dict[str, Callable[[np.random.Generator], tuple[Subject, Volume]]] = {
    "rooms": places.rooms,
    "streets": places.streets,
}
FAMILIES = (*_THINGS, *_PLACES)


@dataclass(frozen=True)
class ZooScene:
    """A scene by its name: everything else follows from the seed of the name."""

    family: str
    part: str
    number: int
    path: str
    """A way of :mod:`.places`."""
    surroundings: str = ""
    few: bool = False
    """Whether it has :data:`FEW` photos only."""

    @property
    def name(self) -> str:
        """Family, d or t, number."""
        return f"{self.family}-{self.part[0]}{self.number}"

    @property
    def variant(self) -> int:
        """Position among all of its family: test scenes go on where development scenes end."""
        before = len(_GIVEN[self.family][DEVELOPMENT]) if self.part == TEST else 0
        return before + self.number - 1

    @property
    def seed(self) -> int:
        """What everything is drawn from."""
        return int.from_bytes(hashlib.sha256(f"zoo {self.name}".encode()).digest()[:4])


_GIVEN: dict[str, dict[str, tuple[tuple[str, ...], ...]]] = {
    "smooth": {
        DEVELOPMENT: ((ORBIT, FAR), (DOME, OPEN), (ORBIT, NEAR, "few")),
        TEST: ((ORBIT, OPEN), (CLOSE_UP, FAR)),
    },
    "thin": {
        DEVELOPMENT: ((ORBIT, FAR), (CLOSE_UP, NEAR), (DOME, OPEN)),
        TEST: ((ORBIT, OPEN), (DOME, FAR)),
    },
    "holed": {
        DEVELOPMENT: ((ORBIT, OPEN), (FORWARD, FAR), (DOME, NEAR), (ORBIT, FAR)),
        TEST: ((ORBIT, FAR), (DOME, OPEN)),
    },
    "vessels": {
        DEVELOPMENT: ((DOME, NEAR), (DOME, FAR), (ORBIT, OPEN, "few")),
        TEST: ((DOME, OPEN),),
    },
    "plates": {
        DEVELOPMENT: ((ORBIT, OPEN), (CLOSE_UP, FAR), (FORWARD, NEAR)),
        TEST: ((DOME, FAR), (ORBIT, NEAR, "few")),
    },
    "foliage": {
        DEVELOPMENT: ((DOME, FAR), (ORBIT, OPEN), (ORBIT, NEAR, "few")),
        TEST: ((DOME, OPEN),),
    },
    "gloss": {
        DEVELOPMENT: ((ORBIT, NEAR), (DOME, FAR), (ORBIT, OPEN)),
        TEST: ((ORBIT, FAR),),
    },
    "rooms": {DEVELOPMENT: ((INSIDE,),) * 3, TEST: ((INSIDE,),) * 2},
    "streets": {DEVELOPMENT: ((WALK,),) * 3, TEST: ((WALK,),) * 2},
}
"""Of each family: path, surroundings and whether photos are few, so that all of them occur."""

SCENES = {
    scene.name: scene
    for scene in (
        ZooScene(family, part, number + 1, given[0], "".join(given[1:2]), few=len(given) > 2)
        for part in PARTS
        for family in FAMILIES
        for number, given in enumerate(_GIVEN[family][part])
    )
}

_SIZES = ((4, 3), (3, 2), (1, 1), (3, 4), (16, 9))
"""Ratios of width to height."""
_SHORT_SIDE_PX = 544
"""Of the largest photos."""
_PHOTOS = (24, 49)
"""Least number, and one more than the largest."""
_PIXELS = 9e6
"""Of all photos together, where more than the least number would have more: time to render."""
_GROUND_GAP = (0.08, 0.3)
"""Things hover so high: the ground stays out of their region."""
_MARGIN, _CROP_MARGIN = 0.05, 0.03
"""Of region and crop around a thing's box, as shares of its diagonal."""


def zoo_scene(name: str) -> ZooScene:
    """Return the scene of this name.

    Raises
    ------
    UsageError
        There is none.
    """
    if name not in SCENES:
        raise UsageError(f"There is no scene {name!r}.", f"Choose one of {', '.join(SCENES)}.")
    return SCENES[name]


def draw_photography(scene: ZooScene) -> Photography:
    """Draw how a scene is photographed."""
    random = np.random.default_rng([scene.seed, 1])
    long = 16 * int(random.integers(30, 51))  # 480 to 800 pixels
    photos = int(random.integers(*_PHOTOS))
    across, down = _SIZES[int(random.integers(len(_SIZES)))]
    if scene.family in _PLACES:
        across, down = max(across, down), min(across, down)
    share = min(across, down) / max(across, down)
    long = min(long, 16 * int(_SHORT_SIDE_PX / share / 16))
    short = 2 * round(long * share / 2)
    width, height = (long, short) if across >= down else (short, long)
    photos = max(_PHOTOS[0], min(photos, int(_PIXELS / (width * height))))
    return Photography(
        width=width,
        height=height,
        photos=FEW if scene.few else photos,
        path=scene.path,
        surroundings=scene.surroundings,
        exposure=bool(random.random() < 0.25),
        pose_noise_px=float(random.choice([0.0, 0.0, 0.15, 0.3, 0.5])),
        point_noise=float(random.uniform(0.3, 1.5)),
        outliers=float(random.uniform(0.005, 0.04)),
        weak_texture=float(random.uniform(1.0, 3.0)),
    )


def draw_content(scene: ZooScene) -> Content:
    """Draw everything of a scene."""
    shot = draw_photography(scene)
    random = np.random.default_rng([scene.seed, 2])
    if scene.family in _PLACES:
        subject, free = _PLACES[scene.family](random)
        parts, looks = [], {}
        if scene.path == WALK:
            dome, look = sky(random)
            parts, looks = [dome], {dome.name: look}
        solid = np.concatenate([p.vertices for p in subject.parts])
        low, high = solid.min(0), solid.max(0)
        region = Region.box("region", low - 1e-3, high + 1e-3)
        assert subject.inner is not None
        crop = Region.box("crop", *(np.array(corner) for corner in subject.inner))
    else:
        subject = _THINGS[scene.family](random, pixel_at_thing(shot), scene.variant)
        solid = np.concatenate([p.vertices for p in subject.parts])
        low, high = solid.min(0), solid.max(0)
        margin = float(np.linalg.norm(high - low))
        ground = low[2] - _MARGIN * margin - random.uniform(*_GROUND_GAP)
        free = (np.array([low[0], low[1], ground]), high)
        parts, looks = around(scene.surroundings, ground, random)
        region = Region.box("region", low - _MARGIN * margin, high + _MARGIN * margin)
        crop = Region.box("crop", low - _CROP_MARGIN * margin, high + _CROP_MARGIN * margin)
    light = Light(float(random.uniform(0.7, 1.6)), (*random.uniform(-0.8, 0.8, 2).tolist(), -0.9))
    if scene.path == WALK:
        light = Light(light.sun, (light.direction[0], 0.7, -0.8))  # from behind the photographer
    cameras = make_cameras(shot, shot.photos, free, random, tests=False)
    tests = make_cameras(shot, TEST_VIEWS, free, random, tests=True)
    return Content(
        subject, tuple(parts), {**subject.looks, **looks}, region, crop, light, shot, cameras, tests
    )
